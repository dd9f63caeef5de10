"""Directions in which a UAV can be, from powers received through several beams.

The power P_k through beam k is 20 log10 |a(u)^T w_k| dB, plus one unknown scale g, plus an error of
at most the bound b. With R_k(u) = P_k - 20 log10 |a(u)^T w_k|, a direction u is possible if and
only if max R_k - min R_k <= 2 b: then one g is within b of every R_k. Branch and bound over the
cells of a cap (``cone``) discards cells in which the intervals of R_k exclude that. The result is a
cap around the other cells, valid whenever the search ends. See docs/math.md 5.4.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.beams.array.geometry import Array
from companion.beams.worth import cone
from companion.beams.worth.cone import ROUNDING_RAD, Boxes, Cells, DirectionCones
from companion.values import BoolArray, Cap, ComplexArray, FloatArray

BEAMS_MAX: Final = 32  # most powers that are used, the largest ones
ENTRIES_MAX: Final = 2**14
"""Limit on beams times elements, which reduces the beams of arrays above 512 elements."""
BEAMS_MIN: Final = 3  # powers that are used whatever the size of the array
TOLERANCE: Final = 0.06
"""Size of a cell, relative to the radius of the result, from which it is not split further."""
RIM: Final = 0.15  # share of that radius, from its edge inward, in which cells are split
LEVELS: Final = 24  # most rounds of splitting cells
TERMS_MAX: Final = 2**23
"""Limit on beams times cells times elements per search; a round that has started is completed."""
BLOCK: Final = 2**19  # beams or elements, times cells, computed at once: some tens of megabytes
CAPS: Final = 33  # caps that cover the arc of a cell of a line
CENTRINGS: Final = 8  # steps towards the centre of the smallest cap around the cells
ROUNDING_DB: Final = 1e-9  # margin for rounding of logarithms and differences


def possible_directions(
    array: Array, within: Cap, *, weights: ComplexArray, powers_db: FloatArray, bound_db: float
) -> Cap | None:
    """Return a cap with every direction of ``within`` that explains powers through beams.

        within     directions in which the UAV is, array frame
        weights    (M, K), weights of the beams; the scales of the columns count
        powers_db  (K,), power through each beam, on any common scale
        bound_db   largest error of each power

    None if no direction of ``within`` explains them. Coupling, channel errors and differing element
    patterns are included; a pattern that all elements share is a common factor. Beams without a
    live element are ignored. The result is ``within`` itself if the powers exclude too little;
    separate sets of directions get one cap around all.

    Elements on a line that face alike resolve only the angle to the line. The result then encloses
    the part of the ring of that angle that is in ``within``: no power shows where on the ring the
    UAV is, hence not its elevation for a line along y.

    Raises ``ValueError`` for weights or powers that do not match or are not finite, for a negative
    bound, and for a centre that is no unit vector.
    """
    bounds_rad = np.array([within.radius_rad])
    center = cone.unit_directions(within.center[np.newaxis], bounds_rad)
    if powers_db.shape != weights.shape[1:] or not np.isfinite(powers_db).all():
        raise ValueError(f"powers {powers_db.shape} for weights {weights.shape}; give finite ones")
    if not 0 <= bound_db < np.inf:
        raise ValueError(f"bound is {bound_db} dB; give a finite one, 0 or more")
    live = np.flatnonzero(array.fed(weights).any(axis=0))
    count = min(BEAMS_MAX, max(BEAMS_MIN, ENTRIES_MAX // array.size))
    used = live[np.argsort(-powers_db[live], kind="stable")[:count]]
    if len(used) < 2:
        return within
    fed = array.fed(weights[:, used])
    unit = cone.unit_power(array, fed)
    scales = np.abs(fed).max(axis=0) / np.abs(unit).max(axis=0)
    carried = array.carried(unit)
    largest = np.abs(carried).max(axis=1, keepdims=True)
    cones = cone.cones_around(array, center, bounds_rad, largest)
    placed = [carried, *(column[:, np.newaxis] * carried for column in cones.positions_m.T)]
    search = _Search(
        cones=cones,
        fed=unit,
        carried=carried,
        moments=np.ascontiguousarray(np.concatenate(placed, axis=1).T),
        levels_db=powers_db[used] - 20 * np.log10(scales),
        spread_db=2 * bound_db + ROUNDING_DB,
    )
    found = search.run()
    return within if found is not None and found.radius_rad >= within.radius_rad else found


@dataclass(frozen=True, slots=True, eq=False)
class _Pieces:
    """C boxes that are left, and the cap around each of their parts, (C, P, 3) and (C, P)."""

    boxes: Boxes
    caps: FloatArray
    caps_rad: FloatArray

    @property
    def count(self) -> int:
        return len(self.boxes.cone)

    def take(self, chosen: BoolArray) -> "_Pieces":
        return _Pieces(self.boxes.take(chosen), self.caps[chosen], self.caps_rad[chosen])

    def around(self) -> tuple[Cap, FloatArray]:
        """Return a cap around all of them, and how far each of them reaches from its centre."""
        if self.count == 0:
            return Cap(np.array([1.0, 0.0, 0.0]), 0.0), np.empty(0)
        points, radii = self.caps.reshape(-1, 3), self.caps_rad.ravel()
        center = points.mean(axis=0)
        for step in range(1, CENTRINGS + 1):
            center = center / max(float(np.sqrt(center @ center)), 1e-9)
            farthest = int(np.argmax(_angles_rad(points, center) + radii))
            center = center + (points[farthest] - center) / (step + 1)
        center = center / max(float(np.sqrt(center @ center)), 1e-9)
        reach = (_angles_rad(self.caps, center) + self.caps_rad).max(axis=1) + ROUNDING_RAD
        return Cap(center, min(float(reach.max()), np.pi)), reach


def _joined(one: _Pieces, other: _Pieces) -> _Pieces:
    boxes = Boxes(
        np.concatenate([one.boxes.cone, other.boxes.cone]),
        np.concatenate([one.boxes.low, other.boxes.low]),
        np.concatenate([one.boxes.high, other.boxes.high]),
    )
    caps = np.concatenate([one.caps, other.caps])
    return _Pieces(boxes, caps, np.concatenate([one.caps_rad, other.caps_rad]))


def _angles_rad(points: FloatArray, center: FloatArray) -> FloatArray:
    """Return the angles (...) between unit vectors (..., 3) and one; exact also if small."""
    off = points - center
    chords = np.sqrt(np.einsum("...k,...k->...", off, off))
    angles: FloatArray = 2 * np.arcsin(np.minimum(chords / 2, 1.0))
    return angles


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Search:
    """Search for the directions of one cone that explain powers through K beams.

    fed, carried  (M, K), weights of unit power, and the excitation of the elements by them
    moments       (K + B K, M), the rows of ``carried``, then times each column of positions
    levels_db     (K,), powers as they would be through weights of unit power
    spread_db     largest difference of levels less responses that the errors explain
    """

    cones: DirectionCones
    fed: ComplexArray
    carried: ComplexArray
    moments: ComplexArray
    levels_db: FloatArray
    spread_db: float

    def run(self) -> Cap | None:
        """Return a cap around all cells that may explain the powers; None if there are none."""
        boxes = cone.first_boxes(self.cones)
        spent, left = len(boxes.cone), self._explaining(boxes)
        for _ in range(LEVELS):
            if left.count == 0:
                return None
            cap, reach = left.around()
            large = self._sizes_rad(left) > TOLERANCE * cap.radius_rad
            chosen = large & (reach >= (1 - RIM) * cap.radius_rad)
            if not chosen.any() or spent * self.carried.size > TERMS_MAX:
                return cap
            boxes = cone.split(self.cones, left.take(chosen).boxes)
            spent += len(boxes.cone)
            left = _joined(left.take(~chosen), self._explaining(boxes))
        return left.around()[0] if left.count else None

    def _sizes_rad(self, left: _Pieces) -> FloatArray:
        """Return the size of each box (C,): half the angle that it covers, or its cap's radius."""
        if self.cones.line:
            return (left.boxes.high - left.boxes.low)[:, 0] / 2
        return left.caps_rad[:, 0]

    def _explaining(self, boxes: Boxes) -> _Pieces:
        """Return the boxes in which a direction may explain the powers."""
        step = max(1, BLOCK // max(self.carried.shape))
        parts = []
        for start in range(0, len(boxes.cone), step):
            part = boxes.take(slice(start, start + step))
            cells = cone.cells(self.cones, part, CAPS)
            chosen = self._may_explain(cells)
            caps_rad = np.broadcast_to(cells.caps_rad, cells.caps.shape[:2])
            parts.append(_Pieces(part, cells.caps, caps_rad).take(chosen))
        found = parts[0]
        for one in parts[1:]:
            found = _joined(found, one)
        return found

    def _may_explain(self, cells: Cells) -> BoolArray:
        """Return for each cell (C,) whether its intervals of responses allow the powers."""
        received, unsure = cone.phasors(self.cones, cells)
        sums = (self.moments @ received).reshape(-1, self.carried.shape[1], len(cells.cone))
        low, high = cone.response_range(self.cones, cells, sums[0], sums[1:])
        off = self._off(received, unsure)
        with np.errstate(divide="ignore"):  # a response may be 0, which explains any low power
            least_db = 20 * np.log10(np.maximum(low - off, 0.0))
        most_db = 20 * np.log10(np.maximum(high + off, 1e-300))
        levels_db = self.levels_db[:, np.newaxis]
        spread_db = (levels_db - most_db).max(axis=0) - (levels_db - least_db).min(axis=0)
        allowed: BoolArray = spread_db <= self.spread_db
        return allowed

    def _off(self, received: ComplexArray, unsure: FloatArray | None) -> FloatArray:
        """Return how far patterns and channel errors change responses, (K, C) or (1, 1)."""
        array, off = self.cones.array, np.zeros((1, 1))
        amplitude: FloatArray = np.abs(received)
        if unsure is not None:
            off = np.abs(self.carried).T @ unsure
            amplitude = amplitude + unsure
        if array.channel_error is not None:
            if array.coupling is not None:
                amplitude = np.abs(array.coupling).T @ amplitude
            off = off + (array.channel_error[:, np.newaxis] * np.abs(self.fed)).T @ amplitude
        return off
