"""Cones of directions in small cells, with proven bounds on an array's response over each cell.

A cone holds every direction within an angle of a predicted one. Directions are written in polar
form about a pole, u = cos r p + sin r (cos t e1 + sin t e2), and a cell is a box in r and t. For
most arrays the pole is the predicted direction: rings and sectors tile the cone exactly, and no
cell crosses its rim. If the elements are on a line and all face alike, they resolve only the angle
r to the line. Then the pole is the line and a cell is an interval of r; the intervals cover the
predicted angle plus and minus the bound.

The response of weights f to u is r(u) = sum f_m g_m(u) exp(jk p_m . u). Let u = u_s + d with u_s
the middle of a cell, q_m the positions about any point c (which only rotates r by exp(-jk c . u)),
c_m = f_m g_m exp(jk q_m . u_s) with g_m constant. From |exp(jx) - 1 - jx| <= x^2/2, for any real x,

    |r(u) - r_s - G.d| <= k^2/2 sum w_m (q_m . d)^2,   r_s = sum c_m,   G = jk sum c_m q_m

for any w_m >= |c_m|. With d in a frame of three axes and each coordinate bounded over the cell,
this bounds |r| from below, by its part in phase with r_s, and from above. The variation of g_m over
the cell is added as an interval, or factored out if all elements face alike. See docs/math.md 5.4.

Over 300 lines: one proof: the cells of a cone, the bound over a cell, and the search over cells.
"""

from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Final, NamedTuple

import numpy as np

from companion.beams.array import steering
from companion.beams.array.elements import ElementPattern
from companion.beams.array.geometry import SAME_PLACE_WAVELENGTHS, Array
from companion.values import BoolArray, ComplexArray, FloatArray, IntArray

