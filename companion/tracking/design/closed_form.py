"""Observer gains in closed form: the linear matrix inequalities of the method, solved by hand.

One axis, interval b (s) between reports, feedthrough d (s: the report leads the position by d times
the unknown input), decay a in (0, 1), output weight 1. The observer is

    x+ = q x + l y,  q = 1 - l;      error  e+ = q e + (l d - b) w,  |w| the unknown input

(docs/math.md 2, paper eq. (8)). The smallest mu = gamma^2 for which the LMIs (paper eq. (10)) are
feasible, with the gain that attains it (paper eq. (11)), is

    mu*(b) = max(0, ((d - b)^2 - (1 - a) d^2) / a)
    q*     = (1 - a) d / (d - b)   where (d - b)^2 > (1 - a) d^2,   else 1 - b/d (and mu* = 0)

Designing each axis of a network alone loses nothing (docs/math.md 2.1). A single p = 1 / max mu*(b)
serves every b at once, so the guarantee |e| <= gamma sup|w| holds with gains scheduled by the
actual interval, in any order (docs/math.md 2.3).

The scalar functions run for every report and are plain arithmetic; those in the plural take arrays.
Source: the optimum over P and Z of the LMIs; derivation in docs/math.md 2.2.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from companion.values import FloatArray, UserError

EPSILON: Final = float(np.finfo(float).eps)
FASTEST_DECAY: Final = 0.99
"""Largest alpha that ``best_alpha`` returns.

