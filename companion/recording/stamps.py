"""A usable time line from time stamps that cannot be trusted.

Logs in the field have stamps that step back by a little (several links merged into one file), that
leap by days or by 10¹² s for one frame, and that leap and stay there (the clock was set). A player
that sleeps on their differences hangs (docs/field-notes.md 1). The time line returned here never
steps back and never leaps by more than an hour: a stamp that does is clamped to the time before it.
When the stamps after it go on from there, the clock was set, and the time line goes on with the
shift that this makes. When they do not, it was one bad stamp, and nothing changes.
"""

from collections.abc import Sequence
from typing import Final

LARGEST_LEAP_NS: Final = 3_600_000_000_000
"""Longest gap in a recording that is believed; a stamp beyond it is wrong."""
LINGERS_NS: Final = 1_000_000_000
"""How long stamps must go on behind the time line before a step back counts as a set clock.

This is for steps of at most an hour: frames of a slower link between others step back and forth.
"""
_LATEST_START_NS: Final = 1 << 62
"""Latest time at which a log may begin, the year 2116.

Times then stay well inside 63 bits however long the log is.
"""


def _goes_on(step_ns: int) -> bool:
    return 0 <= step_ns <= LARGEST_LEAP_NS


class RepairedStamps:
    """Places one stamp after the other. ``first`` are the first few stamps, in nanoseconds.

    The time line starts at the first stamp; at the second where the first does not lead up to it
    but the second leads up to the third; at 0 where that is no possible time.
    """

    def __init__(self, first: Sequence[int]) -> None:
        start_ns = first[0] if first else 0
        if len(first) >= 3 and not _goes_on(first[1] - first[0]) and _goes_on(first[2] - first[1]):
            start_ns = first[1]
        self._absurd_start = not 0 <= start_ns < _LATEST_START_NS
        self.t_ns = 0 if self._absurd_start else start_ns
        self._shift_ns = self.t_ns - start_ns
        self._resumed: tuple[int, int] | None = None  # first and last stamp since clamping began

    def place(self, stamp_ns: int) -> int | None:
        """Move on to this stamp; ``t_ns`` is then its time.

        Returns None where the stamp was good, else by how many nanoseconds it is off (not 0).
        """
        step_ns = stamp_ns + self._shift_ns - self.t_ns
        if 0 <= step_ns <= LARGEST_LEAP_NS:  # ``_goes_on``, which would be most of the time
            self._resumed = None
            self.t_ns += step_ns
            if not self._absurd_start:
                return None
            self._absurd_start = False
            return -self._shift_ns
        began_ns, last_ns = self._resumed or (stamp_ns, stamp_ns)
        if self._resumed is None or stamp_ns < last_ns or not _goes_on(stamp_ns - began_ns):
            self._resumed = (stamp_ns, stamp_ns)
            return step_ns
        if abs(step_ns) <= LARGEST_LEAP_NS and stamp_ns - began_ns < LINGERS_NS:
            self._resumed = (began_ns, stamp_ns)
            return step_ns
        self._shift_ns = self.t_ns - began_ns
        self.t_ns = stamp_ns + self._shift_ns
        self._resumed = None
        return None
