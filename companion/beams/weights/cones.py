"""Cones of directions as an array sees them, and the least gain of beams over them, sampled.

An array sees a direction by its cosines on the axes of its aperture. Those of a cone about a
direction are an interval on each axis: a line sees no more of it, and of a plane's the ellipse in
these intervals is taken. Elements on a grid are asked at places that lie alike about each predicted
direction: turned to look there, what all weights radiate to them is one product of matrices on each
axis. Others are asked in a few directions. What is sampled here steers how much nulls may cost;
what is promised is proven in ``worth.guarantee``.
"""

import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.beams.array.elements import Pattern
from companion.beams.array.geometry import Array
from companion.beams.array.steering import steering_matrix
from companion.beams.weights.shapes import Aperture
from companion.values import BoolArray, ComplexArray, FloatArray, IntArray

FINER: Final = 6
"""Places in each natural width of a line."""
FINER_IN_PLANE: Final = 4
"""The same on each axis of a plane."""
EDGE: Final = 0.25
"""By how many places a place may be beyond a cone and count."""
RINGS: Final = 4
"""Rings of directions in which other arrays are asked."""


@dataclass(frozen=True, slots=True)
class Seen:
    """Cones of K sizes about N directions, by the cosines to the axes of an aperture.

    seen             (N, D), of the predicted direction
    lowest, highest  (K, N, D), the ends of the interval
    """

    seen: FloatArray
    lowest: FloatArray
    highest: FloatArray

    @property
    def middles(self) -> FloatArray:
        return (self.lowest + self.highest) / 2

    @property
    def halves(self) -> FloatArray:
        return (self.highest - self.lowest) / 2

    @property
    def furthest(self) -> FloatArray:
        """To the further end, from the predicted direction."""
        return np.maximum(self.highest - self.seen, self.seen - self.lowest)


def seen_within(across: Aperture, directions: FloatArray, angles_rad: FloatArray) -> Seen:
    """The cones within angles (K, N) of unit directions (N, 3)."""
    cosines = np.minimum(np.maximum(directions @ across.axes.T, -1.0), 1.0)
    angle, wide = np.arccos(cosines), angles_rad[:, :, np.newaxis]
    lowest = np.cos(np.minimum(angle + wide, np.pi))
    highest = np.cos(np.maximum(angle - wide, 0.0))
    return Seen(cosines, np.minimum(lowest, cosines), np.maximum(highest, cosines))


@dataclass(frozen=True, slots=True)
class Cones:
    """Where N beams are looked at, at P places each.

    turns    (M, N), phase factors that turn all beams to one direction, on a grid
    waves    what elements on each axis (n, P_d) radiate to places about it; empty elsewhere
    vectors  (N, P, M), steering vectors of the places; empty on a grid
    inside   (2, N, P), whether a place is within the cone over which the least gain counts, and
             within that of the likely angle
    """

    turns: ComplexArray
    waves: tuple[ComplexArray, ...]
    vectors: ComplexArray
    inside: BoolArray

    def fields(self, weights: ComplexArray) -> ComplexArray:
        """What each column (M, N) radiates to its user's places, (N, P)."""
        if not self.waves:
            found: ComplexArray = np.einsum("npm,mn->np", self.vectors, weights)
            return found
        turned = (weights * self.turns).T
        if len(self.waves) == 1:
            line: ComplexArray = turned @ self.waves[0]
            return line
        along, down = self.waves
        stood = turned.reshape(-1, len(down), len(along))
        plane: ComplexArray = (down.T @ (stood @ along)).reshape(len(stood), -1)
        return plane

    def of(self, users: IntArray) -> "Cones":
        """The cones of some of the users."""
        vectors = self.vectors if self.waves else self.vectors[users]
        return Cones(self.turns[:, users], self.waves, vectors, self.inside[:, users])


