"""Nulls towards the other UAVs, as deep as the least gain over a beam's own cone lets them be.

A beam g reaches the points p of the others by r_p = a_p^T g. What is taken off,

    f = g - S* (S^T S* + X)^-1 (s r),     0 <= s_p <= 1,     s = 0 at the user's own points,

leaves (1 - s_p) r_p there and its own points as they are: exactly where X is 0, at the predicted
directions, and in the sense of least squares at the points around them. Each s_p is what is
allowed by

* the price: with c_p the correlation of a_p with the user's own a and q_p that with g, taking off
  this one alone costs the gain 1 + s^2 q^2 / (1 - c^2), of which each may cost at most ``PRICE``,
  and towards c = 1 nothing (``APART``);
* the floor: within a user's own cone no less may be left than the least gain that he is to have,
  and outside so much less of it as the null is further from the cone.

At last all of it is taken back by one factor for each beam until the least gain over its cone, and
over the likely part of it, has lost no more than ``FLOOR_PRICE_DB``, nor what the link needs fallen
below that. A least gain of less than the link needs is worth little, and left to the nulls. All of
this follows the directions without a step. See docs/math.md 5.5.
"""

from typing import Final, NamedTuple

import numpy as np

from companion.beams.weights.widening import Spread
from companion.values import BoolArray, ComplexArray, FloatArray

PRICE: Final = 0.2  # gain, over the gain that is left, that one null may cost: 0.8 dB
APART: Final = 0.3
"""How unlike the user's own direction, as 1 - c^2, one is from which on a null is worth its price:
some .33 natural widths. Nearer it would be none, and turn round where the two pass one another.
"""
FLOOR_PRICE_DB: Final = 2.5
"""Most that all nulls of a beam may take off its least gain, where it is looked at.

Between these places it may be half a decibel more, and rarely more than that.
"""
ABOVE: Final = 1.15
"""Least gain that is kept if it was there, over what is worth keeping: places are samples."""
GIVEN_UP: Final = 6.0
"""Power of the share of ``ABOVE`` that a lesser least gain is, to which it may fall."""
SHALLOW: Final = 0.05
"""Share of what there is to spare by which a dip may reach below what is kept: some .15 dB."""
NOTHING: Final = 1e-9  # least gain that is no gain
NULL_WIDTHS: Final = 1.0
"""Natural widths from a cone's edge at which a null no longer reaches into it."""
SOFT: Final = 0.02  # loading of the points around a predicted direction, as a share of their power
ROUNDING: Final = 1e-10
"""Loading of the predicted directions, as a share of their power, against rounding."""


class NulledBeams(NamedTuple):
    """Beams (M, N) with nulls, and whether each predicted direction (N,) is left wholly dark."""

    weights: ComplexArray
    exact: BoolArray


def with_nulls(spread: Spread, noise: FloatArray | None = None, exact: bool = False) -> NulledBeams:
    """The beams of a spread with nulls on one another.

    spread  how wide beams and nulls are
    noise   (N,), loading of each predicted direction, for the least mean square error; None: 0
    exact   predicted directions are nulled wholly, whatever it costs
    """
    users, each = spread.beams.shape[1], spread.each
    if users == 1:
        return NulledBeams(spread.beams.copy(), np.ones(1, dtype=bool))
    fields, counts = spread.cones.fields(spread.beams), spread.cones.counts
    power = _power(spread.beams)
    gains = _squared(fields) / power[:, np.newaxis]
    asked = np.where(counts > 0, gains / np.maximum(counts, NOTHING), np.inf)
    kept = _kept(asked.min(axis=2), spread.worth)
    shares = _shares(spread, kept[0], power)
    if exact:
        shares[::each] = 1.0
    own = np.arange(users)
    wanted = (spread.reached * shares).reshape(users, each, users)
    wanted[own, :, own] = 0.0
    taken = _taken(spread, wanted.reshape(-1, users), noise)
    dark = shares[::each] >= 1.0
    dark[own, own] = True
    whole = np.asarray(dark.all(axis=0))
    if exact:
        return NulledBeams(spread.beams - taken, whole)
    least = (counts * kept[:, :, np.newaxis]).max(axis=0)
    back = _back(spread, taken, (fields, power), least)
    return NulledBeams(spread.beams - back * taken, whole & (back >= 1.0))


def _squared(values: ComplexArray) -> FloatArray:
    squared: FloatArray = values.real**2 + values.imag**2
    return squared


