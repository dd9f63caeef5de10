"""Codebooks: the best fixed beam for a direction, the beams to sweep, and the next best one.

A radio that cannot set its own weights selects one beam of a codebook by its index. The received
response is a(u)^T c_k (docs/math.md 7), with c_k of unit power. If all elements face alike, their
pattern is a common factor of all beams and does not change the selection, which then ignores it,
also behind the elements.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np

from companion.beams.array import steering
from companion.beams.array.geometry import Array
from companion.beams.worth import cone
from companion.beams.worth.cone import Boxes, DirectionCones
from companion.values import BoolArray, ComplexArray, FloatArray, IntArray, UserError

LEVELS: Final = 12  # most rounds of splitting cells
RESPONSES_MAX: Final = 2**18
"""Limit on beams times cells examined per query; a round that has started is completed."""
TERMS_MAX: Final = 2**26
"""Limit on beams times cells times elements per query, for arrays above 256 elements."""
FIRST_TERMS_MAX: Final = 2**30
"""Limit on beams times cells times elements in the first round of a query: half a second. Beyond
it, all beams must be swept."""
ENTRIES_MAX: Final = 2**22  # elements times beams of a codebook: 64 MB
BLOCK: Final = 2**19
"""Beams times cells, or beams times directions, computed at once: some tens of megabytes."""
RESOLUTION_S: Final = 1e-3  # precision of the time at which the best beam changes
SAMPLES_PER_BEAM: Final = 4  # samples while a direction crosses one beam


WEIGHT_MAX: Final = 1e300
"""Largest weight accepted in a codebook; each beam's largest must be at least its inverse."""


class CodebookKind(StrEnum):
    """Where a codebook came from: a DFT or a file."""

    DFT = "dft"
    LISTED = "listed"


@dataclass(frozen=True, slots=True, eq=False)
class Codebook:
    """K beams: ``weights`` (M, K), columns of unit power, in the order of their indices."""

    kind: CodebookKind
    weights: ComplexArray

    @property
    def size(self) -> int:
        """K, the number of beams in the codebook."""
        return int(self.weights.shape[1])


@dataclass(frozen=True, slots=True)
class NextBest:
    """Index of the best beam now, of the beam that becomes best next, and seconds until then.

    ``next_index`` and ``after_s`` are None if no other becomes best within the horizon.
    """

    index: int
    next_index: int | None
    after_s: float | None


def dft(array: Array, oversampling: int = 1) -> Codebook:
    """Build the beams of a discrete Fourier transform over a line or a grid of elements.

    A line of n elements along y has K = n oversampling beams. The k-th steps by -2 pi k / K from
    element to element, and so points where spacing / wavelength times u_y is k/K, or that less a
    whole number: at half a wavelength u_y = 2k/K up to k = K/2, and 2k/K - 2 beyond. A line of one
    element has one beam. A grid has all products of a beam down its columns (u_z) and one along its
    rows (u_y), with index k_z K_y + k_y. Raises ``UserError`` for an array without a grid.
    """
    if array.grid is None:
        raise UserError(f"a DFT codebook needs a ULA or a URA, not elements of kind {array.kind}")
    if oversampling < 1:
        raise UserError(f"oversampling is {oversampling}, allowed: 1 or more")
    entries = array.size * math.prod(_beams(count, oversampling) for count in array.grid)
    if entries > ENTRIES_MAX:
        raise UserError(f"codebook has {entries} weights, allowed: at most {ENTRIES_MAX}")
    down, across = (_line(count, oversampling) for count in array.grid)
    return Codebook(CodebookKind.DFT, np.kron(down, across).astype(np.complex128))


def _beams(count: int, oversampling: int) -> int:
    return count * oversampling if count > 1 else 1


def _line(count: int, oversampling: int) -> ComplexArray:
    beams = _beams(count, oversampling)
    # The modulus removes whole turns before the sine: exact for any number of elements.
    steps = np.outer(np.arange(count), np.arange(beams)) % beams
    line: ComplexArray = np.exp(-2j * np.pi * steps / beams) / np.sqrt(count)
    return line


