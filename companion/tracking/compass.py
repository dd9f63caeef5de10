"""Set of the errors of a carrier's reported attitudes, from the directions in which UAVs are seen.

The error is a rotation W in the local frame, constant but for a stated rate: the direction u of a
UAV is seen as W u. It is written as W = exp([w]) V, with V the centre and w, a rotation vector, in
a polytope that its extents along ``DIRECTIONS`` describe. A UAV that reports to be within one cap,
and that is seen within another one, confines w to a cylinder about the axis V u. One UAV of three
or more may report a false position: for each UAV the extents are computed without it, and the
largest count. See docs/math.md 5.8.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from companion.tracking.rotations import cross, rotation, rotation_angle_rad, rotation_vector
from companion.values import Cap, FloatArray, IntArray, angle_rad, lens

MOST_UAVS: Final = 12  # UAVs that confine the error most are used
MAJORITY: Final = 3  # least number of observed UAVs of which some may be false
REFINEMENTS: Final = 12  # most times that a set is cut by the same evidence
LEAST_GAIN: Final = 0.97  # ratio of radii above which another cut is not worth its time
RECENTRE_RAD: Final = math.radians(0.3)  # distance of the set's centre at which V follows it


_CUBE: Final = [v for v in itertools.product((-1, 0, 1), repeat=3) if any(v)]
"""Corners, edges and faces of a cube."""


def _triangles() -> list[tuple[int, int, int]]:
    """Return the triangles of the cube's surface, (48, 3), as indices: a face's middle, an edge's
    and a corner each.
    """
    index = {v: i for i, v in enumerate(_CUBE)}
    by_size = {n: [v for v in _CUBE if sum(map(abs, v)) == n] for n in (1, 2, 3)}
    return [
        (index[face], index[edge], index[corner])
        for face in by_size[1]
        for edge in by_size[2]
        for corner in by_size[3]
        if np.dot(face, edge) == 1 and np.dot(edge, corner) == 2
    ]


DIRECTIONS: Final = np.array([np.array(v) / math.sqrt(np.dot(v, v)) for v in _CUBE])
_OPPOSITE: Final = np.array([int(np.argmin(DIRECTIONS @ one)) for one in DIRECTIONS])
_TRIANGLES: Final = np.array(_triangles())  # (T, 3), neighbouring directions
_CORNERS: Final = np.linalg.inv(DIRECTIONS[_TRIANGLES])  # (T, 3, 3), corner from three extents


class Seen(NamedTuple):
    """Directions in which a UAV may be, and in which the array may see it; local frame."""

    uav: str
    reported: Cap  # by its position
    seen: Cap  # by the array, as the reported attitude shows it


@dataclass(frozen=True, eq=False)
class Misalignment:
    """Error W of the reported attitude: within ``bound_rad`` of ``center``, (3, 3)."""

    center: FloatArray
    bound_rad: float

    @cached_property
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
        found: FloatArray = (_CORNERS @ self.extents[_TRIANGLES][:, :, np.newaxis])[:, :, 0]
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

        Rotations are points of the sphere in four dimensions, at half their angle.
        """
        inside = self.cut(prior(bound_rad, self.center))
        if inside.is_empty:
            return None
        found = inside.misalignment()
        apart = rotation_angle_rad(found.center)
        shared = lens(apart / 2.0, bound_rad / 2.0, found.bound_rad / 2.0)
        if shared is None:
            return None
        along, radius = shared
        share = 0.0 if apart == 0.0 else 2.0 * along / apart
        return Misalignment(rotation(rotation_vector(found.center) * share), 2.0 * radius)

    def recentred(self) -> "ErrorSet":
        """Return the set with V near its centre a, if that is exact enough.

        W V'^T = exp([w]) exp([-a]) = exp([x]), where x follows w from a by the Jacobian J(w) and
        the inverse of J(x). They differ from 1 by at most 0.6 |w| and 0.6 |x| for angles below
        0.5 rad, hence |x - (w - a)| is at most 0.6 (|w| + |x|) |w - a|.
        """
        at, radius = self.ball()
        moved = math.sqrt(at @ at)
        slack = 0.6 * (moved + 2.5 * radius) * radius
        if moved < RECENTRE_RAD or moved + radius > 0.5 or slack > moved * moved:
            return self
        return ErrorSet(rotation(at) @ self.center, self.extents - DIRECTIONS @ at + slack)

    def cut(self, extents: FloatArray) -> "ErrorSet":
        """Return the set within further extents (26,), about the same centre."""
        return ErrorSet(self.center, np.minimum(self.extents, extents))


def prior(bound_rad: float, center: FloatArray) -> FloatArray:
    """Return extents (26,) about ``center`` of all errors of at most ``bound_rad``.

    log(exp([z]) exp([-x])) differs from z - x by at most 0.6 |z| |x| for |z| + |x| below 0.6 rad
    (Baker, Campbell and Hausdorff).
    """
    x = rotation_vector(center)
    size = math.sqrt(x @ x)
    if bound_rad + size > 0.6:
        return np.full(len(DIRECTIONS), bound_rad + size)
    return bound_rad - DIRECTIONS @ x + 0.6 * bound_rad * size


