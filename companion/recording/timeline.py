"""A usable time line from time stamps that cannot be trusted.

Logs in the field have stamps that step back by a little (several links merged into one file),
that leap by days or by 10¹² s for one frame, and that leap and stay there (the clock was set).
Whoever sleeps on their differences hangs. So the time line handed out never steps back and never
leaps by more than an hour: a stamp that does is clamped to the time before it. When the stamps
after it go on from there, the clock was set, and the time line goes on with the shift that this
makes; when they do not, it was one bad stamp, and all is as before.
"""

from collections.abc import Sequence
from typing import Final

LARGEST_LEAP_NS: Final = 3_600_000_000_000
"""Nobody records across a gap of more than an hour; a stamp that says so is wrong."""
LINGERS_NS: Final = 1_000_000_000
"""A step back of at most an hour counts as a set clock once the stamps have gone on behind the
time line for this long. Frames of a slower link between others step back and forth instead."""
_LATEST_START_NS: Final = 1 << 62
"""The year 2116: times stay well inside 63 bits however long the log is."""


def _goes_on(step_ns: int) -> bool:
    return 0 <= step_ns <= LARGEST_LEAP_NS


class Timeline:
    """Places one stamp after the other. ``first``: the first few stamps, in nanoseconds.

    The time line starts at the first stamp, or at the second where the first does not lead up to
    it but the second does lead up to the third; at 0 where that is no time at all.
    """

    def __init__(self, first: Sequence[int]) -> None:
        start_ns = first[0] if first else 0
        if len(first) >= 3 and not _goes_on(first[1] - first[0]) and _goes_on(first[2] - first[1]):
            start_ns = first[1]
        self._absurd_start = not 0 <= start_ns < _LATEST_START_NS
        self.t_ns = 0 if self._absurd_start else start_ns
        self._shift_ns = self.t_ns - start_ns
        self._resumed: tuple[int, int] | None = None  # first and last stamp since the line froze

    def place(self, stamp_ns: int) -> int | None:
        """Moves on to this stamp: ``t_ns`` is its time.

        Returns None where it was good, else by how much it is off in nanoseconds (not 0).
        """
        step_ns = stamp_ns + self._shift_ns - self.t_ns
        if _goes_on(step_ns):
            self._resumed = None
            self.t_ns += step_ns
            absurd, self._absurd_start = self._absurd_start, False
            return -self._shift_ns if absurd else None
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
