"""How late the messages of a receiver's stream arrive, by the time that each states."""

from typing import Final, NamedTuple

DRIFT: Final = 100e-6
"""Largest drift of the stated times against this clock: ten times that of a good crystal."""
EARLY_NS: Final = 1_000_000_000
"""By how much a message may be earlier than all before it, without a confirmation by others."""
CONFIRMED: Final = 5  # messages that confirm one another
CONFIRMED_NS: Final = 1_000_000_000  # over at least this time, and with this largest difference


class _Off(NamedTuple):
    """Messages that are off, one after the other: arrival less stated time, least and newest."""

    began_ns: int
    messages: int
    least_ns: float
    newest_ns: float


class StreamLateness:
    """Delay of messages beyond the least delayed message of their stream.

    A message is *off* if it is more than ``late_max_ns`` late, or ``EARLY_NS`` early. A single one
    has a wrong time, or is of another clock. ``CONFIRMED`` of them with none between that is not
    off show that the clock was set, or is another one. If they are early, the delay is counted
    from them. If they are late, the whole stream may be as late: ``is_late``.
    """

    def __init__(self, late_max_ns: int) -> None:
        self.is_late = False
        self._late_max_ns = late_max_ns
        self._floor_ns: float | None = None  # least of arrival less stated time
        self._seen_ns = 0
        self._off: _Off | None = None

    def observe_ns(self, t_ns: int, stated_ns: float) -> int | None:
        """Return the delay of a message that arrives at ``t_ns``; None if it is off."""
        offset_ns = t_ns - stated_ns
        floor_ns = offset_ns if self._floor_ns is None else self._floor_ns
        if self._floor_ns is not None:
            floor_ns += max(0, t_ns - self._seen_ns) * DRIFT
        self._seen_ns = t_ns
        late_ns = offset_ns - floor_ns
        if -EARLY_NS <= late_ns <= self._late_max_ns:
            self.restart(min(floor_ns, offset_ns))
            return max(0, round(late_ns))
        self._floor_ns = floor_ns
        off = self._off
        if off is None or abs(off.newest_ns - offset_ns) > CONFIRMED_NS:
            off = _Off(began_ns=t_ns, messages=0, least_ns=offset_ns, newest_ns=offset_ns)
        self._off = off = off._replace(
            messages=off.messages + 1, least_ns=min(off.least_ns, offset_ns), newest_ns=offset_ns
        )
        if off.messages < CONFIRMED or t_ns - off.began_ns < CONFIRMED_NS:
            return None
        if late_ns > 0:
            self.is_late = True
            return None
        self.restart(off.least_ns)
        return round(offset_ns - off.least_ns)

    def restart(self, floor_ns: float) -> None:
        """Count delays from a difference of arrival and stated time."""
        self._floor_ns, self._off, self.is_late = floor_ns, None, False
