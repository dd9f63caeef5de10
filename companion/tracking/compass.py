"""Set of the errors of a carrier's reported attitudes, from the directions in which UAVs are seen.

The error is a rotation W in the local frame, constant but for a stated rate: the direction u of a
UAV is seen as W u. It is written as W = exp([w]) V, with V the centre and w, a rotation vector, in
a polytope that ``DIRECTIONS`` extents describe. A UAV at u, known to ``position_rad``, and seen
within a cap confines w to a cylinder with the axis V u. At most ``false_uavs`` UAVs may report
false positions: in each direction all but so many cylinders contain w. See docs/math.md 5.8.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull

from companion.values import Cap, FloatArray, angle_rad

MAJORITY: Final = 3  # least number of observed UAVs of which some may be false
RECENTRE_RAD: Final = math.radians(0.3)  # distance of the polytope's centre at which V follows it


def _normals() -> FloatArray:
    """Return unit vectors towards the corners, edges and faces of a cube, (26, 3)."""
    grid = [v for v in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(v)]
    return np.array([np.array(v) / math.sqrt(sum(x * x for x in v)) for v in grid])


DIRECTIONS: Final = _normals()
_OPPOSITE: Final = np.array([int(np.argmin(DIRECTIONS @ one)) for one in DIRECTIONS])
_TRIANGLES: Final = ConvexHull(DIRECTIONS).simplices  # (T, 3), neighbouring directions
_CORNERS: Final = np.linalg.inv(DIRECTIONS[_TRIANGLES])  # (T, 3, 3), corner from three extents


class Seen(NamedTuple):
    """Directions in which a UAV may be, and in which the array may see it; local frame."""

    uav: str
    reported: Cap  # by its position
    seen: Cap  # by the array, as the reported attitude shows it


def rotation(vector_rad: FloatArray) -> FloatArray:
    """Return exp([w]), (3, 3): the rotation by a rotation vector (3,), Rodrigues' formula."""
    x, y, z = vector_rad.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    if angle == 0.0:
        return np.eye(3)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) / angle
    turned: FloatArray = np.eye(3) + math.sin(angle) * cross
    return turned + (1.0 - math.cos(angle)) * cross @ cross


def rotation_angle_rad(matrix: FloatArray) -> float:
    """Return the angle of a rotation (3, 3)."""
    off = matrix - np.eye(3)
    return 2.0 * math.asin(min(1.0, math.sqrt(float((off * off).sum()) / 8.0)))


@dataclass(frozen=True, slots=True, eq=False)
class Misalignment:
    """Error W of the reported attitude: within ``bound_rad`` of ``center``, (3, 3)."""

    center: FloatArray
    bound_rad: float

    @property
    def largest_rad(self) -> float:
        """Largest angle of the error."""
        return min(math.pi, rotation_angle_rad(self.center) + self.bound_rad)


