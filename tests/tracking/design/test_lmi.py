"""The LMI: its certificate, networks, and unsolvable cases."""

from collections.abc import Sequence

import numpy as np
import pytest

from companion.tracking.design import closed_form, lmi
from companion.values import FloatArray

ONE = np.eye(1)
Plant = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]


def solve(plant: Plant, alpha: float, channels: Sequence[int] | None = None) -> lmi.LmiSolution:
    """Call ``lmi.solve`` with a plant given as one tuple."""
    a, b, c, d, h = plant
    return lmi.solve(a, b=b, c=c, d=d, h=h, alpha=alpha, channels=channels)


def network(intervals_s: list[float], feedthrough_s: float) -> Plant:
    """Return the paper's stacked model with two axes per UAV."""
    stacked = np.repeat(intervals_s, 2)
    eye = np.eye(len(stacked))
    return eye, np.diag(stacked), eye, feedthrough_s * eye, eye


@pytest.mark.parametrize(
    ("intervals_s", "feedthrough_s", "alpha"),
    [([0.15, 0.6, 1.1], 0.5, 0.5), ([0.1, 0.25], 0.0, 0.9), ([0.2, 0.3, 0.5], -0.2, 0.3)],
)
def test_network_mu_is_that_of_its_worst_axis(
    intervals_s: list[float], feedthrough_s: float, alpha: float
) -> None:
    """Unequal intervals, 2N x 2N, no diagonal structure assumed: mu is the largest of the
    axes' mu.
    """
    plant = network(intervals_s, feedthrough_s)
    solved = solve(plant, alpha)
    worst = max(closed_form.mu_star(b, feedthrough_s, alpha) for b in intervals_s)
    assert worst > 0.01
    assert solved.mu == pytest.approx(worst, abs=1e-5)
    # The gains of the single axes with a common P also meet the network's LMIs.
    gains = np.diag(np.repeat(closed_form.gains(intervals_s, feedthrough_s, alpha), 2))
    common = np.eye(len(gains)) / worst
    assert lmi.lmi_margin(common, gain=gains, mu=worst, plant=plant, alpha=alpha) >= -1e-9


def test_margin_sign_matches_positive_definiteness_of_the_lmis() -> None:
    """Positive exactly where the unscaled LMIs are positive definite."""
    rng = np.random.default_rng(5)
    signs = set()
    for _ in range(200):
        a = np.eye(2) + 0.1 * rng.standard_normal((2, 2))
        b, c = 0.3 * rng.standard_normal((2, 3)), np.eye(2)
        d, h = 0.3 * rng.standard_normal((2, 3)), rng.standard_normal((1, 2))
        root = rng.standard_normal((2, 2)) + 2 * np.eye(2)
        p, mu, alpha = root @ root.T, rng.uniform(0.1, 2.0), rng.uniform(0.1, 0.9)
        gain = np.eye(2) + 0.3 * rng.standard_normal((2, 2))
        left, right = p @ (a - gain @ c), p @ (gain @ d - b)
        zero = np.zeros((2, 3))
        decay = np.block(
            [
                [(1 - alpha) * p, zero, left.T],
                [zero.T, alpha * np.eye(3), right.T],
                [left, right, p],
            ]
        )
        output = np.block([[p, h.T], [h, mu * np.eye(1)]])
        least = min(np.linalg.eigvalsh(decay)[0], np.linalg.eigvalsh(output)[0])
        margin = lmi.lmi_margin(p, gain=gain, mu=mu, plant=(a, b, c, d, h), alpha=alpha)
        assert (margin > 0) == (least > 0)
        signs.add(margin > 0)
    assert signs == {True, False}


def test_a_tampered_solution_fails_its_certificate() -> None:
    plant = network([0.6, 0.9], 0.2)
    solved = solve(plant, 0.5)
    assert solved.margin > -1e-6
    assert lmi.lmi_margin(
        solved.lyapunov, gain=solved.gain, mu=solved.mu, plant=plant, alpha=0.5
    ) == pytest.approx(solved.margin)
    p, gain = solved.lyapunov, solved.gain
    certify(p, gain, solved.mu, plant)
    for bad_p, bad_gain, bad_mu in (
        (p, 1.1 * gain, solved.mu),
        (1.5 * p, gain, solved.mu),
        (p, gain, 0.9 * solved.mu),
        (0.5 * p, gain, solved.mu),
    ):
        with pytest.raises(lmi.LmiError, match="fails its certificate"):
            certify(bad_p, bad_gain, bad_mu, plant)


