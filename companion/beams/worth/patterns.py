"""Array patterns: the response in every direction, and measures of a lobe.

The response of weights f towards u is the array gain |a(u)^T f|^2 / |f|^2, in dB, element gain
included: 0 dB is one isotropic element at the same power (docs/math.md 7).

An *azimuth cut* follows a parallel: azimuth varies, elevation is fixed. An *elevation cut* follows
a meridian: elevation varies, azimuth is fixed. Lobes are measured on whole circles, so that a lobe
may lie across azimuth 180 degrees or over a pole. All measures are those of the exact pattern: by a
scan of at least eight points per narrowest possible lobe, then by refinement.

Over 300 lines: the cut, its lobes and their measures share one refinement of angles.
"""

import math
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from companion.beams.array import steering
from companion.beams.array.geometry import SAME_PLACE_WAVELENGTHS, Array
from companion.values import ComplexArray, FloatArray

FLOOR_DB: Final = -200.0
"""Lowest gain returned, dB, also for an exact null: JSON has no minus infinity."""
BLOCK: Final = 8192  # entries of a steering matrix computed at once, so that they stay in the cache
POINTS_PER_SIDE_LOBE: Final = 8  # points of a scan per narrowest possible lobe
LEAST_POINTS: Final = 360  # least number of points of a scan around a circle
SCAN_MAX: Final = 1 << 25
"""Most points of a scan, times elements: some 0.6 s. The side lobes of other arrays are unknown."""
NEAR: Final = 64  # points examined first to either side of a peak; they nearly always suffice
SECTIONS: Final = np.linspace(0.0, 1.0, 17)
"""Relative positions examined in an interval: each step narrows a crossing 16-fold, an extreme
8-fold."""
HALVING_ROUNDS: Final = 10
EXTREME_ROUNDS: Final = 12
RIVALS_DB: Final = 0.5
"""Gap below the highest scanned side lobe within which another lobe may be the highest, dB."""
PERPENDICULAR_COSINE: Final = (
    1e-4  # boresight component below which a direction counts as perpendicular to it
)
RIPPLE_DB: Final = 1.0
"""Largest rise of the gain above the peak within a lobe, as in a broadened lobe, dB."""
CLIMB_MOVES: Final = 400
ROUNDING: Final = 1e-12  # of a gain, relative
SINGULAR: Final = 1e-9  # slope and curvature, relative to the gain, below which they are rounding

_GRID = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]), axis=-1).reshape(9, 2)
_X, _Y = _GRID.T
_QUADRATIC = np.linalg.pinv(np.stack([_X**0, _X, _Y, _X**2 / 2, _X * _Y, _Y**2 / 2], axis=1))
"""(6, 9): from nine values on a grid to value, slopes and curvatures (xx, xy, yy) in its middle."""


def response_db(array: Array, weights: ComplexArray, directions: FloatArray) -> FloatArray:
    """Return the array gain of weights (M,) towards directions (..., 3), array frame; dB, (...).

    The result is at least ``FLOOR_DB``. Raises ``ValueError`` for weights that are not M finite
    numbers, or all zero, as do the functions below.
    """
    return _db(_gains(array, _unit_power(array, weights), directions))


def azimuth_cut(
    array: Array, weights: ComplexArray, elevation_rad: float, points: int
) -> tuple[FloatArray, FloatArray]:
    """Return azimuths (points,) from -pi to pi, both included, and the response in dB there.

    The last point repeats the first, so that a polar plot is a closed curve. Raises ``ValueError``
    for fewer than two points.
    """
    angles = _span(math.pi, points)
    directions = _Circle.parallel(elevation_rad).directions(angles)
    return angles, response_db(array, weights, directions)


def elevation_cut(
    array: Array, weights: ComplexArray, azimuth_rad: float, points: int
) -> tuple[FloatArray, FloatArray]:
    """Return elevations (points,) from -pi/2 to pi/2, both included, and the response in dB.

    Raises ``ValueError`` for fewer than two points.
    """
    angles = _span(math.pi / 2, points)
    directions = _Circle.meridian(azimuth_rad).directions(angles)
    return angles, response_db(array, weights, directions)


def sphere(
    array: Array, weights: ComplexArray, azimuths_rad: FloatArray, elevations_rad: FloatArray
) -> FloatArray:
    """Return the response in dB on a grid: a row per elevation, a column per azimuth."""
    azimuth, elevation = np.meshgrid(azimuths_rad, elevations_rad)
    level = np.cos(elevation)
    directions = np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), -np.sin(elevation)], axis=-1
    )
    return response_db(array, weights, directions)


def null_depths_db(
    array: Array, weights: ComplexArray, peak_db: float, directions: FloatArray
) -> FloatArray:
    """Return responses towards directions (N, 3) less a peak's, (N,): -60 is a null 60 dB deep."""
    return response_db(array, weights, directions) - peak_db


