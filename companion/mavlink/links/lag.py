"""Waits caused by this machine: from the arrival of data to its processing.

Two waits are measured: of datagrams, from the kernel's time stamp to their processing, and of the
event loop, which reads nothing while it is held up. The worst wait of each tenth of a second is
kept, so that a burst counts no more than a quiet time, and a datagram costs one comparison.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from math import ceil
from typing import Annotated, Final

from companion.values.described import Meaning

SLOT_NS: Final = 100_000_000  # interval of which the worst wait is kept
KEPT_NS: Final = 10_000_000_000  # window of waits
LIMIT_NS: Final = 500_000_000
"""Wait above which the machine counts as behind: beams were aimed by outdated reports."""
REPEATED_NS: Final = 250_000_000
"""Wait above which the machine counts as behind if it repeats."""
APART_NS: Final = 400_000_000  # least time between two waits of which the second is a repetition
CAUGHT_UP_AFTER_NS: Final = 2_000_000_000
"""Time without such a wait after which the machine has caught up."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LagSeen:
    """How long frames waited for this machine in the last ten seconds; null without time stamps."""

    newest_s: Annotated[float | None, Meaning("wait of the newest datagram")]
    p95_s: Annotated[
        float | None, Meaning("95th percentile of the longest waits of each tenth of a second")
    ]
    max_s: Annotated[float | None, Meaning("longest wait")]
    behind: Annotated[
        bool,
        Meaning(
            "whether a frame, or the event loop, waited for more than 0.5 s, or repeatedly for "
            "more than 0.25 s, in the last 2 s"
        ),
    ]
    longest_s: Annotated[
        float, Meaning("longest wait of a frame or of the event loop in the last 2 s")
    ] = 0.0


class _Worst:
    """Worst wait of each tenth of a second, with the time at which the tenth began."""

    def __init__(self) -> None:
        self._slots: deque[list[int]] = deque([[0, 0]], KEPT_NS // SLOT_NS + 1)

    def add(self, now_ns: int, wait_ns: int) -> None:
        newest = self._slots[-1]
        if now_ns - newest[0] >= SLOT_NS:
            self._slots.append([now_ns, wait_ns])
        elif wait_ns > newest[1]:
            newest[1] = wait_ns

    def after(self, t_ns: int) -> list[tuple[int, int]]:
        return [(at, worst) for at, worst in self._slots if at > max(0, t_ns)]


class ArrivalLag:
    """Waits of the stamped datagrams of all links, and of the event loop. Times do not decrease."""

    def __init__(self) -> None:
        self._newest = (0, 0)  # time, wait
        self._datagrams = _Worst()
        self._loop = _Worst()

    def observe(self, now_ns: int, lag_ns: int) -> None:
        """Record the wait of a datagram that is being processed now."""
        self._newest = (now_ns, lag_ns)
        self._datagrams.add(now_ns, lag_ns)

    def held_up(self, now_ns: int, late_ns: int) -> None:
        """Record that the event loop resumes now, ``late_ns`` after scheduled work was due."""
        self._loop.add(now_ns, late_ns)

    def waiting_ns(self, now_ns: int) -> int:
        """Return how long datagrams may have to wait now: as long as the newest one."""
        at_ns, lag_ns = self._newest
        return lag_ns if now_ns - at_ns <= SLOT_NS else 0

    def seen(self, now_ns: int) -> LagSeen:
        """Return the waits of the last ten seconds."""
        after_ns = now_ns - CAUGHT_UP_AFTER_NS
        late = sorted((*self._datagrams.after(after_ns), *self._loop.after(after_ns)))
        behind = _is_behind(late)
        longest_s = max((wait for _, wait in late), default=0) * 1e-9
        recent = self._datagrams.after(now_ns - KEPT_NS)
        if not recent:
            return LagSeen(
                newest_s=None, p95_s=None, max_s=None, behind=behind, longest_s=longest_s
            )
        ordered = sorted(worst for _, worst in recent)
        p95_ns = ordered[ceil(0.95 * len(ordered)) - 1]
        return LagSeen(
            newest_s=self._newest[1] * 1e-9,
            p95_s=p95_ns * 1e-9,
            max_s=ordered[-1] * 1e-9,
            behind=behind,
            longest_s=longest_s,
        )


def _is_behind(waits: Iterable[tuple[int, int]]) -> bool:
    first_ns: int | None = None
    for at_ns, wait_ns in waits:
        if wait_ns > LIMIT_NS:
            return True
        if wait_ns > REPEATED_NS:
            if first_ns is not None and at_ns - first_ns >= APART_NS:
                return True
            first_ns = at_ns if first_ns is None else first_ns
    return False
