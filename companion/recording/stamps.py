"""Repair of unreliable time stamps: a usable time line.

Logs from the field have stamps that step back a little (several links merged into one file), that
jump by days or by 10¹² s for one frame, or that jump permanently (the clock was set). A player that
waits for the differences of such stamps hangs (docs/field-notes.md 1). The time line returned here
never steps back and never jumps by more than an hour: such a stamp is clamped to the previous time.
If the following stamps continue from it, the clock was set, and the time line continues with that
shift. Otherwise it was one bad stamp, and nothing changes.
"""

from collections.abc import Sequence
from typing import Final

LARGEST_LEAP_NS: Final = 3_600_000_000_000
"""Longest plausible gap in a recording; a stamp after a longer one is wrong."""
STEP_HOLD_NS: Final = 1_000_000_000
"""Time for which stamps must stay behind the time line before a step back is a set clock.

This is for steps of at most an hour: frames of a slower link step back and forth among others.
"""
_LATEST_START_NS: Final = 1 << 62
"""Latest start of a log, the year 2116.

Times then fit into 63 bits however long the log is.
"""


def _is_plausible(step_ns: int) -> bool:
    return 0 <= step_ns <= LARGEST_LEAP_NS


class RepairedStamps:
    """Time line of successive stamps. ``first`` are the first few stamps, in nanoseconds.

    The time line starts at the first stamp; at the second if only the second is consistent with the
    third; at 0 if the start is impossible.
    """

    def __init__(self, first: Sequence[int]) -> None:
        start_ns = first[0] if first else 0
        if (
            len(first) >= 3
            and not _is_plausible(first[1] - first[0])
            and _is_plausible(first[2] - first[1])
        ):
            start_ns = first[1]
        self._implausible_start = not 0 <= start_ns < _LATEST_START_NS
        self.t_ns = 0 if self._implausible_start else start_ns
        self._shift_ns = self.t_ns - start_ns
        self._resumed: tuple[int, int] | None = None  # first and last stamp since clamping began

    def place(self, stamp_ns: int) -> int | None:
        """Advance the time line to a stamp; ``t_ns`` is then the time of that stamp.

        Returns None for a good stamp, else the stamp's error in nanoseconds (not 0).
        """
        step_ns = stamp_ns + self._shift_ns - self.t_ns
        if 0 <= step_ns <= LARGEST_LEAP_NS:  # inlined ``_is_plausible``, for speed
            self._resumed = None
            self.t_ns += step_ns
            if not self._implausible_start:
                return None
            self._implausible_start = False
            return -self._shift_ns
        began_ns, last_ns = self._resumed or (stamp_ns, stamp_ns)
        if self._resumed is None or stamp_ns < last_ns or not _is_plausible(stamp_ns - began_ns):
            self._resumed = (stamp_ns, stamp_ns)
            return step_ns
        if abs(step_ns) <= LARGEST_LEAP_NS and stamp_ns - began_ns < STEP_HOLD_NS:
            self._resumed = (began_ns, stamp_ns)
            return step_ns
        self._shift_ns = self.t_ns - began_ns
        self.t_ns = stamp_ns + self._shift_ns
        self._resumed = None
        return None
