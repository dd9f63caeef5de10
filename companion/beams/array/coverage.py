"""Coverage: the directions in which beams may point.

The field of view is a cone about boresight; the steering limits are ranges of azimuth and
elevation; both are in the array frame. Sectors hidden by the airframe are in the carrier's body
frame, in which the airframe is fixed. Azimuth is atan2(y, x), to the right; elevation is asin(-z),
up. Edges belong to the allowed range, and to a hidden sector.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.values import FloatArray, UserError

BoolArray = NDArray[np.bool_]
QUARTER: Final = math.pi / 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Sector:
    """Range of azimuths (positive right) and range of elevations (positive up), radians.

    Azimuths are -pi to pi and may cross the tail: from 170 to -170 degrees is 20 degrees wide, from
    -180 to 180 all around; straight up and down the azimuth is 0. A hidden sector is in the
    carrier's body frame. ``azimuths`` and ``elevations`` are the two ranges as text, degrees.

    Raises ``UserError`` for angles out of range, elevations out of order, and a sector without
    width.
    """

    azimuth_from_rad: float
    azimuth_to_rad: float
    elevation_from_rad: float
    elevation_to_rad: float

    def __post_init__(self) -> None:
        if not all(abs(a) <= math.pi for a in (self.azimuth_from_rad, self.azimuth_to_rad)):
            raise UserError(f"azimuth {self.azimuths} degrees: give angles from -180 to 180")
        if self.width_rad == 0:
            raise UserError(f"azimuth {self.azimuths} degrees: give a range above 0 degrees")
        if not -QUARTER <= self.elevation_from_rad < self.elevation_to_rad <= QUARTER:
            raise UserError(
                f"elevation {self.elevations} degrees: give ascending angles from -90 to 90"
            )

    @property
    def width_rad(self) -> float:
        """Width of the azimuth range, from its first azimuth rightward: above 0, at most 2 pi."""
        width = self.azimuth_to_rad - self.azimuth_from_rad
        return width if width >= 0 else max(width + 2 * math.pi, 0.0)

    def holds(self, directions: FloatArray) -> BoolArray:
        """Return a mask (...) of the unit directions (..., 3) inside the sector or on its edge."""
        azimuth, elevation = _angles(directions)
        return self.spans(azimuth) & self.reaches(elevation)

    def to_edge_rad(self, directions: FloatArray) -> FloatArray:
        """Return angles (...) from directions (..., 3), in or out, to the sector's nearest edge.

        Exact: the sides are arcs of great circles, and the nearest point of a parallel has the same
        azimuth or is a corner. A sector all around has no sides; a pole is no edge. Infinite for
        the whole sphere.
        """
        azimuth, elevation = _angles(directions)
        nearest = np.full(azimuth.shape, math.inf)
        abreast = self.spans(azimuth)
        for edge in (self.elevation_from_rad, self.elevation_to_rad):
            if abs(edge) < QUARTER:
                nearest = np.where(abreast, np.minimum(nearest, np.abs(elevation - edge)), nearest)
        if self.width_rad < 2 * math.pi:
            for side in (self.azimuth_from_rad, self.azimuth_to_rad):
                nearest = np.minimum(nearest, self._to_side_rad(directions, side))
        return nearest

    def spans(self, azimuth: FloatArray) -> BoolArray:
        """Return whether azimuths lie within the sector's range."""
        beyond = np.mod(azimuth - self.azimuth_from_rad, 2 * math.pi)
        spanned: BoolArray = beyond <= self.width_rad
        return spanned

    def reaches(self, elevation: FloatArray) -> BoolArray:
        """Return whether elevations lie within the sector's range."""
        return (self.elevation_from_rad <= elevation) & (elevation <= self.elevation_to_rad)

    def _to_side_rad(self, directions: FloatArray, side_rad: float) -> FloatArray:
        """Return the angle from directions to a side, a meridian's arc between two elevations."""
        x, y, up = directions[..., 0], directions[..., 1], -directions[..., 2]
        ahead = x * math.cos(side_rad) + y * math.sin(side_rad)
        aside = y * math.cos(side_rad) - x * math.sin(side_rad)
        foot = np.arctan2(up, ahead)  # elevation of the nearest point of the great circle
        on_arc = (self.elevation_from_rad <= foot) & (foot <= self.elevation_to_rad)
        nearest = np.where(on_arc, np.arctan2(np.abs(aside), np.hypot(ahead, up)), math.inf)
        for edge in (self.elevation_from_rad, self.elevation_to_rad):
            towards = ahead * math.cos(edge) + up * math.sin(edge)
            across = up * math.cos(edge) - ahead * math.sin(edge)
            nearest = np.minimum(nearest, np.arctan2(np.hypot(aside, across), towards))
        return nearest

    def __str__(self) -> str:
        return f"azimuth {self.azimuths}, elevation {self.elevations}"

    @property
    def azimuths(self) -> str:
        return f"{_degrees(self.azimuth_from_rad)} to {_degrees(self.azimuth_to_rad)}"

    @property
    def elevations(self) -> str:
        return f"{_degrees(self.elevation_from_rad)} to {_degrees(self.elevation_to_rad)}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """Directions in which the array may point. A limit of None is no limit.

        field_of_view_rad     full angle of a cone about boresight, at most 2 pi, the whole sphere
        azimuth_limits_rad    steering range (from, to) in the array frame, as in a ``Sector``
        elevation_limits_rad  steering range (from, to) in the array frame
        hidden                sectors that the airframe hides, in the body frame

    Raises ``UserError`` for angles out of range.
    """

    field_of_view_rad: float | None = None
    azimuth_limits_rad: tuple[float, float] | None = None
    elevation_limits_rad: tuple[float, float] | None = None
    hidden: tuple[Sector, ...] = ()

    def __post_init__(self) -> None:
        view = self.field_of_view_rad
        if view is not None and not 0 < view <= 2 * math.pi:
            raise UserError(
                f"field of view {_degrees(view)} degrees: give more than 0, at most 360"
            )
        try:
            self.limits()
        except ValueError as error:
            raise UserError(f"steering limits: {error}") from None

    def limits(self) -> Sector:
        """Return the steering range as a sector of the array frame; default: the whole sphere."""
        azimuth_from_rad, azimuth_to_rad = self.azimuth_limits_rad or (-math.pi, math.pi)
        elevation_from_rad, elevation_to_rad = self.elevation_limits_rad or (-QUARTER, QUARTER)
        return Sector(
            azimuth_from_rad=azimuth_from_rad,
            azimuth_to_rad=azimuth_to_rad,
            elevation_from_rad=elevation_from_rad,
            elevation_to_rad=elevation_to_rad,
        )


EVERYWHERE: Final = Coverage()  # no limits


def refusals(
    coverage: Coverage, directions_array: FloatArray, directions_body: FloatArray
) -> list[str | None]:
    """Return for each of N directions why no beam may point there; None if a beam may.

    Both arguments are the same unit directions (N, 3): in the array frame and in the carrier's body
    frame.
    """
    reasons: list[str | None] = [None] * len(directions_array)

    def refuse(where: BoolArray, reason: str, angles: FloatArray) -> None:
        for i in np.flatnonzero(where).tolist():
            reasons[i] = reasons[i] or reason.format(_degrees(angles[i]))

    view, limits = coverage.field_of_view_rad, coverage.limits()
    off = _off_boresight(directions_array)
    if view is not None:
        outside = f"outside the field of view of {_degrees(view)}"
        refuse(off > view / 2, f"{{}} degrees off boresight, {outside}", off)
    azimuth, elevation = _angles(directions_array)
    outside = f"outside the steering limits of {limits.azimuths}"
    refuse(~limits.spans(azimuth), f"azimuth {{}} degrees, {outside}", azimuth)
    outside = f"outside the steering limits of {limits.elevations}"
    refuse(~limits.reaches(elevation), f"elevation {{}} degrees, {outside}", elevation)
    for sector in coverage.hidden:
        refuse(sector.holds(directions_body), f"hidden by the airframe ({sector})", off)
    return reasons


def margin_rad(
    coverage: Coverage, directions_array: FloatArray, directions_body: FloatArray
) -> FloatArray:
    """Angle from directions to the nearest edge of the coverage.

    Both arguments are the same unit directions (..., 3): in the array frame and in the carrier's
    body frame. The result has shape (...) and is exact on the sphere: 0 outside the coverage,
    infinite without limits. Every direction nearer than the margin is covered; a pointing bound
    beyond it may leave the coverage, and then no gain is guaranteed.
    """
    view, limits = coverage.field_of_view_rad, coverage.limits()
    edge = limits.to_edge_rad(directions_array)
    nearest = np.where(limits.holds(directions_array), edge, 0.0)
    if view is not None and view < 2 * math.pi:
        nearest = np.minimum(nearest, view / 2 - _off_boresight(directions_array))
    for sector in coverage.hidden:
        edge = sector.to_edge_rad(directions_body)
        nearest = np.minimum(nearest, np.where(sector.holds(directions_body), 0.0, edge))
    margin: FloatArray = np.maximum(nearest, 0.0)
    return margin


def _off_boresight(directions: FloatArray) -> FloatArray:
    off: FloatArray = np.arctan2(
        np.hypot(directions[..., 1], directions[..., 2]), directions[..., 0]
    )
    return off


def _angles(directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return azimuth and elevation of directions (..., 3); arctan2 is exact up to the poles."""
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    return np.arctan2(y, x), np.arctan2(-z, np.hypot(x, y))


def _degrees(angle_rad: float) -> str:
    """Format an angle to a tenth of a degree, without trailing zeros or "-0"."""
    return f"{round(math.degrees(angle_rad), 1) + 0.0:g}"