def certify(p: FloatArray, gain: FloatArray, mu: float, plant: Plant) -> None:
    """Certify a solver's answer as ``solve`` does, at alpha = 0.5."""
    a, b, c, d, h = plant
    lmi._certified(
        p,
        [gain],
        mu,
        samplings=[lmi.Sampling(a=a, b=b, c=c, d=d)],
        h=h,
        multipliers=np.array([[0.5]]),
        widths=[len(p)],
    )


def test_non_positive_p_is_rejected() -> None:
    """It raises an ``LmiError``, as for every other answer that cannot be confirmed."""
    with pytest.raises(lmi.LmiError, match="not positive"):
        certify(-ONE, ONE, 1.0, (ONE, ONE, ONE, 0 * ONE, ONE))


@pytest.mark.parametrize("alpha", [0.0, 1.0, -0.1, 1.1, float("nan")])
def test_alpha_outside_0_to_1_is_rejected(alpha: float) -> None:
    with pytest.raises(ValueError, match="allowed: 0 to 1, both excluded"):
        lmi.solve(ONE, b=ONE, c=ONE, d=ONE, h=ONE, alpha=alpha)


def test_infeasible_plant_raises_lmi_error() -> None:
    """An unstable, unmeasured state: no gain and no P exist."""
    unmeasured = 0 * ONE
    with pytest.raises(lmi.LmiError, match=r"^the solver"):
        lmi.solve(2 * ONE, b=ONE, c=unmeasured, d=unmeasured, h=ONE, alpha=0.5)


@pytest.mark.parametrize("dt_s", [1e-4, 1e-3, 100.0, 1000.0])
def test_solution_is_invariant_to_the_unit_of_time(dt_s: float) -> None:
    """mu scales with the square of the interval: a plant solvable at 1 s is solvable at any."""
    solved = lmi.solve(ONE, b=dt_s * ONE, c=ONE, d=-0.3 * dt_s * ONE, h=ONE, alpha=0.5)
    assert solved.mu == pytest.approx(closed_form.mu_star(dt_s, -0.3 * dt_s, 0.5), rel=1e-3)


