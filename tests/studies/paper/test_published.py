"""The published observer, against its own claims and against adversaries."""

import numpy as np
import pytest
from support import rounds

from companion.studies.paper import published
from companion.tracking.design import closed_form

PAPER_GAINS = (0.39, 0.60, 0.76)
B, D = 0.15, 0.5


def errors(gain: float, b: float, d: float, w: np.ndarray) -> tuple[np.ndarray, ...]:
    """Errors of x^ and of both W^ over an input sequence, from an exact start."""
    x = estimate = np.zeros(1)
    found = []
    for wk in w:
        made = published.step(estimate, report_m=x + d * wk, dt_s=b, feedthrough_s=d, gain=gain)
        found.append(
            (
                float(estimate[0] - x[0]),
                float(made.unknown_input_bd_mps[0] - wk),
                float(made.unknown_input_b0_mps[0] - wk),
            )
        )
        x, estimate = x + b * wk, made.estimate_m
    return tuple(np.array(column) for column in zip(*found, strict=True))


def worst_input(gain: float, b: float, d: float, steps: int, last: float) -> np.ndarray:
    """The input of size 1 that increases the error for ``steps``, then ends with ``last``."""
    q = 1 - gain
    signs = np.sign(q) ** np.arange(steps)[::-1] * np.sign(gain * d - b)
    return np.append(np.where(signs == 0, 1.0, signs), last)


@pytest.mark.parametrize("gain", [*PAPER_GAINS, 1.2])
def test_peak_gains_are_attained_and_never_exceeded(gain: float) -> None:
    """Never exceeded by random inputs, attained by the worst one."""
    rng = np.random.default_rng(7)
    peak_e = float(closed_form.peak_gain(B, D, gain))
    peak_bd, peak_b0 = published.unknown_input_peak(B, D, gain)
    reached = np.zeros(3)
    for trial in range(rounds(400, 2000)):
        w = rng.choice([-1.0, 1.0], 40) if trial % 2 else rng.uniform(-1, 1, 40)
        reached = np.maximum(reached, [np.abs(e).max() for e in errors(gain, B, D, w)])
    for last in (-1.0, 1.0):
        w = worst_input(gain, B, D, 200, last)
        reached = np.maximum(reached, [np.abs(e).max() for e in errors(gain, B, D, w)])
    limits = np.array([peak_e, peak_bd, peak_b0])
    assert np.all(reached <= limits * (1 + 1e-9))
    assert np.all(reached >= 0.98 * limits)


@pytest.mark.parametrize("gain", PAPER_GAINS)
def test_unknown_input_peak_equals_the_closed_form(gain: float) -> None:
    """The exact peak is 2 |l d - b| / b; at L = .76 it exceeds the published 3 gamma."""
    _, peak_b0 = published.unknown_input_peak(B, D, gain)
    assert peak_b0 == pytest.approx(2 * abs(gain * D - B) / B)


def test_published_unknown_input_bound_is_violated() -> None:
    """At L = .76 the exact peak is 3.07, and three times its gamma of .96 is 2.88."""
    _, peak_b0 = published.unknown_input_peak(B, D, 0.76)
    assert peak_b0 == pytest.approx(3.07, abs=5e-3)
    gamma_s = 0.96
    assert peak_b0 > 3 * gamma_s
    safe_bd, safe_b0 = published.unknown_input_bound(B, D, gamma_s)
    assert peak_b0 < safe_b0
    assert published.unknown_input_peak(B, D, 0.76)[0] < safe_bd


def test_optimal_gain_gives_zero_error() -> None:
    w = np.random.default_rng(1).normal(0, 100, 100)
    assert np.abs(np.array(errors(0.3, B, D, w))).max() < 1e-9
    scheduled = published.step(np.zeros(2), report_m=np.array([3.0, -1.0]), dt_s=B, feedthrough_s=D)
    assert scheduled.estimate_m == pytest.approx([0.9, -0.3])


def test_irregular_intervals_keep_the_gamma_bound() -> None:
    """|e| <= gamma sup|w| with gamma over the intervals that occurred, in any order."""
    rng = np.random.default_rng(3)
    alpha, d, worst = 0.95, -0.5, 0.0  # where gamma is close to the exact peak
    for _ in range(rounds(500, 2000)):
        dts = rng.uniform(0.05, 1.2, 30)
        gamma = np.sqrt(closed_form.mu_stars(dts, d, alpha).max())
        x = estimate = np.zeros(1)
        for b in dts:
            gain = closed_form.gain(b, d, alpha)
            push = np.sign((1 - gain) * (estimate - x) * (gain * d - b)) + (estimate == x)
            made = published.step(
                estimate, report_m=x + d * push, dt_s=b, feedthrough_s=d, alpha=alpha
            )
            x, estimate = x + b * push, made.estimate_m
            worst = max(worst, float(np.abs(estimate - x)[0] / gamma))
    assert 0.9 < worst <= 1 + 1e-9


@pytest.mark.parametrize("dt_s", [0.0, -1.0, float("nan")])
def test_nonpositive_interval_is_rejected(dt_s: float) -> None:
    with pytest.raises(ValueError, match="positive"):
        published.step(np.zeros(1), report_m=np.zeros(1), dt_s=dt_s, feedthrough_s=D)
