"""Power allocation against independent optimisers and against equal shares."""

import numpy as np
import pytest
from scipy.optimize import linprog, minimize

from companion.beams.weights import powers
from companion.beams.weights.precoding import Precoder, Radio, precode
from companion.values import ComplexArray, FloatArray, Method, Normalisation, Power, Widen


def coupling(seed: int, users: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    made = rng.exponential(1.0, (users, users)) * 10 ** rng.uniform(-1, 1, (users, 1))
    made[np.arange(users), np.arange(users)] *= 30.0
    found: FloatArray = made
    return found


def sinr(coupling: FloatArray, share: FloatArray) -> FloatArray:
    received = coupling * share
    own = received.diagonal()
    found: FloatArray = own / (1 + received.sum(axis=1) - own)
    return found


def steering(seed: int, elements: int, users: int) -> ComplexArray:
    sines = np.random.default_rng(seed).uniform(-0.9, 0.9, users)
    made: ComplexArray = np.exp(1j * np.pi * np.outer(np.arange(elements), sines))
    return made


@pytest.mark.parametrize("users", [1, 2, 5, 16])
@pytest.mark.parametrize("seed", range(3))
def test_max_min_power_matches_bisection_over_linear_programmes(seed: int, users: int) -> None:
    made = coupling(seed, users)
    share = powers.max_min(made)
    assert share.sum() == pytest.approx(1.0)
    own, cross = made.diagonal(), made - np.diag(made.diagonal())
    low, high = 0.0, 1e4
    for _ in range(60):
        level = (low + high) / 2
        rows = level * cross - np.diag(own)
        can = linprog(np.ones(users), rows, np.full(users, -level)).x
        low, high = (level, high) if can is not None and can.sum() <= 1 else (low, level)
    assert sinr(made, share).min() == pytest.approx(low, rel=2e-3)


@pytest.mark.parametrize("seed", range(6))
def test_weighted_sum_power_is_no_worse_than_a_search(seed: int) -> None:
    made, worths = coupling(seed, 4), np.array([1.0, 2.0, 0.5, 1.0])

    def total(share: FloatArray) -> float:
        return float(worths @ np.log2(1 + sinr(made, share)))

    share = powers.weighted_sum(made, worths)
    assert share.sum() == pytest.approx(1.0)
    assert (share > 0).all()
    assert total(share) >= total(np.full(4, 0.25)) - 1e-9

    def cost(logs: FloatArray) -> float:
        parts = np.exp(logs)
        return -total(parts / parts.sum())

    searched = minimize(cost, np.log(np.full(4, 0.25)), method="Nelder-Mead")
    assert total(share) >= -searched.fun - 0.03 * abs(searched.fun)


@pytest.mark.parametrize("snr_db", [-10.0, 5.0, 20.0])
@pytest.mark.parametrize("users", [2, 8, 16])
def test_mmse_with_max_min_power_is_optimal(users: int, snr_db: float) -> None:
    """Uplink-downlink duality: the balanced SINR there is the largest of all beams."""
    a = steering(users, 64, users)
    ranges = np.random.default_rng(users).uniform(0.3, 3.0, users)
    radio = Radio(10 ** (snr_db / 10) / 64 * users * ranges, np.ones(users))
    how = Precoder(
        method=Method.MMSE, power=Power.MAX_MIN, normalisation=Normalisation.TOTAL, widen=Widen.NO
    )
    found = precode(a, how, None, priorities=None, radio=radio).weights
    assert np.linalg.norm(found) == pytest.approx(1.0)
    ours = sinr(radio.snr[:, np.newaxis] * np.abs(a.T @ found) ** 2, np.ones(users)).min()
    share = np.full(users, 1 / users)
    channels = np.sqrt(radio.snr) * a
    for _ in range(3000):
        noise = np.eye(64) + (channels.conj() * share) @ channels.T
        alone = np.array([
            (h @ np.linalg.solve(noise - p * np.outer(h.conj(), h), h.conj())).real
            for h, p in zip(channels.T, share, strict=True)
        ])  # fmt: skip
        before, share = share, 1 / alone / (1 / alone).sum()
        if np.abs(share - before).max() < 1e-9:
            break
    best = float((share * alone).min())
    assert 0.97 * best <= ours <= best * 1.001


@pytest.mark.parametrize("snr_db", [-5.0, 10.0, 25.0])
@pytest.mark.parametrize("users", [4, 16, 32])
def test_mmse_has_a_higher_sum_rate_than_zero_forcing(users: int, snr_db: float) -> None:
    a = steering(3 * users, 64, users)
    radio = Radio(np.full(users, 10 ** (snr_db / 10) / 4), np.ones(users))

    def total(method: Method, power: Power) -> float:
        how = Precoder(
            method=method, power=power, normalisation=Normalisation.TOTAL, widen=Widen.NO
        )
        weights = precode(a, how, None, priorities=None, radio=radio).weights
        found = sinr(radio.snr[:, np.newaxis] * np.abs(a.T @ weights) ** 2, np.ones(users))
        return float(np.log2(1 + found).sum())

    equal = total(Method.MMSE, Power.EQUAL)
    assert equal >= total(Method.ZERO_FORCING, Power.EQUAL) - 1e-6
    assert total(Method.MMSE, Power.WEIGHTED_SUM) >= equal - 1e-3


def test_mmse_requires_a_radio() -> None:
    with pytest.raises(ValueError, match="radio"):
        precode(steering(1, 8, 2), Precoder(method=Method.MMSE))


@pytest.mark.parametrize("power", Power)
@pytest.mark.parametrize("snr_db", [0.0, 60.0, 120.0, 200.0])
def test_identical_channels_give_finite_normalised_weights(power: Power, snr_db: float) -> None:
    """Two UAVs in one direction, two at mirror directions, and more UAVs than elements."""
    rng = np.random.default_rng(3)
    for users in (4, 12):
        sines = rng.uniform(-0.9, 0.9, users)
        sines[1] = sines[0]
        a = np.exp(1j * np.pi * np.outer(np.arange(8), sines))
        snr = 10 ** (snr_db / 10) * 10 ** rng.uniform(-3, 3, users)
        how = Precoder(
            method=Method.MMSE, normalisation=Normalisation.TOTAL, widen=Widen.NO, power=power
        )
        weights = precode(a, how, None, priorities=None, radio=Radio(snr, np.ones(users))).weights
        assert np.isfinite(weights).all()
        assert (np.abs(weights) ** 2).sum() == pytest.approx(1.0)
