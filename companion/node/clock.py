"""The clock of a running node: a timeline that never steps, and how far UTC is from it.   [shell]

Intervals and bounds rest on the timeline. It begins as the wall clock of the start, and goes on
with the time since boot, in which a machine's sleep counts: what was heard before it is that much
older. The wall clock may be set meanwhile, as by NTP on a board without a battery; times that
people and other machines see follow it (``ClockSet``), and the timeline does not.
"""

import time
from collections.abc import Callable
from typing import Final

from companion.mavlink.links.kernel_time import since_boot_ns

SET_NS: Final = 10_000_000
"""Step of the wall clock that is followed. Discipline turns both clocks alike."""
READ_NS: Final = 1_000_000
"""Longest time that reading both clocks may take for what they say to be compared."""


class NodeClock:
    """The timeline of a node, ns since the Unix epoch as the wall clock had it at the start.

    ``wall_ns`` and ``since_boot_ns`` are the clocks of the machine.
    """

    def __init__(
        self,
        wall_ns: Callable[[], int] = time.time_ns,
        since_boot_ns: Callable[[], int] = since_boot_ns,
    ) -> None:
        self._wall_ns = wall_ns
        self._since_boot_ns = since_boot_ns
        self._start_ns = wall_ns() - since_boot_ns()
        self._offset_ns = 0

    def now_ns(self) -> int:
        """The present time on the node's timeline."""
        return self._start_ns + self._since_boot_ns()

    def set_to_ns(self) -> int | None:
        """UTC less the timeline, where the wall clock was set since the last call; else None."""
        before_ns = self.now_ns()
        wall_ns = self._wall_ns()
        if self.now_ns() - before_ns > READ_NS:
            return None  # this process had to wait: the next call tells
        offset_ns = wall_ns - before_ns
        if abs(offset_ns - self._offset_ns) < SET_NS:
            return None
        self._offset_ns = offset_ns
        return offset_ns
