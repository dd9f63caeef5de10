"""One id from two peers at once: whether they tell of one vehicle, or contradict each other.

A vehicle may be heard over any number of peers. A router brings the same reports over each, a
second telemetry port has stamps of its own, and a radio that starts again has another address:
all of them lie on one path. With two reports of one peer, dt apart, a report of another peer whose
stamp lies between them is off the straight line between these two by at most

    a dt^2 / 8    in position, and    a dt / 2    in velocity,

where a is the greatest acceleration, but for what one vehicle may say differently of itself:
``SLACK_M``, the noise that is taken for possible in any report, and ``STALE_S`` of the way flown.
A report that is further off contradicts the other peer. One or two do so where an autopilot resets
its position; ``CONTRADICTIONS`` within ``KEPT_NS`` are two senders, and neither is believed until
they have agreed for that long. The path is not what boot clocks are judged by (``clock/epochs.py``)
nor what can be flown (``tracking/gate.py``): this holds one who copies the clock and stays near.

Peers that the settings name as routers are believed, whoever else contradicts them.
"""

import math
import struct
from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final, NamedTuple

from companion.mavlink.wire.decode import ATTITUDE, GLOBAL_POSITION_INT, unpack
from companion.values import Frame, Vector

REFUSED: Final = frozenset((ATTITUDE, GLOBAL_POSITION_INT))
"""Messages of which none is believed while two peers contradict each other."""
CONTRADICTIONS: Final = 5
SPACED_NS: Final = 500_000_000
"""Time within which contradictions count as one: a position that is reset makes a few."""
KEPT_NS: Final = 30_000_000_000
"""How long a peer and a contradiction are remembered."""
SLACK_M: Final = 3.0
STALE_S: Final = 0.1
SLACK_MPS: Final = 1.0
ACCELERATION_MPS2: Final = 20.0
STRETCH_MS: Final = 2000
"""Longest time between two reports of a peer that another one is held against."""
RESTARTED_MS: Final = 10_000
"""A stamp that steps back so far is of another boot."""

SENDERS_MAX: Final = 4096
"""Senders followed; who was there before is not given up for who is new."""
PEERS_MAX: Final = 4
"""Peers followed of one sender, the last heard."""
REPORTS_KEPT: Final = 32
"""Newest reports kept of a peer."""

_REPORT = struct.Struct("<Iiiiihhh")
_METRES: Final = 111_195.0 * 1e-7
"""Metres in 1e-7 degrees of latitude."""


class _Said(NamedTuple):
    """A report: boot ms; latitude and longitude, 1e-7 deg; height, m; velocity in NED, m/s."""

    boot_ms: int
    lat: int
    lon: int
    alt_m: float
    velocity_mps: Vector


@dataclass(slots=True)
class _Path:
    """What one peer says of a sender; ``is_router``: the settings say that it is believed."""

    is_router: bool
    heard_ns: int
    reports: deque[_Said] = field(default_factory=lambda: deque(maxlen=REPORTS_KEPT))


@dataclass(slots=True, kw_only=True)
class _Sender:
    """A sender by its peers, and when they contradicted each other; ``told`` while it is known."""

    heard_ns: int
    paths: dict[str, _Path] = field(default_factory=dict)
    contradicted_ns: deque[int] = field(default_factory=lambda: deque(maxlen=CONTRADICTIONS))
    told: bool = False


