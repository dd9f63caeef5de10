"""Unit of the stamps of a vehicle's positions: milliseconds, or by some firmwares microseconds.

MAVLink defines ``time_boot_ms``. Betaflight and INAV fill GLOBAL_POSITION_INT with microseconds
(docs/field-notes.md 1), which wrap around after 71.6 min; their other stamps are milliseconds.
"""

from typing import Final

from companion.mavlink.wire.stamps import WRAP_MS, stamp_step

CONFIRMED: Final = 5  # stamps in a row that show another unit, at least
LASTS_NS: Final = 1_000_000_000
"""Time that they must span: radios deliver in bunches."""
_WINDOW_NS: Final = 10_000_000_000  # longest such time
_RECENT_NS: Final = 10_000_000_000
"""Largest age of a stamp in milliseconds that shows how often microseconds have wrapped around."""
_PER_MS: Final = 1000
_RATIO: Final = 2.0  # largest ratio of stamps' steps to those of arrivals, either way

Stamped = tuple[int, int]
"""Arrival, ns, and a stamp."""


class StampUnit:
    """Unit of one sender's stamps, by stamps that its clock does not explain.

    is_microseconds  attribute: whether they are microseconds
    """

    def __init__(self, stamp: int) -> None:
        self.is_microseconds = False
        self._received = stamp  # the newest stamp as received
        self._newest_us: Stamped = 0, stamp  # without wraps
        self._first: Stamped | None = None  # of the stamps in a row that have no time
        self._unexplained = 0  # their number
        self._count = 0  # stamps since the newest of them

    def milliseconds(self, arrival_ns: int, stamp: int, other: Stamped | None) -> int:
        """Convert a stamp; the result wraps around as milliseconds do.

        ``other`` is the newest of the sender's other stamps, which are milliseconds.
        """
        self._received = stamp
        self._count += 1
        if not self.is_microseconds:
            return stamp
        known_ns, known_us = self._newest_us
        if other is not None and arrival_ns - other[0] <= _RECENT_NS:
            known_ns, known_us = other[0], other[1] * _PER_MS
        expected_us = known_us + (arrival_ns - known_ns) // 1000
        us = expected_us + stamp_step(stamp, expected_us)
        self._newest_us = max(self._newest_us, (arrival_ns, us))
        return us // _PER_MS % WRAP_MS

    def note_unexplained(self, arrival_ns: int) -> bool:
        """Note that the newest stamp has no time; return whether the unit changed.

        A stamp in between that has a time has the present unit.
        """
        first, stamp, in_a_row = self._first, self._received, self._count <= 1
        self._count = 0
        if first is None or not in_a_row or arrival_ns - first[0] > _WINDOW_NS:
            self._first, self._unexplained = (arrival_ns, stamp), 1
            return False
        self._unexplained += 1
        elapsed_ns = arrival_ns - first[0]
        if self._unexplained < CONFIRMED or elapsed_ns < LASTS_NS:
            return False
        self._first = None
        unit_ns = 1_000_000 if self.is_microseconds else 1_000  # of the other unit
        step_ns = stamp_step(stamp, first[1]) * unit_ns
        if not 1 / _RATIO <= step_ns / elapsed_ns <= _RATIO:
            return False
        self.is_microseconds = not self.is_microseconds
        self._newest_us = arrival_ns, stamp
        return True
