"""Guaranteed gain: the least array gain over all possible directions of the UAV.

The array gain of weights f towards u is |a(u)^T f|^2 / |f|^2. Its least over the cone of the
pointing bound is found by branch and bound: cells whose bound could still be the least are split
until bound and attained gain agree (``TOLERANCE_DB``) or the work limit is reached. The result is a
bound over every cell, whenever the search ends: never above the true least gain, never below the
true largest. See docs/math.md 5.4 and 7.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

import numpy as np

from companion.beams.array import steering
from companion.beams.array.coverage import EVERYWHERE, Coverage, margin_rad
from companion.beams.array.elements import ElementPattern
from companion.beams.array.geometry import Array
from companion.beams.worth import cone
from companion.beams.worth.cone import Boxes, Cells, DirectionCones
from companion.values import ComplexArray, FloatArray, IntArray

TOLERANCE_DB: Final = 0.05  # difference between bound and attained gain at which the search ends
TOLERANCE: Final = 1 - 10 ** (-TOLERANCE_DB / 20)  # the same as a relative amplitude
NOTHING_DB: Final = 40.0
"""Depth below the weights' greatest possible gain beyond which a gain is not refined, dB."""
LEVELS: Final = 12  # most rounds of splitting cells
CAPS: Final = 8
"""Number of caps, plus one, on the arc of an initial cell of a line; each split doubles it."""
MOST_SPLIT: Final = 4096  # most cells split for one cone; those with many caps count as more
BLOCK: Final = 2**18  # elements or caps, times cells, computed at once: some megabytes


def guaranteed_gains_db(
    array: Array,
    directions: FloatArray,
    pointing_bounds_rad: Sequence[float | None],
    weights: ComplexArray,
) -> tuple[float | None, ...]:
    """Return each beam's least array gain within its pointing bound, proven, dB.

        directions           (N, 3), unit directions, array frame
        pointing_bounds_rad  (N,), half angles of the cones; None: any direction
        weights              (M, N), column n for row n of the directions

    Element patterns, coupling and channel errors are included; the power is that of the weights of
    live elements. A result is None if nothing is proven: the cone contains a null, or has no bound.
    The true minimum is at most ``TOLERANCE_DB`` above the result. Exceptions: it is more than
    ``NOTHING_DB`` down, or the work limit is reached: over cones many beams wide, or if directive
    elements face apart and the weights set them against one another (tenths of a dB). Raises
    ``ValueError`` for weights that are zero or do not match.
    """
    unit, bounds = _cones(directions, pointing_bounds_rad)
    powered = cone.unit_power(array, array.fed(weights))
    if weights.shape[1] != len(unit):
        raise ValueError(f"{weights.shape[1]} columns of weights for {len(unit)} directions")
    found: list[float | None] = [None] * len(unit)
    bounded = np.flatnonzero([bound is not None for bound in pointing_bounds_rad])
    within = unit[bounded], bounds[bounded]
    least = _extremes(array, *within, array.carried(powered[:, bounded]), most=False)
    least = least - _off(array, *within, powered[:, bounded])
    for n, amplitude in zip(bounded.tolist(), least.tolist(), strict=True):
        if amplitude > 0:
            found[n] = 20 * math.log10(amplitude)
    return tuple(found)


def leakage_bounds(
    array: Array,
    directions: FloatArray,
    pointing_bounds_rad: Sequence[float | None],
    weights: ComplexArray,
) -> FloatArray:
    """Return the largest array gain (N, J), linear, of beam j within UAV i's pointing bound.

        directions           (N, 3), unit directions, array frame
        pointing_bounds_rad  (N,), half angles of the cones; None: any direction
        weights              (M, J)

    Up to the powers, this bounds what UAV i receives of UAV j's stream. The true maximum is at most
    ``TOLERANCE_DB`` below, with the exceptions of ``guaranteed_gains_db``.
    """
    unit, bounds = _cones(directions, pointing_bounds_rad)
    powered = cone.unit_power(array, array.fed(weights))
    row, column = np.indices((len(unit), weights.shape[1])).reshape(2, -1)
    within = unit[row], bounds[row]
    largest = _extremes(array, *within, array.carried(powered)[:, column], most=True)
    largest = largest - _off(array, *within, powered[:, column])
    return (largest**2).reshape(len(unit), weights.shape[1])


def _cones(directions: FloatArray, given: Sequence[float | None]) -> tuple[FloatArray, FloatArray]:
    """Return checked unit directions and their bounds; a bound of None becomes pi."""
    bounds = np.array([np.pi if bound is None else bound for bound in given], dtype=float)
    return cone.unit_directions(directions, bounds), bounds


def _off(
    array: Array, unit: FloatArray, bounds: FloatArray, weights: ComplexArray
) -> FloatArray | float:
    """Return the largest change (N,) by channel errors of the response of column n over cone n.

    The worst case: the errors of all elements add up.
    """
    if array.channel_error is None:
        return 0.0
    towards = steering.element_directions(array, unit)
    most = array.element.amplitude_range(towards, bounds)[1]
    if array.coupling is not None:
        most = np.abs(array.coupling).T @ np.broadcast_to(most, (array.size, len(unit)))
    parts = array.channel_error[:, np.newaxis] * np.abs(weights) * most
    off: FloatArray = parts.sum(axis=0)
    return off