def _power(columns: ComplexArray) -> FloatArray:
    """The squared length (N,) of each column (M, N)."""
    power: FloatArray = _squared(columns).sum(axis=0)
    return power


def _kept(least: FloatArray, worth: float) -> FloatArray:
    """The least gains that nulls must leave."""
    wanted = ABOVE * worth
    lowered = np.maximum(least * 10 ** (-FLOOR_PRICE_DB / 10), wanted)
    lowered *= np.minimum(least / wanted, 1.0) ** GIVEN_UP
    kept: FloatArray = np.maximum(lowered, NOTHING)
    return kept


def _shares(spread: Spread, kept: FloatArray, power: FloatArray) -> FloatArray:
    """How much of what reaches each point is taken off, (N K, N)."""
    reached = np.abs(spread.reached)
    lengths = spread.gram.diagonal().real
    lengths = np.maximum(lengths, 1e-12 * lengths.max())
    centres = lengths[:: spread.each]
    alike = np.abs(spread.gram[:, :: spread.each]) ** 2 / np.outer(lengths, centres)
    cost = reached**2 / np.outer(lengths, power) / np.maximum(1.0 - alike, 1e-12)
    priced = np.sqrt(PRICE / np.maximum(cost, PRICE))
    priced *= np.minimum((1.0 - alike) / APART, 1.0)
    near = np.clip(1.0 - spread.outside / NULL_WIDTHS, 0.0, 1.0) ** 2
    left = np.sqrt(kept * power) * near
    floored = 1.0 - np.minimum(left / np.maximum(reached, 1e-300), 1.0)
    shares: FloatArray = np.minimum(priced, floored)
    return shares


def _taken(spread: Spread, wanted: ComplexArray, noise: FloatArray | None) -> ComplexArray:
    """The least change (M, N) of the beams that takes ``wanted`` (N K, N) off the points."""
    points, gram, each = spread.points, spread.gram, spread.each
    power = gram.diagonal().real
    loads = np.maximum(SOFT * power, ROUNDING * power.max())
    loads[::each] = ROUNDING * power.max()
    if noise is not None:
        loads[::each] += noise
    if len(loads) > len(points):
        # More points than elements: the smaller matrix, by S* (G + X)^-1 = (S* X^-1 S^T + 1)^-1 S*
        # X^-1.
        scaled = points.conj() / loads
        few = scaled @ points.T
        few.flat[:: len(few) + 1] += 1.0
        found: ComplexArray = np.linalg.solve(few, scaled @ wanted)
        return found
    loaded = gram.copy()
    loaded.flat[:: len(loaded) + 1] += loads
    taken: ComplexArray = points.conj() @ np.linalg.solve(loaded, wanted)
    return taken


def _back(
    spread: Spread, taken: ComplexArray, known: tuple[ComplexArray, FloatArray], least: FloatArray
) -> FloatArray:
    """The share (N,) of the nulls up to which every place has its least gain (N, P); 0: any.

    With the share t of what is taken, the gain at a place is a ratio of two quadratics in t,

        |v - t z|^2 / |f - t d|^2     v, z: what beam f and nulls d radiate there

    and where it is the least gain, a t^2 - 2 b t + c = 0. ``known`` is what the beams radiate to
    the places, and their squared lengths.
    """
    beams, (fields, power) = spread.beams, known
    less = spread.cones.fields(taken)
    crossed = (beams.real * taken.real + beams.imag * taken.imag).sum(axis=0)
    a = _squared(less) - least * _power(taken)[:, np.newaxis]
    b = fields.real * less.real + fields.imag * less.imag - least * crossed[:, np.newaxis]
    c = np.maximum(_squared(fields) - least * power[:, np.newaxis], 0.0)
    # Without nulls there is enough, c >= 0. The first root above 0, in the form that never cancels.
    depth = b * b - a * c
    inside = np.sqrt(np.maximum(depth, 0.0))
    short = (depth > 0) & ((b > 0) | (a < 0)) & (least > 0)
    first = np.where(b > 0, c, inside - b) / np.where(short, np.where(b > 0, b + inside, -a), 1.0)
    # A dip that hardly reaches below is none: it would come and go at once with the directions.
    reached = np.minimum(depth / np.maximum(SHALLOW * b * b, 1e-300), 1.0)
    first = 1.0 - (1.0 - np.minimum(first, 1.0)) * reached
    back: FloatArray = np.where(short, first, 1.0).min(axis=1)
    return back
