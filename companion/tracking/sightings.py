"""Set of directions in which the array sees a UAV, from bounded measurements, some of them wrong.

A direction is a unit vector in the local frame, as the reported attitude shows it: the array's
measurement, rotated by the reported attitude. Each measurement confines the true direction to a
cap. The caps follow the UAV's motion, and their radii grow by whatever the motion may differ.

At most ``outliers`` of the newest ``WINDOW`` caps may be wrong. In each tangent direction h all but
so many caps contain the true direction s, hence h.s is at most the (outliers + 1)-th smallest of
their extents. These extents along ``FACETS`` directions make a polygon, and a cap around it is the
result. See docs/math.md 5.7.
"""

import math
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np

from companion.tracking.rotations import cross
from companion.values import Cap, FloatArray, angle_rad

WINDOW: Final = 10  # newest measurements of a UAV that are kept
FACETS: Final = 16  # sides of the polygon around the possible directions
RESTART: Final = 6  # measurements that agree with one another, and not with the set, restart it
_ANGLES: Final = np.arange(FACETS) * (2 * math.pi / FACETS)
_FACETS: Final = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)  # (FACETS, 2), normals
_AHEAD: Final = np.roll(np.arange(FACETS), -1)
_BEHIND: Final = np.roll(np.arange(FACETS), 1)
_BETWEEN: Final = 1.0 / math.sin(2 * math.pi / FACETS)
_CORNER: Final = 1.0 / (2 * math.cos(2 * math.pi / FACETS))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion:
    """Motion of a UAV relative to the array between two times, with its bounds.

    moved_ned_m       predicted displacement, (3,), local frame
    error_m           bound on the error of that displacement
    range_m           predicted range at the earlier time
    range_error_m     bound on the error of that range, and of the later one
    misalignment_rad  bound on the error of the reported attitude, as an angle
    turned_rad        bound on the change of that error between the times
    """

    moved_ned_m: FloatArray
    error_m: float
    range_m: float
    range_error_m: float
    misalignment_rad: float
    turned_rad: float