def confined(known: ErrorSet, seen: Sequence[Seen], false_uavs: int) -> FloatArray:
    """Return extents (26,) about the set's centre by what UAVs are seen, some of them false.

    UAV i confines w to a cylinder about its axis a_i, hence n_i.w for every n_i across the axis.
    With n = n_i + n_j, two UAVs confine n.w for every n; one does with the part of n along its axis
    left to the set itself.
    """
    tolerates = false_uavs > 0 and len(seen) >= MAJORITY
    corners = known.corners
    near = sorted(seen, key=lambda one: one.seen.radius_rad + one.reported.radius_rad)[:MOST_UAVS]
    cylinders = [_cylinder(known.center, corners, one) for one in near]
    count = len(cylinders)
    axes = np.array([one.axis for one in cylinders])
    offsets = np.array([one.offset for one in cylinders])
    radii = np.array([one.radius for one in cylinders])
    along, on_axis = DIRECTIONS @ axes.T, corners @ axes.T
    ends = np.where(along > 0.0, along * on_axis.max(axis=0), along * on_axis.min(axis=0))
    alone = (
        DIRECTIONS @ offsets.T + np.sqrt(np.maximum(1.0 - along * along, 0.0)) * radii + ends
    ).T
    first, second = np.triu_indices(count, 1)
    pairs = np.empty((0, len(DIRECTIONS)))
    if len(first):
        pairs = _by_pairs(axes, offsets, radii, first, second)
    bounds = np.concatenate([alone, pairs])
    if not tolerates:
        extents: FloatArray = bounds.min(axis=0)
        return extents
    one_of = np.concatenate([np.arange(count), first])
    other_of = np.concatenate([np.arange(count), second])
    without = [bounds[(one_of != i) & (other_of != i)].min(axis=0) for i in range(count)]
    worst: FloatArray = np.max(without, axis=0)
    return worst


class _Cylinder(NamedTuple):
    """Errors w whose part across a unit axis (3,) is within a radius of an offset (3,)."""

    axis: FloatArray
    offset: FloatArray
    radius: float


def _cylinder(center: FloatArray, corners: FloatArray, one: Seen) -> _Cylinder:
    """Return what one UAV says of the error.

    With a the axis, exp([w]) a differs from a + w x a by at most r = |w| |w x a| / 2. The array
    sees w x a within r and the two bounds of an offset, so that |w x a| is at most their sum.
    """
    axis = center @ one.reported.center
    squares, along = np.vecdot(corners, corners), corners @ axis
    size = math.sqrt(squares.max())
    aside = math.sqrt(max((squares - along * along).max(), 0.0))
    radius = _chord(one.seen.radius_rad) + _chord(one.reported.radius_rad)
    offset = cross(axis, one.seen.center)
    if size < 1.0:
        seen = one.seen.center - axis
        aside = min(aside, (math.sqrt(seen @ seen) + radius) / (1.0 - size / 2.0))
    return _Cylinder(axis, offset, radius + size * aside / 2.0)


def _by_pairs(
    axes: FloatArray, offsets: FloatArray, radii: FloatArray, first: IntArray, second: IntArray
) -> FloatArray:
    """Return extents (P, 26) by pairs of cylinders.

    n is split so that the sum of |n_i|^2 radius_i^2 is least: n_i = P_i M^-1 n / radius_i^2, with
    P_i the projection across the axis and M the sum of P_i / radius_i^2.
    """
    across = (np.eye(3) - axes[:, :, np.newaxis] * axes[:, np.newaxis, :]) / (
        radii[:, np.newaxis, np.newaxis] ** 2
    )
    both = across[first] + across[second]
    apart = 1.0 - (axes[first] * axes[second]).sum(axis=1) ** 2
    usable = apart > 1e-6
    bounds = np.full((len(first), len(DIRECTIONS)), math.inf)
    if usable.any():
        split = np.linalg.inv(both[usable]) @ DIRECTIONS.T  # (P, 3, 26)
        found = np.zeros((int(usable.sum()), len(DIRECTIONS)))
        for of in (first[usable], second[usable]):
            part = across[of] @ split
            found += (offsets[of][:, np.newaxis] @ part)[:, 0]
            found += np.sqrt((part * part).sum(axis=1)) * radii[of, np.newaxis]
        bounds[usable] = found
    return bounds


def refined(known: ErrorSet, seen: Sequence[Seen], false_uavs: int) -> ErrorSet | None:
    """Return the errors that are possible by what is seen; None if there are none.

    A smaller set is more nearly linear, so it is cut again while it shrinks.
    """
    _, before = known.ball()
    for _ in range(REFINEMENTS):
        known = known.cut(confined(known, seen, false_uavs))
        if known.is_empty:
            return None
        known = known.recentred()
        _, radius = known.ball()
        if radius > LEAST_GAIN * before:
            break
        before = radius
    return known


def contradicts(error: Misalignment, one: Seen) -> bool:
    """Return whether a UAV cannot be seen there, whatever the error and its position."""
    expected = error.center @ one.reported.center
    within = error.bound_rad + one.reported.radius_rad + one.seen.radius_rad
    return angle_rad(expected, one.seen.center) > within


def _chord(angle: float) -> float:
    return 2.0 * math.sin(min(angle, math.pi) / 2.0)
