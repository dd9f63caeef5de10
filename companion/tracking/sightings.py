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
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple, Self

import numpy as np

from companion.tracking.moved_caps import Caps, Motion, moved_caps
from companion.values import Cap, FloatArray

WINDOW: Final = 10  # newest measurements of a UAV that are kept
FACETS: Final = 16  # sides of the polygon around the possible directions
CONFIRMED: Final = 2
"""Measurements of a UAV that must agree before they are evidence against anything else.

The first one may be a reflection, or of another UAV; there is no other to contradict it.
"""
RESTART: Final = 6  # measurements that agree with one another, and not with the set, restart it
_ANGLES: Final = np.arange(FACETS) * (2 * math.pi / FACETS)
_FACETS: Final = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)  # (FACETS, 2), normals
_NEXT, _LAST = [1, 2, 0], [2, 0, 1]  # of a cross product
_AHEAD: Final = np.roll(np.arange(FACETS), -1)
_BEHIND: Final = np.roll(np.arange(FACETS), 1)
_BETWEEN: Final = 1.0 / math.sin(2 * math.pi / FACETS)
_TWICE_COS: Final = 2 * math.cos(2 * math.pi / FACETS)
_CORNER: Final = 1.0 / _TWICE_COS


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sightings:
    """Newest caps of one UAV, all moved to the time ``t_ns``; immutable.

    contrary  caps that contradict the set, likewise, since the last one that agreed
    """

    t_ns: int
    caps: Caps
    contrary: "Sightings | None" = None

    @classmethod
    def of(cls, t_ns: int, cap: Cap) -> Self:
        """Return the set with one cap."""
        return cls(t_ns=t_ns, caps=Caps.of(cap))

    @property
    def is_confirmed(self) -> bool:
        """Whether as many caps agree as are evidence."""
        return len(self.caps.radii_rad) >= CONFIRMED

    def moved(self, t_ns: int, motion: Motion) -> "Sightings":
        """Return the caps at a later time."""
        caps = moved_caps([self.caps], [motion])
        contrary = None if self.contrary is None else self.contrary.moved(t_ns, motion)
        return Sightings(t_ns=t_ns, caps=caps, contrary=contrary)

    def with_cap(self, cap: Cap) -> "Sightings":
        """Return the caps with a newer one, which agrees with them; drops the oldest."""
        centers = np.concatenate([self.caps.centers[1 - WINDOW :], cap.center[np.newaxis]])
        radii = np.append(self.caps.radii_rad[1 - WINDOW :], cap.radius_rad)
        return Sightings(t_ns=self.t_ns, caps=Caps(centers, radii))

    def contradicts(self, cap: Cap, outliers: int) -> bool:
        """Return whether a cap is apart from more caps than may be wrong."""
        centers, radii = self.caps
        cosines = np.cos(np.minimum(radii + cap.radius_rad, math.pi))
        apart = np.count_nonzero(centers @ cap.center < cosines - 1e-12)
        return int(apart) > min(outliers, len(radii) - 1)

    def against(self, cap: Cap) -> "Sightings":
        """Return the caps after one that contradicts them.

        ``RESTART`` of these in a row that have a direction in common replace the set; one alone
        replaces another one.
        """
        if not self.is_confirmed:
            return Sightings.of(self.t_ns, cap)
        other = Sightings.of(self.t_ns, cap)
        if self.contrary is not None:
            (known,) = possible([self.contrary.caps], 0)
            agrees = known is not None and not known.is_apart_from(cap)
            other = self.contrary.with_cap(cap) if agrees else other
        if len(other.caps.radii_rad) >= RESTART:
            return other
        return replace(self, contrary=other)


class Guide(NamedTuple):
    """What else is known of a UAV's direction.

    within  a cap that is right
    likely  where the direction probably is, (3,)
    """

    within: Cap
    likely: FloatArray


def possible(
    many: Sequence[Caps], outliers: int, guides: Sequence[Guide | None] | None = None
) -> list[Cap | None]:
    """Return for each of many UAVs a cap with every possible direction.

        many      caps of each UAV: centres (K, 3), oldest first, and radii (K,)
        outliers  most caps of a UAV that may be wrong
        guides    what else is known of each; None: nothing

    None if more caps are wrong than may be: no direction is possible. The centre of a result is in
    the middle of the possible directions, or near the likely one.
    """
    known = list(guides or [None] * len(many))
    found: list[Cap | None] = [
        Cap(centers[-1], math.pi) if guide is None else guide.within
        for (centers, _), guide in zip(many, known, strict=True)
    ]
    enough = [i for i, (_, radii) in enumerate(many) if len(radii) > outliers]
    if enough:
        shared = _shared([many[i] for i in enough], outliers, [known[i] for i in enough])
        for i, cap in zip(enough, shared, strict=True):
            found[i] = cap
    return found


