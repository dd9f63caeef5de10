"""Unit of the stamps of a vehicle's positions: milliseconds, or by some firmwares microseconds.

MAVLink defines ``time_boot_ms``. Betaflight and INAV fill GLOBAL_POSITION_INT with microseconds
(docs/field-notes.md 1); their other stamps are milliseconds.
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
        self._steps = 0  # steps in a row that show the other unit
        self._count = 0  # stamps since the newest one without a time

    def milliseconds(self, stamp: int) -> int:
        """Convert a stamp; the result wraps around as milliseconds do."""
        self._received = stamp
        self._count += 1
        if not self.is_microseconds:
            return stamp
        ahead_us = (stamp - self._newest_us + _WRAP // 2) % _WRAP - _WRAP // 2
        us = max(0, self._newest_us + ahead_us)
        self._newest_us = max(self._newest_us, us)
        return us // _PER_MS % _WRAP

    def note_unexplained(self, arrival_ns: int) -> bool:
        """Note that the newest stamp has no time; return whether the unit changed.

        Steps count in a row: a stamp in between that has a time has the present unit.
        """
        before, self._before = self._before, (arrival_ns, self._received)
        count, self._count = self._count, 0
        if before is None or not _STEP_NS[0] <= arrival_ns - before[0] <= _STEP_NS[1]:
            return False
        unit_ns = 1_000_000 if self.is_microseconds else 1_000  # of the other unit
        step_ns = (self._received - before[1]) % _WRAP * unit_ns
        is_other = 1 / _RATIO <= step_ns / (arrival_ns - before[0]) <= _RATIO
        self._steps = self._steps + 1 if is_other and count <= 1 else 0
        if self._steps < CONFIRMED:
            return False
        self.is_microseconds, self._steps, self._before = not self.is_microseconds, 0, None
        self._newest_us = self._received
        return True
