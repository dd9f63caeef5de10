"""Where the array stands, of few parameters: bearings and distances of positions from it.

Positions are normalised, so that the two axes have scales of their own; the array's place, the way
that it looks and the height are not known. Fitted are the array's place (2), the ratio of the
scales, the way that it looks, the beam in the middle and beams by sine of the bearing; and how many
samples the measured beam lags behind the reported position. The beams of a line of elements are
even in the sine of the bearing.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import least_squares

from companion.values import BoolArray, FloatArray, IntArray

LAGS: Final = tuple(step * 0.5 for step in range(9))
"""Lags that are tried, samples."""
_STARTS: Final = ((0.5, -0.3), (0.5, 1.3), (-0.3, 0.5), (1.3, 0.5))
_WIDEST_RAD: Final = 1.5
_SLOPE: Final = 0.4
_WIDEST_SLOPE: Final = 1.0
"""Beams by sine of the bearing, in codebooks: where the search begins, and at most."""


@dataclass(frozen=True, slots=True)
class Geometry:
    """The array's place in normalised coordinates, and what else few numbers say.

    stretch  log of the scale of the first axis to that of the second
    yaw      the way that the array looks, rad
    middle   the beam that looks there
    slope    beams by sine of the bearing from there
    lag      samples by which the beam is older than the position beside it
    """

    x: float
    y: float
    stretch: float
    yaw: float
    middle: float
    slope: float
    lag: float

    def seen(self, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Bearings from where the array looks, rad, and distances (N,) of positions (N, 2).

        The positions are in order of time.
        """
        there = delayed(place, self.lag) - np.array([self.x, self.y])
        east = there[:, 0] * np.exp(self.stretch)
        turned = np.arctan2(there[:, 1], east) - self.yaw
        return (turned + np.pi) % (2 * np.pi) - np.pi, np.hypot(east, there[:, 1])

    def beams(self, place: FloatArray) -> FloatArray:
        """The beams that are expected at positions (N, 2), with fractions."""
        bearing, _ = self.seen(place)
        expected: FloatArray = self.middle + self.slope * np.sin(
            np.clip(bearing, -_WIDEST_RAD, _WIDEST_RAD)
        )
        return expected


def delayed(place: FloatArray, lag: float) -> FloatArray:
    """Positions (N, 2) as they were ``lag`` samples ago, between two of them linearly."""
    at = np.clip(np.arange(len(place)) - lag, 0, None)
    before = np.floor(at).astype(np.int64)
    after = np.minimum(before + 1, len(place) - 1)
    part = (at - before)[:, None]
    found: FloatArray = place[before] * (1 - part) + place[after] * part
    return found


def fit(
    place: FloatArray, beam: IntArray, learned: BoolArray, beams: int, *, lags: bool
) -> Geometry:
    """The geometry by the samples that may be learned from; without ``lags`` the lag is 0."""
    begin = [
        Geometry(x, y, 0.0, float(np.arctan2(0.5 - y, 0.5 - x)), beams / 2, slope, 0.0)
        for x, y in _STARTS
        for slope in (_SLOPE * beams, -_SLOPE * beams)
    ]
    widest = _WIDEST_SLOPE * beams
    cost, best = min(
        (_fitted(one, place, beam, learned, widest) for one in begin), key=lambda found: found[0]
    )
    for lag in LAGS[1:] if lags else ():
        begun = Geometry(best.x, best.y, best.stretch, best.yaw, best.middle, best.slope, lag)
        again, found = _fitted(begun, place, beam, learned, widest)
        if again < cost:
            cost, best = again, found
    return best


def _fitted(
    begin: Geometry, place: FloatArray, beam: IntArray, learned: BoolArray, widest: float
) -> tuple[float, Geometry]:
    """The least cost, with few far-off beams counting little, and where it is."""
    there = delayed(place, begin.lag)[learned]

    def off(values: FloatArray) -> FloatArray:
        x, y, stretch, yaw, middle, slope = (float(value) for value in values)
        found: FloatArray = (
            Geometry(x, y, stretch, yaw, middle, slope, 0.0).beams(there) - beam[learned]
        )
        return found

    first = [begin.x, begin.y, begin.stretch, begin.yaw, begin.middle, begin.slope]
    low = [-4.0, -4.0, -2.0, -10.0, -np.inf, -widest]
    high = [4.0, 4.0, 2.0, 10.0, np.inf, widest]
    found = least_squares(off, np.clip(first, low, high), loss="soft_l1", bounds=(low, high))
    x, y, stretch, yaw, middle, slope = (float(value) for value in found.x)
    return float(found.cost), Geometry(x, y, stretch, yaw, middle, slope, begin.lag)
