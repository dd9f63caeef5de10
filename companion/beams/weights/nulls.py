"""Nulls towards the other UAVs, limited by the least gain over a beam's own cone.

A beam g reaches the points p of the others by r_p = a_p^T g. The corrected beam

    f = g - S* (S^T S* + X)^-1 (s r),     0 <= s_p <= 1,     s = 0 at the user's own points,

leaves (1 - s_p) r_p there and its own points unchanged: exactly where X is 0, at the predicted
directions, and in the least-squares sense at the points around them. Each s_p is limited by

* the cost: with c_p the correlation of a_p with the user's own a and q_p that with g, removing
  this one alone costs the gain 1 + s^2 q^2 / (1 - c^2). Each may cost ``MAX_NULL_COST``, and
  towards c = 1 nothing (``FULL_COST_DISTANCE``);
* the floor: within a user's own cone at least the least gain must be left, and outside a part of it
  that decreases with the distance of the null from the cone.

Finally the correction of each beam is scaled back by one factor. Then the least gain over its cone,
and over the likely part of it, loses at most ``FLOOR_LOSS_MAX_DB`` and does not fall below the gain
that the link needs. A least gain below that need is of little use, and given up for the nulls. All
of this depends continuously on the directions. See docs/math.md 5.5.
"""

from typing import Final, NamedTuple

import numpy as np

from companion.beams.weights.lapack import zposv
from companion.beams.weights.widening import Spread
from companion.values import BoolArray, ComplexArray, FloatArray

MAX_NULL_COST: Final = 0.2  # gain that one null may cost, over the remaining gain: 0.8 dB
FULL_COST_DISTANCE: Final = 0.3
"""Distance 1 - c^2 from the user's direction at which a null may cost all of
``MAX_NULL_COST``: some .33 natural widths. A nearer null would be ineffective, and change sign
where the two directions cross."""
FLOOR_LOSS_MAX_DB: Final = 2.5
"""Largest loss of a beam's least gain by all its nulls, at the samples, dB.

Between samples the loss may be half a decibel more, rarely larger.
"""
PROTECTION_MARGIN: Final = 1.15
"""Margin of the protected least gain over the least useful gain, because samples are finite."""
REDUCTION_EXPONENT: Final = 6.0
"""Exponent of the ratio of a smaller least gain to the protected gain, by which that gain is
reduced."""
TOLERATED_DIP: Final = 0.05
"""Relative depth of a dip below the protected gain that is tolerated: some .15 dB."""
NEGLIGIBLE_GAIN: Final = 1e-9  # gain that counts as 0
NULL_WIDTHS: Final = 1.0
"""Distance from a cone's edge, in natural widths, at which a null does not affect the cone."""
NULL_LOADING: Final = (
    0.02  # loading of the points around a predicted direction, relative to their power
)
ROUNDING: Final = 1e-10
"""Loading of the predicted directions against rounding errors, relative to their power."""


class NulledBeams(NamedTuple):
    """Beams (M, B) with nulls, and whether every null of a beam is exact (B,)."""

    weights: ComplexArray
    exact: BoolArray


def with_nulls(spread: Spread, noise: FloatArray | None = None, exact: bool = False) -> NulledBeams:
    """Return the widened beams with nulls on one another's users.

    spread  widths of beams and nulls
    noise   (N,), loading of each predicted direction, for the least mean square error; None: 0
    exact   null predicted directions completely, at any cost
    """
    own, each = spread.owners, spread.each
    beams, users = np.arange(len(own)), spread.points.shape[1] // each
    if users == 1:
        return NulledBeams(spread.beams.copy(), np.ones(1, dtype=bool))
    fields, counts = spread.cones.fields(spread.beams), spread.cones.counts
    received = _squared(fields)
    gains = received / spread.powers[:, np.newaxis]
    asked = np.where(counts > 0, gains / np.maximum(counts, NEGLIGIBLE_GAIN), np.inf)
    kept = _protected_gains(asked.min(axis=2), spread.worth)
    shares = _shares(spread, kept[0])
    if exact:
        shares[::each] = 1.0
    wanted = (spread.reached * shares).reshape(users, each, len(own))
    wanted[own, :, beams] = 0.0
    taken = _correction(spread, wanted.reshape(-1, len(own)), noise)
    dark = shares[::each] >= 1.0
    dark[own, beams] = True
    whole = np.asarray(dark.all(axis=0))
    if exact:
        return NulledBeams(spread.beams - taken, whole)
    least = (counts * kept[:, :, np.newaxis]).max(axis=0)
    back = _allowed_share(spread, taken, (fields, received), least)
    return NulledBeams(spread.beams - back * taken, whole & (back >= 1.0))


def _squared(values: ComplexArray) -> FloatArray:
    squared: FloatArray = values.real**2 + values.imag**2
    return squared


