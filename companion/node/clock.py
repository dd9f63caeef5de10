"""The clock of a running node: a timeline that never steps, and its offset from UTC.

Intervals and bounds use the timeline. It starts at the wall clock's time, and continues with the
time since boot, which includes the time that a machine sleeps. The wall clock may be set meanwhile,
as by NTP on a board without a battery. Times shown to people and other machines follow it
(``ClockSet``); the timeline does not.
"""

import time
from collections.abc import Callable
from typing import Final

from companion.mavlink.links.kernel_time import since_boot_ns

SET_NS: Final = 10_000_000
"""Least step of the wall clock that is followed; both clocks are disciplined alike."""
READ_NS: Final = 1_000_000
"""Longest time for reading both clocks if the two readings are to be compared."""
WALL_MAX_NS: Final = 4_102_444_800_000_000_000
"""Latest time of the wall clock that is followed, the year 2100: recordings end in 2116."""


class NodeClock:
    """Timeline of a node, ns, which starts at the wall clock's time since the Unix epoch.

    ``wall_ns`` and ``since_boot_ns`` are the clocks of the machine. A wall clock beyond
    ``WALL_MAX_NS`` is wrong: the timeline starts there, and it is not followed.
    """

    def __init__(
        self,
        wall_ns: Callable[[], int] = time.time_ns,
        since_boot_ns: Callable[[], int] = since_boot_ns,
    ) -> None:
        self._wall_ns = wall_ns
        self._since_boot_ns = since_boot_ns
        self._start_ns = min(wall_ns(), WALL_MAX_NS) - since_boot_ns()
        self._offset_ns = 0

    def now_ns(self) -> int:
        """Return the present time on the node's timeline."""
        return self._start_ns + self._since_boot_ns()

    def set_to_ns(self) -> int | None:
        """Return UTC less the timeline if the wall clock was set since the last call; else None."""
        before_ns = self.now_ns()
        wall_ns = self._wall_ns()
        if wall_ns > WALL_MAX_NS or self.now_ns() - before_ns > READ_NS:
            return None  # this process was interrupted: the next call detects a step
        offset_ns = wall_ns - before_ns
        if abs(offset_ns - self._offset_ns) < SET_NS:
            return None
        self._offset_ns = offset_ns
        return offset_ns