def test_random_networks_with_output_weights_match_the_closed_form() -> None:
    """mu = max h_i^2 mu*_i, and the deciding axis has the closed form's gain."""
    rng = np.random.default_rng(11)
    decided = 0
    for _ in range(12):
        intervals = rng.uniform(0.1, 1.2, 3).tolist()
        feedthrough, alpha = float(rng.uniform(-0.3, 0.5)), float(rng.uniform(0.1, 0.9))
        a, b, c, d, _ = network(intervals, feedthrough)
        weights = np.repeat(rng.uniform(0.5, 2.0, 3), 2)
        solved = lmi.solve(a, b=b, c=c, d=d, h=np.diag(weights), alpha=alpha)
        each = weights**2 * np.repeat(closed_form.mu_stars(intervals, feedthrough, alpha), 2)
        assert solved.mu == pytest.approx(np.max(each), abs=1e-5 if np.max(each) > 0 else 1e-4)
        if np.max(each) < 0.01:
            continue
        worst = int(np.argmax(each))
        expected = closed_form.gain(intervals[worst // 2], feedthrough, alpha)
        assert solved.gain[worst, worst] == pytest.approx(expected, abs=1e-3)
        decided += 1
    assert decided > 6


@pytest.mark.parametrize(("l_gain", "mu"), [(0.39, 0.05), (0.60, 0.25), (0.76, 1.0)])
def test_the_published_gains_are_feasible(l_gain: float, mu: float) -> None:
    """delta = 0.5 s, dt = 0.15 s, alpha = 0.5; a P exists for each mu, and none for a
    smaller one.
    """
    plant = (ONE, 0.15 * ONE, ONE, 0.5 * ONE, ONE)
    margins = [
        lmi.lmi_margin(p * ONE, gain=l_gain * ONE, mu=mu, plant=plant, alpha=0.5)
        for p in np.geomspace(0.1, 1e3, 400)
    ]
    assert max(margins) > 0
    needed = (l_gain * 0.5 - 0.15) ** 2 / (0.5 * (1 - (1 - l_gain) ** 2 / 0.5))
    assert needed < mu
    assert all(
        lmi.lmi_margin(p * ONE, gain=l_gain * ONE, mu=0.98 * needed, plant=plant, alpha=0.5) < 0
        for p in np.geomspace(0.1, 1e5, 400)
    )


@pytest.mark.parametrize("mu_max", [0.05, 0.25, 1.0])
def test_solution_meets_a_feasible_mu_limit(mu_max: float) -> None:
    solved = lmi.solve(ONE, b=0.15 * ONE, c=ONE, d=0.5 * ONE, h=ONE, alpha=0.5, mu_max=mu_max)
    assert solved.mu <= mu_max * (1 + 1e-9)
    assert solved.margin > -1e-6


def test_infeasible_mu_limit_raises_lmi_error() -> None:
    limit_s = closed_form.dt_limit_s(0.05, 0.5, 0.5)
    lmi.solve(ONE, b=0.999 * limit_s * ONE, c=ONE, d=0.5 * ONE, h=ONE, alpha=0.5, mu_max=0.05)
    with pytest.raises(lmi.LmiError):
        lmi.solve(ONE, b=1.001 * limit_s * ONE, c=ONE, d=0.5 * ONE, h=ONE, alpha=0.5, mu_max=0.05)


def test_unattained_infimum_is_flagged() -> None:
    """b < 2 d: mu can be made arbitrarily small by an arbitrarily large P."""
    for b, d, alpha in ((0.15, 0.5, 0.5), (0.4, 0.5, 0.5), (0.65, 0.5, 0.5)):
        assert closed_form.mu_star(b, d, alpha) == 0
        assert not lmi.solve(ONE, b=b * ONE, c=ONE, d=d * ONE, h=ONE, alpha=alpha).attained
    for b, d, alpha in ((0.86, 0.5, 0.5), (0.1, 0.0, 0.9), (0.854, 0.5, 0.5)):
        solved = lmi.solve(ONE, b=b * ONE, c=ONE, d=d * ONE, h=ONE, alpha=alpha)
        assert solved.attained
        assert solved.mu == pytest.approx(closed_form.mu_star(b, d, alpha), rel=1e-3)


def test_common_p_for_several_intervals_has_the_worst_mu() -> None:
    """One axis: docs/math.md states that p = 1 / max mu*(b) serves every b."""
    intervals, d, alpha = [0.1, 0.4, 0.9, 1.2], -0.1, 0.6
    samplings = [lmi.Sampling(a=ONE, b=b * ONE, c=ONE, d=d * ONE) for b in intervals]
    solved = lmi.solve_common(samplings, ONE, [alpha] * 4)
    assert solved.mu == pytest.approx(closed_form.mu_star(1.2, d, alpha), abs=1e-5)
    assert solved.gains[3][0, 0] == pytest.approx(closed_form.gain(1.2, d, alpha), abs=1e-3)
    for sampling, gain in zip(samplings, solved.gains, strict=True):
        plant = (sampling.a, sampling.b, sampling.c, sampling.d, ONE)
        assert (
            lmi.lmi_margin(solved.lyapunov, gain=gain, mu=solved.mu, plant=plant, alpha=alpha)
            > -1e-6
        )


# --- position and velocity ----------------------------------------------------------------------

POSITION = np.array([[1.0, 0.0]])


def held(dt_s: float, velocity: bool) -> lmi.Sampling:
    """Return a plant for 5 m/s^2, *constant within the interval*; noise of 0.5 m and 0.2 m/s."""
    r = 2 if velocity else 1
    b = np.hstack([[[5 * dt_s**2 / 2], [5 * dt_s]], np.zeros((2, r))])
    d = np.hstack([np.zeros((r, 1)), np.diag([0.5, 0.2])[:r, :r]])
    return lmi.Sampling(a=np.array([[1.0, dt_s], [0.0, 1.0]]), b=b, c=np.eye(2)[:r], d=d)


def least_bound_m(intervals_s: list[float], velocity: bool, alphas: list[float]) -> float:
    samplings = [held(x, velocity) for x in intervals_s]
    channels = [1, 1, 1] if velocity else [1, 1]
    found = []
    for alpha in alphas:
        try:
            solved = lmi.solve_common(
                samplings, POSITION, [alpha] * len(intervals_s), channels=channels
            )
        except lmi.LmiError:
            continue
        assert solved.margin > -1e-6
        assert solved.multipliers.sum(axis=1) == pytest.approx(alpha)
        found.append(np.sqrt(solved.mu))
    return float(min(found))


@pytest.mark.parametrize(
    ("dt_s", "velocity", "bound_m"),
    [
        *((0.1, True, 0.55), (0.25, True, 0.71), (1.0, True, 3.2)),
        *((0.1, False, 1.1), (0.25, False, 1.7), (1.0, False, 7.5)),
    ],
)
def test_kinematic_position_bounds_match_published_values(
    dt_s: float, velocity: bool, bound_m: float
) -> None:
    alphas = [0.4, 0.5, 0.6, 0.99, 0.9999]
    assert least_bound_m([dt_s], velocity, alphas) == pytest.approx(bound_m, rel=0.02)


def test_common_p_over_a_range_of_intervals() -> None:
    grid = np.geomspace(0.05, 0.5, 8).tolist()
    common = least_bound_m(grid, True, [0.8, 0.9, 0.95])
    assert common == pytest.approx(1.25, rel=0.03)
    assert common > least_bound_m([0.5], True, [0.9999])


def test_multipliers_per_channel_tighten_the_bound() -> None:
    """|w_i| <= 1 for each of three channels is |w| <= sqrt 3 for one: the bound must tighten."""
    sampling = held(0.25, velocity=True)
    plant = (sampling.a, sampling.b, sampling.c, sampling.d, POSITION)
    apart = solve(plant, 0.9, channels=[1, 1, 1])
    together = solve(plant, 0.9)
    assert np.sqrt(together.mu) < np.sqrt(apart.mu) < np.sqrt(3 * together.mu)


@pytest.mark.parametrize("channels", [[1, 1], [3, 0], [2, 2]])
def test_channels_that_do_not_cover_the_inputs_are_rejected(channels: list[int]) -> None:
    sampling = held(0.25, velocity=True)
    with pytest.raises(ValueError, match="channels must cover the columns"):
        lmi.solve_common([sampling], POSITION, [0.5], channels=channels)


@pytest.mark.parametrize("size", [1e-4, 1.0, 1e4])
def test_solution_is_invariant_to_state_units(size: float) -> None:
    """Position in a different unit than velocity: scaled internally, certified externally."""
    s, change = held(0.25, velocity=True), np.diag([size, 1.0])
    back = np.diag([1 / size, 1.0])
    changed = (change @ s.a @ back, change @ s.b, s.c @ back, s.d, POSITION @ back)
    solved = solve(changed, 0.9, channels=[1, 1, 1])
    plain = lmi.solve(s.a, b=s.b, c=s.c, d=s.d, h=POSITION, alpha=0.9, channels=[1, 1, 1])
    assert solved.mu == pytest.approx(plain.mu, rel=1e-4)


def test_decay_lmi_keeps_its_slack() -> None:
    s = held(0.25, velocity=True)
    plant = (s.a, s.b, s.c, s.d, POSITION)
    for slack in (0.0, 1e-3):
        found = lmi.solve_common([s], POSITION, [0.9], channels=[1, 1, 1], slack=slack)
        roomy = 2 * found.mu + 1  # so that the other LMI is not active
        margin = lmi.lmi_margin(
            found.lyapunov,
            gain=found.gain,
            mu=roomy,
            plant=plant,
            alpha=0.9,
            shares=found.multipliers[0],
        )
        assert margin == pytest.approx(slack, abs=1e-5)
