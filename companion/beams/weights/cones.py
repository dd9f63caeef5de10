"""Cones of directions as an array sees them, and the least gain of beams over them, sampled.

An array sees a direction by its cosines on the axes of its aperture. Those of a cone about a
direction are an interval on each axis: a line sees no more of it, and a plane an ellipse. Elements
on a grid are asked at places that lie alike about each predicted direction: turned to look there,
what all weights radiate to them is one product of matrices on each axis. Others are asked in a few
directions. What is sampled here steers how much nulls may cost; what is promised is proven in
``worth.guarantee``.
"""

import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.beams.array.geometry import Array
from companion.beams.array.steering import steering_matrix
from companion.beams.weights.shapes import Aperture
from companion.beams.worth.cone import faces_apart
from companion.values import ComplexArray, FloatArray, IntArray

FINER: Final = 6  # places in each natural width of a line
FINER_IN_PLANE: Final = 8  # the same on each axis of a plane
EDGE: Final = 0.25  # by how many places a place may be beyond a cone and count half
MOST_INCLINED: Final = 0.95
"""Inclination beyond which ellipses are no narrower: cones there reach behind the plane."""
RINGS: Final = 4  # rings of directions in which other arrays are asked


@dataclass(frozen=True, slots=True)
class ApertureCones:
    """Cones of K sizes about N directions, by the cosines to the axes of an aperture.

    lowest, highest  (K, N, D), the ends of the interval
    """

    seen: FloatArray  # (N, D), of the predicted direction
    lowest: FloatArray
    highest: FloatArray

    @property
    def middles(self) -> FloatArray:
        return (self.lowest + self.highest) / 2

    @property
    def halves(self) -> FloatArray:
        return (self.highest - self.lowest) / 2

    @property
    def inclined(self) -> FloatArray:
        """How inclined the ellipses are as which a plane sees cones, (N,), -1 to 1.

        A cone about u is seen as an ellipse like 1 - u u^T, u cut to the two axes: this is that
        matrix's coefficient of correlation. 0: parallel to the axes.
        """
        y, z = self.seen.T
        level = np.sqrt(np.maximum((1.0 - y * y) * (1.0 - z * z), 1e-12))
        inclined: FloatArray = np.clip(-y * z / level, -MOST_INCLINED, MOST_INCLINED)
        return inclined

    @property
    def furthest(self) -> FloatArray:
        """To the further end, from the predicted direction."""
        return np.maximum(self.highest - self.seen, self.seen - self.lowest)


def cones_on_aperture(
    across: Aperture, directions: FloatArray, angles_rad: FloatArray
) -> ApertureCones:
    """The cones within angles (K, N) of unit directions (N, 3)."""
    cosines = np.minimum(np.maximum(directions @ across.axes.T, -1.0), 1.0)
    angle, wide = np.arccos(cosines), angles_rad[:, :, np.newaxis]
    lowest = np.cos(np.minimum(angle + wide, np.pi))
    highest = np.cos(np.maximum(angle - wide, 0.0))
    return ApertureCones(cosines, np.minimum(lowest, cosines), np.maximum(highest, cosines))


@dataclass(frozen=True, slots=True, kw_only=True)
class ConeSamples:
    """Where N beams are looked at, at P places each.

    turns    (M, N), phase factors that turn all beams to one direction, on a grid
    waves    what elements on each axis (n, P_d) radiate to places about it; empty elsewhere
    vectors  (N, P, M), steering vectors of the places; empty on a grid
    counts   (2, N, P), how much of a least gain is asked at a place: 1 within the cone over which
             it counts, and within that of the likely angle; about the edge it falls to 0
    """

    turns: ComplexArray
    waves: tuple[ComplexArray, ...]
    vectors: ComplexArray
    counts: FloatArray

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

    def of(self, users: IntArray) -> "ConeSamples":
        """The cones of some of the users."""
        vectors = self.vectors if self.waves else self.vectors[users]
        return ConeSamples(
            turns=self.turns[:, users],
            waves=self.waves,
            vectors=vectors,
            counts=self.counts[:, users],
        )