@dataclass(frozen=True, slots=True)
class CutLobe:
    """Lobe of a pattern in one cut through its peak; angles of the cut, radians.

        half_power_width_rad  between the nearest points on either side where the gain falls to half
        first_nulls_rad       the first minimum beyond them on either side, as angles from the peak,
                              (below 0, above 0)
        side_lobe_db          the highest maximum outside of those, less the peak

    The first two are None if the gain never falls to half, or first rises a decibel above the peak
    (the flank of a stronger lobe); the third also if there is no other maximum, or if a scan for it
    takes too long (``SCAN_MAX``: elements many wavelengths apart). If all elements are
    in one plane across boresight and face alike, front and back look the same: the mirror lobe
    behind is not counted as a side lobe.
    """

    half_power_width_rad: float | None
    first_nulls_rad: tuple[float, float] | None
    side_lobe_db: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Lobe:
    """Lobe of a pattern: its peak (array frame, gain in dB), and its two cuts."""

    peak_azimuth_rad: float
    peak_elevation_rad: float
    peak_db: float
    azimuth: CutLobe
    elevation: CutLobe


def lobe(array: Array, weights: ComplexArray, direction: FloatArray) -> Lobe:
    """Return the lobe of weights (M,) that contains a unit direction (3,) in the array frame.

    Its peak is found by ascent from the direction.
    """
    unit = _unit_power(array, weights)
    peak = _peak_direction(array, unit, direction)
    azimuth, elevation = (float(angle[0]) for angle in steering.angles_rad(peak[np.newaxis]))
    return Lobe(
        peak_azimuth_rad=azimuth,
        peak_elevation_rad=elevation,
        peak_db=float(_db(_gains(array, unit, peak))),
        azimuth=_cut_lobe(_Cut(array, unit, _Circle.parallel(elevation)), azimuth),
        elevation=_cut_lobe(_Cut(array, unit, _Circle.meridian(azimuth)), elevation),
    )


