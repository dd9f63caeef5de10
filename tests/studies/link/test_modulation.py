"""16-QAM against its table, brute force over the constellation, and exact sums of probabilities."""

import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from companion.studies.link.modulation import BITS, SCALE, bit_error_rate, modulate, soft_bits

LABELS = np.array(list(product([False, True], repeat=BITS)))
POINTS = np.array(
    [complex(i, q) for i, q in (
        (1, 1), (1, 3), (3, 1), (3, 3), (1, -1), (1, -3), (3, -1), (3, -3),
        (-1, 1), (-1, 3), (-3, 1), (-3, 3), (-1, -1), (-1, -3), (-3, -1), (-3, -3))]
) / math.sqrt(10)  # fmt: skip
"""3GPP TS 38.211, 5.1.4, for labels in counting order, written out."""


def test_constellation_matches_the_standard() -> None:
    assert modulate(LABELS.ravel()) == pytest.approx(POINTS)
    assert np.mean(np.abs(POINTS) ** 2) == pytest.approx(1.0)


def test_neighbouring_symbols_differ_in_one_bit() -> None:
    for i, j in product(range(16), repeat=2):
        if abs(POINTS[i] - POINTS[j]) == pytest.approx(2 * SCALE):
            assert np.count_nonzero(LABELS[i] != LABELS[j]) == 1


def test_bit_count_not_filling_symbols_is_rejected() -> None:
    with pytest.raises(ValueError, match="6 bits do not fill symbols of 4"):
        modulate(np.zeros((2, 6), dtype=bool))


parts = st.floats(-3, 3)


@given(st.lists(st.tuples(parts, parts), min_size=1, max_size=8), st.floats(1e-3, 10))
def test_soft_bits_match_brute_force(places: list[tuple[float, float]], n0: float) -> None:
    received = np.array([complex(*place) for place in places])
    metric = np.abs(received[:, None] - POINTS) ** 2 / n0
    expected = [
        [metric[k, LABELS[:, b]].min() - metric[k, ~LABELS[:, b]].min() for b in range(BITS)]
        for k in range(len(received))
    ]
    assert soft_bits(received, n0) == pytest.approx(np.ravel(expected), abs=1e-9 / n0)


def test_soft_bit_signs_of_clean_symbols_are_the_bits() -> None:
    """Each symbol is weighted by its own noise."""
    n0 = np.linspace(0.1, 2.0, 16)
    soft = soft_bits(POINTS, n0).reshape(16, BITS)
    assert ((soft < 0) == LABELS).all()
    assert soft * n0[:, None] == pytest.approx(soft_bits(POINTS, 1.0).reshape(16, BITS))


@pytest.mark.parametrize("snr_db", [-5, 5, 15, 22])
def test_exact_bit_error_rate_sums_over_decision_regions(snr_db: float) -> None:
    """Per axis: levels 3, 1, -1, -3 with labels 01, 00, 10, 11, decision thresholds 2, 0 and -2."""
    snr = 10 ** (snr_db / 10)
    sigma = math.sqrt(10 / (2 * snr))
    levels, labels = (3, 1, -1, -3), ("01", "00", "10", "11")
    edges = (math.inf, 2.0, 0.0, -2.0, -math.inf)
    wrong = 0.0
    for level, label in zip(levels, labels, strict=True):
        for number, decided in enumerate(labels):
            low, high = (edges[number + 1] - level) / sigma, (edges[number] - level) / sigma
            chance = norm.cdf(high) - norm.cdf(low) if high < 0 else norm.sf(low) - norm.sf(high)
            wrong += chance * sum(a != b for a, b in zip(label, decided, strict=True)) / 8
    assert float(bit_error_rate(snr)) == pytest.approx(wrong, rel=1e-6)


@pytest.mark.parametrize("snr_db", [4.0, 10.0, 16.5])
def test_simulated_bit_error_rate_matches_the_exact_rate(snr_db: float) -> None:
    """Within four standard deviations and 0.1 dB."""
    rng = np.random.default_rng(5)
    bits = rng.random(1_200_000) < 0.5
    n0 = 10 ** (-snr_db / 10)
    noise = rng.standard_normal((2, len(bits) // 4)) * math.sqrt(n0 / 2)
    decided = soft_bits(modulate(bits) + noise[0] + 1j * noise[1], n0) < 0
    rate, expected = np.mean(decided != bits), float(bit_error_rate(1 / n0))
    assert rate == pytest.approx(expected, abs=4 * math.sqrt(expected / len(bits)))
    assert bit_error_rate(10**0.01 / n0) < rate < bit_error_rate(10**-0.01 / n0)