class Twins:
    """Judges the frames of all links by who brought them.

    ``routers`` names peers that are believed: a link as in the settings, HOST or HOST:PORT.
    ``told`` holds what is new for the operator: a source's id, and the peers that bring it.
    """

    def __init__(self, routers: Collection[str] = ()) -> None:
        self.told: list[tuple[str, tuple[str, ...]]] = []
        self._routers = frozenset(routers)
        self._senders: dict[tuple[int, int], _Sender] = {}

    def refuses(self, link: str, peer: str, frame: Frame) -> bool:
        """Take in a frame of one of ``REFUSED``. Returns whether it is not to be believed.

        ``link`` is the link as it stands in the settings, ``peer`` the peer's HOST:PORT, or the
        link again where it has but one peer.
        """
        sender = self._senders.get(frame.source)
        if sender is None:
            sender = self._follow(frame)
            if sender is None:
                return False
        sender.heard_ns = frame.t_ns
        path = sender.paths.get(peer)
        if path is None:
            path = self._meet(sender, link, peer, frame.t_ns)
        path.heard_ns = frame.t_ns
        if len(sender.paths) == 1:
            return False
        if frame.msgid == GLOBAL_POSITION_INT and self._contradicts(sender, path, _said(frame)):
            when = sender.contradicted_ns
            if not when or frame.t_ns - when[-1] >= SPACED_NS:
                when.append(frame.t_ns)
        return self._are_two(frame, sender) and not path.is_router

    def _follow(self, frame: Frame) -> _Sender | None:
        """Begin to follow a sender; None where there is no room for one that is new."""
        if len(self._senders) >= SENDERS_MAX:
            before_ns = frame.t_ns - KEPT_NS
            self._senders = {k: v for k, v in self._senders.items() if v.heard_ns >= before_ns}
            if len(self._senders) >= SENDERS_MAX:
                return None
        return self._senders.setdefault(frame.source, _Sender(heard_ns=frame.t_ns))

    def _meet(self, sender: _Sender, link: str, peer: str, t_ns: int) -> _Path:
        """Begin to follow a peer of a sender; those that are silent are forgotten."""
        paths = sender.paths
        for name in [name for name, path in paths.items() if t_ns - path.heard_ns > KEPT_NS]:
            del paths[name]
        if len(paths) >= PEERS_MAX:
            strangers = [name for name, path in paths.items() if not path.is_router]
            del paths[min(strangers or paths, key=lambda name: paths[name].heard_ns)]
        known = {link, peer, peer.rpartition(":")[0].strip("[]")}
        return paths.setdefault(peer, _Path(not known.isdisjoint(self._routers), t_ns))

    def _contradicts(self, sender: _Sender, path: _Path, said: _Said) -> bool:
        """Add a report to its path. Returns whether that shows two senders.

        It is held against the stretches of other peers, and their reports against the stretch that
        it ends.
        """
        before = path.reports[-1] if path.reports else None
        if before is not None and said.boot_ms <= before.boot_ms:
            if before.boot_ms - said.boot_ms > RESTARTED_MS:
                path.reports.clear()
            return False
        path.reports.append(said)
        for other in sender.paths.values():
            if other is path or (other.is_router and path.is_router):
                continue
            if any(_is_off(said, *stretch) for stretch in _around(other.reports, said.boot_ms)):
                return True
            if before is not None and any(
                _is_off(q, before, said) for q in _within(other.reports, before, said)
            ):
                return True
        return False

    def _are_two(self, frame: Frame, sender: _Sender) -> bool:
        """Whether the peers of a sender contradict each other, which is told once."""
        when = sender.contradicted_ns
        while when and frame.t_ns - when[0] > KEPT_NS:
            when.popleft()
        if sender.told:
            sender.told = bool(when)
        elif len(when) >= CONTRADICTIONS:
            sender.told = True
            self.told.append((str(frame.source), tuple(sender.paths)))
        return sender.told


def _around(reports: deque[_Said], boot_ms: int) -> Iterator[tuple[_Said, _Said]]:
    """The stretches of a path in which a stamp lies, the newest first: one, or two that meet."""
    for last, first in pairwise(reversed(reports)):
        if boot_ms > last.boot_ms:
            return
        if first.boot_ms <= boot_ms:
            yield first, last


def _within(reports: deque[_Said], first: _Said, last: _Said) -> Iterator[_Said]:
    """The reports of a path whose stamps lie between those of two others, the newest first."""
    for one in reversed(reports):
        if one.boot_ms < first.boot_ms:
            return
        if one.boot_ms <= last.boot_ms:
            yield one


def _said(frame: Frame) -> _Said:
    boot_ms, lat, lon, alt_mm, _, north, east, down = unpack(frame, _REPORT)
    return _Said(
        boot_ms=boot_ms,
        lat=lat,
        lon=lon,
        alt_m=alt_mm * 1e-3,
        velocity_mps=(north * 1e-2, east * 1e-2, down * 1e-2),
    )


def _is_off(said: _Said, first: _Said, last: _Said) -> bool:
    """Whether a report whose stamp is between two others cannot be of who made these."""
    stretch_ms = last.boot_ms - first.boot_ms
    if stretch_ms > STRETCH_MS:
        return False
    share, dt_s = (said.boot_ms - first.boot_ms) / stretch_ms, stretch_ms * 1e-3
    between = [one + share * (two - one) for one, two in _pairs(first, last)]
    fastest_mps = max(math.hypot(*one.velocity_mps) for one in (said, first, last))
    limit_m = SLACK_M + STALE_S * fastest_mps + ACCELERATION_MPS2 * dt_s**2 / 8
    east = _METRES * math.cos(math.radians(said.lat * 1e-7))
    scales = (_METRES, east, 1.0)
    here = (said.lat, said.lon, said.alt_m)
    off_m = math.hypot(*(s * (a - b) for s, a, b in zip(scales, here, between, strict=False)))
    if off_m > limit_m:
        return True
    off_mps = math.dist(said.velocity_mps, between[3:])
    return off_mps > SLACK_MPS + ACCELERATION_MPS2 * dt_s / 2


def _pairs(first: _Said, last: _Said) -> Iterator[tuple[float, float]]:
    """Positions and velocities of two reports, component by component."""
    yield (first.lat, last.lat)
    yield (first.lon, last.lon)
    yield (first.alt_m, last.alt_m)
    yield from zip(first.velocity_mps, last.velocity_mps, strict=True)
