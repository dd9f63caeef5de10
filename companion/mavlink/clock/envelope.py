"""The lower envelope: the line under all points (sender time, arrival - sender time) of a window.

What is seen of a sender is

    y = arrival - boot = offset + drift * x + latency,     x = boot, latency >= its smallest value

so a line that lies under every point and touches their lower convex hull follows offset and drift,
up to the smallest latency. Of all such lines the one along the hull's edge over the mean of x has
the least sum of gaps to the points; for exponential latencies it is the most likely line (Moon,
Skelly and Towsley, INFOCOM 1999; docs/math.md 6). Its slope is used only where a level line is less
likely by more than ``SIGNIFICANT`` in the logarithm. Short windows and jittery links therefore have
a drift of 0, while a clock that is 2 % off is still followed.

A frame that was overtaken lies above its overtaker by more than any slope below 1 could bridge, so
it never touches the line. Only stamps that advance enter the hull, in order of x as of arrival.

Memory is bounded whatever arrives. The window consists of pieces of sender time in which something
was heard; each piece keeps its own lower hull, from which the whole hull is made when needed, and a
few of its points for the statistics.
"""

import math
from collections import deque
from itertools import pairwise
from typing import Final, NamedTuple

Point = tuple[int, int]
"""(sender time, arrival - sender time), nanoseconds."""

PIECES: Final = 16
"""Pieces that make up the window."""
SIGNIFICANT: Final = 8.0
"""Log-likelihood by which a sloped line must beat a level one before its drift is used."""
_INDEPENDENT: Final = 8  # samples of a piece that count as independent: latencies come in spells
_VERTICES: Final = 16  # hull vertices of a piece; one that reaches them is closed early
_SAMPLES: Final = 16  # samples kept of a piece
_OLDEST_WINDOWS: Final = 10
_RESOLUTION_NS: Final = 1e6
_RARE: Final = 7.0
"""Numerator of a bound exceeded once in 1000.

The least of n exponential latencies exceeds the true minimum by more than 7/n of their mean once in
1000.
"""


class _Piece:
    """One piece of the window: its lower hull, a sample of its points and the sample's sums."""

    __slots__ = ("hull", "index", "samples", "sum_x", "sum_y")

    def __init__(self, index: int) -> None:
        self.index = index
        self.hull: list[Point] = []
        self.samples: list[Point] = []
        self.sum_x = self.sum_y = 0  # of the samples


class _Cloud(NamedTuple):
    """The points' lower hull, and their mean relative to the hull's first vertex.

    A line depends on nothing else.
    """

    hull: list[Point]
    mean_x: float
    mean_y: float

    def laid(self, drift: float) -> tuple[float, Point]:
        """Lay a line of slope ``drift`` under the hull.

        Returns its mean gap (ns) and where it touches.
        """
        x0, y0 = self.hull[0]
        pivot = min(self.hull, key=lambda p: p[1] - y0 - drift * (p[0] - x0))
        gap = self.mean_y - (pivot[1] - y0) - drift * (self.mean_x - (pivot[0] - x0))
        return max(0.0, gap), pivot