mu* falls towards its limit as alpha tends to 1, where the invariant set degenerates; the last per
cent gains almost nothing.
"""


def _check(dt_s: ArrayLike, alpha: float) -> FloatArray:
    """Return the intervals as an array, checked together with alpha.

    Raises ``UserError`` for an interval or alpha out of range.
    """
    b = np.asarray(dt_s, dtype=float)
    if not np.all(np.isfinite(b) & (b > 0)):
        raise UserError("interval between reports: give a positive number of seconds")
    if not 0.0 < alpha < 1.0:
        raise UserError(f"alpha is {alpha}, allowed: 0 to 1, both excluded")
    return b


def mu_star(dt_s: float, feedthrough_s: float, alpha: float) -> float:
    """Return the smallest feasible mu (s²) at one interval; 0 if the error can be cancelled.

    It is mu*(b) of docs/math.md 2.2.
    """
    return max(0.0, _excess(dt_s, feedthrough_s, alpha) / alpha)


def gain(dt_s: float, feedthrough_s: float, alpha: float | None = None) -> float:
    """Return the optimal gain l* for the report at one interval; q* = 1 - l* (docs/math.md 2.2).

    ``alpha=None``: ``best_alpha``. Plain arithmetic, because it runs for every report and
    prediction.
    """
    b, d = dt_s, feedthrough_s
    if alpha is None:
        alpha = best_alpha(b, d)
    if d != 0 and _excess(b, d, alpha) <= 0:
        return b / d
    return 1 - (1 - alpha) * d / (d - b)


def _excess(b: float, d: float, alpha: float) -> float:
    """Return (d - b)^2 - (1 - alpha) d^2, with rounding errors set to 0, as at ``best_alpha``."""
    excess = (d - b) ** 2 - (1 - alpha) * d * d
    return excess if excess > 4 * EPSILON * d * d else min(excess, 0.0)


def mu_stars(dt_s: ArrayLike, feedthrough_s: float, alpha: float) -> FloatArray:
    """Return ``mu_star`` for each of an array of intervals, in the same shape."""
    b, d = _check(dt_s, alpha), feedthrough_s
    return np.maximum(0.0, ((d - b) ** 2 - (1 - alpha) * d * d) / alpha)


def gains(dt_s: ArrayLike, feedthrough_s: float, alpha: float) -> FloatArray:
    """Return ``gain`` for each of an array of intervals, in the same shape."""
    b = _check(dt_s, alpha)
    return np.array([gain(x, feedthrough_s, alpha) for x in b.flat]).reshape(b.shape)


def dt_limit_s(mu_max: float, feedthrough_s: float, alpha: float) -> float:
    """Return the largest interval (s) at which ``mu <= mu_max`` (s²) is feasible; 0 if none is.

    Raises ``UserError`` for a negative ``mu_max`` or an alpha outside (0, 1).
    """
    _check(1.0, alpha)
    if not mu_max >= 0:
        raise UserError(f"mu is {mu_max}, allowed: at least 0")
    d = feedthrough_s
    return max(0.0, float(d + np.sqrt(alpha * mu_max + (1 - alpha) * d * d)))


def best_alpha(dt_s: float, feedthrough_s: float) -> float:
    """Return the alpha with the smallest mu* at one interval.

    If the feedthrough allows mu* = 0 (b < 2d), this is the largest alpha for which mu* = 0, up to
    ``FASTEST_DECAY``: it has the fastest certified decay. Otherwise mu* decreases with alpha, and
    ``FASTEST_DECAY`` is returned.
    """
    b, d = dt_s, feedthrough_s
    if 0 < b < 2 * d:
        return min(FASTEST_DECAY, 1 - (d - b) ** 2 / d**2)
    return FASTEST_DECAY


def peak_gain(dt_s: ArrayLike, feedthrough_s: float, l_gain: ArrayLike) -> FloatArray:
    """Return the largest |e| / sup|w| (s) with a fixed gain, exactly: |l d - b| / (1 - |1 - l|).

    This is the sum of the error's absolute impulse response (docs/math.md 2.4). Infinite if the
    gain does not contract, unless no input enters.
    """
    b, gain = np.asarray(dt_s, dtype=float), np.asarray(l_gain, dtype=float)
    enters, margin = np.abs(gain * feedthrough_s - b), 1 - np.abs(1 - gain)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(enters == 0, 0.0, np.where(margin > 0, enters / margin, np.inf))


def lmi_margin(
    dt_s: float, *, feedthrough_s: float, alpha: float, l_gain: float, mu: float, p: float
) -> float:
    """Return the smallest eigenvalue of both LMIs; a value >= 0 proves the solution.

    The matrices are scaled by congruence (P to 1), so that the margin is dimensionless.
    """
    b, d, root = dt_s, feedthrough_s, np.sqrt(p)
    enters = (l_gain * d - b) * root
    keep = 1 - l_gain
    decay = np.array([[1 - alpha, 0, keep], [0, alpha, enters], [keep, enters, 1]])
    output = np.array([[1, 1 / root], [1 / root, mu]])
    return float(min(np.linalg.eigvalsh(decay)[0], np.linalg.eigvalsh(output)[0]))


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosedFormDesign:
    """Gain for one interval and its certificate; times in seconds, mu in s²."""

    dt_s: float
    alpha: float
    feedthrough_s: float
    l_gain: float
    q: float
    mu: float
    gamma: float
    peak_gain: float
    residual: float


def design(dt_s: float, feedthrough_s: float, alpha: float | None = None) -> ClosedFormDesign:
    """Return the optimal gain at one interval; ``alpha=None``: use ``best_alpha``.

    If mu* = 0 the infimum over P is not attained: the certificate is then given at p = 1, which
    proves the decay LMI, and mu is the limit. Raises ``UserError`` for an interval, feedthrough or
    alpha out of range.
    """
    if alpha is None:
        alpha = best_alpha(dt_s, feedthrough_s)
    _check(dt_s, alpha)
    if not np.isfinite(feedthrough_s):
        raise UserError(f"feedthrough is {feedthrough_s}, allowed: a finite number of seconds")
    mu = mu_star(dt_s, feedthrough_s, alpha)
    l_gain = gain(dt_s, feedthrough_s, alpha)
    p = 1 / mu if mu > 0 else 1.0
    return ClosedFormDesign(
        dt_s=dt_s,
        alpha=alpha,
        feedthrough_s=feedthrough_s,
        l_gain=l_gain,
        q=1 - l_gain,
        mu=mu,
        gamma=float(np.sqrt(mu)),
        peak_gain=float(peak_gain(dt_s, feedthrough_s, l_gain)),
        residual=lmi_margin(
            dt_s, feedthrough_s=feedthrough_s, alpha=alpha, l_gain=l_gain, mu=max(mu, 1 / p), p=p
        ),
    )
