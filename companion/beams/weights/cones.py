"""Cones of directions as an array sees them, and the least gain of beams over them, sampled.

An array sees a direction by its cosines on the axes of its aperture. Those of a cone about a
direction are an interval on each axis: a line sees no more of it, and of a plane's the ellipse in
these intervals is taken. Elements on a grid answer everywhere by one Fourier transform; others are
asked in a few directions. What is sampled here steers how much nulls may cost; what is promised is
proven in ``worth.guarantee``.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.beams.array.elements import Pattern
from companion.beams.array.geometry import Array
from companion.beams.array.steering import steering_matrix
from companion.beams.weights.shapes import Aperture
from companion.values import BoolArray, ComplexArray, FloatArray, IntArray

FINER: Final = 6
"""Samples in each natural width of a line."""
FINER_IN_PLANE: Final = 4
"""The same on each axis of a plane."""
RINGS: Final = 4
"""Rings of directions in which other arrays are asked."""


@dataclass(frozen=True, slots=True)
class Seen:
    """Cones by the cosines to the axes of an aperture, (N, D) each.

    seen             of the predicted direction
    lowest, highest  the ends of the interval
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
    """The cones within angles (N,) of unit directions (N, 3)."""
    cosines = np.clip(directions @ across.axes.T, -1.0, 1.0)
    angle, wide = np.arccos(cosines), angles_rad[:, np.newaxis]
    lowest = np.cos(np.minimum(angle + wide, np.pi))
    highest = np.cos(np.maximum(angle - wide, 0.0))
    return Seen(cosines, np.minimum(lowest, cosines), np.maximum(highest, cosines))


@dataclass(frozen=True, slots=True)
class Cones:
    """Where N beams are looked at, at P places each.

    grid     rows and columns of elements, and of the Fourier transform; None: ``vectors`` are asked
    vectors  (N, P, M), steering vectors of the places; empty on a grid
    held     (N, P), whether a place is within the cone over which the least gain counts
    likely   (N, P), whether it is within that of the likely angle
    """

    grid: tuple[tuple[int, int], tuple[int, int]] | None
    vectors: ComplexArray
    held: BoolArray
    likely: BoolArray

    def fields(self, weights: ComplexArray) -> ComplexArray:
        """What each column (M, N) radiates to its user's places, (N, P)."""
        if self.grid is None:
            found: ComplexArray = np.einsum("npm,mn->np", self.vectors, weights)
            return found
        placed, asked = self.grid
        if placed[0] == 1:
            line: ComplexArray = np.fft.ifft(weights.T, asked[1], axis=1, norm="forward")
            return line
        stood = weights.T.reshape(-1, *placed)
        plane: ComplexArray = np.fft.ifft2(stood, asked, norm="forward").reshape(len(stood), -1)
        return plane

    def of(self, users: IntArray) -> "Cones":
        """The cones of some of the users."""
        vectors = self.vectors if self.grid is not None else self.vectors[users]
        return Cones(self.grid, vectors, self.held[users], self.likely[users])


def cones(
    array: Array, across: Aperture, directions: FloatArray, held: Seen, likely: Seen
) -> Cones:
    """Where the beams towards unit directions (N, 3) are looked at."""
    apart = array.element_from_array is not None and array.element.pattern is not Pattern.ISOTROPIC
    if array.grid is None or apart or array.coupling is not None:
        return _asked(array, across, directions, held, likely)
    nothing: ComplexArray = np.empty((0, 0, 0), dtype=complex)
    rows, columns = array.grid
    finer = FINER if min(array.grid) == 1 else FINER_IN_PLANE
    asked = tuple(_fast_length(finer * n) if n > 1 else 1 for n in (rows, columns))
    on = _on_line if min(array.grid) == 1 else _on_grid
    near = on(array, across, (held, likely), asked)
    return Cones((array.grid, (asked[0], asked[1])), nothing, near[0], near[1])


@functools.cache
def _fast_length(least: int) -> int:
    """The first length from ``least`` on that a Fourier transform is fast for: 2, 3 and 5 make it.

    ``scipy.fft`` would know one, and brings all that ``lapack`` does without.
    """
    length = least
    while True:
        rest = length
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return length
        length += 1


def _on_line(
    array: Array, across: Aperture, seen: Sequence[Seen], asked: tuple[int, ...]
) -> BoolArray:
    """Which places of the Fourier transform are in K times N intervals, (K, N, P).

    Half a place more at both ends, so that the nearest place is always in it.
    """
    bins = max(asked)
    places = bins * across.lengths_m / (array.wavelength_m * array.size)
    middles = np.concatenate([one.middles for one in seen]) * places
    halves = np.concatenate([one.halves for one in seen]) * places + 0.5
    lowest = (middles - halves) % bins
    highest = lowest + 2.0 * halves
    place = np.arange(bins)
    inside: BoolArray = (place >= lowest) & (place <= highest)
    inside |= place <= highest - bins  # round the end, as a Fourier transform goes
    return inside.reshape(len(seen), -1, bins)


def _on_grid(
    array: Array, across: Aperture, seen: Sequence[Seen], asked: tuple[int, ...]
) -> BoolArray:
    """Which places of the Fourier transform are in K times N cones, (K, N, P)."""
    assert array.grid is not None
    wide = across.lengths_m / array.wavelength_m
    middles = np.concatenate([one.middles for one in seen]) * wide
    halves = np.concatenate([one.halves for one in seen]) * wide
    off = np.zeros((len(middles), 1))
    # The axes are y and z; the places are those of z by those of y.
    for d, axis in reversed(list(enumerate(across.axes))):
        place = 1 if axis[1] else 0
        count, bins = array.grid[place], asked[place]
        apart = np.arange(bins) * (count / bins) - middles[:, d, np.newaxis]
        apart -= count * np.rint(apart / count)
        apart /= (halves[:, d] + 0.5 * count / bins)[:, np.newaxis]
        apart *= apart
        off = (off[:, :, np.newaxis] + apart[:, np.newaxis]).reshape(len(apart), -1)
    inside: BoolArray = off <= np.maximum(off.min(axis=1, keepdims=True), 1.0)
    return inside.reshape(len(seen), -1, inside.shape[1])


def _asked(
    array: Array, across: Aperture, directions: FloatArray, held: Seen, likely: Seen
) -> Cones:
    """Steering vectors of directions in rings about each predicted one, out to either cone."""
    users = len(directions)
    wide = np.arccos(np.clip(held.seen - held.halves, -1, 1)) - np.arccos(held.seen)
    reach = np.abs(wide).max(axis=1)
    inner = np.arcsin(np.clip(likely.halves.max(axis=1), 0.0, 1.0))
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
    inside = np.ones((users, len(share)), dtype=bool)
    return Cones(None, vectors, inside, inside & from_likely)


def outside(across: Aperture, held: Seen, around: FloatArray, wavelength_m: float) -> FloatArray:
    """How far directions (P, 3) are outside of cones (N,), in natural widths, (P, N); 0 within."""
    cosines = (around @ across.axes.T)[:, np.newaxis]
    beyond = np.maximum(np.maximum(held.lowest - cosines, cosines - held.highest), 0.0)
    beyond *= across.lengths_m / wavelength_m
    found: FloatArray = np.sqrt(np.einsum("pnd,pnd->pn", beyond, beyond))
    return found
