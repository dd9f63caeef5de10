"""Visible part of a sender's latencies: heights above the floor, sampled evenly over a window.

Random sampling keeps slow and fast stamps in proportion, however they are clustered. Taking every
n-th stamp would not: if a link sends frames eight at a time, every eighth one is the slowest. The
least height of each piece of the window gives the floor at its time, and reveals a drift that
lasts for the whole window.
"""

from array import array
from collections import deque
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from companion.values import FloatArray, IntArray

PIECES: Final = 16  # pieces of the window whose least heights are kept
SAMPLES: Final = 256
RESOLUTION_NS: Final = 1e6  # resolution of the stamps
_LOTS: Final = 1 << 32
LEAST_SLOPE: Final = -0.99
"""Slope below which arrivals stand still or run backwards: the log's times are wrong."""
_STEADY: Final = 0.1
"""Largest ratio of a sloped line's mean gap to a level line's that shows a steady drift."""


class _Piece(NamedTuple):
    """Heights of the stamps in a piece of the window, ns.

    number      of the piece, by sender time
    least_x_ns  sender time of the least height
    """

    number: int
    least_x_ns: int
    least: float
    greatest: float


class Latencies:
    """Heights of stamps; ``measure`` computes their median above the floor.

    window_ns   time over which stamps are kept
    drift_max   largest drift assumed, a ratio
    median_ns   attribute: median of the visible latencies at the last ``measure``
    mean_ns     attribute: mean of the visible latencies
    largest_ns  attribute: largest of them
    """

    def __init__(self, window_ns: int, drift_max: float) -> None:
        self._window_ns = window_ns
        self._piece_ns = max(1, window_ns // PIECES)
        self._drift_max = drift_max
        self._pieces: deque[_Piece] = deque()
        self._samples = _Samples()
        self._one_of = 1
        self._lot = 0
        self._kept_median_ns = 0.0
        self.median_ns = self.mean_ns = self.largest_ns = 0.0

    def add(self, x_ns: int, height: float) -> None:
        """Add a stamp: its sender time and its height, ns."""
        number = x_ns // self._piece_ns
        pieces, samples = self._pieces, self._samples
        if not pieces or number > pieces[-1].number:
            pieces.append(_Piece(number=number, least_x_ns=x_ns, least=height, greatest=height))
            while len(pieces) > PIECES:
                pieces.popleft()
        elif height < pieces[-1].least:
            pieces[-1] = pieces[-1]._replace(least_x_ns=x_ns, least=height)
        elif height > pieces[-1].greatest:
            pieces[-1] = pieces[-1]._replace(greatest=height)
        # A linear congruential generator (Numerical Recipes): sampling is reproducible.
        self._lot = (1664525 * self._lot + 1013904223) % _LOTS
        if self._lot * self._one_of >= _LOTS:
            return
        samples.add(x_ns, height, self._lot)
        samples.drop_before(x_ns - self._window_ns)
        if len(samples) > SAMPLES:
            self._one_of *= 2
            samples.keep(self._one_of)
        elif self._one_of > 1 and len(samples) < SAMPLES // 8:
            self._one_of //= 2

    def keep_median(self) -> None:
        """Hold the median at or above its present value until there are enough new samples."""
        self._kept_median_ns = self.median_ns

    def measure(self, newest_ns: int, since_ns: int) -> None:
        """Measure the latencies of the stamps since a sender time, each above its own floor."""
        pieces = [one for one in self._pieces if one.least_x_ns >= since_ns]
        x_ns, heights = self._samples.arrays()
        is_new = x_ns >= since_ns
        if not pieces or not is_new.any():
            return
        x, heights = (x_ns[is_new] - newest_ns).astype(float), heights[is_new]
        at = np.array([[one.least_x_ns - newest_ns] for one in pieces], dtype=float)
        floors = np.array([[one.least] for one in pieces])
        below = (floors + self._drift_max * np.abs(x - at)).min(axis=0)
        gaps = np.maximum(0.0, heights - below)
        self.mean_ns = float(gaps.mean())
        gaps.sort()  # np.median would dominate the run time
        n, self.largest_ns = len(gaps), float(gaps[-1])
        self.median_ns = float(gaps[(n - 1) // 2] + gaps[n // 2]) / 2.0
        if n < SAMPLES // 4:
            self.median_ns = max(self.median_ns, self._kept_median_ns)

    def greatest(self, newest_ns: int) -> float:
        """Return the greatest height of the window, of any stamp, as of the newest one."""
        return max(
            one.greatest + self._drift_max * (newest_ns - one.number * self._piece_ns)
            for one in self._pieces
        )

    def raise_greatest(self, by_ns: float) -> None:
        """Move the greatest heights with the floor, whose clock changed."""
        self._pieces = deque(one._replace(greatest=one.greatest + by_ns) for one in self._pieces)

    def steady_drift(self, newest_ns: int) -> float:
        """Return the steady drift of the floor over a window, a ratio; 0 unless above the limit.

        The line is the edge of the pieces' lower hull over the mean time (Moon, Skelly and Towsley
        1999). It must remove nearly all of the level line's gaps: a queue that fills for a while,
        or a clock that stalls for a moment, leaves more.
        """
        first_ns, last_ns = self._pieces[0].least_x_ns, self._pieces[-1].least_x_ns
        if last_ns - first_ns < self._window_ns * (PIECES - 2) / PIECES:
            return 0.0
        x_ns, heights = self._samples.arrays()
        x = (x_ns - newest_ns).astype(float)
        points = [(float(one.least_x_ns - newest_ns), one.least) for one in self._pieces]
        slope = _slope_over(points, float(np.mean(x)))
        if abs(slope) <= self._drift_max or slope < LEAST_SLOPE:
            return 0.0
        mean = float(np.mean(heights))
        level = mean - min(height for _, height in points)
        least = min(height - slope * at for at, height in points)
        sloped = mean - slope * float(np.mean(x)) - least
        return slope if sloped + RESOLUTION_NS <= _STEADY * level else 0.0

    def tilt(self, drift: float, newest_ns: int, level: float) -> list[tuple[int, float]]:
        """Subtract drift and level from all heights; return the least ones: sender time, height."""
        tilted = deque[_Piece]()
        for one in self._pieces:
            moved = drift * (one.least_x_ns - newest_ns) + level
            tilted.append(one._replace(least=one.least - moved, greatest=one.greatest - moved))
        self._pieces = tilted
        self._samples.clear()
        return [(one.least_x_ns, one.least) for one in self._pieces]


class _Samples:
    """Sampled stamps in order of arrival: sender time, height and lot.

    Three arrays of numbers, which are measured without a copy and take a sixth of the memory of
    tuples.
    """

    __slots__ = ("_heights", "_lots", "_x_ns")

    def __init__(self) -> None:
        self._x_ns = array("q")
        self._heights = array("d")
        self._lots = array("q")

    def __len__(self) -> int:
        return len(self._x_ns)

    def add(self, x_ns: int, height: float, lot: int) -> None:
        self._x_ns.append(x_ns)
        self._heights.append(height)
        self._lots.append(lot)

    def drop_before(self, x_ns: int) -> None:
        """Drop the first stamps as long as they are older."""
        old, times_ns = 0, self._x_ns
        while times_ns[old] < x_ns:
            old += 1
        if old:
            del times_ns[:old], self._heights[:old], self._lots[:old]

    def keep(self, one_of: int) -> None:
        """Keep the stamps whose lot is among the lowest of ``one_of`` parts."""
        kept = [n for n, lot in enumerate(self._lots) if lot * one_of < _LOTS]
        self._x_ns = array("q", [self._x_ns[n] for n in kept])
        self._heights = array("d", [self._heights[n] for n in kept])
        self._lots = array("q", [self._lots[n] for n in kept])

    def arrays(self) -> tuple[IntArray, FloatArray]:
        """Return sender times and heights, valid until the next change."""
        return np.array(self._x_ns), np.array(self._heights)

    def clear(self) -> None:
        """Drop all stamps."""
        del self._x_ns[:], self._heights[:], self._lots[:]


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
