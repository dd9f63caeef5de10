"""The carrier plan, the transforms, and the effect of a delay within the prefix."""

import numpy as np
import pytest

from companion.studies.link.ofdm import (
    CARRIERS,
    DATA,
    NULLS,
    PILOT_SIGNS,
    PILOTS,
    PREFIX,
    SAMPLES,
    carriers,
    flat_estimate,
    frequency_response,
    received_carriers,
    samples,
)
from companion.values import ComplexArray


def drawn(*shape: int, seed: int = 1) -> ComplexArray:
    rng = np.random.default_rng(seed)
    return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)


def test_carrier_plan_matches_the_paper() -> None:
    """Counting from 1: nulls [1:7 129 251:256], pilots as listed, data on all others."""
    nulls = [*range(1, 8), 129, *range(251, 257)]
    pilots = [26, 54, 90, 118, 140, 168, 204, 232]
    assert (NULLS + 1).tolist() == nulls
    assert (PILOTS + 1).tolist() == pilots
    assert (len(DATA), len(PILOTS), len(NULLS)) == (234, 8, 14)
    assert sorted([*(DATA + 1), *pilots, *nulls]) == list(range(1, CARRIERS + 1))


def test_middle_null_carrier_is_at_0_hz() -> None:
    """Symbols have zero mean; the lowest carrier rotates once backwards, the next upper one
    forwards."""
    sent = samples(carriers(drawn(3, 234), PILOT_SIGNS[0]))
    assert sent[:, PREFIX:].mean(axis=-1) == pytest.approx(np.zeros(3), abs=1e-12)
    one = np.zeros(CARRIERS, dtype=complex)
    one[127] = 16.0  # just below 0 Hz
    turning = np.exp(-2j * np.pi * np.arange(CARRIERS) / CARRIERS)
    assert samples(one)[PREFIX:] == pytest.approx(turning)


def test_transform_keeps_energy_and_prefix_repeats_the_end() -> None:
    placed = carriers(drawn(4, 234), PILOT_SIGNS[:4])
    sent = samples(placed)
    assert sent.shape == (4, SAMPLES)
    assert np.sum(np.abs(sent[:, PREFIX:]) ** 2) == pytest.approx(np.sum(np.abs(placed) ** 2))
    assert (sent[:, :PREFIX] == sent[:, -PREFIX:]).all()
    assert received_carriers(sent) == pytest.approx(placed)


@pytest.mark.parametrize("delay", [0, 1, 17, PREFIX])
def test_delay_within_the_prefix_is_a_phase_ramp(delay: int) -> None:
    """Independent of the preceding symbol."""
    stream = samples(carriers(drawn(2, 234), PILOT_SIGNS[0]))
    late = np.concatenate([np.zeros(delay), stream.ravel()])[: 2 * SAMPLES].reshape(2, SAMPLES)
    ramp = np.exp(-2j * np.pi * delay * (np.arange(CARRIERS) - 128) / CARRIERS)
    expected = carriers(drawn(2, 234), PILOT_SIGNS[0]) * ramp
    assert received_carriers(late)[1] == pytest.approx(expected[1])
    taps = np.zeros((delay + 1, 1))
    taps[delay] = 1.0
    assert frequency_response(taps)[:, 0] == pytest.approx(ramp)


def test_delay_beyond_the_prefix_causes_interference() -> None:
    stream = samples(carriers(drawn(2, 234), PILOT_SIGNS[0])).ravel()
    late = np.concatenate([np.zeros(PREFIX + 1), stream])[: 2 * SAMPLES].reshape(2, SAMPLES)
    sent = carriers(drawn(2, 234), PILOT_SIGNS[0])[1]
    assert np.abs(received_carriers(late)[1, NULLS]).max() > 0.01
    assert np.abs(np.abs(received_carriers(late)[1]) - np.abs(sent)).max() > 0.01


def test_pilots_separate_streams() -> None:
    """Over a flat channel each stream's estimate is its own gain, independent of the others."""
    gains = drawn(8, seed=3)
    heard = np.einsum("n,nc->c", gains, carriers(drawn(8, 234), PILOT_SIGNS))
    found = [flat_estimate(heard, signs)[0] for signs in PILOT_SIGNS]
    assert found == pytest.approx(gains.tolist())


def test_pilot_estimate_averages_white_noise() -> None:
    noise = received_carriers(drawn(4000, SAMPLES, seed=4))
    assert np.mean(np.abs(noise) ** 2) == pytest.approx(2.0, rel=0.01)
    estimates = flat_estimate(noise, PILOT_SIGNS[3])
    assert np.mean(np.abs(estimates) ** 2) == pytest.approx(2.0 / 8, rel=0.08)
