"""The closed form against the LMI by CVXPY and Clarabel, simulation and dense scans."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from companion.tracking.design import closed_form, lmi

ONE = np.eye(1)
INTERVALS = st.floats(0.01, 3.0)
FEEDTHROUGHS = st.floats(-1.0, 1.0)
ALPHAS = st.floats(0.01, 0.99)


def grid() -> list[tuple[float, float, float]]:
    """Return interval, feedthrough and alpha near, but not on, a grid."""
    rng = np.random.default_rng(2)
    return [
        (b * rng.uniform(0.9, 1.1), d + rng.uniform(-0.05, 0.05), a * rng.uniform(0.9, 1.05))
        for a in (0.1, 0.5, 0.9)
        for d in (-0.3, -0.1, 0.0, 0.2, 0.5)
        for b in (0.15, 0.4, 0.7, 1.2)
    ]


@pytest.mark.parametrize(("b", "d", "alpha"), grid())
def test_closed_form_equals_the_lmi_optimum(b: float, d: float, alpha: float) -> None:
    solved = lmi.solve(ONE, b=b * ONE, c=ONE, d=d * ONE, h=ONE, alpha=alpha)
    mu = closed_form.mu_star(b, d, alpha)
    # For mu* = 0 no P attains it; the solver stops slightly above.
    assert solved.mu == pytest.approx(mu, abs=1e-5 if mu > 0 else 1e-4)
    if mu > 1e-3:
        assert solved.gain[0, 0] == pytest.approx(closed_form.gain(b, d, alpha), abs=1e-3)
    p = 1 / mu if mu > 0 else 1.0
    plant = (ONE, b * ONE, ONE, d * ONE, ONE)
    l_gain = np.array([[closed_form.gain(b, d, alpha)]])
    margin = lmi.lmi_margin(
        np.array([[p]]), gain=l_gain, mu=max(mu, 1 / p), plant=plant, alpha=alpha
    )
    assert margin >= -1e-9
    assert closed_form.design(b, d, alpha).residual == pytest.approx(margin, abs=1e-9)


@pytest.mark.parametrize(("mu", "limit_s"), [(0.05, 0.8873), (0.25, 1.0000), (1.0, 1.2906)])
def test_interval_limits_match_the_paper(mu: float, limit_s: float) -> None:
    """The paper used a grid of 0.01 s and found infeasibility at 0.89, 1.01 and 1.3 s."""
    assert round(closed_form.dt_limit_s(mu, 0.5, 0.5), 4) == limit_s


def test_paper_interval_has_zero_error_gain() -> None:
    found = closed_form.design(0.15, 0.5, 0.5)
    assert found.l_gain == pytest.approx(0.30, abs=1e-12)
    assert (found.mu, found.gamma) == (0.0, 0.0)
    assert found.q == pytest.approx(0.70, abs=1e-12)
    assert found.peak_gain == pytest.approx(0.0, abs=1e-15)


@given(INTERVALS, FEEDTHROUGHS, ALPHAS)
def test_certificate_holds_and_rejects_a_wrong_gain(b: float, d: float, alpha: float) -> None:
    found = closed_form.design(b, d, alpha)
    assert found.residual >= -1e-9
    assert found.gamma == math.sqrt(found.mu)
    assume(found.mu > 1e-3)
    for wrong in (found.l_gain + 0.05, found.l_gain - 0.05):
        assert (
            closed_form.lmi_margin(
                b, feedthrough_s=d, alpha=alpha, l_gain=wrong, mu=found.mu, p=1 / found.mu
            )
            < -1e-6
        )


@given(INTERVALS, FEEDTHROUGHS, ALPHAS)
def test_certificate_fails_for_a_smaller_mu(b: float, d: float, alpha: float) -> None:
    mu = closed_form.mu_star(b, d, alpha)
    assume(mu > 1e-3)
    smaller = 0.98 * mu
    for p in (1 / mu, 1 / smaller):
        gains = np.linspace(-1, 3, 401)
        margins = [
            closed_form.lmi_margin(b, feedthrough_s=d, alpha=alpha, l_gain=l_gain, mu=smaller, p=p)
            for l_gain in gains
        ]
        assert max(margins) < 0


@given(st.lists(INTERVALS, min_size=1, max_size=5), FEEDTHROUGHS, ALPHAS)
def test_scalars_and_arrays_agree(intervals: list[float], d: float, alpha: float) -> None:
    mus = closed_form.mu_stars([intervals, intervals], d, alpha)
    gains = closed_form.gains([intervals, intervals], d, alpha)
    assert mus.shape == gains.shape == (2, len(intervals))
    for column, b in enumerate(intervals):
        assert mus[1, column] == pytest.approx(closed_form.mu_star(b, d, alpha), abs=1e-12)
        assert gains[1, column] == closed_form.gain(b, d, alpha)


@given(INTERVALS, FEEDTHROUGHS)
def test_chosen_alpha_minimises_mu_within_the_decay_limit(b: float, d: float) -> None:
    best = closed_form.best_alpha(b, d)
    assume(best > 1e-6)
    assert best <= closed_form.FASTEST_DECAY
    attained = closed_form.mu_star(b, d, best)
    scan = np.linspace(1e-4, closed_form.FASTEST_DECAY, 500)
    mus = np.array([((d - b) ** 2 - (1 - a) * d * d) / a for a in scan]).clip(min=0.0)
    assert attained <= mus.min() + 1e-9
    # It is the largest of those that null the error.
    if attained == 0.0 and best < closed_form.FASTEST_DECAY:
        assert mus[scan > best + 1e-3].min(initial=1.0) > 0
    assert closed_form.gain(b, d) == closed_form.gain(b, d, best)
    assert closed_form.design(b, d).alpha == best


@given(st.floats(0.0, 2.0), FEEDTHROUGHS, ALPHAS)
def test_interval_limit_is_where_mu_reaches_its_bound(mu: float, d: float, alpha: float) -> None:
    limit_s = closed_form.dt_limit_s(mu, d, alpha)
    assume(limit_s > 1e-3)
    assert closed_form.mu_star(limit_s * (1 - 1e-9), d, alpha) <= mu + 1e-6
    assert closed_form.mu_star(limit_s * (1 + 1e-6) + 1e-6, d, alpha) > mu


def test_interval_limit_is_not_negative() -> None:
    """With a lag no interval meets a small mu; the limit is then 0, not negative."""
    assert closed_form.mu_stars([1e-6], -1.0, 0.5)[0] > 0.9
    assert closed_form.dt_limit_s(0.0, -1.0, 0.5) >= 0.0


@given(INTERVALS, FEEDTHROUGHS, st.floats(0.05, 1.95))
def test_peak_gain_matches_the_worst_case_input(b: float, d: float, l_gain: float) -> None:
    """e+ = (1-l) e + (l d - b) w, with w = -1 or 1 in the worst sense, until it settles."""
    error, q, enters = 0.0, 1 - l_gain, l_gain * d - b
    steps = math.ceil(math.log(1e-12) / math.log(max(abs(q), 1e-3))) + 1
    for _ in range(steps):
        worst = math.copysign(1.0, q * error) * math.copysign(1.0, enters)
        error = q * error + enters * worst
    assert abs(error) == pytest.approx(
        float(closed_form.peak_gain(b, d, l_gain)), rel=1e-9, abs=1e-12
    )


def test_peak_gain_is_infinite_without_contraction() -> None:
    assert closed_form.peak_gain([0.1, 0.1, 0.5], 0.0, [0.0, 2.0, -1.0]).tolist() == [math.inf] * 3
    assert closed_form.peak_gain(0.5, 0.25, 2.0) == 0.0  # no input


@given(INTERVALS, FEEDTHROUGHS, ALPHAS)
def test_gamma_is_no_less_than_the_exact_peak(b: float, d: float, alpha: float) -> None:
    found = closed_form.design(b, d, alpha)
    assert found.peak_gain <= found.gamma + 1e-7


@pytest.mark.parametrize("dt_s", [0.0, -0.1, math.nan, math.inf])
def test_invalid_interval_is_rejected(dt_s: float) -> None:
    with pytest.raises(ValueError, match="positive number of seconds"):
        closed_form.design(dt_s, 0.5, 0.5)
    with pytest.raises(ValueError, match="positive number of seconds"):
        closed_form.mu_stars([0.1, dt_s], 0.5, 0.5)


@pytest.mark.parametrize("alpha", [0.0, 1.0, -0.5, math.nan])
def test_alpha_outside_0_to_1_is_rejected(alpha: float) -> None:
    for call in (
        lambda: closed_form.design(0.1, 0.5, alpha),
        lambda: closed_form.gains([0.1], 0.5, alpha),
        lambda: closed_form.dt_limit_s(1.0, 0.5, alpha),
    ):
        with pytest.raises(ValueError, match="allowed: 0 to 1, both excluded"):
            call()


@pytest.mark.parametrize("mu", [-1e-9, math.nan])
def test_negative_bound_on_mu_is_rejected(mu: float) -> None:
    with pytest.raises(ValueError, match="allowed: at least 0"):
        closed_form.dt_limit_s(mu, 0.5, 0.5)


@pytest.mark.parametrize("feedthrough_s", [math.nan, math.inf, -math.inf])
def test_non_finite_feedthrough_is_rejected(feedthrough_s: float) -> None:
    with pytest.raises(ValueError, match="feedthrough"):
        closed_form.design(0.1, feedthrough_s, 0.5)