def cones(
    array: Array, across: Aperture, directions: FloatArray, seen: Seen, centres: ComplexArray
) -> Cones:
    """Where the beams towards unit directions (N, 3) are looked at.

    ``seen`` has the cones of the bound and of the likely angle; ``centres`` (M, N) are the steering
    vectors of the directions.
    """
    apart = array.element_from_array is not None and array.element.pattern is not Pattern.ISOTROPIC
    if array.grid is None or apart or array.coupling is not None:
        return _asked(array, across, directions, seen)
    wide = across.lengths_m / array.wavelength_m
    furthest = (seen.furthest * wide).max(axis=(0, 1))
    middles, halves = (seen.middles - seen.seen) * wide, seen.halves * wide
    finer = FINER if len(across.axes) == 1 else FINER_IN_PLANE
    waves, off = [], np.zeros((*middles.shape[:2], 1))
    for d, axis in enumerate(across.axes):
        count = array.grid[1 if axis[1] else 0]
        most = finer * count // 2
        reach = min(math.ceil(furthest[d] * finer), most)
        waves.append(_waves(count, finer, reach))
        beside = np.arange(-reach, reach + 1) / finer - middles[:, :, d, np.newaxis]
        if reach == most:  # round the end, as the field goes
            beside -= count * np.rint(beside / count)
        # A little more, as edges lie between places.
        beside /= (halves[:, :, d] + EDGE / finer)[:, :, np.newaxis]
        beside *= beside
        # The axes are y and z; the places are those of z by those of y.
        off = (beside[:, :, :, np.newaxis] + off[:, :, np.newaxis]).reshape(*off.shape[:2], -1)
    inside = off <= np.maximum(off.min(axis=2, keepdims=True), 1.0)
    turns = centres / np.maximum(np.abs(centres).max(axis=0), 1e-300)
    nothing: ComplexArray = np.empty((0, 0, 0), dtype=complex)
    return Cones(turns, tuple(waves), nothing, inside)


def _waves(count: int, finer: int, reach: int) -> ComplexArray:
    """What elements radiate, (count, 2 reach + 1), to places ``finer`` to a natural width."""
    longest = 1 << max(reach - 1, 0).bit_length()
    return _all_waves(count, finer, longest)[:, longest - reach : longest + reach + 1]


@functools.lru_cache(maxsize=16)
def _all_waves(count: int, finer: int, reach: int) -> ComplexArray:
    placed = (np.arange(count) - (count - 1) / 2) / count
    places = np.arange(-reach, reach + 1) / finer
    waves: ComplexArray = np.exp(2j * np.pi * np.outer(placed, places))
    return waves


def _asked(array: Array, across: Aperture, directions: FloatArray, seen: Seen) -> Cones:
    """Steering vectors of directions in rings about each predicted one, out to either cone."""
    users = len(directions)
    held, likely = seen.halves
    wide = np.arccos(np.clip(seen.seen - held, -1, 1)) - np.arccos(seen.seen)
    reach = np.abs(wide).max(axis=1)
    inner = np.arcsin(np.clip(likely.max(axis=1), 0.0, 1.0))
    ring = np.repeat(np.arange(1, RINGS + 1), 6 * np.arange(1, RINGS + 1))
    turn = np.concatenate([np.arange(6 * n) * (np.pi / (3 * n)) for n in range(1, RINGS + 1)])
    share = np.concatenate([[0.0], ring / RINGS, ring / RINGS])
    turns = np.concatenate([[0.0], turn, turn])
    from_likely = np.arange(len(share)) <= len(ring)
    angles = share * np.where(from_likely, inner[:, np.newaxis], reach[:, np.newaxis])
    first = across.axes[0] - (directions @ across.axes[0])[:, np.newaxis] * directions
    first /= np.maximum(np.linalg.norm(first, axis=1), 1e-9)[:, np.newaxis]
    aside = (
        np.cos(turns)[:, np.newaxis] * first[:, np.newaxis]
        + np.sin(turns)[:, np.newaxis] * np.cross(directions, first)[:, np.newaxis]
    )
    towards = np.cos(angles)[:, :, np.newaxis] * directions[:, np.newaxis]
    towards = towards + np.sin(angles)[:, :, np.newaxis] * aside
    vectors = steering_matrix(array, towards.reshape(-1, 3)).T.reshape(users, len(share), -1)
    inside = np.ones((2, users, len(share)), dtype=bool)
    inside[1] = from_likely
    nothing: ComplexArray = np.empty((0, users), dtype=complex)
    return Cones(nothing, (), vectors, inside)


def outside(across: Aperture, seen: Seen, around: FloatArray, wavelength_m: float) -> FloatArray:
    """How far directions (P, 3) are outside of the first of K cones, in natural widths, (P, N).

    0 within.
    """
    cosines = (around @ across.axes.T)[:, np.newaxis]
    beyond = np.maximum(np.maximum(seen.lowest[0] - cosines, cosines - seen.highest[0]), 0.0)
    beyond *= across.lengths_m / wavelength_m
    found: FloatArray = np.sqrt(np.einsum("pnd,pnd->pn", beyond, beyond))
    return found
