"""The recent reports of one UAV, in the order in which they were made.

Links deliver late and out of order. A late report within the window is put where it belongs, and
what follows it is estimated again, so that the result is that of reports in order. A report older
than the window is not used. Nearly always a report is the newest, and costs one step.
"""

from bisect import bisect_left
from dataclasses import dataclass
from typing import Generic

from companion.tracking.observers.estimates import Observer, Prediction, State
from companion.values import Fix

ACCELERATION_REPORTS_MAX = 15
"""Most velocities used for an acceleration: of more, only every n-th over the whole window."""


@dataclass(slots=True)
class Entry(Generic[State]):
    """A report, the observer's state there, and the prediction for it (None for the first)."""

    fix: Fix
    state: State
    predicted: Prediction | None


class History(Generic[State]):
    """The reports of one UAV within the window.

    ``entries`` are in order of the sender's time, and never empty.
    """

    def __init__(self, observer: Observer[State], first: Fix, window_ns: int) -> None:
        self._observer = observer
        self._window_ns = window_ns
        self.entries = [Entry(first, observer.begin(first), None)]

    @property
    def newest(self) -> Entry[State]:
        """The entry that predictions start from."""
        return self.entries[-1]

    def index(self, sender_ns: int) -> int | None:
        """The place of a report with this time; None if it is too old to be used."""
        if sender_ns > self.newest.fix.sender_ns:
            return len(self.entries)
        if sender_ns < self.newest.fix.sender_ns - self._window_ns:
            return None
        return bisect_left(self.entries, sender_ns, key=lambda entry: entry.fix.sender_ns)

    def insert(self, index: int, fix: Fix, predicted: Prediction | None = None) -> None:
        """Put a report in its place and estimate again what follows it.

        ``predicted`` is what the entry before predicts for it, if that was computed already.
        """
        if predicted is not None and index == len(self.entries):
            state = self._observer.after(self.newest.state, predicted, fix)
            self.entries.append(Entry(fix, state, predicted))
        else:
            self.entries.insert(index, Entry(fix, self.newest.state, None))
            for at in range(index, len(self.entries)):
                self.entries[at] = self._estimated(at)
        oldest_ns = self.newest.fix.sender_ns - self._window_ns
        while len(self.entries) > 1 and self.entries[1].fix.sender_ns <= oldest_ns:
            del self.entries[0]

    def _estimated(self, at: int) -> Entry[State]:
        fix = self.entries[at].fix
        if at == 0:
            return Entry(fix, self._observer.begin(fix), None)
        before = self.entries[at - 1].state
        predicted = self._observer.predict(before, fix.sender_ns)
        return Entry(fix, self._observer.after(before, predicted, fix), predicted)

    def acceleration(self, window_s: float, fewest: int) -> tuple[float, float, float] | None:
        """Least-squares slope of the velocities reported within a time, m/s².

        Of at least so many velocities, older ones if need be; None if there are too few.
        """
        newest_ns = self.newest.fix.sender_ns
        rows: list[tuple[float, float, float, float]] = []
        stride = max(1, len(self.entries) // ACCELERATION_REPORTS_MAX)
        for entry in self.entries[::-stride]:
            fix = entry.fix
            ago_s = (newest_ns - fix.sender_ns) * 1e-9
            if fix.velocity_ned_mps is None or (ago_s > window_s and len(rows) >= fewest):
                break
            north, east, down = fix.velocity_ned_mps.tolist()
            rows.append((-ago_s, north, east, down))
        if len(rows) < fewest:
            return None
        middle = sum(row[0] for row in rows) / len(rows)
        spread = sum((row[0] - middle) ** 2 for row in rows)
        if not spread:
            return None
        north, east, down = (
            sum((row[0] - middle) * row[axis] for row in rows) / spread for axis in (1, 2, 3)
        )
        return north, east, down
