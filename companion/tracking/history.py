"""The reports of one UAV that are still open to change, in the order in which they were made.

Links deliver late and out of order. Within a window a late report is put where it belongs and
what came after it is estimated again, so that the result is that of reports in order; what is
older than the window is beyond use. Nearly always a report is the newest, and costs one step.
"""

from bisect import bisect_left
from dataclasses import dataclass
from typing import Generic

import numpy as np

from companion.tracking.estimates import Observer, Prediction, State
from companion.values import Fix, FloatArray

ACCELERATION_WINDOW_NS = 5_000_000_000
ACCELERATION_REPORTS, ACCELERATION_REPORTS_MAX = 5, 15
"""The acceleration is the slope of the velocities reported over the window, and of at least so
many: fewer say more of their noise than of a turn. Of very many, one in a few is taken."""


@dataclass(slots=True)
class Entry(Generic[State]):
    """A report, the observer's state there, and what had been predicted for it (first: None)."""

    fix: Fix
    state: State
    predicted: Prediction | None


class History(Generic[State]):
    """Begins with a report; ``entries`` are in order of the sender's time, never empty."""

    def __init__(self, observer: Observer[State], first: Fix, window_ns: int) -> None:
        self._observer = observer
        self._window_ns = window_ns
        self.entries = [Entry(first, observer.begin(first), None)]

    @property
    def newest(self) -> Entry[State]:
        """The entry that predictions start from."""
        return self.entries[-1]

    def index(self, sender_ns: int) -> int | None:
        """Where a report of that time belongs; None if it is too old to be used."""
        if sender_ns > self.newest.fix.sender_ns:
            return len(self.entries)
        if sender_ns < self.newest.fix.sender_ns - self._window_ns:
            return None
        return bisect_left(self.entries, sender_ns, key=lambda entry: entry.fix.sender_ns)

    def insert(self, index: int, fix: Fix, predicted: Prediction | None = None) -> None:
        """Put a report in its place and estimate what follows it again.

        ``predicted``: what the entry before predicts for it, if that was asked already.
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

    def acceleration(self) -> FloatArray | None:
        """Least-squares slope of the newest reported velocities, m/s^2, (3,); None if unknown."""
        newest_ns = self.newest.fix.sender_ns
        times_ns: list[int] = []
        velocities: list[FloatArray] = []
        stride = max(1, len(self.entries) // ACCELERATION_REPORTS_MAX)
        for entry in self.entries[::-stride]:
            fix = entry.fix
            old = newest_ns - fix.sender_ns > ACCELERATION_WINDOW_NS
            if fix.velocity_ned_mps is None or (old and len(times_ns) >= ACCELERATION_REPORTS):
                break
            times_ns.append(fix.sender_ns - newest_ns)
            velocities.append(fix.velocity_ned_mps)
        if len(times_ns) < ACCELERATION_REPORTS:
            return None
        t = np.array(times_ns) * 1e-9
        t -= t.sum() / len(t)
        slope: FloatArray = t @ np.array(velocities) / (t @ t)
        return slope
