"""Cones of directions as an array resolves them, and the sampled least gain of beams over them.

An array resolves a direction by its cosines to the axes of its aperture. A cone about a direction
gives an interval on each axis; a plane sees it as an ellipse. For elements on a grid, the samples
lie alike about each predicted direction: with all beams steered to one direction, their responses
are one matrix product per axis. Other arrays are sampled in a few directions. These samples only
decide how much nulls may cost; ``worth.guarantee`` proves the guaranteed gain.
"""

import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.beams.array.elements import ElementPattern
from companion.beams.array.geometry import Array
from companion.beams.array.steering import steering_matrix
from companion.beams.weights.shapes import Aperture
from companion.beams.worth.cone import has_distinct_patterns
from companion.values import ComplexArray, FloatArray, IntArray

SAMPLES_PER_WIDTH: Final = 6  # samples per natural width of a line
SAMPLES_PER_WIDTH_IN_PLANE: Final = 8  # the same on each axis of a plane
EDGE: Final = 0.25  # distance beyond a cone, in sample steps, at which a sample counts half
MOST_INCLINED: Final = 0.95
"""Inclination at which ellipses are clipped; cones inclined more reach behind the plane."""
RINGS: Final = 4  # rings of directions in which other arrays are sampled


@dataclass(frozen=True, slots=True, kw_only=True)
class ApertureCones:
    """Cones of K sizes about N directions, as cosines to the axes of an aperture.

    lowest, highest  (K, N, D), the ends of the interval
    furthest         (K, N, D), distance from the predicted direction to the further end
    """

    seen: FloatArray  # (N, D), of the predicted direction
    lowest: FloatArray
    highest: FloatArray
    furthest: FloatArray

    def of(self, users: list[int]) -> "ApertureCones":
        """Return the cones about some of the directions."""
        return ApertureCones(
            seen=self.seen[users],
            lowest=self.lowest[:, users],
            highest=self.highest[:, users],
            furthest=self.furthest[:, users],
        )

    @property
    def middles(self) -> FloatArray:
        return (self.lowest + self.highest) / 2

    @property
    def halves(self) -> FloatArray:
        return (self.highest - self.lowest) / 2

    @property
    def inclined(self) -> FloatArray:
        """Inclination of the ellipses that a planar array sees, (N,), -1 to 1.

        A cone about u is seen as an ellipse like 1 - u u^T, u reduced to the two axes: this is that
        matrix's coefficient of correlation. 0: parallel to the axes.
        """
        y, z = self.seen.T
        level = np.sqrt(np.maximum((1.0 - y * y) * (1.0 - z * z), 1e-12))
        inclined: FloatArray = np.clip(-y * z / level, -MOST_INCLINED, MOST_INCLINED)
        return inclined


def cones_on_aperture(
    across: Aperture, directions: FloatArray, angles_rad: FloatArray
) -> ApertureCones:
    """Return the cones within angles (K, N) of unit directions (N, 3), as an aperture sees them."""
    cosines = np.minimum(np.maximum(directions @ across.axes.T, -1.0), 1.0)
    angle, wide = np.arccos(cosines), angles_rad[:, :, np.newaxis]
    lowest = np.minimum(np.cos(np.minimum(angle + wide, np.pi)), cosines)
    highest = np.maximum(np.cos(np.maximum(angle - wide, 0.0)), cosines)
    furthest = np.maximum(highest - cosines, cosines - lowest)
    return ApertureCones(seen=cosines, lowest=lowest, highest=highest, furthest=furthest)


@dataclass(frozen=True, slots=True, kw_only=True)
class ConeSamples:
    """Samples of N beams, at P directions each.

    turns    (M, N), phase factors that steer all beams to one direction, on a grid
    waves    responses of the elements on each axis (n, P_d) to places about it; empty elsewhere
    vectors  (N, P, M), steering vectors of the places; empty on a grid
    counts   (2, N, P), weight of a sample in a least gain: 1 within the bound's cone, and within
             the likely cone; it falls to 0 about the edge
    """

    turns: ComplexArray
    waves: tuple[ComplexArray, ...]
    vectors: ComplexArray
    counts: FloatArray

    def fields(self, weights: ComplexArray) -> ComplexArray:
        """Return the field of each column (M, N) at its user's sampled directions, (N, P)."""
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
        """Return the samples of some of the users."""
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
    """Return the samples of beams towards unit directions (N, 3).

    ``seen`` has the cones of the bound and of the likely angle; ``centres`` (M, N) are the steering
    vectors of the directions.
    """
    if array.grid is None or has_distinct_patterns(array) or array.coupling is not None:
        return _ring_samples(array, across, directions, seen)
    waves, counts = _grid_samples(across, seen, array.grid, array.wavelength_m)
    turns = centres
    if array.element.pattern is not ElementPattern.ISOTROPIC:
        turns = centres / np.maximum(np.abs(centres).max(axis=0), 1e-300)
    nothing: ComplexArray = np.empty((0, 0, 0), dtype=complex)
    return ConeSamples(turns=turns, waves=tuple(waves), vectors=nothing, counts=counts)


