"""Boot clock of a sender on the log's timeline, estimated from the whole log.

The offset, arrival less boot time, is the offset of the clocks plus a latency. The estimate takes
the least offset within ``WINDOW_NS`` before a stamp and within ``WINDOW_NS`` after it, and returns
the greater of the two (at the ends of a log the only one). A late frame has faster ones on both
sides. If the boot clock paused or was set, all frames on one side of the change differ, and the
other side gives the clock. The remaining error is the latency of the fastest frame.

A boot clock that steps back by more than ``REBOOT_STEP_NS`` has restarted, which starts a new boot.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.studies.truth.trajectory import Times
from companion.values import IntArray

REBOOT_STEP_NS: Final = 10_000_000_000
WINDOW_NS: Final = 10_000_000_000
EDGE_NS: Final = 3_000_000_000
"""Least time span before or after a stamp that counts; a shorter one may hold only late frames."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class BootClock:
    """Samples of one boot clock, one per stamp, in order of arrival, (N,)."""

    arrival_ns: Times
    boot_ns: Times  # value of the stamp
    life: IntArray  # number of restarts before it
    made_ns: Times  # time of creation on the log's timeline

    def node_ns(self, boot_ns: Times, life: IntArray) -> Times:
        """Convert boot times (K,) to the log's timeline, (K,), given the boot of each."""
        found = np.empty(len(boot_ns), dtype=np.int64)
        for number in np.unique(life).tolist():
            wanted, (known,) = life == number, np.nonzero(self.life == number)
            known = known[np.argsort(self.boot_ns[known], kind="stable")]
            first = int(self.boot_ns[known[0]])
            offset_ns = self.made_ns[known] - self.boot_ns[known]
            late = np.interp(
                boot_ns[wanted] - first, self.boot_ns[known] - first, offset_ns - offset_ns[0]
            )
            found[wanted] = boot_ns[wanted] + offset_ns[0] + np.round(late).astype(np.int64)
        return found


def boot_clock(arrival_ns: Times, boot_ns: Times) -> BootClock:
    """Estimate a sender's boot clock from stamps (N,), in order of arrival."""
    life = lives(boot_ns)
    made_ns = np.empty_like(boot_ns)
    for number in range(int(life[-1]) + 1 if len(life) else 0):
        (rows,) = np.nonzero(life == number)
        here, offset_ns = arrival_ns[rows], arrival_ns[rows] - boot_ns[rows]
        row = np.arange(len(rows))
        starts = np.searchsorted(here, here - WINDOW_NS, side="left")
        stops = np.searchsorted(here, here + WINDOW_NS, side="right")
        # Frames with equal arrival times are one sample of the clock and count on both sides.
        first, last = np.searchsorted(here, here, "left"), np.searchsorted(here, here, "right")
        before = least(offset_ns, np.minimum(starts, row), last)
        after = least(offset_ns, first, np.maximum(stops, row + 1))
        early = here - here[np.minimum(starts, row)] < EDGE_NS
        late = here[np.maximum(stops, row + 1) - 1] - here < EDGE_NS
        both = np.where(early, after, np.where(late, before, np.maximum(before, after)))
        made_ns[rows] = boot_ns[rows] + np.where(early & late, np.minimum(before, after), both)
    return BootClock(arrival_ns=arrival_ns, boot_ns=boot_ns, life=life, made_ns=made_ns)


def lives(boot_ns: Times) -> IntArray:
    """Return the number of reboots before each stamp, (N,), found by backward steps."""
    if len(boot_ns) == 0:
        return np.zeros(0, dtype=np.int64)
    return np.cumsum(np.diff(boot_ns, prepend=boot_ns[0]) < -REBOOT_STEP_NS)


def least(values: Times, starts: IntArray, stops: IntArray) -> Times:
    """Return the minimum of ``values[start:stop]`` for each pair, (K,); no range may be empty.

    The method uses minima over powers of two, two of which cover any range.
    """
    levels = [values]
    while 2 ** len(levels) <= len(values):
        step = 2 ** (len(levels) - 1)
        levels.append(np.minimum(levels[-1][:-step], levels[-1][step:]))
    found = np.empty(len(starts), dtype=values.dtype)
    level = np.floor(np.log2(stops - starts)).astype(np.int64)
    for number in np.unique(level).tolist():
        here = level == number
        last = stops[here] - 2**number
        found[here] = np.minimum(levels[number][starts[here]], levels[number][last])
    return found
