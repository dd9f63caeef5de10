"""Nulls towards the other UAVs, as deep as the least gain over a beam's own cone lets them be.

A beam g reaches the points p of the others by r_p = a_p^T g. What is taken off,

    f = g - S* (S^T S* + X)^-1 (s r),     0 <= s_p <= 1,     s = 0 at the user's own points,

leaves (1 - s_p) r_p there and its own points as they are: exactly where X is 0, at the predicted
directions, and in the sense of least squares at the points around them. Each s_p is what is
allowed by

* the price: with c_p the correlation of a_p with the user's own a and q_p that with g, taking off
  this one alone costs the gain 1 + s^2 q^2 / (1 - c^2), of which each may cost at most ``PRICE``;
* the floor: within a user's own cone no less may be left than the least gain that he is to have,
  and outside so much less of it as the null is further from the cone.

At last all of it is taken back by one factor for each beam until the least gain over its cone, and
over the likely part of it, has lost no more than ``FLOOR_PRICE_DB``, nor what was above isotropic
fallen below it. All of this follows the directions without a step. See docs/math.md 5.5.
"""

from typing import Final, NamedTuple

import numpy as np

from companion.beams.weights.widening import Spread
from companion.values import BoolArray, ComplexArray, FloatArray, IntArray

PRICE: Final = 0.6
"""Gain, over the gain that is left, that one null may cost: 2 dB."""
FLOOR_PRICE_DB: Final = 2.5
"""Most that all nulls of a beam may take off its least gain, where it is looked at.

Between these places it may be half a decibel more, and rarely more than that.
"""
ABOVE: Final = 1.2
"""Least gain that is kept if it was there: what is sampled at 1.2 is surely above 1."""
NOTHING: Final = 1e-9
"""Least gain that is no gain."""
NULL_WIDTHS: Final = 1.0
"""Natural widths from a cone's edge at which a null no longer reaches into it."""
SOFT: Final = 0.02
"""Loading of the points around a predicted direction, as a share of their power."""
ROUNDING: Final = 1e-10
"""Loading of the predicted directions, as a share of their power, against rounding."""
BACK: Final = np.array([0.8, 0.6, 0.4, 0.2, 0.0])
"""Shares of the nulls that are tried, in descending order."""
FINE: Final = np.array([0.75, 0.5, 0.25, 0.0])
"""Places between two of them that are tried then."""
AGAIN: Final = 10
"""Most steps towards the share that is known to do, each at least halves what is left."""
NEARLY: Final = 0.99
"""A share of the least gain that is to be kept: all but .04 dB."""


class Nulled(NamedTuple):
    """Beams (M, N) with nulls, and whether each predicted direction (N,) is left wholly dark."""

    weights: ComplexArray
    exact: BoolArray


def nulled(spread: Spread, noise: FloatArray | None = None, exact: bool = False) -> Nulled:
    """The beams of a spread with nulls on one another.

    spread  how wide beams and nulls are
    noise   (N,), loading of each predicted direction, for the least mean square error; None: 0
    exact   predicted directions are nulled wholly, whatever it costs
    """
    users, each = spread.beams.shape[1], spread.each
    if users == 1:
        return Nulled(spread.beams.copy(), np.ones(1, dtype=bool))
    places = _places(spread)
    fields = spread.cones.fields(spread.beams)[places.rows, places.columns]
    power = np.einsum("mn,mn->n", spread.beams, spread.beams.conj()).real
    least, inner = _least(places, fields.real**2 + fields.imag**2, power)
    kept = _kept(least)
    shares = _shares(spread, kept, power)
    if exact:
        shares[::each] = 1.0
    own = np.arange(users)
    wanted = (spread.reached * shares).reshape(users, each, users)
    wanted[own, :, own] = 0.0
    taken = _taken(spread, wanted.reshape(-1, users), noise)
    back = np.ones(users)
    if not exact:
        back = _back(spread, taken, (places, fields), power, (kept, _kept(inner)))
    whole = shares[::each] >= 1.0
    whole[own, own] = True
    return Nulled(spread.beams - back * taken, whole.all(axis=0) & (back >= 1.0))