def cones(
    array: Array,
    across: Aperture,
    directions: FloatArray,
    seen: ApertureCones,
    centres: ComplexArray,
) -> ConeSamples:
    """Where the beams towards unit directions (N, 3) are looked at.

    ``seen`` has the cones of the bound and of the likely angle; ``centres`` (M, N) are the steering
    vectors of the directions.
    """
    if array.grid is None or faces_apart(array) or array.coupling is not None:
        return _asked(array, across, directions, seen)
    waves, counts = _about(across, seen, array.grid, array.wavelength_m)
    turns = centres / np.maximum(np.abs(centres).max(axis=0), 1e-300)
    nothing: ComplexArray = np.empty((0, 0, 0), dtype=complex)
    return ConeSamples(turns=turns, waves=tuple(waves), vectors=nothing, counts=counts)


def _about(
    across: Aperture, seen: ApertureCones, grid: tuple[int, int], wavelength_m: float
) -> tuple[list[ComplexArray], FloatArray]:
    """The places about each predicted direction: their waves on each axis, and how they count."""
    wide = across.lengths_m / wavelength_m
    furthest = (seen.furthest * wide).max(axis=(0, 1))
    middles, halves = (seen.middles - seen.seen) * wide, seen.halves * wide
    finer = FINER if len(across.axes) == 1 else FINER_IN_PLANE
    waves, sides = list[ComplexArray](), list[FloatArray]()
    for d, axis in enumerate(across.axes):
        count = grid[1 if axis[1] else 0]
        most = finer * count // 2
        reach = min(math.ceil(furthest[d] * finer), most)
        waves.append(_waves(count, finer, reach))
        aside = np.arange(-reach, reach + 1) / finer - middles[:, :, d, np.newaxis]
        if reach == most:  # round the end, as the field goes
            aside -= count * np.rint(aside / count)
        aside /= (halves[:, :, d] + EDGE / finer)[:, :, np.newaxis]
        sides.append(aside)
    off = np.abs(sides[0]) if len(sides) == 1 else _off_ellipses(sides[0], sides[1], seen.inclined)
    # Over one place about the edge: no place comes or goes at once.
    steps = np.maximum(halves.min(axis=2) * finer + EDGE, 0.5)[:, :, np.newaxis]
    counts = np.minimum(np.maximum(0.5 + steps * (1.0 - off), 0.0), 1.0)
    counts /= np.maximum(counts.max(axis=2, keepdims=True), 1e-9)
    return waves, counts


def _off_ellipses(along: FloatArray, down: FloatArray, inclined: FloatArray) -> FloatArray:
    """How far places are off ellipses: 1 on the rim, (K, N, P_1 P_0).

    By the places on the first axis (K, N, P_0) and on the second (K, N, P_1), in half intervals.
    """
    y, z = along[:, :, np.newaxis], down[:, :, :, np.newaxis]
    mixed = inclined[:, np.newaxis, np.newaxis]
    off = (y * y + z * z - 2.0 * mixed * y * z) / (1.0 - mixed * mixed)
    return np.asarray(np.sqrt(np.maximum(off, 0.0)).reshape(*off.shape[:2], -1))


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


def _asked(
    array: Array, across: Aperture, directions: FloatArray, seen: ApertureCones
) -> ConeSamples:
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
    counts = np.ones((2, users, len(share)))
    counts[1] = from_likely
    nothing: ComplexArray = np.empty((0, users), dtype=complex)
    return ConeSamples(turns=nothing, waves=(), vectors=vectors, counts=counts)


def outside(
    across: Aperture, seen: ApertureCones, around: FloatArray, wavelength_m: float
) -> FloatArray:
    """How far directions (P, 3) are outside of the first of K cones, in natural widths, (P, N).

    0 within.
    """
    cosines = (around @ across.axes.T)[:, np.newaxis]
    beyond = np.maximum(np.maximum(seen.lowest[0] - cosines, cosines - seen.highest[0]), 0.0)
    beyond *= across.lengths_m / wavelength_m
    found: FloatArray = np.sqrt(np.einsum("pnd,pnd->pn", beyond, beyond))
    return found
