"""WGS84 and the local frame.

The local frame is north-east-down at a fixed origin, and Cartesian: a far point has its exact
straight-line coordinates, and only "north" and "down" differ there from the directions at the
origin. ``local_from_ned`` rotates one into the other. Heights are used as the sender gives them
(above mean sea level for GLOBAL_POSITION_INT); a common datum error cancels in every difference of
positions.
"""

import math
from typing import Annotated, Final, NamedTuple

import numpy as np

from companion.values import FloatArray, Vector
from companion.values.described import Meaning

SEMI_MAJOR_M: Final = 6_378_137.0
SEMI_MINOR_M: Final = SEMI_MAJOR_M * (1 - 1 / 298.257223563)
ECCENTRICITY2: Final = 1 - (SEMI_MINOR_M / SEMI_MAJOR_M) ** 2
SECOND_ECCENTRICITY2: Final = (SEMI_MAJOR_M / SEMI_MINOR_M) ** 2 - 1
"""Square of the second eccentricity. Source of the constants: WGS84 (NIMA TR8350.2)."""


def ned_from_ecef(lat_deg: float, lon_deg: float) -> FloatArray:
    """Return the rotation (3, 3) from earth-centred axes to north-east-down at a position.

    Source: e.g. Groves, Principles of GNSS (2013), eq. 2.150.
    """
    lat, lon = math.radians(lat_deg), math.radians(lon_deg)
    sin_lat, cos_lat, sin_lon, cos_lon = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
    return np.array(
        [
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [-sin_lon, cos_lon, 0.0],
            [-cos_lat * cos_lon, -cos_lat * sin_lon, -sin_lat],
        ]
    )


class Place(NamedTuple):
    """Position on Earth: WGS84 degrees, metres above the ellipsoid or mean sea level, as given."""

    lat_deg: Annotated[float, Meaning("latitude, WGS84", example=47.3977)]
    lon_deg: Annotated[float, Meaning("longitude, WGS84", example=8.5456)]
    alt_m: Annotated[float, Meaning("altitude above the datum of its reports", example=531.2)]


class _Axes:
    """North, east and down axes at a position, by sines and cosines."""

    __slots__ = ("cos_lat", "cos_lon", "sin_lat", "sin_lon")

    def __init__(self, lat_deg: float, lon_deg: float) -> None:
        lat, lon = math.radians(lat_deg), math.radians(lon_deg)
        self.sin_lat, self.cos_lat = math.sin(lat), math.cos(lat)
        self.sin_lon, self.cos_lon = math.sin(lon), math.cos(lon)

    def ecef_m(self, alt_m: float) -> Vector:
        """Return earth-centred coordinates of the position at a height."""
        sine, cosine = self.sin_lat, self.cos_lat
        normal_m = SEMI_MAJOR_M**2 / math.hypot(SEMI_MAJOR_M * cosine, SEMI_MINOR_M * sine)
        across_m = (normal_m + alt_m) * cosine
        z_m = (normal_m * (SEMI_MINOR_M / SEMI_MAJOR_M) ** 2 + alt_m) * sine
        return across_m * self.cos_lon, across_m * self.sin_lon, z_m

    def ned(self, x: float, y: float, z: float) -> Vector:
        """Rotate an earth-centred vector to north, east and down at the position."""
        out = self.cos_lon * x + self.sin_lon * y
        return (
            self.cos_lat * z - self.sin_lat * out,
            self.cos_lon * y - self.sin_lon * x,
            -(self.cos_lat * out + self.sin_lat * z),
        )

    def ecef(self, north: float, east: float, down: float) -> Vector:
        """Rotate north, east, down at the position to earth-centred axes; inverse of ``ned``."""
        out = -self.sin_lat * north - self.cos_lat * down
        return (
            self.cos_lon * out - self.sin_lon * east,
            self.sin_lon * out + self.cos_lon * east,
            self.cos_lat * north - self.sin_lat * down,
        )


class LocalFrame:
    """Local north-east-down frame at an origin given in degrees and metres."""

    def __init__(self, lat_deg: float, lon_deg: float, alt_m: float) -> None:
        self.origin = (lat_deg, lon_deg, alt_m)
        self._local_from_ecef = ned_from_ecef(lat_deg, lon_deg)
        self._axes = _Axes(lat_deg, lon_deg)
        self._origin = self._axes.ecef_m(alt_m)
        self._origin_m = np.array(self._origin)
        self._rows = tuple(
            zip(self._origin_m.tolist(), *self._local_from_ecef.tolist(), strict=True)
        )

    @property
    def origin_ecef_m(self) -> FloatArray:
        """Earth-centred coordinates (3,) of the origin."""
        return self._origin_m.copy()

    def localise(
        self, lat_deg: float, lon_deg: float, alt_m: float, velocity_ned: Vector | None
    ) -> tuple[Vector, Vector | None]:
        """Return local coordinates of a position, and of a velocity in north-east-down there."""
        there, here = _Axes(lat_deg, lon_deg), self._axes
        (x, y, z), (x0, y0, z0) = there.ecef_m(alt_m), self._origin
        position = here.ned(x - x0, y - y0, z - z0)
        return position, None if velocity_ned is None else here.ned(*there.ecef(*velocity_ned))

    def position_ned_m(self, lat_deg: float, lon_deg: float, alt_m: float) -> FloatArray:
        """Return local coordinates (3,) of a position on Earth, in metres."""
        return np.array(self.localise(lat_deg, lon_deg, alt_m, None)[0])

    def local_from_ned(self, lat_deg: float, lon_deg: float) -> FloatArray:
        """Return the rotation (3, 3) from north-east-down at a position to this frame."""
        return self._local_from_ecef @ ned_from_ecef(lat_deg, lon_deg).T

    def place(self, north_m: float, east_m: float, down_m: float) -> Place:
        """Return the position on Earth of one local point; faster than ``geodetic``."""
        return _geodetic(
            *(at + x * north_m + y * east_m + z * down_m for at, x, y, z in self._rows)
        )

    def geodetic(self, position_ned_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return latitude and longitude in degrees and height in metres of local points, (N, 3)."""
        ecef_m = np.asarray(position_ned_m, dtype=float) @ self._local_from_ecef + self._origin_m
        places = [_geodetic(*point) for point in ecef_m.tolist()]
        lat, lon, alt = np.array(places).reshape(-1, 3).T
        return lat, lon, alt


def _geodetic(x_m: float, y_m: float, z_m: float) -> Place:
    """Return the position on Earth of an earth-centred point.

    Bowring's formula (1976), two steps: exact to rounding at all flight altitudes. pymap3d does the
    same for arrays; for the few points of an update its overhead would dominate.
    """
    across_m = math.hypot(x_m, y_m)
    lat = math.atan2(z_m, across_m * (1 - ECCENTRICITY2))
    for _ in range(2):
        reduced = math.atan2(SEMI_MINOR_M * math.sin(lat), SEMI_MAJOR_M * math.cos(lat))
        lat = math.atan2(
            z_m + SECOND_ECCENTRICITY2 * SEMI_MINOR_M * math.sin(reduced) ** 3,
            across_m - ECCENTRICITY2 * SEMI_MAJOR_M * math.cos(reduced) ** 3,
        )
    sine, cosine = math.sin(lat), math.cos(lat)
    normal_m = SEMI_MAJOR_M / math.sqrt(1 - ECCENTRICITY2 * sine * sine)
    alt_m = across_m * cosine + (z_m + ECCENTRICITY2 * normal_m * sine) * sine - normal_m
    return Place(math.degrees(lat), math.degrees(math.atan2(y_m, x_m)), alt_m)