def _extremes(
    array: Array, unit: FloatArray, bounds: FloatArray, weights: ComplexArray, most: bool
) -> FloatArray:
    """Return the least response (N,) of column n over cone n.

    With ``most``, the negated largest response: a least one as well.
    """
    if len(unit) == 0:
        return np.empty(0)
    cones = cone.cones_around(array, unit, bounds, np.abs(weights))
    patterned = array.element.pattern is not ElementPattern.ISOTROPIC
    scales = (
        1.0 if cone.has_distinct_patterns(array) else array.element.amplitude_range(unit, bounds)[1]
    )
    nothing = 10 ** (-NOTHING_DB / 20) * scales * cones.ceilings
    proven, attained = np.full((2, len(unit)), np.inf)
    spent = np.zeros(len(unit), dtype=np.int64)
    boxes = cone.first_boxes(cones)
    for level in range(LEVELS):
        caps = CAPS * 2**level if patterned else 0
        bound, seen = _over_boxes(cones, boxes, weights, caps + 1, most)
        np.minimum.at(attained, boxes.cone, seen)
        size = np.abs(attained)
        enough = attained - TOLERANCE * np.maximum(size, nothing)
        going = most | (size > nothing)
        going &= level + 1 < LEVELS
        in_doubt = bound < np.where(going, enough, -np.inf)[boxes.cone]
        if in_doubt.any():
            spent += (1 + caps // CAPS) * np.bincount(boxes.cone[in_doubt], minlength=len(unit))
            in_doubt &= (spent <= MOST_SPLIT)[boxes.cone]
        done = ~in_doubt
        np.minimum.at(proven, boxes.cone[done], bound[done])
        if done.all():
            break
        boxes = cone.split(cones, boxes.take(in_doubt))
    return proven


def _over_boxes(
    cones: DirectionCones, boxes: Boxes, weights: ComplexArray, caps: int, most: bool
) -> tuple[FloatArray, FloatArray]:
    """Return for each box a lower bound (C,) of the least response, and an attained value."""
    step = max(1, BLOCK // max(cones.array.size, caps))
    starts = range(0, len(boxes.cone), step)
    if step >= len(boxes.cone):
        return _over_cells(cones, cone.cells(cones, boxes, caps), weights, most)
    parts = [
        _over_cells(cones, cone.cells(cones, boxes.take(slice(at, at + step)), caps), weights, most)
        for at in starts
    ]
    return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])


def _over_cells(
    cones: DirectionCones, cells: Cells, weights: ComplexArray, most: bool
) -> tuple[FloatArray, FloatArray]:
    received, unsure = cone.phasors(cones, cells)
    sums = _by_cone(cones, weights, received, cells.cone)
    responses = sums[0]
    low, high = cone.response_range(cones, cells, responses, sums[1:])
    seen = np.abs(responses)
    if unsure is not None:
        slack = np.einsum("mc,mc->c", np.abs(weights)[:, cells.cone], unsure)
        return (-high - slack, -seen) if most else (low - slack, seen)
    if cones.array.element.pattern is ElementPattern.ISOTROPIC:
        return (-high, -seen) if most else (low, seen)
    least, largest = cones.array.element.amplitude_range(cells.caps, cells.caps_rad)
    amplitude = cones.array.element.amplitude(cells.caps)
    if most:
        attained = np.where(cells.in_cone, amplitude, 0.0).max(axis=1)
        return -high * largest.max(axis=1), -seen * attained
    attained = np.where(cells.in_cone, amplitude, np.inf).min(axis=1)
    return low * least.min(axis=1), seen * attained


def _by_cone(
    cones: DirectionCones, weights: ComplexArray, received: ComplexArray, cone_of: IntArray
) -> ComplexArray:
    """Return for each cell its weights' response and moments by position, (1 + B, C).

    Cells are in the order of their cones, so that each cone needs one matrix product.
    """
    parts = np.vstack([np.ones(len(weights)), cones.positions_m.T])
    first, end_cone = int(cone_of[0]), int(cone_of[-1]) + 1
    placed = weights.T[first:end_cone, np.newaxis] * parts  # (cones, 1 + B, M)
    edges = np.searchsorted(cone_of, np.arange(first, end_cone + 1)).tolist()
    found: ComplexArray = np.empty((len(parts), len(cone_of)), dtype=complex)
    for one, (begin, end) in zip(placed, pairwise(edges), strict=True):
        if begin < end:
            np.matmul(one, received[:, begin:end], out=found[:, begin:end])
    return found


def covered_bounds(
    array: Array,
    coverage: Coverage,
    directions: FloatArray,
    pointing_bounds_rad: Sequence[float | None],
) -> list[float | None]:
    """Return pointing bounds of directions (N, 3), array frame; None if they leave the coverage.

    A UAV may then be outside the coverage, and nothing is guaranteed.
    """
    if coverage == EVERYWHERE:
        return list(pointing_bounds_rad)
    margins = margin_rad(coverage, directions, directions @ array.array_from_body)
    return [
        bound if bound is not None and bound <= margin else None
        for bound, margin in zip(pointing_bounds_rad, margins.tolist(), strict=True)
    ]