def listed(weights: ComplexArray, array: Array) -> Codebook:
    """Build a codebook from a list of weights (M, K), each column scaled to unit power.

    Raises ``UserError`` if they do not match the array, are not finite, or a beam is zero.
    """
    if weights.ndim != 2 or weights.shape[0] != array.size:
        raise UserError(f"weights of shape {weights.shape} do not match {array.size} elements")
    if weights.shape[1] == 0:
        raise UserError("codebook has no beam; give at least one")
    if not np.isfinite(weights).all():
        raise UserError("weights must be finite")
    silent = np.flatnonzero(~weights.any(axis=0))
    if silent.size:
        raise UserError(f"column {silent[0]} of the weights is zero")
    most = np.maximum(np.abs(weights.real), np.abs(weights.imag)).max(axis=0)
    if most.max() > WEIGHT_MAX or most.min() < 1 / WEIGHT_MAX:
        raise UserError(f"largest weight of a beam is not between 1e-300 and {WEIGHT_MAX:.0e}")
    return Codebook(CodebookKind.LISTED, cone.unit_power(array, weights))


def best(codebook: Codebook, array: Array, directions: FloatArray) -> tuple[IntArray, FloatArray]:
    """Find the best beam for each unit direction (N, 3), and its gain.

    Returns indices (N,), the lowest of equal ones, and array gains |a^T c|^2 (N,), linear, element
    pattern included.
    """
    unit = cone.unit_directions(directions, np.zeros(len(directions)))
    indices = np.empty(len(unit), dtype=np.int64)
    gains = np.empty(len(unit))
    step = max(1, BLOCK // max(codebook.size, array.size))
    for start in range(0, len(unit), step):
        block = slice(start, start + step)
        indices[block], gains[block] = _best(codebook, array, unit[block])
    return indices, gains


def _best(codebook: Codebook, array: Array, unit: FloatArray) -> tuple[IntArray, FloatArray]:
    power, pattern = _gains(codebook, array, unit)
    return power.argmax(axis=0), power.max(axis=0) * pattern


def _gains(codebook: Codebook, array: Array, unit: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return gains (K, N) of all beams towards unit directions, and their common factor (N,)."""
    if cone.has_distinct_patterns(array) or array.live is not None or array.coupling is not None:
        power = np.abs(codebook.weights.T @ steering.steering_matrix(array, unit)) ** 2
        return power, np.ones(len(unit))
    phase = array.wavenumber_radpm * (array.elements_m @ unit.T)
    power = np.abs(codebook.weights.T @ np.exp(1j * phase)) ** 2
    return power, steering.amplitudes(array, unit)[0] ** 2


def strongest_first(
    codebook: Codebook, array: Array, direction: FloatArray, indices: IntArray
) -> IntArray:
    """Sort indices by descending gain towards a direction (3,); ties by ascending index."""
    unit = cone.unit_directions(direction[np.newaxis], np.zeros(1))
    power = _gains(codebook, array, unit)[0][indices, 0]
    ordered: IntArray = indices[np.argsort(-power, kind="stable")]
    return ordered


def candidates(
    codebook: Codebook,
    array: Array,
    direction: FloatArray,
    pointing_bound_rad: float | None,
    share: float = 1.0,
) -> IntArray:
    """Return the indices, ascending, of the beams that must be swept to find the best one.

    They include the best beam for every true direction within the bound of the unit direction (3,);
    all beams without a bound (None). This is proven: a beam is excluded from a cell only if its
    largest response there is less than the least of another. Cells are split while they contain a
    beam that is not known to be best somewhere, until the work limit is reached: ``share`` of that
    of one query.
    """
    if pointing_bound_rad is None:
        return np.arange(codebook.size)
    bounds = np.array([pointing_bound_rad])
    unit = cone.unit_directions(direction[np.newaxis], bounds)
    carried = array.carried(codebook.weights)
    largest = np.abs(carried).max(axis=1, keepdims=True)  # holds for every beam
    cones = cone.cones_around(array, unit, bounds, largest)
    alive = np.arange(codebook.size)
    found = np.zeros(codebook.size, dtype=bool)
    boxes = cone.first_boxes(cones)
    if len(boxes.cone) * codebook.weights.size > share * FIRST_TERMS_MAX:
        return np.arange(codebook.size)
    spent, most = 0, share * min(RESPONSES_MAX, TERMS_MAX // array.size)
    for level in range(LEVELS):
        possible, seen = _possible_beams(cones, boxes, carried[:, alive])
        found[alive[seen]] = True
        in_doubt: BoolArray = np.any(possible & ~found[alive, np.newaxis], axis=0)
        alive = alive[possible[:, in_doubt].any(axis=1)]
        spent += possible.size
        if not in_doubt.any() or spent >= most or level + 1 == LEVELS:
            found[alive] = True
            break
        boxes = cone.split(cones, boxes.take(in_doubt))
    return np.flatnonzero(found)


def _possible_beams(
    cones: DirectionCones, boxes: Boxes, weights: ComplexArray
) -> tuple[BoolArray, BoolArray]:
    """Return masks of beams: best somewhere in each box (K, C), best in any box's middle (K,)."""
    size, beams = weights.shape
    placed = cones.positions_m.T[:, :, np.newaxis] * weights
    stacked = np.concatenate([weights[np.newaxis], placed]).transpose(0, 2, 1)
    possible = np.empty((beams, len(boxes.cone)), dtype=bool)
    seen = np.zeros(beams, dtype=bool)
    step = max(1, BLOCK // max(beams, size))
    for start in range(0, len(boxes.cone), step):
        block = slice(start, start + step)
        pieces = cone.cells(cones, boxes.take(block), caps=1)
        received, unsure = cone.phasors(cones, pieces)
        sums = stacked @ received
        low, high = cone.response_range(cones, pieces, sums[0], sums[1:])
        if unsure is not None:
            slack = np.abs(weights).T @ unsure
            low, high = low - slack, high + slack
        possible[:, block] = high >= low.max(axis=0)
        middle = np.abs(sums[0])
        seen |= (middle == middle.max(axis=0)).any(axis=1)
    return possible, seen


def next_best(
    codebook: Codebook,
    array: Array,
    directions_at: Callable[[FloatArray], FloatArray],
    horizon_s: float,
    step_s: float,
) -> NextBest:
    """Find the best beam now and the one that becomes best next, to a millisecond.

        directions_at  unit directions (T, 3) for seconds from now (T,)
        horizon_s      how far ahead to search
        step_s         sampling step; the first change between two samples is bisected

    A beam that is best for less than a step can be missed; if several changes fall into one step,
    one of them is found. With ``sampling_step_s`` neither case occurs in practice. Raises
    ``UserError`` for a horizon or a step not above 0.
    """
    if not (0 < horizon_s < math.inf and step_s > 0):
        raise UserError(
            f"horizon {horizon_s:g} s and step {step_s:g} s: give finite values above 0 s"
        )

    def best_at(times_s: FloatArray) -> IntArray:
        return best(codebook, array, directions_at(times_s))[0]

    times_s = np.append(np.arange(0.0, horizon_s, step_s), horizon_s)
    indices = best_at(times_s)
    now = int(indices[0])
    changed = np.flatnonzero(indices != now)
    if len(changed) == 0:
        return NextBest(now, None, None)
    low_s, high_s = times_s[changed[0] - 1], times_s[changed[0]]
    index = int(indices[changed[0]])
    while high_s - low_s > RESOLUTION_S:
        middle_s = (low_s + high_s) / 2
        between = int(best_at(np.array([middle_s]))[0])
        if between == now:
            low_s = middle_s
        else:
            high_s, index = middle_s, between
    return NextBest(now, index, float(high_s))


def sampling_step_s(codebook: Codebook, array: Array, rate_radps: float) -> float | None:
    """Return a step for ``next_best``: a quarter of the time in which a direction crosses a beam.

    ``rate_radps`` is the direction's angular rate. A beam is assumed as wide as wavelength /
    extent, or less if there are more beams than elements. None if the direction is constant or the
    array has no extent.
    """
    centred = array.centred_m
    extent_m = 2 * float(np.sqrt(np.einsum("mk,mk->m", centred, centred).max()))
    if rate_radps == 0 or extent_m == 0:
        return None
    width_rad = array.wavelength_m / extent_m / max(1.0, codebook.size / array.size)
    return width_rad / abs(rate_radps) / SAMPLES_PER_BEAM