class Envelope:
    """The line ``at(x)`` under all points of the window.

    Arguments:

        window_ns     length of the window in sender time, counted where something was heard, to a
                      sixteenth; points ten times as old are dropped in any case
        drift_limit   largest slope to either side, a ratio below 1
        drift_unsure  least error assumed of a slope, a ratio

    Attributes:

        newest_ns     newest sender time taken in; 0 without any
        drift_error   bound on the slope's error, a ratio: ``drift_unsure``, or what the points
                      leave open if that is more
        count         number of samples
        independent   number of samples that count as independent of one another
    """

    def __init__(self, window_ns: int, drift_limit: float, drift_unsure: float) -> None:
        self._piece_ns = max(1, window_ns // PIECES)
        self._oldest_ns = _OLDEST_WINDOWS * window_ns
        self._drift_limit = drift_limit
        self._drift_unsure = drift_unsure
        self._pieces: deque[_Piece] = deque()
        self.count = 0
        self._newest: Point | None = None
        self._pivot: Point = (0, 0)
        self.drift = 0.0
        """Slope of the line, a ratio: node time that passes per sender time, less 1."""
        self.mean_gap_ns = 0.0
        self._cloud = _Cloud([(0, 0)], 0.0, 0.0)
        self._fitted = self._least_gap_ns = 0.0
        self._independent_fitted = 0
        self._drift_error = (-1, drift_limit)  # the fit it was computed for, and its value
        self.fits = 0
        """Number of times the line was laid anew."""

    def __bool__(self) -> bool:
        return self._newest is not None

    @property
    def newest_ns(self) -> int:
        return self._newest[0] if self._newest else 0

    @property
    def independent(self) -> int:
        return min(self.count, _INDEPENDENT * len(self._pieces))

    def at(self, x_ns: int) -> int:
        """Height of the line at a sender time, ns, rounded down."""
        x0_ns, y0_ns = self._pivot
        return y0_ns + math.floor(self.drift * (x_ns - x0_ns))

    def add(self, x_ns: int, y_ns: int) -> None:
        """Take in a point, in order of arrival. Afterwards the line is not above it."""
        if self._newest is not None and x_ns <= self._newest[0]:
            self._sample(x_ns, y_ns)
            return
        self._newest = (x_ns, y_ns)
        renewed = self._advance(x_ns)
        _append(self._pieces[-1].hull, (x_ns, y_ns))
        self._sample(x_ns, y_ns)
        if renewed or y_ns < self.at(x_ns):
            self._fit()

    def gaps_ns(self) -> list[int]:
        """Heights (ns) above the line of the samples kept, at most 16 from each piece."""
        (x0_ns, y0_ns), drift, floor = self._pivot, self.drift, math.floor
        return [
            y_ns - y0_ns - floor(drift * (x_ns - x0_ns))
            for piece in self._pieces
            for x_ns, y_ns in piece.samples
        ]

    def points(self) -> list[Point]:
        """Points of the window that some line under all of them may touch, in order of x."""
        return [point for piece in self._pieces for point in piece.hull]

    @property
    def drift_error(self) -> float:
        if self._drift_error[0] != self.fits:
            self._drift_error = (self.fits, self._open_slopes())
        return self._drift_error[1]

    def residual_ns(self) -> float:
        """Bound on how far this line lies above that of an endless window, at the newest point, ns.

        The least latency of n exceeds the true minimum by up to ``7 mean / n``; the slope's error
        is added, carried on from where the line touches to the newest point. Infinite before the
        first point.
        """
        if self._newest is None:
            return math.inf
        n = self.independent
        reach_ns = abs(self._newest[0] - self._pivot[0])
        return _RARE * self.mean_gap_ns / n + self.drift_error * reach_ns

    def _sample(self, x_ns: int, y_ns: int) -> None:
        piece = self._pieces[-1]
        if len(piece.samples) < _SAMPLES:
            piece.samples.append((x_ns, y_ns))
            piece.sum_x += x_ns
            piece.sum_y += y_ns
            self.count += 1

    def _advance(self, x_ns: int) -> bool:
        """Open a new piece if one is due and drop pieces that are too old.

        Returns whether it did.
        """
        pieces, index = self._pieces, x_ns // self._piece_ns
        if pieces and pieces[-1].index == index and len(pieces[-1].hull) < _VERTICES:
            return False
        pieces.append(_Piece(index))
        while len(pieces) > PIECES or pieces[0].index * self._piece_ns < x_ns - self._oldest_ns:
            self.count -= len(pieces.popleft().samples)
        return True

    def _open_slopes(self) -> float:
        """Largest distance from the slope in use to any slope that the points do not rule out.

        Ruled out are slopes less likely than the best by more than ``SIGNIFICANT``. The gap is
        convex in the slope, so each end is found by bisection, to a thousandth of the interval.
        """
        scale = math.exp(SIGNIFICANT / max(1, self._independent_fitted))
        allowed_ns = (self._least_gap_ns + _RESOLUTION_NS) * scale - _RESOLUTION_NS
        furthest = self._drift_unsure
        for end in (-self._drift_limit, self._drift_limit):
            inside, outside = self._fitted, end
            if self._cloud.laid(end)[0] <= allowed_ns:
                inside = end
            for _ in range(10 if inside != end else 0):
                middle = (inside + outside) / 2.0
                if self._cloud.laid(middle)[0] <= allowed_ns:
                    inside = middle
                else:
                    outside = middle
            furthest = max(furthest, abs(inside - self.drift))
        return furthest

    def _fit(self) -> None:
        """Choose the slope and lay the line under the hull."""
        self.fits += 1
        n = self.count
        hull: list[Point] = []
        for point in self.points():
            _append(hull, point)
        x0_ns, y0_ns = hull[0]
        mean_x = (sum(piece.sum_x for piece in self._pieces) - n * x0_ns) / n
        mean_y = (sum(piece.sum_y for piece in self._pieces) - n * y0_ns) / n

        self._cloud = _Cloud(hull, mean_x, mean_y)
        laid = self._cloud.laid
        level_gap, level_pivot = laid(0.0)
        fitted = _slope_over(hull, x0_ns + mean_x)
        fitted = min(max(fitted, -self._drift_limit), self._drift_limit)
        gap, pivot = laid(fitted)
        gain = self.independent * math.log((level_gap + _RESOLUTION_NS) / (gap + _RESOLUTION_NS))
        if gain > SIGNIFICANT:
            self.drift, self._pivot, self.mean_gap_ns = fitted, pivot, gap
        else:
            self.drift, self._pivot, self.mean_gap_ns = 0.0, level_pivot, level_gap
        self._fitted, self._least_gap_ns = fitted, gap
        self._independent_fitted = self.independent


def _append(hull: list[Point], point: Point) -> None:
    """Add a point to the right of a lower convex hull (Andrew's monotone chain)."""
    x, y = point
    while len(hull) > 1:
        (x0, y0), (x1, y1) = hull[-2:]
        if (y1 - y0) * (x - x1) < (y - y1) * (x1 - x0):
            break
        hull.pop()
    hull.append(point)


def _slope_over(hull: list[Point], x: float) -> float:
    """Slope of the hull's edge over ``x``; 0 where there is none."""
    for (x0, y0), (x1, y1) in pairwise(hull):
        if x <= x1:
            return (y1 - y0) / (x1 - x0)
    return 0.0
