"""Event loop lag: delay between the due time and the start of scheduled work."""

from bisect import bisect_left
from itertools import accumulate
from typing import Final

BUCKETS_S: Final = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
"""Upper bounds of the buckets of a lateness histogram, seconds.

A tick that is late by more than its period is skipped, but its lateness is counted here.
"""


class Lateness:
    """Histogram of the event loop's lateness. ``sum_s`` is the sum of all observations."""

    def __init__(self) -> None:
        self.sum_s = 0.0
        self._counts = [0] * (len(BUCKETS_S) + 1)

    def observe(self, seconds: float) -> None:
        """Count one observation; a negative one counts as 0."""
        late_s = max(0.0, seconds)
        self.sum_s += late_s
        self._counts[bisect_left(BUCKETS_S, late_s)] += 1

    def buckets(self) -> list[tuple[str, float]]:
        """Return upper bounds with cumulative counts, as in Prometheus."""
        ends = [*map(str, BUCKETS_S), "+Inf"]
        return list(zip(ends, map(float, accumulate(self._counts)), strict=True))
