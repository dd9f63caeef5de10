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

    def common(self, other: "Cap") -> "Cap | None":
        """Return the smallest cap around what both share; None if they share nothing."""
        small, large = (self, other) if self.radius_rad <= other.radius_rad else (other, self)
        apart = angle_rad(small.center, large.center)
        if apart > small.radius_rad + large.radius_rad:
            return None
        if apart + small.radius_rad <= large.radius_rad or large.radius_rad >= math.pi / 2:
            return small
        # The edges meet ``along`` from the smaller centre, on the arc between the centres.
        cos_small, cos_large = math.cos(small.radius_rad), math.cos(large.radius_rad)
        along = math.atan2(cos_large - cos_small * math.cos(apart), cos_small * math.sin(apart))
        if along <= 0.0:  # the common chord is beyond the smaller centre
            return small
        radius = math.acos(min(1.0, cos_small / math.cos(along)))
        center = math.sin(apart - along) * small.center + math.sin(along) * large.center
        return Cap(center / math.sqrt(center @ center), radius)


def angle_rad(one: FloatArray, other: FloatArray) -> float:
    """Return the angle between two unit vectors (3,); exact also for small angles."""
    x, y, z = (one - other).tolist()
    return 2.0 * math.asin(min(1.0, math.sqrt(x * x + y * y + z * z) / 2.0))
