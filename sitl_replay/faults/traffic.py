"""Application of the requested faults to a stream of frames. Pure.

Time is seconds since the start of the stream. The faults of senders (``Senders``) come first and
are the same on every link. Then each link applies its faults with its own random streams
(``Network``): loss and duplication, then delays, then corruption. The same faults, seed and frames
give the same bytes at the same times.
"""

import heapq
import math
import random
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

from sitl_replay.faults.asked import Fault, FaultError, Sender, in_order
from sitl_replay.faults.content import (
    Compass,
    ContentFault,
    Drift,
    Frozen,
    Glitch,
    Reboot,
    Spoof,
    sender_of,
)
from sitl_replay.faults.link import (
    BitErrors,
    Burst,
    Delay,
    Duplication,
    Garbage,
    Jitter,
    LinkFault,
    Loss,
    Reordering,
    Truncation,
)

HELD_MAX: Final = 100_000  # maximum of delayed frames over all links; further ones are lost
OVERFLOW: Final = "overflow"  # name under which these are counted
CONTENT: Final = frozenset(("drift", "reboot", "frozen", "glitch", "spoof", "compass"))
"""Names of the faults that apply to senders."""


class Senders:
    """Stage that applies the faults of senders to all frames, in the order of sending.

    ``touched`` counts the frames changed by each fault.
    """

    def __init__(self, faults: Sequence[Fault], seed: int, touched: Counter[str]) -> None:
        chosen = [fault for fault in in_order(faults) if fault.name in CONTENT]
        self._faults = [(fault, _content(fault, seed)) for fault in chosen]
        self._touched = touched
        touched.update({str(fault): 0 for fault in chosen})

    def altered(self, t_s: float, raw: bytes) -> bytes:
        """Return a frame as its sender sends it at ``t_s``, with the faults."""
        for fault, effect in self._faults:
            if fault.concerns(sender_of(raw), t_s):
                before, raw = raw, effect(t_s, raw)
                self._touched[str(fault)] += raw is not before
        return raw


class Delivery(NamedTuple):
    """Bytes that leave a link at a time. ``place`` is the order among equal times."""

    t_s: float
    place: int
    link: int
    raw: bytes


class Network:
    """Stage that applies the faults of each link to all frames, in the order of sending.

    ``touched`` counts, over all links, the frames that each fault has lost, duplicated, delayed or
    corrupted. Times must not decrease.
    """

    def __init__(
        self, *, faults: Sequence[Fault], links: int, seed: int, touched: Counter[str]
    ) -> None:
        chosen = [fault for fault in in_order(faults) if fault.name not in CONTENT]
        self._links = [_Link(chosen, f"{seed} {link}", touched) for link in range(links)]
        self._touched = touched
        self._held: list[Delivery] = []
        self._count = 0
        touched.update({str(fault): 0 for fault in chosen})

    def take(self, t_s: float, raw: bytes) -> None:
        """Send a frame over all links at ``t_s``."""
        for number, link in enumerate(self._links):
            for released_s, arriving in link.carry(t_s, raw):
                if len(self._held) >= HELD_MAX:
                    self._touched[OVERFLOW] += 1
                    continue
                self._count += 1
                heapq.heappush(
                    self._held,
                    Delivery(t_s=released_s, place=self._count, link=number, raw=arriving),
                )

    def due(self, until_s: float = math.inf) -> Iterator[Delivery]:
        """Remove and yield the bytes that arrive up to and including ``until_s``, by time."""
        while self._held and self._held[0].t_s <= until_s:
            yield heapq.heappop(self._held)


class _Link:
    """Faults of one link, by stage."""

    def __init__(self, faults: Sequence[Fault], seed: str, touched: Counter[str]) -> None:
        effects = [(fault, _on_link(fault, random.Random(f"{seed} {fault}"))) for fault in faults]
        self._touched = touched
        self._loss = [(f, e) for f, e in effects if isinstance(e, Loss)]
        self._doubling = [(f, e) for f, e in effects if isinstance(e, Duplication)]
        self._timing = [
            (f, e) for f, e in effects if isinstance(e, Delay | Jitter | Burst | Reordering)
        ]
        self._damage = [(f, e) for f, e in effects if isinstance(e, BitErrors | Truncation)]
        self._garbage = [(f, e) for f, e in effects if isinstance(e, Garbage)]

    def carry(self, now_s: float, raw: bytes) -> Iterator[tuple[float, bytes]]:
        """Return what arrives of a frame sent at ``now_s``, with the times of arrival."""
        sender = sender_of(raw)
        for fault, loss in self._loss:
            if fault.concerns(sender, now_s) and loss.loses():
                self._touched[str(fault)] += 1
                return
        times_s = [self._released_s(now_s, sender)]
        for fault, doubling in self._doubling:
            if fault.concerns(sender, now_s) and (lag_s := doubling.lag_s()) is not None:
                self._touched[str(fault)] += 1
                times_s.append(times_s[0] + lag_s)
        for t_s in times_s:
            yield from ((t_s, piece) for piece in self._damaged(raw, sender, now_s))

    def _released_s(self, now_s: float, sender: Sender) -> float:
        t_s = now_s
        for fault, timing in self._timing:
            if fault.concerns(sender, now_s):
                before_s, t_s = t_s, timing.release_s(now_s, t_s, sender)
                self._touched[str(fault)] += t_s > before_s
        return t_s

    def _damaged(self, raw: bytes, sender: Sender, now_s: float) -> Iterator[bytes]:
        for fault, garbage in self._garbage:
            if fault.concerns(sender, now_s) and (noise := garbage.noise()):
                self._touched[str(fault)] += 1
                yield noise
        for fault, damage in self._damage:
            if fault.concerns(sender, now_s):
                before, raw = raw, damage.damaged(raw)
                self._touched[str(fault)] += raw != before
        yield raw


def _content(fault: Fault, seed: int) -> ContentFault:
    match fault.name, fault.values:
        case "drift", (ppm,):
            return Drift(ppm)
        case "reboot", (at_s,):
            return Reboot(at_s)
        case "frozen", (at_s, lasts_s):
            return Frozen(at_s, lasts_s)
        case "glitch", (at_s, metres, reports):
            return Glitch(
                at_s=at_s, metres=metres, reports=int(reports), seed=f"{seed} {fault} {at_s}"
            )
        case "spoof", (at_s, speed_mps, course_deg):
            return Spoof(at_s, speed_mps, course_deg)
        case "compass", (error_deg, at_s):
            return Compass(error_deg, at_s)
    raise FaultError(f"{fault} with {len(fault.values)} numbers is not a fault of senders")


_RANDOM_FAULTS: Final[dict[str, Callable[..., LinkFault]]] = {
    "loss": Loss,
    "duplication": Duplication,
    "jitter": Jitter,
    "burst": Burst,
    "reordering": Reordering,
    "bit-errors": BitErrors,
    "truncation": Truncation,
    "garbage": Garbage,
}


def _on_link(fault: Fault, rng: random.Random) -> LinkFault:
    if fault.name == "delay":
        return Delay(*fault.values)
    return _RANDOM_FAULTS[fault.name](rng, *fault.values)