def _shared(
    many: Sequence[Caps], outliers: int, guides: Sequence[Guide | None]
) -> list[Cap | None]:
    """Return the possible directions of UAVs with more caps than may be wrong."""
    centers, radii = _stacked(many)
    middles = (centers / (radii + 1e-6)[:, :, np.newaxis]).sum(axis=1)
    middles /= np.maximum(np.sqrt(np.vecdot(middles, middles)), 1e-9)[:, np.newaxis]
    cosines = np.vecdot(centers, middles[:, np.newaxis])
    reach = np.arccos(np.clip(cosines, -1.0, 1.0)) + radii
    farthest = np.partition(reach, outliers, axis=1)[:, outliers]
    axes = _axes(middles)
    ends = _ends(centers @ axes.transpose(0, 2, 1), radii)
    extents = np.partition(ends, outliers, axis=1)[:, outliers] if outliers else ends.min(axis=1)
    guided = [i for i, guide in enumerate(guides) if guide is not None]
    likely = np.full((len(many), 2), math.nan)
    if guided:
        sure = [guide for guide in guides if guide is not None]
        within = np.array([guide.within.center for guide in sure])
        spread = np.array([guide.within.radius_rad for guide in sure])
        apart = within - middles[guided]
        off = 2.0 * np.arcsin(np.minimum(np.sqrt(np.vecdot(apart, apart)) / 2.0, 1.0))
        farthest[guided] = np.minimum(farthest[guided], off + spread)
        in_plane = np.stack([within, np.array([guide.likely for guide in sure])], axis=1)
        in_plane = in_plane @ axes[guided].transpose(0, 2, 1)
        outer = _ends(in_plane[:, :1], spread[:, np.newaxis])[:, 0]
        extents[guided] = np.minimum(extents[guided], outer)
        likely[guided] = in_plane[:, 1]
    around = _enclosed(middles, axes, extents, likely)
    # The tangent plane shows half of all directions.
    return [
        Cap(middle, math.pi) if far >= math.pi / 2 else cap
        for middle, far, cap in zip(middles, farthest.tolist(), around, strict=True)
    ]


def _stacked(many: Sequence[Caps]) -> tuple[FloatArray, FloatArray]:
    """Return caps of N UAVs as centres (N, K, 3) and radii (N, K); what is missing has no end."""
    counts = [len(radii) for _, radii in many]
    most = max(counts)
    if min(counts) == most:
        return np.array([one.centers for one in many]), np.array([one.radii_rad for one in many])
    centers, radii = np.zeros((len(many), most, 3)), np.full((len(many), most), math.inf)
    for i, (count, caps) in enumerate(zip(counts, many, strict=True)):
        centers[i, :count], radii[i, :count] = caps
    return centers, radii


def _axes(middles: FloatArray) -> FloatArray:
    """Return two axes (N, 2, 3) of the tangent planes at unit vectors (N, 3)."""
    every, least = np.arange(len(middles)), np.abs(middles).argmin(axis=1)
    first = -middles[every, least, np.newaxis] * middles
    first[every, least] += 1.0
    first /= np.sqrt(np.vecdot(first, first))[:, np.newaxis]
    axes: FloatArray = np.empty((len(middles), 2, 3))
    axes[:, 0] = first
    axes[:, 1] = middles[:, _NEXT] * first[:, _LAST] - middles[:, _LAST] * first[:, _NEXT]
    return axes


def _ends(centers: FloatArray, radii_rad: FloatArray) -> FloatArray:
    """Return extents (N, K, FACETS) of caps along all normals, from centres (N, K, 2) in the plane.

    A cap about c of radius r extends along h to sin(asin(h.c) + r).
    """
    along = np.arcsin(np.clip(centers @ _FACETS.T, -1.0, 1.0))
    ends: FloatArray = np.sin(np.minimum(along + radii_rad[:, :, np.newaxis], math.pi / 2))
    return ends


def _enclosed(
    middles: FloatArray, axes: FloatArray, extents: FloatArray, likely: FloatArray
) -> list[Cap | None]:
    """Return a cap around the directions within each extents (N, FACETS); None if there are none.

    likely  (N, 2), where the centre should be, in the plane; nan: in the middle

    A point of the polygon in direction n from a point o has n between two neighbouring normals, so
    it is no farther from o than the corner of these two sides.
    """
    extents = np.minimum(extents, (extents[:, _AHEAD] + extents[:, _BEHIND]) * _CORNER)
    empty = (extents[:, : FACETS // 2] + extents[:, FACETS // 2 :]).min(axis=1) < 0.0
    at = (2.0 / FACETS) * (extents @ _FACETS)
    outside = (likely @ _FACETS.T - extents).max(axis=1)
    span = (extents - at @ _FACETS.T).max(axis=1)
    share = np.where(outside <= 0.0, 1.0, span / np.maximum(span + outside, 1e-12))
    wanted = at + (likely - at) * share[:, np.newaxis]
    at = np.where(np.isnan(likely), at, wanted)
    rest = extents - at @ _FACETS.T
    following = rest[:, _AHEAD]
    corners = (rest * rest + following * following - _TWICE_COS * rest * following).max(axis=1)
    found = list[Cap | None]()
    in_plane = (at[:, np.newaxis] @ axes)[:, 0]
    rows = zip(empty.tolist(), np.sqrt(np.vecdot(at, at)).tolist(), corners.tolist(), strict=True)
    for i, (is_empty, from_middle, corner) in enumerate(rows):
        if is_empty:
            found.append(None)
            continue
        radius = math.sqrt(corner) * _BETWEEN
        if from_middle + radius >= 1.0:
            found.append(Cap(middles[i], math.pi))
            continue
        center = in_plane[i] + math.sqrt(1.0 - from_middle**2) * middles[i]
        slope = math.sqrt(1.0 - (from_middle + radius) ** 2)
        found.append(Cap(center, 2.0 * math.asin(min(1.0, radius / (2.0 * slope)))))
    return found