def half_power_beamwidths_rad(
    array: Array, direction: FloatArray
) -> tuple[float | None, float | None]:
    """Return half-power widths, azimuth and elevation, of the beam matched to a direction.

    ``direction`` (3,) is a unit vector in the array frame. A width is None if the gain never falls
    to half along that cut; both are None if no element radiates towards the direction.
    """
    matched = steering.steering_matrix(array, direction[np.newaxis])[:, 0].conj()
    if not matched.any():
        return None, None
    unit = _unit_power(array, matched)
    peak = _peak_direction(array, unit, direction)
    azimuth, elevation = (float(angle[0]) for angle in steering.angles_rad(peak[np.newaxis]))
    return (
        _half_power(_Cut(array, unit, _Circle.parallel(elevation)), azimuth)[0],
        _half_power(_Cut(array, unit, _Circle.meridian(azimuth)), elevation)[0],
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Circle:
    """Circle of directions: middle + cos(t) ahead + sin(t) aside, on the sphere for every t."""

    middle: FloatArray
    ahead: FloatArray
    aside: FloatArray

    @classmethod
    def parallel(cls, elevation_rad: float) -> Self:
        """Return the circle along azimuth, at one elevation."""
        level = math.cos(elevation_rad)
        middle = np.array([0.0, 0.0, -math.sin(elevation_rad)])
        return cls(middle, np.array([level, 0.0, 0.0]), np.array([0.0, level, 0.0]))

    @classmethod
    def meridian(cls, azimuth_rad: float) -> Self:
        """Return the circle along elevation, at one azimuth, continued over the poles."""
        ahead = np.array([math.cos(azimuth_rad), math.sin(azimuth_rad), 0.0])
        return cls(np.zeros(3), ahead, np.array([0.0, 0.0, -1.0]))

    def directions(self, angles_rad: FloatArray) -> FloatArray:
        """Return unit directions (..., 3) at angles (...) of the circle."""
        cosine, sine = np.cos(angles_rad)[..., np.newaxis], np.sin(angles_rad)[..., np.newaxis]
        found: FloatArray = self.middle + cosine * self.ahead + sine * self.aside
        return found


@dataclass(frozen=True, slots=True, eq=False)
class _Cut:
    """Pattern of weights of unit power around a circle."""

    array: Array
    weights: ComplexArray
    circle: _Circle

    def gains(self, angles_rad: FloatArray) -> FloatArray:
        """Return the array gain (not dB) at angles (...) of the circle."""
        return _gains(self.array, self.weights, self.circle.directions(angles_rad))

    def points(self) -> int:
        """Number of points of a scan around the whole circle.

        Between elements 2 r apart in the plane of the circle the phase changes by at most 2 k r per
        radian, and no fringe of the pattern is finer.
        """
        centred = self.array.centred_m
        radius_m = np.hypot(centred @ self.circle.ahead, centred @ self.circle.aside).max()
        fringes = 2 * self.array.wavenumber_radpm * float(radius_m)
        return max(LEAST_POINTS, math.ceil(POINTS_PER_SIDE_LOBE * fringes))

    def most_points(self) -> int:
        """Return the limit on the points of a scan."""
        return max(LEAST_POINTS, SCAN_MAX // self.array.size)


def _span(half_rad: float, points: int) -> FloatArray:
    if points < 2:
        raise ValueError(f"cut has {points} points; give at least 2")
    return np.linspace(-half_rad, half_rad, points)


def _db(gains: FloatArray) -> FloatArray:
    decibels: FloatArray = 10 * np.log10(np.maximum(gains, 10 ** (FLOOR_DB / 10)))
    return decibels


def _unit_power(array: Array, weights: ComplexArray) -> ComplexArray:
    """Scale weights to |f| = 1 in two steps, since squares of very small numbers are 0."""
    if weights.shape != (array.size,) or not np.isfinite(weights).all():
        raise ValueError(f"weights must be {array.size} finite numbers, one for each element")
    most = np.abs(weights).max()
    if most == 0:
        raise ValueError("weights are all zero")
    scaled = weights / most
    unit: ComplexArray = scaled / np.linalg.norm(scaled)
    return unit


def _gains(array: Array, weights: ComplexArray, directions: FloatArray) -> FloatArray:
    rows = directions.reshape(-1, 3)
    gains: FloatArray = np.empty(len(rows))
    block = max(1, BLOCK // array.size)
    for start in range(0, len(rows), block):
        part = slice(start, start + block)
        field = weights @ steering.steering_matrix(array, rows[part])
        gains[part] = field.real**2 + field.imag**2
    return gains.reshape(directions.shape[:-1])


def _peak_direction(array: Array, weights: ComplexArray, direction: FloatArray) -> FloatArray:
    """Return the direction (3,) of the local maximum reached by ascent from ``direction``.

    Newton's method on a quadratic through 3 x 3 directions, in steps too short to leave a lobe.
    These directions lie along the array's axes as seen from there, usually those of the maximum: on
    a ridge (a line of elements has its peak on a cone) it ascends straight.
    """
    centred = array.centred_m
    aperture_m = 2 * float(np.linalg.norm(centred, axis=1).max())
    widest = 0.05 if aperture_m == 0 else min(0.05, array.wavelength_m / aperture_m / 16)
    scatter = centred.T @ centred / max(aperture_m**2, 1e-300)
    reach, best, top = widest, -1.0, direction
    here: FloatArray = direction
    for _ in range(CLIMB_MOVES):
        flat = np.eye(3) - np.outer(here, here)
        across = np.linalg.eigh(flat @ scatter @ flat - np.outer(here, here))[1][:, 1:].T
        around = here + reach * (_GRID @ across)
        gains = _gains(array, weights, around / np.linalg.norm(around, axis=1)[:, np.newaxis])
        _, x, y, xx, xy, yy = (_QUADRATIC @ (gains / max(gains.max(), 1e-300))).tolist()
        step = _uphill(np.array([x, y]), np.array([[xx, xy], [xy, yy]]), 4 * reach**2)
        higher = gains[4] >= best * (1 - ROUNDING)  # also where it returns to the top
        if higher:
            best, top, onward = gains[4], here, here + reach * (step @ across)
        else:  # the previous step was too long
            onward = top
        if higher and np.linalg.norm(step) >= 1:
            reach = min(2 * reach, widest)
        elif reach > widest / 64:
            reach /= 4
        else:
            break
        here = onward / np.linalg.norm(onward)
    return top


def _uphill(slope: FloatArray, curvature: FloatArray, bend: float) -> FloatArray:
    """Return the step (2,) to the maximum of a quadratic, at most 2 along each of its axes.

    From a minimum or a saddle the step follows the axis that rises most. On a ridge, an apparent
    rise is that of the sphere itself: it is at most ``bend`` of the other axis' curvature.
    """
    values, axes = np.linalg.eigh(curvature)
    along = slope @ axes
    newton = np.divide(along, -values, out=2 * np.sign(along), where=values < -SINGULAR)
    steps = np.where(np.abs(along) > SINGULAR, np.clip(newton, -2.0, 2.0), 0.0)
    if not steps.any() and values[1] > max(SINGULAR, -bend * values[0]):
        steps[1] = 2.0
    climbed: FloatArray = axes @ steps
    return climbed


def _cut_lobe(cut: _Cut, peak_rad: float) -> CutLobe:
    width, nulls = _half_power(cut, peak_rad)
    side = None if nulls is None else _side_lobe_db(cut, peak_rad, nulls)
    return CutLobe(width, nulls, side)


def _half_power(cut: _Cut, peak_rad: float) -> tuple[float | None, tuple[float, float] | None]:
    """Return a lobe's width at half power, and the first minima beyond, from the peak."""
    half = float(cut.gains(np.array(peak_rad))) / 2
    points = cut.points()
    step = 2 * math.pi / points
    ways = np.array([[-1.0], [1.0]])
    for count in (min(NEAR, points), min(points, cut.most_points())):
        offsets = step * np.arange(count + 1)
        gains = cut.gains(peak_rad + ways * offsets)
        low = gains < half
        bottom = (np.diff(gains, axis=1, append=-1.0) >= 0) & np.logical_or.accumulate(low, axis=1)
        if bottom.any(axis=1).all():
            fall, turn = low.argmax(axis=1), bottom.argmax(axis=1)
            lobe_most = max(gains[0, : fall[0]].max(), gains[1, : fall[1]].max())
            if lobe_most > 2 * half * 10 ** (RIPPLE_DB / 10):
                return None, None
            edges = _crossings(cut, peak_rad, half, ways * offsets[fall - 1][:, np.newaxis], step)
            around = ways * offsets[turn][:, np.newaxis] + step * np.array([-1.0, 1.0])
            below, above = (_extremes(cut, peak_rad + around, -1.0)[0] - peak_rad).tolist()
            return float(edges.sum()), (below, above)
    return None, None


def _crossings(
    cut: _Cut, peak_rad: float, half: float, inner: FloatArray, step: float
) -> FloatArray:
    """Return distances (2,) below and above the peak, both positive, where the gain is ``half``.

    ``inner`` (2, 1) are angles from the peak, one step before the crossing.
    """
    ways, near = np.array([[-1.0], [1.0]]), np.abs(inner)
    for _ in range(HALVING_ROUNDS):
        offsets = near + step * SECTIONS
        low = cut.gains(peak_rad + ways * offsets) < half
        low[:, -1] = True  # known, despite rounding
        near = np.take_along_axis(offsets, np.maximum(low.argmax(axis=1) - 1, 0)[:, np.newaxis], 1)
        step *= float(SECTIONS[1])
    return near[:, 0] + step / 2


def _extremes(cut: _Cut, brackets: FloatArray, sign: float) -> tuple[FloatArray, FloatArray]:
    """Find the highest (sign 1) or lowest (-1) point in each of (K, 2) brackets: angles, gains."""
    low, high = brackets[:, :1], brackets[:, 1:]
    for _ in range(EXTREME_ROUNDS):
        angles = low + (high - low) * SECTIONS
        best = (sign * cut.gains(angles)).argmax(axis=1)[:, np.newaxis]
        low = np.take_along_axis(angles, np.maximum(best - 1, 0), axis=1)
        high = np.take_along_axis(angles, np.minimum(best + 1, len(SECTIONS) - 1), axis=1)
    middle = (low[:, 0] + high[:, 0]) / 2
    return middle, cut.gains(middle)


def _side_lobe_db(cut: _Cut, peak_rad: float, nulls: tuple[float, float]) -> float | None:
    """Return the highest maximum outside the first nulls, less the peak, dB."""
    points = cut.points()
    if points > cut.most_points():
        return None
    step = 2 * math.pi / points
    offsets: FloatArray = step * np.arange(points, dtype=np.float64)
    angles: FloatArray = offsets + peak_rad
    directions = cut.circle.directions(angles)
    gains = _gains(cut.array, cut.weights, directions)
    tops = (gains >= np.roll(gains, 1)) & (gains > np.roll(gains, -1))
    tops &= (offsets > nulls[1]) & (offsets < 2 * math.pi + nulls[0])
    side = math.copysign(1.0, directions[0, 0])
    mirrored = _mirrored(cut.array) and abs(directions[0, 0]) > PERPENDICULAR_COSINE
    if mirrored:
        tops &= directions[:, 0] * side >= -step
    while tops.any():
        rivals = np.flatnonzero(tops & (gains >= gains[tops].max() * 10 ** (-RIVALS_DB / 10)))
        brackets = angles[rivals][:, np.newaxis] + step * np.array([-1.0, 1.0])
        found, highest = _extremes(cut, brackets, 1.0)
        behind = mirrored & (cut.circle.directions(found)[:, 0] * side < -PERPENDICULAR_COSINE)
        if not behind.any():
            return float(_db(highest.max()) - _db(gains[0]))
        tops[rivals[behind]] = False
    return None


def _mirrored(array: Array) -> bool:
    """Return whether directions and their images in the yz plane look alike to the elements."""
    depths = np.ptp(array.elements_m[:, 0]) / array.wavelength_m
    return array.element_from_array is None and bool(depths < SAME_PLACE_WAVELENGTHS)
