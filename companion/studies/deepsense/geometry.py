"""Geometry of the array with few parameters: the expected beam at a position.

Positions are normalised, so that each axis has its own scale; the array's position, orientation and
the flight height above it are unknown. Fitted are the array's position (2), the ratio of the
scales, the orientation, the height, the middle beam and beams per sine; and the lag, in samples, of
the measured beam behind the reported position.

The beams of a line of elements are even in the sine of the angle from its middle, which includes
the height: far above the array every direction is in the middle, at any bearing.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.optimize import least_squares

from companion.values import BoolArray, FloatArray, IntArray

LAGS: Final = tuple(step * 0.5 for step in range(9))  # lags that are tried, samples
_STARTS: Final = ((0.5, -0.3), (0.5, 1.3), (-0.3, 0.5), (1.3, 0.5))
_HEIGHT: Final = 0.3
_HIGHEST: Final = 3.0
_SLOPE: Final = 0.4
_WIDEST_SLOPE: Final = 1.0  # beams per sine, in codebooks: start of the search, and limit


@dataclass(frozen=True, slots=True, kw_only=True)
class Geometry:
    """Fitted parameters: the array's position in normalised coordinates, and the others.

    height   of the flight above the array, in the scale of the second axis; one for all samples
    """

    x: float
    y: float
    stretch: float  # log of the scale of the first axis to that of the second
    yaw: float  # orientation of the array, rad
    middle: float  # the beam in that direction
    slope: float  # beams per sine of the angle from it
    height: float
    lag: float  # samples by which the beam lags behind the position

    def beams(self, place: FloatArray) -> FloatArray:
        """Return the expected beams at positions (N, 2) in order of time, with fractions."""
        return self._at(delayed(place, self.lag))

    def _at(self, place: FloatArray) -> FloatArray:
        """Return the expected beams at positions (N, 2) that are already delayed."""
        east = (place[:, 0] - self.x) * np.exp(self.stretch)
        north = place[:, 1] - self.y
        across = north * np.cos(self.yaw) - east * np.sin(self.yaw)
        away = np.sqrt(east**2 + north**2 + self.height**2)
        expected: FloatArray = self.middle + self.slope * across / np.maximum(away, 1e-9)
        return expected


def delayed(place: FloatArray, lag: float) -> FloatArray:
    """Return positions (N, 2) as they were ``lag`` samples ago, by linear interpolation."""
    at = np.clip(np.arange(len(place)) - lag, 0, None)
    before = np.floor(at).astype(np.int64)
    after = np.minimum(before + 1, len(place) - 1)
    part = (at - before)[:, None]
    found: FloatArray = place[before] * (1 - part) + place[after] * part
    return found


def fit(
    place: FloatArray, beam: IntArray, learned: BoolArray, beams: int, *, simple: bool = False
) -> Geometry:
    """Fit the geometry to the training samples; a simple geometry has no height or lag."""
    height = 0.0 if simple else _HEIGHT
    begin = [
        Geometry(
            x=x,
            y=y,
            stretch=0.0,
            yaw=float(np.arctan2(0.5 - y, 0.5 - x)),
            middle=beams / 2,
            slope=slope,
            height=height,
            lag=0.0,
        )
        for x, y in _STARTS
        for slope in (_SLOPE * beams, -_SLOPE * beams)
    ]
    cost, best = min(
        (_fitted(one, place, beam, learned, beams) for one in begin), key=lambda found: found[0]
    )
    for lag in () if simple else LAGS[1:]:
        again, found = _fitted(replace(best, lag=lag), place, beam, learned, beams)
        if again < cost:
            cost, best = again, found
    return best


def refit(
    begin: Geometry, place: FloatArray, beam: IntArray, learned: BoolArray, beams: int
) -> Geometry:
    """Fit the geometry to fewer samples, with a known lag."""
    _, found = _fitted(begin, place, beam, learned, beams)
    return found


def _fitted(
    begin: Geometry, place: FloatArray, beam: IntArray, learned: BoolArray, beams: int
) -> tuple[float, Geometry]:
    """Return the least cost of a fit, robust against outliers, and its geometry.

    If the height is 0, it is not fitted.
    """
    there = delayed(place, begin.lag)[learned]
    limits = {
        "x": (-4.0, 4.0),
        "y": (-4.0, 4.0),
        "stretch": (-2.0, 2.0),
        "yaw": (-10.0, 10.0),
        "middle": (-np.inf, np.inf),
        "slope": (-_WIDEST_SLOPE * beams, _WIDEST_SLOPE * beams),
    }
    if begin.height > 0:
        limits["height"] = 0.0, _HIGHEST

    def made(values: FloatArray) -> Geometry:
        return replace(begin, **dict(zip(limits, values.tolist(), strict=True)))

    def off(values: FloatArray) -> FloatArray:
        return made(values)._at(there) - beam[learned]

    low, high = np.array(list(limits.values())).T
    first = np.clip([getattr(begin, name) for name in limits], low, high)
    found = least_squares(off, first, loss="soft_l1", bounds=(low, high))
    return float(found.cost), made(found.x)