class _Places(NamedTuple):
    """The places that are looked at, user by user: rows and columns of what ``Cones`` answers.

    starts  (N,), where each user's begin
    held    whether a place is within the cone over which the least gain counts
    likely  whether it is within that of the likely angle
    """

    rows: IntArray
    columns: IntArray
    starts: IntArray
    held: BoolArray
    likely: BoolArray


def _places(spread: Spread) -> _Places:
    held, likely = spread.cones.held, spread.cones.likely
    rows, columns = np.nonzero(held | likely)
    starts = np.searchsorted(rows, np.arange(len(held)))
    return _Places(rows, columns, starts, held[rows, columns], likely[rows, columns])


def _least(
    places: _Places, towards: FloatArray, power: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Least gains (N,) over the cones and over their likely parts, of powers at the places."""
    held, likely = (
        np.minimum.reduceat(np.where(inside, towards, np.inf), places.starts) / power
        for inside in (places.held, places.likely)
    )
    return held, likely


def _kept(least: FloatArray) -> FloatArray:
    """The least gains that nulls must leave."""
    lowered = np.maximum(least * 10 ** (-FLOOR_PRICE_DB / 10), np.minimum(least, ABOVE))
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
    spread: Spread,
    taken: ComplexArray,
    seen: tuple[_Places, ComplexArray],
    power: FloatArray,
    kept: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """The share (N,) of the nulls up to which the least gains are kept, by interpolation."""
    places, fields = seen
    less = spread.cones.fields(taken)[places.rows, places.columns]
    cross = np.einsum("mn,mn->n", spread.beams.conj(), taken).real
    own = np.einsum("mn,mn->n", taken.conj(), taken).real

    def kept_at(share: FloatArray) -> FloatArray:
        """The least gains over what must be kept, (N,), for shares (N,) of the nulls."""
        at = share[places.rows]
        towards = fields - at * less
        left = np.maximum(power - 2 * share * cross + share**2 * own, 1e-300)
        held, likely = _least(places, towards.real**2 + towards.imag**2, left)
        return np.minimum(held / kept[0], likely / kept[1])

    high, low = np.ones(len(power)), np.ones(len(power))
    above = kept_at(high)
    if (above >= 1.0).all():
        return high
    below = above
    for tries in (BACK, FINE):
        # Down from the greatest share until the least gains are kept; then finer in between.
        begin, end = high, np.where(above >= 1.0, high, 0.0) if tries is BACK else low
        found = above >= 1.0 if tries is BACK else np.zeros(len(power), dtype=bool)
        high, low, over = begin.copy(), begin.copy(), above
        for part in tries.tolist():
            share = end + part * (begin - end)
            now = kept_at(share)
            first = ~found & ((now >= 1.0) | (part == 0.0))
            low, below = np.where(first, share, low), np.where(first, now, below)
            failed = ~found & ~first
            high, over = np.where(failed, share, high), np.where(failed, now, over)
            found |= first
        above = over
    back: FloatArray = np.where(low >= high, high, high + _part(above, below) * (low - high))
    for _ in range(AGAIN):
        # Nulls that are crowded take so much that a straight line between two shares misses by far.
        now = kept_at(back)
        missed = (now < NEARLY) & (back > low)
        if not missed.any():
            return back
        back = np.where(missed, back + np.maximum(_part(now, below), 0.5) * (low - back), back)
    return np.where(missed, low, back)


def _part(above: FloatArray, below: FloatArray) -> FloatArray:
    """Where a straight line from what is ``above`` to ``below`` reaches 1, in [0, 1]."""
    part: FloatArray = np.clip((1.0 - above) / np.maximum(below - above, 1e-12), 0.0, 1.0)
    return part