def _moved(
    centers: FloatArray, radii_rad: FloatArray, motion: Motion
) -> tuple[FloatArray, FloatArray]:
    """Return caps (K, 3), (K,) after a motion.

    With r the true and r' the predicted range, the true direction becomes that of r s + W d + e,
    and the centre that of r' c + d: W is the misalignment and e the error of the displacement d.
    """
    way_m = math.sqrt(motion.moved_ned_m @ motion.moved_ned_m)
    least_m = motion.range_m - motion.range_error_m - way_m - motion.error_m
    if least_m <= 0.0:
        return centers, np.full(len(radii_rad), math.pi)
    off_m = motion.error_m + way_m * (
        motion.misalignment_rad + motion.range_error_m / motion.range_m
    )
    if off_m >= least_m:
        return centers, np.full(len(radii_rad), math.pi)
    grown = math.asin(off_m / least_m) + motion.turned_rad
    scale = motion.range_m / (motion.range_m - way_m)
    later = centers * motion.range_m + motion.moved_ned_m
    later /= np.sqrt(np.einsum("kc,kc->k", later, later))[:, np.newaxis]
    spread = 2.0 * np.arcsin(np.minimum(1.0, scale * np.sin(np.minimum(radii_rad, math.pi) / 2.0)))
    return later, np.minimum(spread + grown, math.pi)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sightings:
    """Newest caps of one UAV, all moved to the time ``t_ns``; immutable.

    centers, radii_rad  (K, 3) and (K,), oldest first
    contrary            caps that contradict the set, likewise, since the last one that agreed
    """

    t_ns: int
    centers: FloatArray
    radii_rad: FloatArray
    contrary: "Sightings | None" = None

    @classmethod
    def of(cls, t_ns: int, cap: Cap) -> Self:
        """Return the set with one cap."""
        return cls(t_ns=t_ns, centers=cap.center[np.newaxis], radii_rad=np.array([cap.radius_rad]))

    def moved(self, t_ns: int, motion: Motion) -> "Sightings":
        """Return the caps at a later time."""
        centers, radii = _moved(self.centers, self.radii_rad, motion)
        contrary = None if self.contrary is None else self.contrary.moved(t_ns, motion)
        return Sightings(t_ns=t_ns, centers=centers, radii_rad=radii, contrary=contrary)

    def with_cap(self, cap: Cap) -> "Sightings":
        """Return the caps with a newer one, which agrees with them; drops the oldest."""
        centers = np.concatenate([self.centers[1 - WINDOW :], cap.center[np.newaxis]])
        radii = np.append(self.radii_rad[1 - WINDOW :], cap.radius_rad)
        return Sightings(t_ns=self.t_ns, centers=centers, radii_rad=radii)

    def contradicts(self, cap: Cap, outliers: int) -> bool:
        """Return whether a cap is apart from more caps than may be wrong."""
        cosines = np.cos(np.minimum(self.radii_rad + cap.radius_rad, math.pi))
        apart = np.count_nonzero(self.centers @ cap.center < cosines - 1e-12)
        return int(apart) > min(outliers, len(self.radii_rad) - 1)

    def against(self, cap: Cap) -> "Sightings":
        """Return the caps after one that contradicts them.

        ``RESTART`` of these in a row that have a direction in common replace the set.
        """
        other = Sightings.of(self.t_ns, cap)
        if self.contrary is not None:
            known = self.contrary.possible(0)
            agrees = known is not None and not known.is_apart_from(cap)
            other = self.contrary.with_cap(cap) if agrees else other
        if len(other.radii_rad) >= RESTART:
            return other
        return replace(self, contrary=other)

    def possible(
        self, outliers: int, within: Cap | None = None, about: FloatArray | None = None
    ) -> Cap | None:
        """Return a cap with every possible direction, if at most ``outliers`` caps are wrong.

            within  a cap that is right; None: none is known
            about   where the centre should be, (3,); None: in the middle

        None if more than that are wrong: no direction is possible.
        """
        if len(self.radii_rad) <= outliers:
            return Cap(self.centers[-1], math.pi) if within is None else within
        middle = (self.centers / (self.radii_rad[:, np.newaxis] + 1e-6)).sum(axis=0)
        middle /= max(math.sqrt(middle @ middle), 1e-9)
        reach = np.arccos(np.clip(self.centers @ middle, -1.0, 1.0)) + self.radii_rad
        farthest = float(np.partition(reach, outliers)[outliers])
        if within is not None:
            farthest = min(farthest, angle_rad(within.center, middle) + within.radius_rad)
        if farthest >= math.pi / 2:  # the tangent plane shows half of all directions
            return Cap(middle, math.pi)
        axes, extents = self._extents(middle, outliers)
        if within is not None:
            extents = np.minimum(extents, _ends(axes @ within.center, within.radius_rad))
        return _enclosed(middle, axes, extents, about)

    def _extents(self, middle: FloatArray, outliers: int) -> tuple[FloatArray, FloatArray]:
        """Return the tangent plane's axes (2, 3) at ``middle``, and extents (FACETS,) on it.

        A cap about c of radius r extends along h to sin(asin(h.c) + r).
        """
        least = np.zeros(3)
        least[int(np.argmin(np.abs(middle)))] = 1.0
        first = least - middle[int(np.argmin(np.abs(middle)))] * middle
        first /= math.sqrt(first @ first)
        axes = np.stack([first, cross(middle, first)])
        ends = _ends(self.centers @ axes.T, self.radii_rad[:, np.newaxis])
        if outliers:
            return axes, np.partition(ends, outliers, axis=0)[outliers]
        extents: FloatArray = ends.min(axis=0)
        return axes, extents


def _ends(centers: FloatArray, radii_rad: FloatArray | float) -> FloatArray:
    """Return extents of caps along all normals, from their centres in the plane, (..., 2)."""
    along = np.arcsin(np.clip(centers @ _FACETS.T, -1.0, 1.0))
    ends: FloatArray = np.sin(np.minimum(along + radii_rad, math.pi / 2))
    return ends


def _enclosed(
    middle: FloatArray, axes: FloatArray, extents: FloatArray, about: FloatArray | None
) -> Cap | None:
    """Return a cap around the directions within the extents; None if there are none.

    A point of the polygon in direction n from a point o has n between two neighbouring normals, so
    it is no farther from o than the corner of these two sides.
    """
    extents = np.minimum(extents, (extents[_AHEAD] + extents[_BEHIND]) * _CORNER)
    if (extents[: FACETS // 2] + extents[FACETS // 2 :]).min() < 0.0:
        return None
    at = (2.0 / FACETS) * (extents @ _FACETS)
    if about is not None:
        wanted = axes @ about
        outside = float((_FACETS @ wanted - extents).max())
        span = float((extents - _FACETS @ at).max())
        at = wanted if outside <= 0.0 else at + (wanted - at) * span / max(span + outside, 1e-12)
    rest = extents - _FACETS @ at
    following = rest[_AHEAD]
    cosine = math.cos(2 * math.pi / FACETS)
    corners = (rest * rest + following * following - 2 * cosine * rest * following).max()
    radius = math.sqrt(corners) * _BETWEEN
    from_middle = math.sqrt(at @ at)
    if from_middle + radius >= 1.0:
        return Cap(middle, math.pi)
    center = at @ axes + math.sqrt(1.0 - from_middle**2) * middle
    slope = math.sqrt(1.0 - (from_middle + radius) ** 2)
    return Cap(center, 2.0 * math.asin(min(1.0, radius / (2.0 * slope))))