MOST_INTERVALS: Final = 512
"""Most initial cells of one cone of a line array; undecided cells are split further."""
MOST_RINGS: Final = 16
"""Most rings of initial cells of one cone of other arrays; undecided cells are split further."""
LINE_PHASE_RAD: Final = 0.12  # on a line
DISC_PHASE_RAD: Final = 0.25  # elsewhere
"""RMS phase of the elements from the middle of an initial cell to its end.

Half of its square is the error of the bounds, relative to the largest possible response.
"""
LINE_QUARTERS: Final = np.array([4, 1]), np.array([(0, 0), (1, 0), (2, 0), (3, 0)])
"""Parts of a split box in angle and rotation, and the place of each quarter among them."""
DISC_QUARTERS: Final = np.array([2, 2]), np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
ROUNDING_RAD: Final = 1e-12
"""Margin for rounding, added to the angle within which a pattern is bounded, radians."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class DirectionCones:
    """N cones of directions, with the data that bound the responses of one array over them.

    ``w`` are the largest magnitudes of the weights, patterns included if they differ.
    """

    array: Array
    frames: FloatArray  # (N, 3, 3), rows pole, e1, e2
    tilts_rad: FloatArray  # (N,), from the pole towards e1 to the prediction; 0 except on a line
    bounds_rad: FloatArray  # (N,), half angle of each cone
    positions_m: FloatArray  # (M, B), elements about their centroid, without columns of zeros
    columns: IntArray  # (B,), the columns that are left
    centres_m: FloatArray  # (N, B), centroid of the magnitudes w
    curvatures: FloatArray  # (N, B, B), k^2 sum w q q^T
    ceilings: FloatArray  # (N,), sum of w
    rounding: FloatArray  # (N,), a generous bound on floating-point error
    line: bool  # only the angle to the pole matters


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """C cells as boxes in angle from the pole and rotation about it, in the order of their cones.

    On a line the cone limits the rotation, and the second column is unused.
    """

    cone: IntArray  # (C,), the cone of each
    low: FloatArray  # (C, 2), lower ends in angle and turn
    high: FloatArray  # (C, 2), upper ends

    def take(self, chosen: BoolArray | slice) -> "Boxes":
        """Return the boxes that a mask or a slice selects."""
        return Boxes(self.cone[chosen], self.low[chosen], self.high[chosen])


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Cells:
    """C cells on the sphere, each in the union of its K caps.

    Any direction of a cell differs from its middle by a sum of axes, each times at most its reach.
    A line has one axis, as it does not resolve the others.
    """

    cone: IntArray  # (C,), the cone of each
    middles: FloatArray  # (C, 3), a direction in each cell and in its cone
    axes: FloatArray  # (C, D, B), orthonormal but for columns that ``DirectionCones`` leaves out
    reach: FloatArray  # (C, D)
    caps: FloatArray  # (C, K, 3), unit directions in the middles of the caps
    caps_rad: FloatArray  # (C, K), radius of each cap
    in_cone: BoolArray  # (C, K), whether a cap's middle is inside the cone


def unit_directions(directions: FloatArray, bounds_rad: FloatArray) -> FloatArray:
    """Return unit directions (N, 3), scaled to length 1 exactly.

    Raises ``ValueError`` if a length is off by more than 1e-6, or if a bound of ``bounds_rad`` (N,)
    is missing or negative.
    """
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ValueError(f"directions have shape {directions.shape}; give rows of three")
    lengths = np.sqrt(np.vecdot(directions, directions))
    if not (np.abs(lengths - 1) < 1e-6).all():
        raise ValueError("directions must be unit vectors")
    if bounds_rad.shape != lengths.shape or not (bounds_rad >= 0).all():
        raise ValueError("give one pointing bound, 0 or more radians, for each direction")
    unit: FloatArray = directions / lengths[:, np.newaxis]
    return unit


def unit_power(array: Array, weights: ComplexArray) -> ComplexArray:
    """Return weights (M, K) with each column scaled to unit power.

    Raises ``ValueError`` if they do not match the array, are not finite, or a column is zero.
    """
    if weights.ndim != 2 or len(weights) != array.size:
        raise ValueError(f"weights of shape {weights.shape} do not match {array.size} elements")
    if not np.isfinite(weights).all():
        raise ValueError("weights must be finite")
    largest = np.abs(weights).max(axis=0)
    if not largest.all():
        raise ValueError(f"column {int(np.argmin(largest))} of the weights is zero")
    scaled = weights / largest  # so that no square over- or underflows
    powered: ComplexArray = scaled / np.sqrt(np.sum(np.abs(scaled) ** 2, axis=0))
    return powered


def has_distinct_patterns(array: Array) -> bool:
    """Return whether element patterns differ, so that they are no common factor."""
    return (
        array.element_from_array is not None
        and array.element.pattern is not ElementPattern.ISOTROPIC
    )


def cones_around(
    array: Array, directions: FloatArray, bounds_rad: FloatArray, magnitudes: FloatArray
) -> DirectionCones:
    """Return cones within ``bounds_rad`` (N,) of unit directions (N, 3).

    The cones apply to responses of weights that are at most ``magnitudes`` (M, N).
    """
    layout = _layout(array)
    if has_distinct_patterns(array):
        towards = steering.element_directions(array, directions)
        magnitudes = magnitudes * array.element.amplitude_range(towards, bounds_rad)[1]
    positions = layout.positions_m
    ceilings = np.maximum(magnitudes.sum(axis=0), 1e-300)  # 0: no element radiates there
    centres = magnitudes.T @ positions / ceilings[:, np.newaxis]
    moments = (magnitudes.T @ layout.products_m2).reshape(len(ceilings), *positions.shape[1:] * 2)
    moments -= (ceilings[:, np.newaxis] * centres)[:, :, np.newaxis] * centres[:, np.newaxis]
    poles = layout.along[np.newaxis].repeat(len(directions), 0) if layout.line else directions
    frames, tilts = _frames(poles, directions)
    return DirectionCones(
        array=array,
        frames=frames,
        tilts_rad=tilts,
        bounds_rad=np.minimum(bounds_rad, np.pi),
        positions_m=positions,
        columns=layout.columns,
        centres_m=centres,
        curvatures=array.wavenumber_radpm**2 * moments,
        ceilings=ceilings,
        rounding=layout.unsure * ceilings,
        line=layout.line,
    )


class _Layout(NamedTuple):
    """Elements of an array as cones see them; see ``DirectionCones``.

    along        (3,), direction of the outermost element
    products_m2  (M, B B), products of the positions' columns
    unsure       bound on floating-point error, relative to the largest response
    """

    along: FloatArray
    line: bool
    columns: IntArray
    positions_m: FloatArray
    products_m2: FloatArray
    unsure: float


@lru_cache(maxsize=8)
def _layout(array: Array) -> _Layout:
    centred = array.centred_m
    far = centred[np.argmax(np.vecdot(centred, centred))]
    extent_m = float(np.sqrt(far @ far))
    along = far / max(extent_m, 1e-300)
    aside_m = float(np.abs(centred - np.outer(centred @ along, along)).max())
    aligned = extent_m > 0 and aside_m <= SAME_PLACE_WAVELENGTHS * array.wavelength_m
    line = aligned and not has_distinct_patterns(array)
    columns = np.flatnonzero(np.abs(centred).max(axis=0) > 0)
    positions = centred[:, columns]
    wavenumber = array.wavenumber_radpm
    phase = wavenumber * float(np.abs(array.elements_m).max())
    unsure = (array.size + 16 + 8 * phase) * float(np.finfo(float).eps)
    unsure += 4 * wavenumber * aside_m if line else 0.0
    products = (positions[:, :, np.newaxis] * positions[:, np.newaxis]).reshape(array.size, -1)
    return _Layout(
        along=along,
        line=line,
        columns=columns,
        positions_m=positions,
        products_m2=products,
        unsure=unsure,
    )


def _frames(poles: FloatArray, towards: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return pole, e1 and e2 as rows (N, 3, 3), and the angle (N,) from the pole to ``towards``.

    e1 is on the side of ``towards`` if that differs from the pole.
    """
    cosines = np.vecdot(poles, towards)
    aside = towards - cosines[:, np.newaxis] * poles
    sines = np.sqrt(np.vecdot(aside, aside))
    e1 = aside
    if not sines.min(initial=1.0) > 1e-15:
        least = np.eye(3)[np.argmin(np.abs(poles), axis=1)]
        e1 = np.where((sines > 1e-15)[:, np.newaxis], aside, least)
    for _ in range(2):  # twice: for a short vector the residual along the pole is not small
        e1 = e1 / np.sqrt(np.vecdot(e1, e1))[:, np.newaxis]
        e1 = e1 - np.vecdot(e1, poles)[:, np.newaxis] * poles
    e1 = e1 / np.sqrt(np.vecdot(e1, e1))[:, np.newaxis]
    frames: FloatArray = np.empty((len(poles), 3, 3))
    frames[:, 0], frames[:, 1] = poles, e1
    later, last = [1, 2, 0], [2, 0, 1]
    frames[:, 2] = poles[:, later] * e1[:, last] - poles[:, last] * e1[:, later]
    return frames, np.arctan2(sines, cosines)


