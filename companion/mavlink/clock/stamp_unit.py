"""Unit of the stamps of a vehicle's positions: milliseconds, or by some firmwares microseconds.

MAVLink defines ``time_boot_ms``. Betaflight, and older versions of INAV, fill GLOBAL_POSITION_INT
with ``micros()`` (``telemetry/mavlink.c`` of both); their other stamps are milliseconds.
"""

from typing import Final

CONFIRMED: Final = 5  # steps in a row that show another unit
_PER_MS: Final = 1000
_WRAP: Final = 1 << 32
_RATIO: Final = 2.0  # largest ratio of a step to the time between two arrivals, either way
_STEP_NS: Final = 20_000_000, 10_000_000_000  # shortest and longest such time


class StampUnit:
    """Unit of one sender's stamps, by stamps that its clock does not explain.

    is_microseconds  attribute: whether they are microseconds
    """

    def __init__(self, stamp: int) -> None:
        self.is_microseconds = False
        self._received = self._newest_us = stamp  # the newest stamp as received; without wraps
        self._before: tuple[int, int] | None = None  # arrival and stamp of the one before
        self._explained_ns: int | None = None  # newest stamp that the clock explained
        self._steps = 0  # steps in a row that show the other unit

    def milliseconds(self, stamp: int) -> int:
        """Convert a stamp; the result wraps around as milliseconds do."""
        self._received = stamp
        if not self.is_microseconds:
            return stamp
        ahead_us = (stamp - self._newest_us + _WRAP // 2) % _WRAP - _WRAP // 2
        us = max(0, self._newest_us + ahead_us)
        self._newest_us = max(self._newest_us, us)
        return us // _PER_MS % _WRAP

    def note_unexplained(self, arrival_ns: int, explained_ns: int | None) -> bool:
        """Note that the newest stamp has no time; return whether the unit changed.

        ``explained_ns`` is the newest stamp that the clock explained: another one than before shows
        that some stamps have the present unit.
        """
        before, self._before = self._before, (arrival_ns, self._received)
        explained, self._explained_ns = self._explained_ns, explained_ns
        if before is None or not _STEP_NS[0] <= arrival_ns - before[0] <= _STEP_NS[1]:
            return False
        unit_ns = 1_000_000 if self.is_microseconds else 1_000  # of the other unit
        step_ns = (self._received - before[1]) % _WRAP * unit_ns
        is_other = 1 / _RATIO <= step_ns / (arrival_ns - before[0]) <= _RATIO
        self._steps = self._steps + 1 if is_other and explained == explained_ns else 0
        if self._steps < CONFIRMED:
            return False
        self.is_microseconds, self._steps, self._before = not self.is_microseconds, 0, None
        self._newest_us = self._received
        return True
