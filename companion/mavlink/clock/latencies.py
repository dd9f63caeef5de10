"""Visible part of a sender's latencies: heights above the floor, sampled evenly over a window.

Random sampling keeps slow and fast stamps in proportion, however they are clustered. Taking every
n-th stamp would not: if a link sends frames eight at a time, every eighth one is the slowest. The
least height of each piece of the window gives the floor at its time, and reveals a drift that
lasts for the whole window.
"""

from collections import deque
from itertools import pairwise
from typing import Final

import numpy as np

PIECES: Final = 16  # pieces of the window whose least heights are kept
SAMPLES: Final = 256
RESOLUTION_NS: Final = 1e6  # resolution of the stamps
_LOTS: Final = 1 << 32
_STEADY: Final = 0.1
"""Largest ratio of a sloped line's mean gap to a level line's that shows a steady drift."""


class Latencies:
    """Heights of stamps; ``measure`` computes their median above the floor.

    window_ns   time over which stamps are kept
    drift_max   largest drift assumed, a ratio
    median_ns   attribute: median of the visible latencies at the last ``measure``
    mean_ns     attribute: mean of the visible latencies
    """

    def __init__(self, window_ns: int, drift_max: float) -> None:
        self._window_ns = window_ns
        self._piece_ns = max(1, window_ns // PIECES)
        self._drift_max = drift_max
        self._pieces: deque[tuple[int, int, float]] = deque()  # index, x, least height
        self._samples: deque[tuple[int, float, int]] = deque()  # x, height, lot
        self._one_of = 1
        self._lot = 0
        self._kept_median_ns = 0.0
        self.median_ns = self.mean_ns = 0.0

    def add(self, x_ns: int, height: float) -> None:
        """Add a stamp: its sender time and its height, ns."""
        index = x_ns // self._piece_ns
        pieces, samples = self._pieces, self._samples
        if not pieces or index > pieces[-1][0]:
            pieces.append((index, x_ns, height))
            while len(pieces) > PIECES:
                pieces.popleft()
        elif height < pieces[-1][2]:
            pieces[-1] = (pieces[-1][0], x_ns, height)
        # A linear congruential generator (Numerical Recipes): sampling is reproducible.
        self._lot = (1664525 * self._lot + 1013904223) % _LOTS
        if self._lot * self._one_of >= _LOTS:
            return
        samples.append((x_ns, height, self._lot))
        while samples[0][0] < x_ns - self._window_ns:
            samples.popleft()
        if len(samples) > SAMPLES:
            self._one_of *= 2
            self._samples = deque(one for one in samples if one[2] * self._one_of < _LOTS)
        elif self._one_of > 1 and len(samples) < SAMPLES // 8:
            self._one_of //= 2

    def keep_median(self) -> None:
        """Hold the median at or above its present value until there are enough new samples."""
        self._kept_median_ns = self.median_ns

    def measure(self, newest_ns: int, since_ns: int) -> None:
        """Measure the latencies of the stamps since a sender time, each above its own floor."""
        samples = [one for one in self._samples if one[0] >= since_ns]
        pieces = [one for one in self._pieces if one[1] >= since_ns]
        if not samples or not pieces:
            return
        # Apart: an array of pairs takes twice as long to make as two arrays.
        x = np.array([x_ns - newest_ns for x_ns, _, _ in samples], dtype=float)
        heights = np.array([height for _, height, _ in samples])
        at = np.array([[at_ns - newest_ns] for _, at_ns, _ in pieces], dtype=float)
        floors = np.array([[least] for _, _, least in pieces])
        below = (floors + self._drift_max * np.abs(x - at)).min(axis=0)
        gaps = np.maximum(0.0, heights - below)
        self.mean_ns = float(gaps.mean())
        gaps.sort()  # np.median would dominate the run time
        n = len(gaps)
        self.median_ns = float(gaps[(n - 1) // 2] + gaps[n // 2]) / 2.0
        if n < SAMPLES // 4:
            self.median_ns = max(self.median_ns, self._kept_median_ns)

    def steady_drift(self, newest_ns: int) -> float:
        """Return the steady drift of the floor over a window, a ratio; 0 unless above the limit.

        The line is the edge of the pieces' lower hull over the mean time (Moon, Skelly and Towsley
        1999). It must remove nearly all of the level line's gaps: a queue that fills for a while,
        or a clock that stalls for a moment, leaves more.
        """
        first_ns, last_ns = self._pieces[0][1], self._pieces[-1][1]
        if last_ns - first_ns < self._window_ns * (PIECES - 2) / PIECES:
            return 0.0
        x = np.array([one[0] - newest_ns for one in self._samples], dtype=float)
        heights = np.array([one[1] for one in self._samples])
        points = [(float(at_ns - newest_ns), height) for _, at_ns, height in self._pieces]
        slope = _slope_over(points, float(np.mean(x)))
        if abs(slope) <= self._drift_max:
            return 0.0
        mean = float(np.mean(heights))
        level = mean - min(height for _, height in points)
        least = min(height - slope * at for at, height in points)
        sloped = mean - slope * float(np.mean(x)) - least
        return slope if sloped + RESOLUTION_NS <= _STEADY * level else 0.0

    def tilt(self, drift: float, newest_ns: int, level: float) -> list[tuple[int, float]]:
        """Subtract drift and level from all heights; return the least ones: sender time, height."""
        self._pieces = deque(
            (index, at_ns, height - drift * (at_ns - newest_ns) - level)
            for index, at_ns, height in self._pieces
        )
        self._samples.clear()
        return [(at_ns, height) for _, at_ns, height in self._pieces]


def _slope_over(points: list[tuple[float, float]], x: float) -> float:
    """Return the slope of the lower hull's edge over ``x``, for ordered points; 0 if none."""
    hull: list[tuple[float, float]] = []
    for point in points:
        while len(hull) > 1:
            (x0, y0), (x1, y1) = hull[-2:]
            if (y1 - y0) * (point[0] - x1) < (point[1] - y1) * (x1 - x0):
                break
            hull.pop()
        hull.append(point)
    for (x0, y0), (x1, y1) in pairwise(hull):
        if x <= x1:
            return (y1 - y0) / (x1 - x0)
    return 0.0