def _grid_samples(
    across: Aperture, seen: ApertureCones, grid: tuple[int, int], wavelength_m: float
) -> tuple[list[ComplexArray], FloatArray]:
    """Return samples about each predicted direction on a grid: waves per axis, and weights."""
    wide = across.lengths_m / wavelength_m
    furthest = (seen.furthest * wide).max(axis=(0, 1))
    middles, halves = (seen.middles - seen.seen) * wide, seen.halves * wide
    finer = SAMPLES_PER_WIDTH if len(across.axes) == 1 else SAMPLES_PER_WIDTH_IN_PLANE
    waves, sides = list[ComplexArray](), list[FloatArray]()
    for d, axis in enumerate(across.axes):
        count = grid[1 if axis[1] else 0]
        most = finer * count // 2
        reach = min(math.ceil(furthest[d] * finer), most)
        waves.append(_waves(count, finer, reach))
        aside = np.arange(-reach, reach + 1) / finer - middles[:, :, d, np.newaxis]
        if reach == most:  # wrap around, as the field is periodic
            aside -= count * np.rint(aside / count)
        aside /= (halves[:, :, d] + EDGE / finer)[:, :, np.newaxis]
        sides.append(aside)
    off = np.abs(sides[0]) if len(sides) == 1 else _off_ellipses(sides[0], sides[1], seen.inclined)
    # A ramp one sample wide at the edge, so that weights change continuously.
    narrower = halves[:, :, :1] if len(sides) == 1 else halves.min(axis=2, keepdims=True)
    steps = np.maximum(narrower * finer + EDGE, 0.5)
    counts = np.minimum(np.maximum(0.5 + steps * (1.0 - off), 0.0), 1.0)
    counts /= np.maximum(counts.max(axis=2, keepdims=True), 1e-9)
    return waves, counts


def _off_ellipses(along: FloatArray, down: FloatArray, inclined: FloatArray) -> FloatArray:
    """Return the relative distance of points from ellipses, (K, N, P_1 P_0); 1 on the rim.

    Takes points on the first axis (K, N, P_0) and on the second (K, N, P_1), in half intervals.
    """
    y, z = along[:, :, np.newaxis], down[:, :, :, np.newaxis]
    mixed = inclined[:, np.newaxis, np.newaxis]
    off = (y * y + z * z - 2.0 * mixed * y * z) / (1.0 - mixed * mixed)
    return np.asarray(np.sqrt(np.maximum(off, 0.0)).reshape(*off.shape[:2], -1))


def _waves(count: int, finer: int, reach: int) -> ComplexArray:
    """Return responses of elements, (count, 2 reach + 1), to points ``finer`` per natural width."""
    longest = 1 << max(reach - 1, 0).bit_length()
    return _all_waves(count, finer, longest)[:, longest - reach : longest + reach + 1]


@functools.lru_cache(maxsize=16)
def _all_waves(count: int, finer: int, reach: int) -> ComplexArray:
    placed = (np.arange(count) - (count - 1) / 2) / count
    places = np.arange(-reach, reach + 1) / finer
    waves: ComplexArray = np.exp(2j * np.pi * np.outer(placed, places))
    return waves


def _ring_samples(
    array: Array, across: Aperture, directions: FloatArray, seen: ApertureCones
) -> ConeSamples:
    """Return steering vectors of directions in rings about each predicted one, out to the cones."""
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
    """Return how far directions (P, 3) are outside the first of K cones, natural widths, (P, N).

    0 within that cone.
    """
    cosines = (around @ across.axes.T)[:, np.newaxis]
    beyond = np.maximum(np.maximum(seen.lowest[0] - cosines, cosines - seen.highest[0]), 0.0)
    beyond *= across.lengths_m / wavelength_m
    if len(across.axes) == 1:
        return np.asarray(beyond[:, :, 0])
    found: FloatArray = np.sqrt(np.einsum("pnd,pnd->pn", beyond, beyond))
    return found
