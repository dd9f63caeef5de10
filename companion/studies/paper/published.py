"""Position-model observer exactly as published, for studies and comparison.

Reports arrive at the ends of intervals. Each report gives an estimate for the time of the next:

    x+ = x + b w,   y = x + d w          b the interval (s), d the feedthrough (s)
    x^+ = (1 - l) x^ + l y,              e = x^ - x:   e+ = (1 - l) e + (l d - b) w

One of two left inverses estimates the unknown input (docs/math.md 3),

    G = [b; d]:   W^ = (b (x^+ - x^) + d (y - x^)) / (b^2 + d^2)       (Chakrabarty et al.)
    G = [b; 0]:   W^ = (x^+ - x^) / b                                  (Mohammadi et al.)

Their exact largest errors with a fixed gain follow from substituting the error equation: with e and
w independent at each step,

    G = [b; d]:   |W^ - w| <= |k| peak + b |l d - b| / (b^2 + d^2),   k = (b l + d) / (b^2 + d^2)
    G = [b; 0]:   |W^ - w| <= |l| / b peak + |l d - b| / b

times sup|w|, where peak is the exact gain to the error (``closed_form.peak_gain``). For 0 <= 1 - l
< 1 the second is 2 |l d - b| / b: the published "3 gamma" fails for small b. All axes are equal,
so estimates are arrays of any shape, in metres.
"""

from dataclasses import dataclass

import numpy as np

from companion.tracking.design import closed_form
from companion.values import FloatArray


@dataclass(frozen=True, slots=True)
class Step:
    """Result of one report: the estimate for the next report's time, and both W^ (m/s)."""

    estimate_m: FloatArray
    unknown_input_bd_mps: FloatArray
    unknown_input_b0_mps: FloatArray


def step(
    estimate_m: FloatArray,
    *,
    report_m: FloatArray,
    dt_s: float,
    feedthrough_s: float,
    gain: float | None = None,
    alpha: float | None = None,
) -> Step:
    """Apply one step of the published observer over the interval that follows the report.

    ``gain`` None schedules it by the interval with ``alpha`` (None: the best for the interval).
    Raises ``ValueError`` for an interval that is not positive.
    """
    if not dt_s > 0:
        raise ValueError(f"interval between reports is {dt_s}; give a positive number of seconds")
    b, d = dt_s, feedthrough_s
    kept = closed_form.gain(b, d, alpha) if gain is None else gain
    residual = report_m - estimate_m
    after = estimate_m + kept * residual
    moved = after - estimate_m
    return Step(after, (b * moved + d * residual) / (b * b + d * d), moved / b)


def unknown_input_peak(dt_s: float, feedthrough_s: float, gain: float) -> tuple[float, float]:
    """Return the exact largest |W^ - w| / sup|w| of both left inverses; inf if not contracting."""
    b, d = dt_s, feedthrough_s
    peak_s = float(closed_form.peak_gain(b, d, gain))
    enters = abs(gain * d - b)
    square = b * b + d * d
    with_d = abs(b * gain + d) / square * peak_s + b * enters / square
    without_d = abs(gain) / b * peak_s + enters / b
    return with_d, without_d


def unknown_input_bound(dt_s: float, feedthrough_s: float, gamma_s: float) -> tuple[float, float]:
    """Return bounds on |W^ - w| / sup|w| from gamma alone: sqrt(5) |G+| gamma, and 2 gamma / b."""
    pseudo_inverse = 1 / float(np.hypot(dt_s, feedthrough_s))
    return float(np.sqrt(5)) * pseudo_inverse * gamma_s, 2 * gamma_s / dt_s
