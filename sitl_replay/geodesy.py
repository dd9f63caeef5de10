"""From metres about an origin to latitude, longitude and height, fast enough for a thousand UAVs.

Sources: WGS84 (NIMA TR8350.2); the closed form of B. R. Bowring, "Transformation from spatial to
geographical coordinates", Survey Review 23 (1976), and for the height "The accuracy of geodetic
latitude and height equations", Survey Review 28 (1985). Both are exact to micrometres up to
20 km. ``tests/sitl_replay/test_geodesy.py`` holds them against pymap3d.
"""

import math
from typing import Final, NamedTuple, Self

from sitl_replay.motion import Vector

SEMI_MAJOR_M: Final = 6_378_137.0
FLATTENING: Final = 1.0 / 298.257223563
SEMI_MINOR_M: Final = SEMI_MAJOR_M * (1.0 - FLATTENING)
_E2: Final = FLATTENING * (2.0 - FLATTENING)
_SECOND_E2: Final = _E2 / (1.0 - _E2)


class Place(NamedTuple):
    """A point on Earth: WGS84 degrees, metres above mean sea level."""

    lat_deg: float
    lon_deg: float
    alt_m: float


class LocalPlane(NamedTuple):
    """The tangent plane at an origin: where the origin is in the Earth-fixed frame, and the turn
    from north-east-down into that frame, row by row."""

    x_m: float
    y_m: float
    z_m: float
    x_row: Vector
    y_row: Vector
    z_row: Vector

    @classmethod
    def at(cls, origin: Place) -> Self:
        """The plane that touches the ellipsoid's parallel surface at ``origin``."""
        lat_rad, lon_rad = math.radians(origin.lat_deg), math.radians(origin.lon_deg)
        sin_lat, cos_lat = math.sin(lat_rad), math.cos(lat_rad)
        sin_lon, cos_lon = math.sin(lon_rad), math.cos(lon_rad)
        normal_m = SEMI_MAJOR_M / math.sqrt(1.0 - _E2 * sin_lat**2)
        out_m = (normal_m + origin.alt_m) * cos_lat
        return cls(
            out_m * cos_lon,
            out_m * sin_lon,
            (normal_m * (1.0 - _E2) + origin.alt_m) * sin_lat,
            (-sin_lat * cos_lon, -sin_lon, -cos_lat * cos_lon),
            (-sin_lat * sin_lon, cos_lon, -cos_lat * sin_lon),
            (cos_lat, 0.0, -sin_lat),
        )

    def place(self, position_ned_m: Vector) -> Place:
        """The point at ``position_ned_m`` metres from the origin. Not for the poles."""
        north_m, east_m, down_m = position_ned_m
        to_x, to_y, to_z = self.x_row, self.y_row, self.z_row
        x_m = self.x_m + to_x[0] * north_m + to_x[1] * east_m + to_x[2] * down_m
        y_m = self.y_m + to_y[0] * north_m + to_y[1] * east_m + to_y[2] * down_m
        z_m = self.z_m + to_z[0] * north_m + to_z[2] * down_m
        out_m = math.sqrt(x_m * x_m + y_m * y_m)
        reduced_rad = math.atan2(z_m * SEMI_MAJOR_M, out_m * SEMI_MINOR_M)
        lat_rad = math.atan2(
            z_m + _SECOND_E2 * SEMI_MINOR_M * math.sin(reduced_rad) ** 3,
            out_m - _E2 * SEMI_MAJOR_M * math.cos(reduced_rad) ** 3,
        )
        sin_lat = math.sin(lat_rad)
        alt_m = (
            out_m * math.cos(lat_rad)
            + z_m * sin_lat
            - SEMI_MAJOR_M * math.sqrt(1.0 - _E2 * sin_lat * sin_lat)
        )
        return Place(math.degrees(lat_rad), math.degrees(math.atan2(y_m, x_m)), alt_m)
