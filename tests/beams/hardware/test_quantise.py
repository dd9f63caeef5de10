"""Device settings for weights, against exhaustive search, direct sums and closed forms."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples, rounds

from companion.beams.hardware.quantise import (
    EMPHASIS,
    MOVES,
    Quadrature,
    Resolution,
    SettableStates,
    quantise,
    stepped,
)
from companion.beams.weights.precoding import gain_db
from companion.values import ComplexArray, IntArray

KINDS: list[SettableStates] = [
    Resolution(2),
    Resolution(8),
    Resolution(7),
    stepped(64, 0.5, 15.5),
    stepped(16, 1.0, 6.0, off=True),
    Quadrature(7),
    Quadrature(31),
]
SEEDS = st.integers(0, 2**32 - 1)


def line(sines: list[float], elements: int = 64) -> ComplexArray:
    """Return the steering matrix of a half-wave line for directions given by their sines."""
    made: ComplexArray = np.exp(1j * np.pi * np.outer(np.arange(elements), sines))
    return made


def drawn(rng: np.random.Generator, elements: int) -> ComplexArray:
    """Return random weights with any phase and amplitudes that differ by tens of decibels."""
    amplitude = 10 ** rng.uniform(-1.5, 0.5, elements)
    made: ComplexArray = amplitude * np.exp(1j * rng.uniform(0, 2 * np.pi, elements))
    return made


def rounded(weights: ComplexArray, kind: SettableStates) -> ComplexArray:
    """Return the weights of plain rounding: strongest element at full gain, no search."""
    return kind.values(kind.nearest(weights / np.abs(weights).max()))


def cost(radiated: ComplexArray, weights: ComplexArray, towards: ComplexArray) -> float:
    """Return J over |f|^2 + sum of w_j |a_j^T f|^2, by least squares over beta on stacked
    residuals."""
    power = np.sum(np.abs(towards) ** 2, axis=0)
    rows = np.sqrt(EMPHASIS * len(weights) / power)[:, np.newaxis] * towards.T
    stack = np.vstack([np.eye(len(weights)), rows])
    wanted, sent = stack @ weights, stack @ radiated
    beta = np.linalg.lstsq(sent[:, np.newaxis], wanted, rcond=None)[0]
    left = wanted - beta * sent
    return float(np.vdot(left, left).real / np.vdot(wanted, wanted).real)


def loss_db(own: ComplexArray, wanted: ComplexArray, sent: ComplexArray) -> float:
    """Return the loss of array gain towards ``own``."""
    both = np.stack([wanted, sent], axis=1)
    gains = gain_db(np.stack([own, own], axis=1), both)
    return float(gains[0] - gains[1])


# --- settings -----------------------------------------------------------------------------------


def every_code(kind: SettableStates) -> IntArray:
    """Return all codes of a device, (n, 2)."""
    if isinstance(kind, Resolution):
        pairs = itertools.product(range(kind.phase_steps), range(len(kind.levels)))
    else:
        assert isinstance(kind, Quadrature)
        reach = range(-kind.peak, kind.peak + 1)
        pairs = itertools.product(reach, reach)
    return np.array(list(pairs))


@pytest.mark.parametrize("kind", KINDS)
def test_nearest_setting_matches_exhaustive_search(kind: SettableStates) -> None:
    """In I and Q, or in phase and gain separately."""
    rng = np.random.default_rng(3)
    wanted = np.sqrt(rng.uniform(0, 1, 300)) * np.exp(1j * rng.uniform(-4, 4, 300))
    everything = kind.values(every_code(kind))
    codes = kind.nearest(wanted)
    found = kind.values(codes)
    assert codes.shape == (300, 2)
    if isinstance(kind, Quadrature):
        least = np.abs(wanted[:, np.newaxis] - everything).min(axis=1)
        assert np.abs(wanted - found) == pytest.approx(least, abs=1e-12)
    else:
        levels = np.abs(everything)
        least = np.abs(np.abs(wanted)[:, np.newaxis] - levels).min(axis=1)
        assert np.abs(np.abs(wanted) - np.abs(found)) == pytest.approx(least, abs=1e-12)
        loud = everything[levels > 0]
        turns = np.abs(np.angle(wanted[:, np.newaxis] / loud)).min(axis=1)
        on = np.abs(found) > 0
        assert np.abs(np.angle(wanted[on] / found[on])) == pytest.approx(turns[on], abs=1e-9)
    assert {tuple(c) for c in codes.tolist()} <= {tuple(c) for c in every_code(kind).tolist()}


@pytest.mark.parametrize("kind", KINDS)
def test_neighbouring_codes_are_valid_and_include_the_code_itself(kind: SettableStates) -> None:
    everything = {tuple(c) for c in every_code(kind).tolist()}
    for code in kind.nearest(np.exp(1j * np.linspace(0, 6, 40)) * np.linspace(0, 1, 40)):
        near = {tuple(c) for c in kind.around(code[np.newaxis])[0].tolist()}
        assert tuple(code.tolist()) in near
        assert near <= everything
        loud = np.abs(kind.values(np.array(sorted(near))))
        assert loud.max() < 1 + 0.51 / getattr(kind, "peak", 1e9)


def test_gain_below_range_rounds_to_lowest_level_or_off() -> None:
    """6 dB down is 0.501; below half of that, off is nearer."""
    phase_only, clipped, with_off = (
        Resolution(4),
        stepped(4, 3.0, 6.0),
        stepped(4, 3.0, 6.0, off=True),
    )
    wanted = np.array([0.27, 0.23], dtype=complex)
    assert np.abs(phase_only.values(phase_only.nearest(wanted))).tolist() == [1, 1]
    assert np.abs(clipped.values(clipped.nearest(wanted))) == pytest.approx(
        [0.501, 0.501], abs=1e-3
    )
    assert np.abs(with_off.values(with_off.nearest(wanted))) == pytest.approx([0.501, 0], abs=1e-3)


def test_gain_levels_are_steps_below_full_gain() -> None:
    levels = stepped(64, 0.5, 31.0, off=True).levels
    assert len(levels) == 64
    assert levels[-1] == 0
    assert 20 * np.log10(levels[:-1]) == pytest.approx(-0.5 * np.arange(63))
    assert len(stepped(8, 0.1, 0.3).levels) == 4  # though 0.3 / 0.1 is below 3 in binary
    assert len(stepped(8, 2.0, 5.0).levels) == 3  # not beyond its range


@pytest.mark.parametrize(
    ("phases", "step_db", "range_db", "said"),
    [
        (1, None, 0.0, "1 phase steps"),
        (8, 0.0, 6.0, "gain steps of 0.0 dB"),
        (8, 7.0, 6.0, "over 6.0 dB"),
        (8, 1.0, np.inf, "over inf dB"),
        (8, np.nan, 6.0, "gain steps of nan"),
    ],
)
def test_invalid_resolution_is_rejected(
    phases: int, step_db: float | None, range_db: float, said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        stepped(phases, step_db, range_db)


@pytest.mark.parametrize("levels", [(), (0.5,), (1.0, 1.0), (1.0, 0.5, 0.7), (1.0, -0.1)])
def test_gain_levels_that_do_not_decrease_are_rejected(levels: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="must decrease"):
        Resolution(8, levels)


# --- search -------------------------------------------------------------------------------------


@settings(max_examples=examples(60), deadline=None)
@given(SEEDS, st.sampled_from(KINDS), st.integers(1, 20), st.integers(1, 3))
def test_search_is_no_worse_than_rounding_and_reports_its_cost(
    seed: int, kind: SettableStates, elements: int, directions: int
) -> None:
    rng = np.random.default_rng(seed)
    towards = line(list(rng.uniform(-1, 1, directions)), elements)
    weights = drawn(rng, elements)
    found = quantise(weights, kind, towards)
    assert found.weights == pytest.approx(kind.values(found.codes))
    paid = cost(found.weights, weights, towards)
    assert found.cost == pytest.approx(paid, abs=1e-12)
    assert paid <= cost(rounded(weights, kind), weights, towards) + 1e-12


@settings(max_examples=examples(60), deadline=None)
@given(SEEDS, st.sampled_from(KINDS), st.integers(1, 12))
def test_changing_one_element_does_not_lower_the_cost(
    seed: int, kind: SettableStates, elements: int
) -> None:
    """No neighbouring setting of a single element costs less, except those that lower full gain."""
    rng = np.random.default_rng(seed)
    towards = line(list(rng.uniform(-1, 1, 2)), elements)
    weights = drawn(rng, elements)
    found = quantise(weights, kind, towards)
    strongest = int(np.argmax(np.abs(weights)))
    for m in range(elements):
        for near in kind.around(found.codes[m : m + 1])[0]:
            other = found.codes.copy()
            other[m] = near
            sent = kind.values(other)
            weaker = np.abs(sent[strongest]) < np.abs(found.weights[strongest]) - 1e-12
            if not (m == strongest and weaker):
                assert cost(sent, weights, towards) > found.cost - 1e-9


class Counted(Resolution):
    """Settings that count the elements that the search moves."""

    moves = 0

    def around(self, codes: IntArray) -> IntArray:
        Counted.moves += 1
        return super().around(codes)


@pytest.mark.parametrize("elements", [300, 1000])
def test_search_moves_a_limited_number_of_elements(elements: int) -> None:
    Counted.moves, rng = 0, np.random.default_rng(1)
    weights, towards = drawn(rng, elements), line(list(rng.uniform(-1, 1, 6)), elements)
    kind = Counted(64, (1.0, 0.9, 0.8))
    found = quantise(weights, kind, towards)
    assert elements <= Counted.moves <= MOVES
    assert found.cost < cost(rounded(weights, kind), weights, towards)


def test_search_result_is_near_the_exhaustive_optimum() -> None:
    """Six elements of two bits: 4**5 distinct settings. Usually the result is the optimum."""
    rng = np.random.default_rng(11)
    kind = Resolution(4)
    every = np.array([(0, *rest) for rest in itertools.product(range(4), repeat=5)])
    every_sent = kind.values(np.stack([every, np.zeros_like(every)], axis=-1))
    excess = []
    for _ in range(rounds(10, 20)):
        towards = line(list(rng.uniform(-1, 1, 2)), 6)
        weights = drawn(rng, 6)
        best = min(cost(sent, weights, towards) for sent in every_sent)
        excess.append(quantise(weights, kind, towards).cost - best)
    assert min(excess) > -1e-12
    assert np.mean(np.array(excess) < 1e-9) >= 0.5
    assert np.mean(excess) < 0.02


@pytest.mark.parametrize(("bits", "table_db"), [(2, 0.89), (3, 0.22), (4, 0.054), (5, 0.014)])
def test_matched_beam_quantisation_loss_matches_theory(bits: int, table_db: float) -> None:
    """64 elements, docs/math.md golden values; at most the sinc of one step."""
    rng = np.random.default_rng(bits)
    losses = []
    for sine in rng.uniform(-1, 1, rounds(15, 60)):
        own = line([sine])
        sent = quantise(own[:, 0].conj(), Resolution(2**bits), own).weights
        losses.append(loss_db(own[:, 0], own[:, 0].conj(), sent))
    assert min(losses) > -1e-9
    assert np.mean(losses) < table_db + 0.05
    assert np.mean(losses) < -20 * np.log10(np.sinc(1 / 2**bits)) * 1.02


def test_six_bit_quantisation_loss_matches_theory() -> None:
    rng = np.random.default_rng(6)
    theory_db = -20 * np.log10(np.sinc(1 / 64))
    assert theory_db == pytest.approx(0.0035, abs=1e-4)
    losses = []
    for sine in rng.uniform(-1, 1, rounds(15, 60)):
        own = line([sine])
        sent = quantise(own[:, 0].conj(), Resolution(64), own).weights
        losses.append(loss_db(own[:, 0], own[:, 0].conj(), sent))
    assert 0 < np.mean(losses) < theory_db * 1.05


@pytest.mark.parametrize(
    ("kind", "deeper_db"),
    [
        (Resolution(8), 6.0),
        (Resolution(16), 8.0),
        (stepped(128, 0.5, 31.0, off=True), 10.0),
        (Quadrature(31), 8.0),
    ],
)
def test_search_gives_deeper_nulls_than_rounding(kind: SettableStates, deeper_db: float) -> None:
    """Zero forcing of two users; response at the other over that at the own, mean in dB."""
    rng = np.random.default_rng(5)
    plain, searched, lost = [], [], []
    for _ in range(rounds(8, 25)):
        sine = rng.uniform(-0.8, 0.6)
        towards = line([sine, sine + rng.uniform(0.05, 0.3)])
        weights = np.linalg.pinv(towards.T)[:, 0]
        found = quantise(weights, kind, towards).weights
        for sent, depths in ((rounded(weights, kind), plain), (found, searched)):
            own, other = np.abs(towards.T @ sent)
            depths.append(20 * np.log10(other / own))
        lost.append(loss_db(towards[:, 0], weights, found))
    assert np.mean(searched) < np.mean(plain) - deeper_db
    assert np.mean(lost) < 0.3


# --- channels, scale, order ---------------------------------------------------------------------


@settings(max_examples=examples(40), deadline=None)
@given(SEEDS, st.sampled_from(KINDS))
def test_common_weight_factor_does_not_change_codes(seed: int, kind: SettableStates) -> None:
    """Any level; a rotation by a whole phase step shifts only the codes."""
    rng = np.random.default_rng(seed)
    weights, towards = drawn(rng, 9), line([0.1, 0.4], 9)
    found = quantise(weights, kind, towards)
    assert np.array_equal(quantise(weights * 2.0**-40, kind, towards).codes, found.codes)
    turned = quantise(weights * np.exp(1j * kind.period_rad), kind, towards)
    assert turned.cost == pytest.approx(found.cost, rel=0.3, abs=1e-6)


@settings(max_examples=examples(40), deadline=None)
@given(SEEDS)
def test_quantisation_compensates_for_channels(seed: int) -> None:
    """Fine settings behind any channels radiate the wanted weights."""
    rng = np.random.default_rng(seed)
    weights = np.exp(1j * rng.uniform(0, 7, 12))
    channel = 10 ** rng.uniform(-0.2, 0.2, 12) * np.exp(1j * rng.uniform(0, 7, 12))
    kind = stepped(4096, 0.01, 20.0)
    found = quantise(weights, kind, None, channel)
    assert found.weights == pytest.approx(channel * kind.values(found.codes))
    assert found.cost < 1e-5
    beta = np.vdot(found.weights, weights) / np.vdot(found.weights, found.weights)
    assert np.abs(weights - beta * found.weights).max() < 3e-3


@settings(max_examples=examples(40), deadline=None)
@given(SEEDS, st.sampled_from(KINDS), st.integers(1, 20))
def test_strongest_element_is_set_to_full_gain(
    seed: int, kind: SettableStates, elements: int
) -> None:
    """The strongest element is the one whose setting must be largest behind its channel."""
    rng = np.random.default_rng(seed)
    weights = drawn(rng, elements)
    channel = 10 ** rng.uniform(-0.3, 0.3, elements)
    found = quantise(weights, kind, None, channel)
    strongest = int(np.argmax(np.abs(weights / channel)))
    full = np.abs(found.weights[strongest] / channel[strongest])
    assert full > 1 - 1 / getattr(kind, "peak", 1e9)


def test_zero_weight_switches_its_element_off() -> None:
    weights = np.array([1, 0, 1j, 0.3], dtype=complex)
    found = quantise(weights, stepped(4, 1.0, 20.0, off=True))
    assert np.abs(found.weights) == pytest.approx([1, 0, 1, 0.3], abs=0.02)


def test_direction_without_radiation_does_not_affect_codes() -> None:
    weights, seen = drawn(np.random.default_rng(2), 8), line([0.2, 0.5], 8)
    kind = Resolution(16)
    blind = np.insert(seen, 1, 0.0, axis=1)
    assert np.array_equal(quantise(weights, kind, blind).codes, quantise(weights, kind, seen).codes)


@pytest.mark.parametrize(
    ("weights", "towards", "channel", "said"),
    [
        (np.zeros(3, complex), None, None, "all weights are 0"),
        (np.empty(0, complex), None, None, "all weights are 0"),
        (np.array([1, np.nan], complex), None, None, "must be finite"),
        (np.ones(2, complex), None, np.array([1, 0], complex), "no channel may be 0"),
        (np.ones(2, complex), None, np.ones(3, complex), "both must be"),
        (np.ones((2, 2), complex), None, None, "both must be"),
        (np.ones(2, complex), np.ones((3, 1), complex), None, r"must be \(2, J\)"),
        (np.ones(2, complex), np.ones(2, complex), None, r"must be \(2, J\)"),
        (np.ones(2, complex), np.array([[1], [np.inf]], complex), None, "and finite"),
    ],
)
def test_invalid_weights_or_channels_are_not_quantised(
    weights: ComplexArray, towards: ComplexArray | None, channel: ComplexArray | None, said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        quantise(weights, Resolution(8), towards, channel)