@dataclass(frozen=True, slots=True, eq=False)
class ErrorSet:
    """Polytope of the errors exp([w]) V: V ``center``, n.w at most ``extents`` (26,); immutable."""

    center: FloatArray
    extents: FloatArray

    @classmethod
    def within(cls, bound_rad: float) -> "ErrorSet":
        """Return the errors of at most an angle."""
        return cls(np.eye(3), np.full(len(DIRECTIONS), bound_rad))

    @property
    def corners(self) -> FloatArray:
        """Points (T, 3) whose hull contains the polytope."""
        found: FloatArray = np.einsum("tij,tj->ti", _CORNERS, self.extents[_TRIANGLES])
        return found

    @property
    def is_empty(self) -> bool:
        """Whether no error is possible, as two opposite extents show."""
        return bool((self.extents + self.extents[_OPPOSITE]).min() < 0.0)

    def ball(self) -> tuple[FloatArray, float]:
        """Return centre (3,) and radius of a ball around the polytope.

        A point in direction n from the centre has n between three neighbouring normals, so it is no
        farther than the corner of these three faces.
        """
        at = (3.0 / len(DIRECTIONS)) * (self.extents @ DIRECTIONS)
        off = self.corners - at
        return at, min(math.pi, math.sqrt(float((off * off).sum(axis=1).max())))

    def misalignment(self) -> Misalignment:
        """Return the error as one rotation and a bound.

        exp([w]) and exp([a]) differ by an angle of at most |w - a|.
        """
        at, radius = self.ball()
        return Misalignment(rotation(at) @ self.center, radius)

    def grown(self, by_rad: float) -> "ErrorSet":
        """Return the set after a change of the error by at most an angle.

        exp([v]) exp([w]) is exp([x]) with |x - w| at most the angle of v times (x/2) / sin(x/2),
        the norm of the inverse Jacobian; x is at most |v| + |w|.
        """
        at, radius = self.ball()
        size = math.sqrt(at @ at) + radius + by_rad
        if size >= math.pi / 2:
            return ErrorSet(self.center, self.extents + math.pi)
        return ErrorSet(self.center, self.extents + by_rad * (1.0 + size * size / 6.0))

    def within_ball(self, bound_rad: float) -> "Misalignment | None":
        """Return the error if its angle is at most ``bound_rad``; None if that excludes it.

        The smallest ball around what two balls share.
        """
        inside = self.cut(prior(bound_rad, self.center))
        offset = _vector(self.center)
        at, radius = inside.ball()
        size = math.sqrt(offset @ offset)
        at, radius = at + offset, radius + (size + math.sqrt(at @ at) + radius) * size
        apart = math.sqrt(at @ at)
        if inside.is_empty or apart > radius + bound_rad:
            return None
        if apart + radius <= bound_rad:
            return Misalignment(rotation(at), radius)
        along = 0.0
        if apart > 0.0:
            along = (apart * apart + bound_rad * bound_rad - radius * radius) / (2.0 * apart)
        if along <= 0.0:
            return Misalignment(np.eye(3), bound_rad)
        if along >= apart:
            return Misalignment(rotation(at), radius)
        half = math.sqrt(max(bound_rad * bound_rad - along * along, 0.0))
        return Misalignment(rotation(at * (along / apart)), half)

    def recentred(self) -> "ErrorSet":
        """Return the set with V near its centre.

        exp([w]) exp([-a]) is exp([x]) with |x - (w - a)| at most (|w| + |a|) |a|, as the inverse
        Jacobian differs from 1 by less than |x| for angles below 1 rad.
        """
        at, radius = self.ball()
        moved = math.sqrt(at @ at)
        if moved < RECENTRE_RAD or moved + radius > 1.0:
            return self
        extents = self.extents - DIRECTIONS @ at + (2.0 * moved + radius) * moved
        return ErrorSet(rotation(at) @ self.center, extents)

    def cut(self, extents: FloatArray) -> "ErrorSet":
        """Return the set within further extents (26,), about the same centre."""
        return ErrorSet(self.center, np.minimum(self.extents, extents))


def prior(bound_rad: float, center: FloatArray) -> FloatArray:
    """Return extents (26,) about ``center`` of all errors of at most ``bound_rad``."""
    x = _vector(center)
    size = math.sqrt(x @ x)
    if bound_rad + size > 1.0:
        return np.full(len(DIRECTIONS), bound_rad + size)
    return bound_rad - DIRECTIONS @ x + (bound_rad + size) * size


def confined(known: ErrorSet, seen: Sequence[Seen], false_uavs: int) -> FloatArray:
    """Return extents (26,) about the set's centre by what UAVs are seen, some of them false.

    For a unit vector n: n.w = (n - (n.u) u).w + (n.u) (u.w). The first part is what the array sees;
    of the second only the set itself is known.
    """
    tolerated = false_uavs if len(seen) >= MAJORITY else 0
    corners = known.corners
    size = math.sqrt(float((corners * corners).sum(axis=1).max()))
    rows = np.empty((len(seen), len(DIRECTIONS)))
    for row, one in zip(rows, seen, strict=True):
        axis = known.center @ one.reported.center
        across = _cross(axis, one.seen.center - axis)
        radius = _chord(one.seen.radius_rad) + _chord(one.reported.radius_rad) + size * size / 2.0
        along = DIRECTIONS @ axis
        on_axis = corners @ axis
        ends = np.where(along > 0.0, along * on_axis.max(), along * on_axis.min())
        row[:] = DIRECTIONS @ across + np.sqrt(np.maximum(1.0 - along * along, 0.0)) * radius + ends
    if len(rows) <= tolerated:
        return np.full(len(DIRECTIONS), math.inf)
    extents: FloatArray = np.partition(rows, tolerated, axis=0)[tolerated]
    return extents


def contradicts(error: Misalignment, one: Seen) -> bool:
    """Return whether a UAV cannot be seen there, whatever the error and its position."""
    expected = error.center @ one.reported.center
    within = error.bound_rad + one.reported.radius_rad + one.seen.radius_rad
    return angle_rad(expected, one.seen.center) > within


def _chord(angle: float) -> float:
    return 2.0 * math.sin(min(angle, math.pi) / 2.0)


def _cross(one: FloatArray, other: FloatArray) -> FloatArray:
    (x, y, z), (a, b, c) = one.tolist(), other.tolist()
    return np.array([y * c - z * b, z * a - x * c, x * b - y * a])


def _vector(matrix: FloatArray) -> FloatArray:
    """Return the rotation vector (3,) of a rotation (3, 3) of less than pi/2."""
    off = matrix - matrix.T
    sine = np.array([off[2, 1], off[0, 2], off[1, 0]]) / 2.0
    size = math.sqrt(sine @ sine)
    return sine if size < 1e-12 else sine * (math.asin(min(1.0, size)) / size)