def _protected_gains(least: FloatArray, worth: float) -> FloatArray:
    """Return the least gains that nulls must leave to each beam."""
    wanted = PROTECTION_MARGIN * worth
    lowered = np.maximum(least * 10 ** (-FLOOR_LOSS_MAX_DB / 10), wanted)
    lowered *= np.minimum(least / wanted, 1.0) ** REDUCTION_EXPONENT
    kept: FloatArray = np.maximum(lowered, NEGLIGIBLE_GAIN)
    return kept


def _shares(spread: Spread, kept: FloatArray) -> FloatArray:
    """Return the share of a beam's field that is removed at each point, (N K, B)."""
    squared, own = _squared(spread.reached), spread.owners * spread.each
    lengths = np.maximum(spread.lengths, 1e-12 * spread.lengths.max())[:, np.newaxis]
    alike = _squared(spread.crossed) / (lengths * lengths[own, 0])
    apart = 1.0 - alike
    cost = squared / (lengths * spread.powers) / np.maximum(apart, 1e-12)
    priced = np.sqrt(MAX_NULL_COST / np.maximum(cost, MAX_NULL_COST))
    priced *= np.minimum(apart / FULL_COST_DISTANCE, 1.0)
    near = np.maximum(1.0 - spread.outside / NULL_WIDTHS, 0.0) ** 2
    left = np.sqrt(kept * spread.powers) * near
    floored = 1.0 - np.minimum(left / np.maximum(np.sqrt(squared), 1e-300), 1.0)
    shares: FloatArray = np.minimum(priced, floored)
    return shares


def _correction(spread: Spread, wanted: ComplexArray, noise: FloatArray | None) -> ComplexArray:
    """Return the least change (M, B) of beams that removes ``wanted`` (N K, B) at the points."""
    points, gram, each, power = spread.points, spread.gram, spread.each, spread.lengths
    loads = np.maximum(NULL_LOADING * power, ROUNDING * power.max())
    loads[::each] = ROUNDING * power.max()
    if noise is not None:
        loads[::each] += noise
    if gram is None or len(loads) > len(points):
        # More points than elements: the smaller matrix, by S* (G + X)^-1 = (S* X^-1 S^T + 1)^-1 S*
        # X^-1.
        scaled = points.conj() / loads
        return _solved(_with_loading(scaled @ points.T, 1.0), scaled @ wanted)
    taken: ComplexArray = points.conj() @ _solved(_with_loading(gram, loads), wanted)
    return taken


def _with_loading(gram: ComplexArray, loads: FloatArray | float) -> ComplexArray:
    loaded = gram.copy()
    loaded.ravel()[:: len(loaded) + 1] += loads
    return loaded


def _solved(matrix: ComplexArray, wanted: ComplexArray) -> ComplexArray:
    """Return X with matrix X = wanted, for a Hermitian matrix that is positive definite."""
    _, found, info = zposv(matrix, wanted)
    if info:  # not positive definite to rounding
        found = np.linalg.solve(matrix, wanted)
    return np.asarray(found)


def _allowed_share(
    spread: Spread, taken: ComplexArray, known: tuple[ComplexArray, FloatArray], least: FloatArray
) -> FloatArray:
    """Return the largest share (B,) of the correction that leaves each place its least gain.

    least  (B, P), least gains; 0 does not limit

    With the share t of the correction, the gain at a place is a ratio of two quadratics in t,

        |v - t z|^2 / |f - t d|^2     v, z: fields of beam f and correction d there

    and at the least gain, a t^2 - 2 b t + c = 0. ``known`` is the fields of the beams at the
    places, and their squares.
    """
    beams, (fields, received) = spread.beams, known
    less = spread.cones.fields(taken)
    crossed = np.vecdot(beams.T, taken.T).real
    power = np.vecdot(taken.T, taken.T).real
    a = _squared(less) - least * power[:, np.newaxis]
    b = fields.real * less.real + fields.imag * less.imag - least * crossed[:, np.newaxis]
    c = np.maximum(received - least * spread.powers[:, np.newaxis], 0.0)
    # Without nulls the gain suffices: c >= 0. This form of the first root above 0 never cancels.
    depth = b * b - a * c
    inside = np.sqrt(np.maximum(depth, 0.0))
    short = (depth > 0) & ((b > 0) | (a < 0)) & (least > 0)
    first = np.where(b > 0, c, inside - b) / np.where(short, np.where(b > 0, b + inside, -a), 1.0)
    # A shallow dip is faded in, so that the result is continuous in the directions.
    reached = np.minimum(depth / np.maximum(TOLERATED_DIP * b * b, 1e-300), 1.0)
    first = 1.0 - (1.0 - np.minimum(first, 1.0)) * reached
    back: FloatArray = np.where(short, first, 1.0).min(axis=1)
    return back