def first_boxes(cones: DirectionCones) -> Boxes:
    """Return boxes that cover every cone, finer where the phases of the elements change faster."""
    curvatures = cones.curvatures.diagonal(axis1=1, axis2=2)
    spread = curvatures.max(axis=1, initial=0.0) / cones.ceilings
    turned_rad = np.sqrt(np.maximum(spread, 0.0)) * cones.bounds_rad
    if cones.line:
        wanted, most = turned_rad / LINE_PHASE_RAD, MOST_INTERVALS
    else:
        wanted, most = turned_rad / (2 * DISC_PHASE_RAD), MOST_RINGS
    wanted = np.minimum(np.maximum(wanted, 1), most)
    counts = 2 ** np.ceil(np.log2(wanted)).astype(np.int64)  # few different counts
    boxes = _intervals(counts) if cones.line else _discs(counts)
    tilt, bound = cones.tilts_rad[boxes.cone], cones.bounds_rad[boxes.cone]
    for ends in (boxes.low, boxes.high):
        ends[:, 0] = np.minimum(np.maximum(tilt + bound * ends[:, 0], 0.0), np.pi)
    return boxes


def _intervals(counts: IntArray) -> Boxes:
    """Return -1 to 1 in ``counts`` (N,) equal parts for each cone; the rotation is unused."""
    cone = np.repeat(np.arange(len(counts)), counts)
    number = np.arange(len(cone)) - (np.cumsum(counts) - counts)[cone]
    width = 2.0 / counts[cone]
    low, high = np.zeros((2, len(cone), 2))
    low[:, 0], high[:, 0] = number * width - 1.0, (number + 1) * width - 1.0
    return Boxes(cone, low, high)


def _discs(counts: IntArray) -> Boxes:
    """Return the unit disc in ``counts`` (N,) rings for each cone."""
    parts = [_sectors(count) for count in counts.tolist()]
    cone = np.repeat(np.arange(len(counts)), [len(low) for low, _ in parts])
    low, high = (np.concatenate(ends) for ends in zip(*parts, strict=True))
    return Boxes(cone, low, high)


@cache
def _sectors(rings: int) -> tuple[FloatArray, FloatArray]:
    """Return cells of the unit disc: ring n has 6n sectors about as long as they are wide."""
    parts = 6 * np.arange(1, rings + 1)
    ring = np.repeat(np.arange(rings), parts)
    sector = np.arange(len(ring)) - np.repeat(np.cumsum(parts) - parts, parts)
    width = 2 * np.pi / parts[ring]
    low = np.stack([ring / rings, sector * width], axis=1)
    return low, np.stack([(ring + 1) / rings, (sector + 1) * width], axis=1)


