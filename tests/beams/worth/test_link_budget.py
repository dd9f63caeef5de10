"""Link budget by hand; SINR against simulated symbols and closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.beams.array import steering
from companion.beams.array.elements import Element, ElementPattern
from companion.beams.array.geometry import uniform_linear, uniform_rectangular
from companion.beams.weights.precoding import Precoder, precode
from companion.beams.worth.channel import (
    Blockages,
    SalehValenzuela,
    combined_rows,
    draw,
    free_space_gain,
)
from companion.beams.worth.guarantee import guaranteed_gains_db, leakage_bounds
from companion.beams.worth.link_budget import (
    LinkBudget,
    least_sinr_db,
    predicted_sinr_db,
    share_power,
    sinr,
    spectral_efficiency,
    transmitted,
)
from companion.values import ComplexArray, FloatArray, IntArray, Normalisation

BUDGET = LinkBudget(tx_power_dbm=30.0, bandwidth_hz=50e6, noise_figure_db=7.0)
ARRAY = uniform_linear(64, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3))
RANGES_M = np.array([100.0, 150.0, 200.0, 250.0])


def in_plane(*degrees: float) -> FloatArray:
    angles = np.radians(degrees)
    return np.stack([np.cos(angles), np.sin(angles), np.zeros(len(degrees))], axis=1)


APART = in_plane(-50.0, -10.0, 15.0, 60.0)


def random_complex(rng: np.random.Generator, *shape: int) -> ComplexArray:
    made: ComplexArray = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    return made


# --- link budget --------------------------------------------------------------------------------


def test_noise_power_matches_hand_calculation() -> None:
    """-174 dBm/Hz + 77 dB (50 MHz) + 7 dB = -90 dBm; 30 dBm is one watt."""
    assert 10 * math.log10(BUDGET.noise_power_w * 1e3) == pytest.approx(-174 + 76.99 + 7, abs=0.03)
    assert BUDGET.noise_power_w == pytest.approx(1e-12, rel=0.01)
    assert BUDGET.tx_power_w == pytest.approx(1.0)
    cold = LinkBudget(tx_power_dbm=0.0, bandwidth_hz=50e6, noise_figure_db=7.0, temperature_k=29.0)
    assert cold.noise_power_w == pytest.approx(BUDGET.noise_power_w / 10)
    assert cold.tx_power_w == pytest.approx(1e-3)


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ((math.nan, 1.0, 1.0, 1.0), "tx_power_dbm"),
        ((0.0, 0.0, 1.0, 1.0), "bandwidth_hz"),
        ((0.0, math.inf, 1.0, 1.0), "bandwidth_hz"),
        ((0.0, 1.0, -0.1, 1.0), "noise_figure_db"),
        ((0.0, 1.0, math.nan, 1.0), "noise_figure_db"),
        ((0.0, 1.0, 1.0, 0.0), "temperature_k"),
    ],
)
def test_invalid_link_budget_is_rejected(values: tuple[float, ...], name: str) -> None:
    with pytest.raises(ValueError, match=name):
        LinkBudget(
            tx_power_dbm=values[0],
            bandwidth_hz=values[1],
            noise_figure_db=values[2],
            temperature_k=values[3],
        )


# --- power --------------------------------------------------------------------------------------


@settings(max_examples=examples(40))
@given(st.integers(0, 1000), st.lists(st.integers(0, 2), min_size=1, max_size=6))
def test_each_time_slot_splits_full_power_equally(seed: int, slots: list[int]) -> None:
    rng = np.random.default_rng(seed)
    weights = random_complex(rng, 5, len(slots)) * 10.0 ** rng.integers(-9, 9, len(slots))
    groups = np.array(slots)
    shared = share_power(weights, 3.0, groups)
    powers = np.sum(np.abs(shared) ** 2, axis=0)
    for slot in set(slots):
        mine = powers[groups == slot]
        assert mine == pytest.approx(np.full(len(mine), 3.0 / len(mine)))
    # Column directions are unchanged.
    assert shared / np.sqrt(powers) == pytest.approx(weights / np.linalg.norm(weights, axis=0))


def test_zero_stream_gets_no_power() -> None:
    weights = np.array([[1, 0, 2j], [1, 0, 0]], dtype=complex)
    shared = share_power(weights, 2.0)
    assert np.sum(np.abs(shared) ** 2, axis=0) == pytest.approx([1.0, 0.0, 1.0])
    assert share_power(np.zeros((2, 3), dtype=complex), 1.0).tolist() == [[0] * 3] * 2
    assert share_power(np.zeros((2, 0), dtype=complex), 1.0).shape == (2, 0)


@pytest.mark.parametrize("power_w", [0.0, -1.0, math.nan, math.inf])
def test_invalid_power_is_rejected(power_w: float) -> None:
    with pytest.raises(ValueError, match="power_w"):
        share_power(np.ones((2, 2), dtype=complex), power_w)


# --- SINR ---------------------------------------------------------------------------------------


def test_sinr_matches_a_symbol_level_simulation() -> None:
    """Symbols through the whole chain: weights, scattered channel, noise at each UAV antenna,
    combining. The wanted part is found by correlation; the rest is interference and noise."""
    rng = np.random.default_rng(12)
    users, antennas, symbols = 3, 4, 200_000
    uav = uniform_linear(antennas, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3))
    at_node, at_uav = in_plane(-20.0, 5.0, 30.0), in_plane(10.0, 0.0, -30.0)
    array = uniform_rectangular(
        2, columns=4, frequency_hz=30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3)
    )
    channels = draw(
        SalehValenzuela(rician_k_db=3.0),
        array,
        uav_array=uav,
        directions_at_node=at_node,
        directions_at_uav=at_uav,
        rng=rng,
    )
    weights = share_power(random_complex(rng, 8, users), 2.0)
    gains, noise = np.array([1.0, 0.3, 0.01]), 0.05
    s = (rng.choice([-1, 1], (2, users, symbols)) * np.array([[[1]], [[1j]]])).sum(0) / math.sqrt(2)

    b = steering.steering_matrix(uav, at_uav)
    found = sinr(combined_rows(channels, b) @ weights, gains, noise)
    for i in range(users):
        n = random_complex(rng, antennas, symbols) * math.sqrt(noise / 2)
        y = math.sqrt(gains[i]) * channels[i] @ weights @ s + n
        heard = b[:, i].conj() / math.sqrt(antennas) @ y
        part = np.mean(heard * s[i].conj())
        rest = np.mean(np.abs(heard - part * s[i]) ** 2)
        assert found[i] == pytest.approx(abs(part) ** 2 / rest, rel=0.03)


@settings(max_examples=examples(40))
@given(st.integers(0, 1000), st.lists(st.integers(0, 2), min_size=1, max_size=6))
def test_sinr_matches_direct_summation(seed: int, slots: list[int]) -> None:
    rng = np.random.default_rng(seed)
    users = len(slots)
    responses = random_complex(rng, users, users)
    gains = rng.uniform(0.1, 2.0, users)
    found = sinr(responses, gains, 0.3, np.array(slots))
    for i in range(users):
        rest = sum(
            gains[i] * abs(responses[i, j]) ** 2
            for j in range(users)
            if j != i and slots[j] == slots[i]
        )
        assert found[i] == pytest.approx(gains[i] * abs(responses[i, i]) ** 2 / (rest + 0.3))
    alone = sinr(responses, gains, 0.3, np.arange(users))
    together = sinr(responses, gains, 0.3)
    assert (together <= found + 1e-12).all()
    assert (found <= alone + 1e-12).all()


def test_batched_sinr_equals_individual_sinr() -> None:
    rng = np.random.default_rng(3)
    responses, gains = random_complex(rng, 5, 2, 3, 3), rng.uniform(0.1, 1, (5, 2, 3))
    found = sinr(responses, gains, 0.1, np.array([0, 1, 0]))
    assert found.shape == (5, 2, 3)
    for k in np.ndindex(5, 2):
        assert found[k] == pytest.approx(sinr(responses[k], gains[k], 0.1, np.array([0, 1, 0])))


def test_zero_forcing_in_line_of_sight_is_limited_by_noise_alone() -> None:
    """SINR = P g / noise times the gain |a^T f|^2 / |f|^2, to the last digits."""
    a = steering.steering_matrix(ARRAY, APART)
    f = precode(a, Precoder()).weights
    gains = free_space_gain(RANGES_M, ARRAY.wavelength_m)
    found = sinr(a.T @ share_power(f, 1.0), gains, BUDGET.noise_power_w)
    towards = 1 / np.sum(np.abs(f) ** 2, axis=0)  # a^T f = 1
    assert found == pytest.approx(gains * towards * 0.25 / BUDGET.noise_power_w, rel=1e-9)


def test_matched_uav_antennas_gain_exactly_their_number() -> None:
    sight = SalehValenzuela(rician_k_db=math.inf)
    weights = share_power(precode(steering.steering_matrix(ARRAY, APART), Precoder()).weights, 1.0)
    gains = free_space_gain(RANGES_M, ARRAY.wavelength_m)
    found = []
    for antennas in (1, 4):
        uav = uniform_linear(antennas, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3))
        at_uav = in_plane(0.0, 30.0, 80.0, -45.0)
        channels = draw(
            sight,
            ARRAY,
            uav_array=uav,
            directions_at_node=APART,
            directions_at_uav=at_uav,
            rng=np.random.default_rng(1),
        )
        rows = combined_rows(channels, steering.steering_matrix(uav, at_uav))
        found.append(sinr(rows @ weights, gains, BUDGET.noise_power_w))
    assert found[1] == pytest.approx(4 * found[0], rel=1e-9)


@pytest.mark.parametrize("depth_db", [3.0, 25.0])
def test_blockage_lowers_sinr_by_its_depth(depth_db: float) -> None:
    """Exactly so without interference; with interference alone the SINR does not change."""
    lost_db = Blockages(((1.0, 2.0),), depth_db).attenuation_db(np.array([0.5, 1.5]))
    gains = 10 ** (-lost_db / 10)[:, np.newaxis] * np.ones(2)
    clear, blocked = sinr(np.broadcast_to(np.eye(2, dtype=complex), (2, 2, 2)), gains, 0.1)
    assert 10 * np.log10(clear / blocked) == pytest.approx([depth_db] * 2)
    clear, blocked = sinr(np.ones((2, 2, 2), dtype=complex), gains, 1e-30)
    assert clear == pytest.approx(blocked)


def test_weak_interference_is_not_lost_to_rounding() -> None:
    responses = np.array([[1.0, 1e-12], [1e-12, 1.0]], dtype=complex)
    assert sinr(responses, np.ones(2), 1e-30) == pytest.approx([1e24] * 2, rel=1e-5)


@pytest.mark.parametrize(
    ("responses", "gains", "noise", "groups", "name"),
    [
        ((2, 3), 2, 0.1, None, "responses"),
        ((2, 2), 3, 0.1, None, "path_gains"),
        ((2, 2), 2, 0.0, None, "noise_power_w"),
        ((2, 2), 2, math.nan, None, "noise_power_w"),
        ((2, 2), 2, 0.1, 3, "groups"),
    ],
)
def test_mismatched_arguments_are_rejected(
    responses: tuple[int, int], gains: int, noise: float, groups: int | None, name: str
) -> None:
    slots = None if groups is None else np.zeros(groups, dtype=np.int64)
    with pytest.raises(ValueError, match=name):
        sinr(np.ones(responses, dtype=complex), np.ones(gains), noise, slots)


# --- spectral efficiency ------------------------------------------------------------------------


def test_spectral_efficiency_is_log2() -> None:
    assert spectral_efficiency(np.array([0.0, 1.0, 3.0, 1023.0])) == pytest.approx([0, 1, 2, 10])
    assert float(spectral_efficiency(1.0, slots=4)) == pytest.approx(0.25)
    assert float(spectral_efficiency(1e-18)) == pytest.approx(1e-18 / math.log(2), abs=0)


@given(st.floats(0, 1e12), st.floats(1.001, 10))
def test_spectral_efficiency_increases_with_sinr(ratio: float, factor: float) -> None:
    low, high = spectral_efficiency(np.array([ratio, ratio * factor + 1e-3]))
    assert 0 <= low < high


def test_invalid_sinr_or_slot_count_is_rejected() -> None:
    for ratio in (-0.1, math.nan):
        with pytest.raises(ValueError, match="SINR"):
            spectral_efficiency(np.array([1.0, ratio]))
    with pytest.raises(ValueError, match="slots"):
        spectral_efficiency(1.0, slots=0)


# --- displayed values ---------------------------------------------------------------------------


def sent(weights: ComplexArray, groups: IntArray | None = None) -> ComplexArray:
    return transmitted(weights, BUDGET.tx_power_w, groups)


@pytest.mark.parametrize("normalisation", Normalisation)
@pytest.mark.parametrize("groups", [None, np.array([0, 1, 0, 0])])
def test_sent_weights_are_the_delivered_matrix_up_to_scale(
    normalisation: Normalisation, groups: IntArray | None
) -> None:
    """Up to one factor per time slot; full power, or its share at the busiest element."""
    rng = np.random.default_rng(1)
    weights = random_complex(rng, 8, 4) * np.array([1.0, 2.0, 0.1, 5.0])
    if normalisation is Normalisation.ANTENNA:
        for slot in (0, 1):
            now = np.zeros(4) == slot if groups is None else groups == slot
            if now.any():
                busiest = np.sum(np.abs(weights[:, now]) ** 2, axis=1).max()
                weights[:, now] /= np.sqrt(busiest * 8)
    found = transmitted(weights, 3.0, groups, normalisation)
    for slot in (0, 1):
        now = np.zeros(4) == slot if groups is None else groups == slot
        if not now.any():
            continue
        ratio = found[:, now] / weights[:, now]
        assert ratio == pytest.approx(np.full(ratio.shape, ratio[0, 0]))
        power = np.abs(found[:, now]) ** 2
        if normalisation is Normalisation.ANTENNA:
            assert power.sum(axis=1).max() == pytest.approx(3.0 / 8)
        else:
            assert power.sum() == pytest.approx(3.0)


def test_single_uav_sinr_matches_hand_calculation() -> None:
    """30 dBm + 18.06 dB (64 elements) + 6.02 dB (4 antennas) - 101.99 dB + 89.98 dBm."""
    ahead, at = in_plane(0.0), np.array([100.0])
    f = steering.steering_matrix(ARRAY, ahead).conj() * 7.0  # any normalisation
    found = predicted_sinr_db(
        ARRAY, ahead, ranges_m=at, sent=sent(f), groups=None, budget=BUDGET, uav_antennas=4
    )
    assert found == pytest.approx([30 + 18.06 + 6.02 - 101.99 + 89.98], abs=0.05)


def test_predicted_sinr_matches_the_line_of_sight_channel() -> None:
    """The whole chain with a drawn channel, for weights that leave interference."""
    weights = steering.steering_matrix(ARRAY, APART).conj()
    groups = np.array([0, 1, 0, 0])
    uav = uniform_linear(4, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3))
    at_uav = in_plane(0.0, 30.0, 80.0, -45.0)
    sight = SalehValenzuela(rician_k_db=math.inf)
    channels = draw(
        sight,
        ARRAY,
        uav_array=uav,
        directions_at_node=APART,
        directions_at_uav=at_uav,
        rng=np.random.default_rng(1),
    )
    rows = combined_rows(channels, steering.steering_matrix(uav, at_uav))
    gains = free_space_gain(RANGES_M, ARRAY.wavelength_m)
    shared = sent(weights, groups)
    wanted = 10 * np.log10(sinr(rows @ shared, gains, BUDGET.noise_power_w, groups))
    found = predicted_sinr_db(
        ARRAY, APART, ranges_m=RANGES_M, sent=shared, groups=groups, budget=BUDGET, uav_antennas=4
    )
    assert found == pytest.approx(wanted, abs=1e-9)


def test_separate_time_slots_have_full_power_and_no_interference() -> None:
    close = in_plane(10.0, 10.5)
    weights = steering.steering_matrix(ARRAY, close).conj()
    at = np.array([100.0, 100.0])
    slots = np.array([0, 1])
    together = predicted_sinr_db(
        ARRAY, close, ranges_m=at, sent=sent(weights), groups=None, budget=BUDGET
    )
    apart = predicted_sinr_db(
        ARRAY, close, ranges_m=at, sent=sent(weights, slots), groups=slots, budget=BUDGET
    )
    alone = predicted_sinr_db(
        ARRAY, close[:1], ranges_m=at[:1], sent=sent(weights[:, :1]), groups=None, budget=BUDGET
    )
    assert apart == pytest.approx(np.repeat(alone, 2))
    assert (together < 5).all()
    assert (apart > 35).all()


def test_sinr_behind_the_elements_is_minus_infinity() -> None:
    array = uniform_linear(
        8,
        30e9,
        spacing_wavelengths=0.5,
        array_from_body=np.eye(3),
        element=Element(ElementPattern.COSINE),
    )
    seen = in_plane(0.0, 180.0)
    f = np.ones((8, 2), dtype=complex)
    found = predicted_sinr_db(
        array, seen, ranges_m=np.array([100.0, 100.0]), sent=sent(f), groups=None, budget=BUDGET
    )
    assert found[1] == -math.inf


def test_no_uavs_give_no_sinr_and_no_antennas_are_rejected() -> None:
    nothing = np.empty((64, 0), dtype=complex)
    assert (
        predicted_sinr_db(
            ARRAY, np.empty((0, 3)), ranges_m=np.empty(0), sent=nothing, groups=None, budget=BUDGET
        ).size
        == 0
    )
    with pytest.raises(ValueError, match="uav_antennas"):
        predicted_sinr_db(
            ARRAY,
            APART,
            ranges_m=RANGES_M,
            sent=nothing,
            groups=None,
            budget=BUDGET,
            uav_antennas=0,
        )


@settings(max_examples=examples(40))
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_least_sinr_holds_for_every_link_within_the_bounds(seed: int, slots: bool) -> None:
    """True directions and ranges anywhere in their bounds, against the combined worst case."""
    rng = np.random.default_rng(seed)
    bounds = rng.uniform(0.001, 0.03, 4)
    made = precode(steering.steering_matrix(ARRAY, APART), Precoder())
    groups = np.array([0, 1, 0, 1]) if slots else np.zeros(4, dtype=np.int64)
    gains_db = guaranteed_gains_db(ARRAY, APART, list(bounds), made.weights)
    known = [i for i, gain_db in enumerate(gains_db) if gain_db is not None]
    leaks = leakage_bounds(ARRAY, APART[known], list(bounds[known]), made.weights)
    linear = 10 ** (np.array([gains_db[i] for i in known], dtype=float) / 10)
    far_m = RANGES_M[known] + 5.0
    shared = sent(made.weights * rng.uniform(0.3, 3.0, 4), groups)  # columns of unequal powers
    powers_w = np.sum(np.abs(shared) ** 2, axis=0)
    least = least_sinr_db(
        linear,
        leaks=leaks,
        users=np.array(known),
        farthest_m=far_m,
        groups=groups,
        powers_w=powers_w,
        budget=BUDGET,
        wavelength_m=ARRAY.wavelength_m,
        uav_antennas=4,
    )
    for _ in range(20):
        aside = np.cross(APART, rng.standard_normal((4, 3)))
        aside /= np.linalg.norm(aside, axis=1)[:, np.newaxis]
        off = (bounds * rng.uniform(0, 1, 4))[:, np.newaxis]
        true = np.cos(off) * APART + np.sin(off) * aside
        at_m = RANGES_M + rng.uniform(-5, 5, 4)
        found = predicted_sinr_db(
            ARRAY, true, ranges_m=at_m, sent=shared, groups=groups, budget=BUDGET, uav_antennas=4
        )
        assert (found[known] >= least - 1e-9).all()


def test_least_sinr_equals_predicted_sinr_without_uncertainty() -> None:
    made = precode(steering.steering_matrix(ARRAY, APART), Precoder())
    gains_db = guaranteed_gains_db(ARRAY, APART, [0.0] * 4, made.weights)
    linear = 10 ** (np.array(gains_db, dtype=float) / 10)
    leaks = leakage_bounds(ARRAY, APART, [0.0] * 4, made.weights)
    everyone, together = np.arange(4), np.zeros(4, dtype=np.int64)
    powers_w = np.sum(np.abs(sent(made.weights)) ** 2, axis=0)
    least = least_sinr_db(
        linear,
        leaks=leaks,
        users=everyone,
        farthest_m=RANGES_M,
        groups=together,
        powers_w=powers_w,
        budget=BUDGET,
        wavelength_m=ARRAY.wavelength_m,
        uav_antennas=2,
    )
    same = predicted_sinr_db(
        ARRAY,
        APART,
        ranges_m=RANGES_M,
        sent=sent(made.weights),
        groups=together,
        budget=BUDGET,
        uav_antennas=2,
    )
    assert least == pytest.approx(same, abs=1e-6)


def test_least_sinr_counts_only_uavs_of_the_same_time_slot() -> None:
    """Three UAVs, the last in its own time slot, against direct sums."""
    gains, leaks = np.array([40.0, 50.0]), np.array([[9.0, 3.0, 8.0], [7.0, 6.0, 9.0]])
    groups, users, at = np.array([0, 0, 1]), np.array([1, 2]), np.array([900.0, 500.0])
    powers_w = np.array([0.3, 0.7, 0.9])
    found = least_sinr_db(
        gains,
        leaks=leaks,
        users=users,
        farthest_m=at,
        groups=groups,
        powers_w=powers_w,
        budget=BUDGET,
        wavelength_m=0.01,
        uav_antennas=2,
    )
    path = 2 * free_space_gain(at, 0.01)
    noise_w = BUDGET.noise_power_w
    shared = path[0] * 40.0 * 0.7 / (path[0] * 9.0 * 0.3 + noise_w)
    alone = path[1] * 50.0 * 0.9 / noise_w
    assert found == pytest.approx(10 * np.log10([shared, alone]))
