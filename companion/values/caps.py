"""Caps of the unit sphere: sets of possible directions."""

import math
from typing import NamedTuple

from companion.values.numbers import FloatArray


class Cap(NamedTuple):
    """Directions within an angle of a unit vector (3,)."""

    center: FloatArray
    radius_rad: float

    def is_apart_from(self, other: "Cap") -> bool:
        """Return whether no direction is in both caps."""
        return angle_rad(self.center, other.center) > self.radius_rad + other.radius_rad


def lens(apart: float, one: float, other: float) -> tuple[float, float] | None:
    """Return place and radius of the smallest cap around what two caps of a sphere share.

        apart       angle between their centres, rad
        one, other  their radii, rad

    The place is the angle from the first centre towards the second. None if they share nothing.
    Valid on spheres of any dimension.
    """
    if apart > one + other:
        return None
    if apart + one <= other:
        return 0.0, one
    if apart + other <= one:
        return apart, other
    if max(one, other) >= math.pi / 2:
        return (0.0, one) if one <= other else (apart, other)
    # The edges meet on the plane that crosses the arc between the centres at ``along``.
    along = math.atan2(
        math.cos(other) - math.cos(one) * math.cos(apart), math.cos(one) * math.sin(apart)
    )
    if along <= 0.0:
        return 0.0, one
    if along >= apart:
        return apart, other
    return along, math.acos(min(1.0, math.cos(one) / math.cos(along)))


def angle_rad(one: FloatArray, other: FloatArray) -> float:
    """Return the angle between two unit vectors (3,); exact also for small angles."""
    x, y, z = (one - other).tolist()
    return 2.0 * math.asin(min(1.0, math.sqrt(x * x + y * y + z * z) / 2.0))
