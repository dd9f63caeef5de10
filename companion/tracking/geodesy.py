"""WGS84 and the local frame.

The local frame is north-east-down at a fixed origin, and Cartesian: a point far away has its
exact straight-line coordinates, and only "north" and "down" differ there from the directions
here. ``local_from_ned`` turns one into the other. Heights are taken as given by the sender
(above mean sea level for GLOBAL_POSITION_INT); a common error of datum cancels in every
difference of positions.
"""

import math
from typing import cast

import numpy as np
import pymap3d

from companion.values import FloatArray


def ned_from_ecef(lat_deg: float, lon_deg: float) -> FloatArray:
    """Rotation (3, 3) from earth-centred axes to north-east-down at a place.

    Source: any text on navigation frames, e.g. Groves, Principles of GNSS (2013), eq. 2.150.
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


class LocalFrame:
    """North-east-down at an origin given in degrees and metres."""

    def __init__(self, lat_deg: float, lon_deg: float, alt_m: float) -> None:
        self.origin = (lat_deg, lon_deg, alt_m)
        self._local_from_ecef = ned_from_ecef(lat_deg, lon_deg)

    def position_ned_m(self, lat_deg: float, lon_deg: float, alt_m: float) -> FloatArray:
        """Local coordinates, shape (3,), of a place."""
        return np.array(pymap3d.geodetic2ned(lat_deg, lon_deg, alt_m, *self.origin), dtype=float)

    def local_from_ned(self, lat_deg: float, lon_deg: float) -> FloatArray:
        """Rotation (3, 3) from north-east-down at another place to this frame."""
        return self._local_from_ecef @ ned_from_ecef(lat_deg, lon_deg).T

    def geodetic(self, position_ned_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Latitude and longitude in degrees and height in metres of local points, (N, 3)."""
        north, east, down = np.asarray(position_ned_m, dtype=float).T
        return cast(
            tuple[FloatArray, FloatArray, FloatArray],
            pymap3d.ned2geodetic(north, east, down, *self.origin),
        )
