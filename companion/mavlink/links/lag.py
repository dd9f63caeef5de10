"""Processing lag of this machine: from a datagram's kernel time stamp to its processing.

The worst lag of each tenth of a second is kept, so that a burst counts no more than a quiet time,
and a datagram costs one comparison.
"""

from collections import deque
from dataclasses import dataclass
from math import ceil
from typing import Annotated, Final

from companion.values.described import Meaning

SLOT_NS: Final = 100_000_000  # interval of which the worst lag is kept
KEPT_NS: Final = 10_000_000_000  # window of lags
LIMIT_NS: Final = 500_000_000  # lag above which beams are aimed by outdated reports
BEHIND_AFTER_NS: Final = 1_000_000_000
"""Time over which every lag must exceed the limit before the machine counts as behind."""
CAUGHT_UP_AFTER_NS: Final = 2_000_000_000
"""Time without a lag above the limit after which the machine has caught up."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LagSeen:
    """How long frames waited for this machine in the last ten seconds; null without time stamps."""

    newest_s: Annotated[float | None, Meaning("wait of the newest datagram")]
    p95_s: Annotated[
        float | None, Meaning("95th percentile of the longest waits of each tenth of a second")
    ]
    max_s: Annotated[float | None, Meaning("longest wait")]
    behind: Annotated[
        bool, Meaning("whether waits exceeded 0.5 s for 1 s; true until none exceeds 0.5 s for 2 s")
    ]


class ArrivalLag:
    """Processing lags of the stamped datagrams of all links. Times do not decrease."""

    def __init__(self) -> None:
        self._newest_ns = 0
        self._slots: deque[list[int]] = deque([[0, 0]], KEPT_NS // SLOT_NS + 1)  # when, worst lag

    def observe(self, now_ns: int, lag_ns: int) -> None:
        """Record the lag of a datagram that is being processed now."""
        self._newest_ns = lag_ns
        newest = self._slots[-1]
        if now_ns - newest[0] >= SLOT_NS:
            self._slots.append([now_ns, lag_ns])
        elif lag_ns > newest[1]:
            newest[1] = lag_ns

    def seen(self, now_ns: int) -> LagSeen:
        """Return the lags of the last ten seconds."""
        recent = [(at, worst) for at, worst in self._slots if at > max(0, now_ns - KEPT_NS)]
        if not recent:
            return LagSeen(newest_s=None, p95_s=None, max_s=None, behind=False)
        ordered = sorted(worst for _, worst in recent)
        p95_ns = ordered[ceil(0.95 * len(ordered)) - 1]
        return LagSeen(
            newest_s=self._newest_ns * 1e-9,
            p95_s=p95_ns * 1e-9,
            max_s=ordered[-1] * 1e-9,
            behind=_is_behind(recent, now_ns),
        )


def _is_behind(slots: list[tuple[int, int]], now_ns: int) -> bool:
    behind, since_ns, last_ns = False, None, 0
    for at_ns, worst_ns in slots:
        if worst_ns > LIMIT_NS:
            since_ns = at_ns if since_ns is None else since_ns
            behind = behind or at_ns - since_ns >= BEHIND_AFTER_NS
            last_ns = at_ns
        elif not behind or at_ns - last_ns > CAUGHT_UP_AFTER_NS:
            behind, since_ns = False, None
    return behind and now_ns - last_ns <= CAUGHT_UP_AFTER_NS
