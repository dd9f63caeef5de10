"""Recent reports of one UAV, in the order of the sender's time.

Links deliver late and out of order. A late report within the window is inserted in its place, and
all later states are estimated again, so that the result equals that of reports in order. A report
older than the window is not used. Nearly always a report is the newest, and costs one step. The
number of reports is limited: a sender of a thousand reports a second, out of order, would
otherwise cost thousands of steps for each.
"""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Generic

from companion.tracking.observers.estimates import Observer, Prediction, State
from companion.values import Fix, Vector

REPORTS_MAX: Final = 512
"""Most reports of a UAV that are kept: those of 5 s at 100 Hz; of faster ones the newest."""
ACCELERATION_REPORTS_MAX: Final = 25
"""Most velocities used for an acceleration; of more, every n-th over the whole window."""


@dataclass(slots=True)
class Entry(Generic[State]):
    """Report with the observer's state at it, and the prediction for it (None for the first)."""

    fix: Fix
    state: State
    predicted: Prediction | None


class ReportHistory(Generic[State]):
    """Recent reports of one UAV, within the window, and at most ``REPORTS_MAX``.

    ``entries`` are in order of the sender's time, and never empty.
    """

    def __init__(self, observer: Observer[State], first: Fix, window_ns: int) -> None:
        self._observer = observer
        self._window_ns = window_ns
        self.entries = [Entry(first, observer.begin(first), None)]

    @property
    def newest(self) -> Entry[State]:
        """Newest entry, from which predictions start."""
        return self.entries[-1]

    def index(self, sender_ns: int) -> int | None:
        """Return the index at which to insert a report; None if it is too old to be used."""
        newest_ns = self.entries[-1].fix.sender_ns
        if sender_ns > newest_ns:
            return len(self.entries)
        if sender_ns < newest_ns - self._window_ns:
            return None
        at = bisect_left(self.entries, sender_ns, key=lambda entry: entry.fix.sender_ns)
        return None if at == 0 and len(self.entries) >= REPORTS_MAX else at

    def insert(self, index: int, fix: Fix, predicted: Prediction | None = None) -> None:
        """Insert a report and estimate all later states again.

        ``predicted`` is the previous entry's prediction for the report, if already computed.
        """
        entries = self.entries
        if predicted is not None and index == len(entries):
            state = self._observer.after(entries[-1].state, predicted, fix)
            entries.append(Entry(fix, state, predicted))
        else:
            entries.insert(index, Entry(fix, entries[-1].state, None))
            for at in range(index, len(entries)):
                entries[at] = self._estimated(at)
        oldest_ns = entries[-1].fix.sender_ns - self._window_ns
        while len(entries) > 1 and (
            entries[1].fix.sender_ns <= oldest_ns or len(entries) > REPORTS_MAX
        ):
            del entries[0]

    def _estimated(self, at: int) -> Entry[State]:
        fix = self.entries[at].fix
        if at == 0:
            return Entry(fix, self._observer.begin(fix), None)
        before = self.entries[at - 1].state
        predicted = self._observer.predict(before, fix.sender_ns)
        return Entry(fix, self._observer.after(before, predicted, fix), predicted)

    def accelerations(self, windows: Sequence[tuple[float, int]]) -> list[Vector | None]:
        """Return least-squares slopes of the reported velocities over several windows, m/s².

        windows  lengths in seconds, ascending, each with the least number of velocities: older ones
                 are added if needed, and the slope is None if there are too few

        One pass over the reports, newest first: each window ends where the next report is too old.
        """
        newest_ns, found, due = self.newest.fix.sender_ns, [], 0
        n = t1 = t2 = 0.0
        v1, v2, v3, w1, w2, w3 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        stride = max(1, len(self.entries) // ACCELERATION_REPORTS_MAX)
        longest_s, fewest = windows[0]
        for entry in self.entries[::-stride]:
            fix = entry.fix
            velocity = fix.velocity_ned_mps
            if velocity is None:
                break
            t = (fix.sender_ns - newest_ns) * 1e-9
            while -t > longest_s and n >= fewest:
                found.append(_slope(n, t1, t2, (v1, v2, v3), (w1, w2, w3)))
                due += 1
                if due == len(windows):
                    return found
                longest_s, fewest = windows[due]
            north, east, down = velocity
            n += 1.0
            t1 += t
            t2 += t * t
            v1 += north
            v2 += east
            v3 += down
            w1 += t * north
            w2 += t * east
            w3 += t * down
        for _, fewest in windows[due:]:
            enough = n >= fewest
            found.append(_slope(n, t1, t2, (v1, v2, v3), (w1, w2, w3)) if enough else None)
        return found


def _slope(n: float, t1: float, t2: float, v: Vector, w: Vector) -> Vector | None:
    """Return the slope from the sums of 1, t, t², v and t v; None if all times are equal."""
    spread = t2 - t1 * t1 / n
    if spread <= 0.0:
        return None
    return (
        (w[0] - t1 * v[0] / n) / spread,
        (w[1] - t1 * v[1] / n) / spread,
        (w[2] - t1 * v[2] / n) / spread,
    )