def split(cones: DirectionCones, boxes: Boxes) -> Boxes:
    """Split each box in four: quarters of the angle on a line, else halves on both axes."""
    parts, quarter = LINE_QUARTERS if cones.line else DISC_QUARTERS
    size = ((boxes.high - boxes.low) / parts)[:, np.newaxis]
    low = boxes.low[:, np.newaxis] + size * quarter
    return Boxes(boxes.cone.repeat(len(quarter)), low.reshape(-1, 2), (low + size).reshape(-1, 2))


def cells(cones: DirectionCones, boxes: Boxes, caps: int) -> Cells:
    """Return the cells on the sphere of boxes in angle and rotation.

    ``caps`` is the number of caps that cover the arc of a cell on a line, an odd number; 1 does not
    cover it, for callers that need no pattern.
    """
    return _strips(cones, boxes, caps) if cones.line else _patches(cones, boxes)


def _strips(cones: DirectionCones, boxes: Boxes, caps: int) -> Cells:
    """Return the cells of a line: arcs of the cone about it, of which only the angle matters."""
    low, high = boxes.low[:, 0], boxes.high[:, 0]
    angle, half = (low + high) / 2, (high - low) / 2
    frames = cones.frames[boxes.cone]
    # |cos r - cos r_s| at either end, without the cancellation.
    ends = np.sin((low + angle) / 2), np.sin((high + angle) / 2)
    reach = 2 * np.sin(half / 2) * np.maximum(*ends)
    if caps == 1:
        middles = np.cos(angle)[:, np.newaxis] * frames[:, 0]
        middles += np.sin(angle)[:, np.newaxis] * frames[:, 1]
        return Cells(
            cone=boxes.cone,
            middles=middles,
            axes=frames[:, :1, cones.columns],
            reach=reach[:, np.newaxis],
            caps=middles[:, np.newaxis],
            caps_rad=half[:, np.newaxis] + ROUNDING_RAD,
            in_cone=np.ones((len(half), 1), dtype=bool),
        )
    turn = _turn_rad(cones, boxes)[:, np.newaxis] / caps
    around = _polar(frames, angle[:, np.newaxis], turn * (2 * np.arange(caps) + 1 - caps))
    caps_rad = _angle_rad(_inward(boxes, turn))
    tilt = cones.tilts_rad[boxes.cone, np.newaxis]
    predicted = _polar(frames, tilt, np.zeros_like(tilt))
    cosines = np.einsum("ckj,coj->ck", around, predicted)
    in_cone = cosines >= np.cos(cones.bounds_rad)[boxes.cone, np.newaxis] - 1e-12
    return Cells(
        cone=boxes.cone,
        middles=around[:, caps // 2],
        axes=frames[:, :1, cones.columns],
        reach=reach[:, np.newaxis],
        caps=around,
        caps_rad=caps_rad,
        in_cone=in_cone,
    )


def _turn_rad(cones: DirectionCones, boxes: Boxes) -> FloatArray:
    """Return the largest rotation about the line for directions both in a cell and its cone.

    sin^2(t / 2) = sin((bound + r - tilt) / 2) sin((bound - r + tilt) / 2) / (sin r sin tilt); its
    only extreme between the ends of r is where cos r = cos tilt / cos bound.
    """
    tilt, bound = cones.tilts_rad[boxes.cone], cones.bounds_rad[boxes.cone]
    cosine = np.where(np.abs(np.cos(bound)) < 1e-9, 1e-9, np.cos(bound))
    widest = np.arccos(np.clip(np.cos(tilt) / cosine, -1.0, 1.0))
    low, high = boxes.low[:, 0], boxes.high[:, 0]
    angles = np.stack([low, high, np.clip(widest, low, high)])
    wide = bound + 8 * np.finfo(float).eps
    over = np.sin((wide + angles - tilt) / 2) * np.sin((wide - angles + tilt) / 2)
    under = np.maximum(np.sin(angles) * np.sin(tilt), 1e-300)
    turns: FloatArray = 2 * np.arcsin(np.sqrt(np.clip(over / under, 0.0, 1.0))).max(axis=0)
    return turns


def _patches(cones: DirectionCones, boxes: Boxes) -> Cells:
    """Return the cells of a disc, with axes inward, along r and along t.

    u.e_r = sin(r - r_s) - sin r cos r_s (1 - cos(t - t_s)),   u.e_t = sin r sin(t - t_s).
    """
    angle, turn = (boxes.low + boxes.high).T / 2
    half, width = (boxes.high - boxes.low).T / 2
    right = np.full_like(angle, np.pi / 2)
    axes = _polar(
        cones.frames[boxes.cone],
        np.stack([angle, angle + right, right], axis=1),
        np.stack([turn, turn, turn + right], axis=1),
    )
    inward = _inward(boxes, width[:, np.newaxis])
    highest = _highest_sine(boxes)
    outward = np.sin(np.minimum(half, right))
    outward += highest * np.abs(np.cos(angle)) * 2 * np.sin(width / 2) ** 2
    sideways = highest * np.sin(np.minimum(width, right))
    return Cells(
        cone=boxes.cone,
        middles=axes[:, 0],
        axes=axes[:, :, cones.columns],
        reach=np.stack([inward[:, 0], outward, sideways], axis=1),
        caps=axes[:, :1],
        caps_rad=_angle_rad(inward),
        in_cone=np.ones(inward.shape, dtype=bool),
    )


def _polar(frames: FloatArray, angle: FloatArray, turn: FloatArray) -> FloatArray:
    """Return directions (C, K, 3) at angles (C, 1 or K) and rotations (C, K) about the poles."""
    sine = np.sin(angle)
    parts = np.stack(
        np.broadcast_arrays(np.cos(angle), sine * np.cos(turn), sine * np.sin(turn)), axis=2
    )
    directions: FloatArray = parts @ frames
    return directions


def _highest_sine(boxes: Boxes) -> FloatArray:
    low, high = boxes.low[:, 0], boxes.high[:, 0]
    sines: FloatArray = np.sin(np.clip(np.pi / 2, low, high))
    return sines


def _inward(boxes: Boxes, width: FloatArray) -> FloatArray:
    """Return an upper bound on 1 - u . u_s for rotations within ``width`` (C, 1) of the middle's.

    u . u_s = cos(r - r_s) - sin r sin r_s (1 - cos(t - t_s)).
    """
    angle, half = (boxes.low + boxes.high)[:, :1] / 2, (boxes.high - boxes.low)[:, :1] / 2
    sines = _highest_sine(boxes)[:, np.newaxis] * np.sin(angle)
    bound: FloatArray = 2 * np.sin(half / 2) ** 2 + 2 * sines * np.sin(width / 2) ** 2
    return bound


def _angle_rad(inward: FloatArray) -> FloatArray:
    """Return the angle whose cosine is 1 - ``inward``, with a margin for rounding."""
    angle: FloatArray = 2 * np.arcsin(np.sqrt(np.minimum(inward / 2, 1.0))) + ROUNDING_RAD
    return angle


def phasors(cones: DirectionCones, pieces: Cells) -> tuple[ComplexArray, FloatArray | None]:
    """Return each element's response to each cell's middle, (M, C), and its largest change there.

    The change is None if all elements face alike; their pattern is then left out. Phases are from
    the origin of the array frame; any other point would do.
    """
    received = steering.phase_factors(cones.array, pieces.middles)
    if not has_distinct_patterns(cones.array):
        return received, None
    towards = steering.element_directions(cones.array, pieces.middles)
    least, most = cones.array.element.amplitude_range(towards, pieces.caps_rad[:, 0])
    amplitude = cones.array.element.amplitude(towards)
    received *= amplitude
    return received, np.maximum(most - amplitude, amplitude - least)


def response_range(
    cones: DirectionCones, pieces: Cells, responses: ComplexArray, moments: ComplexArray
) -> tuple[FloatArray, FloatArray]:
    """Return lower (may be negative) and upper bounds of |response| over each cell, (..., C).

    responses  (..., C), responses to the middles
    moments    (B, ..., C), the same sums with every term times its element's position: sum p_m
               c_m
    """
    size = np.abs(responses)
    turned = np.where(size > 0, responses.conj() / np.maximum(size, 1e-300), 1.0)
    slopes = np.zeros((2, *size.shape))
    about = cones.centres_m[pieces.cone].T
    balanced = [(m - about[b] * responses) * turned for b, m in enumerate(moments)]
    for d in range(pieces.reach.shape[1]):
        slope = sum(part * pieces.axes[:, d, b] for b, part in enumerate(balanced))
        # jk swaps the parts: the imaginary part is in phase with the response.
        slopes[0] += np.abs(np.imag(slope)) * pieces.reach[:, d]
        slopes[1] += np.abs(np.real(slope)) * pieces.reach[:, d]
    slopes *= cones.array.wavenumber_radpm
    curved = pieces.axes @ cones.curvatures[pieces.cone] @ pieces.axes.transpose(0, 2, 1)
    bent = np.vecdot(pieces.reach, (np.abs(curved) @ pieces.reach[:, :, np.newaxis])[:, :, 0]) / 2
    bent += cones.rounding[pieces.cone]
    return size - slopes[0] - bent, np.hypot(size + slopes[0], slopes[1]) + bent
