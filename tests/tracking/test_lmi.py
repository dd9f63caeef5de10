"""The LMI: its certificate, networks, and what it does not solve."""

import numpy as np
import pytest

from companion.tracking import design, lmi
from companion.values import FloatArray

ONE = np.eye(1)
Plant = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]


def network(intervals_s: list[float], feedthrough_s: float) -> Plant:
    """The paper's stacked model: two axes for each UAV."""
    stacked = np.repeat(intervals_s, 2)
    eye = np.eye(len(stacked))
    return eye, np.diag(stacked), eye, feedthrough_s * eye, eye


@pytest.mark.parametrize(
    ("intervals_s", "feedthrough_s", "alpha"),
    [([0.15, 0.6, 1.1], 0.5, 0.5), ([0.1, 0.25], 0.0, 0.9), ([0.2, 0.3, 0.5], -0.2, 0.3)],
)
def test_a_network_is_no_worse_than_its_worst_axis(
    intervals_s: list[float], feedthrough_s: float, alpha: float
) -> None:
    """Unequal intervals, 2N x 2N, nothing assumed diagonal: mu is the largest of the axes'."""
    plant = network(intervals_s, feedthrough_s)
    solved = lmi.solve(*plant, alpha)
    worst = max(design.mu_star(b, feedthrough_s, alpha) for b in intervals_s)
    assert worst > 0.01
    assert solved.mu == pytest.approx(worst, abs=1e-5)
    # And the gains of the single axes, with one common P, meet the network's LMIs.
    gains = np.diag(np.repeat(design.gains(intervals_s, feedthrough_s, alpha), 2))
    common = np.eye(len(gains)) / worst
    assert lmi.lmi_margin(common, gains, worst, plant, alpha) >= -1e-9


def test_the_margin_is_the_least_eigenvalue_of_what_is_written() -> None:
    """Positive exactly where the LMIs, unscaled, are positive definite."""
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
        margin = lmi.lmi_margin(p, gain, mu, (a, b, c, d, h), alpha)
        assert (margin > 0) == (least > 0)
        signs.add(margin > 0)
    assert signs == {True, False}


def test_a_tampered_solution_fails_its_certificate() -> None:
    plant = network([0.6, 0.9], 0.2)
    solved = lmi.solve(*plant, 0.5)
    assert solved.margin > -1e-6
    assert lmi.lmi_margin(
        solved.lyapunov, solved.gain, solved.mu, plant, 0.5
    ) == pytest.approx(solved.margin)  # fmt: skip
    p, z = solved.lyapunov, solved.lyapunov @ solved.gain
    lmi._certified(p, z, solved.mu, plant, 0.5)
    for bad_p, bad_z, bad_mu in (
        (p, 1.1 * z, solved.mu),
        (1.5 * p, 1.5 * z, solved.mu),
        (p, z, 0.9 * solved.mu),
        (0.5 * p, 0.5 * z, solved.mu),
    ):
        with pytest.raises(lmi.LmiError, match="fails its certificate"):
            lmi._certified(bad_p, bad_z, bad_mu, plant, 0.5)


def test_a_p_that_is_not_positive_is_no_certificate() -> None:
    """An ``LmiError`` like every other answer that cannot be confirmed."""
    with pytest.raises(lmi.LmiError):
        lmi._certified(-ONE, -ONE, 1.0, (ONE, ONE, ONE, 0 * ONE, ONE), 0.5)


@pytest.mark.parametrize("alpha", [0.0, 1.0, -0.1, 1.1, float("nan")])
def test_alpha_lies_between_0_and_1(alpha: float) -> None:
    with pytest.raises(ValueError, match="alpha lies strictly between 0 and 1"):
        lmi.solve(ONE, ONE, ONE, ONE, ONE, alpha)


def test_what_cannot_be_met_is_an_error() -> None:
    """A growing state that is not measured: no gain, no P."""
    unmeasured = 0 * ONE
    with pytest.raises(lmi.LmiError, match=r"^the solver"):
        lmi.solve(2 * ONE, ONE, unmeasured, unmeasured, ONE, 0.5)


@pytest.mark.parametrize("dt_s", [1e-4, 1e-3, 100.0, 1000.0])
def test_the_unit_of_time_does_not_matter(dt_s: float) -> None:
    """mu scales with the square of the interval: what is solved at 1 s is solved at any."""
    solved = lmi.solve(ONE, dt_s * ONE, ONE, -0.3 * dt_s * ONE, ONE, 0.5)
    assert solved.mu == pytest.approx(design.mu_star(dt_s, -0.3 * dt_s, 0.5), rel=1e-3)
