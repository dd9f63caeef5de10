"""The echo baseline: errors against a simulated receiver, losses in constructed cases."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.beams.array import steering
from companion.beams.array.elements import Element, ElementPattern
from companion.beams.array.geometry import (
    Array,
    uniform_circular,
    uniform_linear,
    uniform_rectangular,
)
from companion.beams.worth.link_budget import LinkBudget
from companion.studies.paper.probing import (
    EchoProbing,
    EchoState,
    alignment,
    direction_error_rad,
    echo_snr,
    started,
    step,
)
from companion.values import FloatArray

LINE = uniform_linear(64, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3))
PANEL = uniform_rectangular(
    8, columns=8, frequency_hz=30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3)
)
BUDGET = LinkBudget(tx_power_dbm=40.0, bandwidth_hz=50e6, noise_figure_db=7.0)
HALF_BEAM_RAD = math.radians(0.79)
NO_ECHO = np.array([0.0])


def in_plane(*radians: float) -> FloatArray:
    angles = np.array(radians)
    return np.stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))], axis=1)


def off_rad(a: FloatArray, b: FloatArray) -> FloatArray:
    """Angles between unit vectors, row by row."""
    sine = np.linalg.norm(np.cross(a, b), axis=1)
    angles: FloatArray = np.arctan2(sine, np.sum(a * b, axis=1))
    return angles


def flown(
    probing: EchoProbing,
    azimuths_rad: FloatArray,
    snr: FloatArray,
    array: Array = LINE,
    seed: int = 1,
) -> list[EchoState]:
    """One UAV along azimuths in the plane, with echo SNRs, starting from an aligned beam."""
    rng = np.random.default_rng(seed)
    state = started(in_plane(float(azimuths_rad[0])))
    states = []
    for azimuth, strength in zip(azimuths_rad, snr, strict=True):
        state = step(
            probing, array, state, directions=in_plane(azimuth), snr=np.array([strength]), rng=rng
        )
        states.append(state)
    return states


# --- the radar equation -------------------------------------------------------------------------


def test_echo_snr_matches_hand_computed_values() -> None:
    """Both ways: power density at the UAV, scattered power, power collected by the aperture."""
    probing = EchoProbing(cross_section_m2=0.05, dwell_s=1e-3)
    found = echo_snr(probing, BUDGET, LINE, directions=in_plane(0.0), ranges_m=np.array([200.0]))
    sphere = 4 * math.pi * 200.0**2
    scattered_w = 10.0 * 64 / sphere * 0.05
    collected_w = scattered_w / sphere * 64 * LINE.wavelength_m**2 / (4 * math.pi)
    energy_j, density = collected_w * 1e-3, BUDGET.noise_power_w / BUDGET.bandwidth_hz
    assert found == pytest.approx([energy_j / density])
    assert 10 * math.log10(found[0]) == pytest.approx(34.5, abs=1.0)


def test_echo_weakens_with_range_blockage_and_shared_power() -> None:
    """Range to the fourth; a blockage both ways; power shared among UAVs; the element pattern."""
    probing = EchoProbing()
    where, at = in_plane(0.0, 0.0), np.array([100.0, 200.0])
    near, far = echo_snr(probing, BUDGET, LINE, directions=where, ranges_m=at)
    assert near / far == pytest.approx(16.0)
    assert echo_snr(probing, BUDGET, LINE, directions=where[:1], ranges_m=at[:1]) == pytest.approx(
        [2 * near]
    )
    blocked = echo_snr(
        probing, BUDGET, LINE, directions=where, ranges_m=at, attenuation_db=np.array([25.0, 0.0])
    )
    assert blocked == pytest.approx([near * 1e-5, far])
    patch = uniform_linear(
        64,
        30e9,
        spacing_wavelengths=0.5,
        array_from_body=np.eye(3),
        element=Element(ElementPattern.COSINE),
    )
    seen = echo_snr(probing, BUDGET, patch, directions=in_plane(0.0, math.pi), ranges_m=at)
    assert seen == pytest.approx([near * 4.0**2, 0.0])  # 2 (q + 1) = 4, both ways
    with pytest.raises(ValueError, match="ranges_m"):
        echo_snr(probing, BUDGET, LINE, directions=where, ranges_m=np.array([100.0, 0.0]))


CIRCLE = uniform_circular(
    16,
    30e9,
    spacing_wavelengths=0.5,
    array_from_body=np.eye(3),
    element=Element(ElementPattern.COSINE),
)


@pytest.mark.parametrize("array", [LINE, PANEL, CIRCLE], ids=["line", "panel", "circle"])
def test_alignment_equals_the_gain_lost_by_mispointing(array: Array) -> None:
    rng = np.random.default_rng(2)
    pointed, true = (v / np.linalg.norm(v, axis=1)[:, None] for v in rng.normal(size=(2, 20, 3)))
    found = alignment(array, pointed, true)
    for n in range(20):
        a = steering.steering_matrix(array, true[n : n + 1])[:, 0]
        f = steering.steering_matrix(array, pointed[n : n + 1])[:, 0].conj()
        gain = abs(a @ f) ** 2 / np.sum(np.abs(f) ** 2)
        assert found[n] == pytest.approx(gain / np.sum(np.abs(a) ** 2))
    assert alignment(array, true, true) == pytest.approx(np.ones(20))
    assert (found <= 1).all()


def test_alignment_is_one_half_at_half_beamwidth() -> None:
    assert alignment(LINE, in_plane(0.0), in_plane(HALF_BEAM_RAD)) == pytest.approx([0.5], abs=0.01)
    patch = uniform_linear(
        8,
        30e9,
        spacing_wavelengths=0.5,
        array_from_body=np.eye(3),
        element=Element(ElementPattern.COSINE),
    )
    assert alignment(patch, in_plane(0.0), in_plane(math.pi)).tolist() == [0.0]


# --- the error of an echo -----------------------------------------------------------------------


@pytest.mark.parametrize("azimuth_rad", [0.0, 0.9, -1.3])
def test_linear_array_error_matches_the_published_bound(azimuth_rad: float) -> None:
    """6 / (SNR M (M^2 - 1)) in electrical angle, SNR at one element."""
    many, snr = 4000, 100.0
    true = np.tile(in_plane(azimuth_rad), (many, 1))
    errors = direction_error_rad(LINE, true, np.full(many, snr), np.random.default_rng(4))
    electrical = math.sqrt(6 / (snr / 64 * 64 * (64**2 - 1)))
    wanted = electrical / (math.pi * math.cos(azimuth_rad))
    assert errors[:, 2].std() == pytest.approx(wanted, rel=0.05)
    assert abs(errors[:, 2].mean()) < 4 * wanted / math.sqrt(many)
    # A linear array has no resolution along its axis, and its beams do not depend on it.
    assert errors[:, :2] == pytest.approx(np.zeros((many, 2)), abs=1e-12)


def test_direction_error_matches_maximum_likelihood() -> None:
    """Simulated maximum likelihood: the beamformer peak of the noisy snapshot."""
    line, true_sine, snr = (
        uniform_linear(16, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3)),
        0.3,
        400.0,
    )
    rng = np.random.default_rng(6)
    index = np.arange(16)
    signal = math.sqrt(snr / 16) * np.exp(1j * np.pi * index * true_sine)
    noise = (rng.standard_normal((600, 16)) + 1j * rng.standard_normal((600, 16))) / math.sqrt(2)
    sines = true_sine + np.linspace(-0.02, 0.02, 801)
    spectrum = np.abs((signal + noise) @ np.exp(-1j * np.pi * np.outer(index, sines))) ** 2
    measured = np.arcsin(sines[np.argmax(spectrum, axis=1)])
    true = np.tile(in_plane(math.asin(true_sine)), (4000, 1))
    drawn = direction_error_rad(line, true, np.full(4000, snr), rng)[:, 2]
    assert drawn.std() == pytest.approx(measured.std(), rel=0.1)


@pytest.mark.parametrize(
    "element", [Element(), Element(ElementPattern.TR38901)], ids=["same", "3gpp"]
)
def test_direction_error_matches_inverse_fisher_information(element: Element) -> None:
    """Fisher information by numerical derivatives of the snapshot, amplitude and phase unknown."""
    array = uniform_circular(
        12, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3), element=element
    )
    true = np.array([0.48, 0.64, 0.6])
    axes = np.array([[-0.8, 0.6, 0.0], [-0.36, -0.48, 0.8]])
    snr, h = 50.0, 1e-6
    weight = np.abs(steering.steering_matrix(array, true[np.newaxis])[:, 0])
    scale = math.sqrt(snr / np.sum(weight**2))

    def snapshot(x: FloatArray) -> FloatArray:
        """Map amplitude, phase and two angles to real and imaginary parts. Amplitudes carry no
        information about direction."""
        moved = true + x[2] * axes[0] + x[3] * axes[1]
        phase = array.wavenumber_radpm * array.elements_m @ moved
        made = (scale + x[0]) * weight * np.exp(1j * (phase + x[1]))
        return np.concatenate([made.real, made.imag])

    slopes = np.array([(snapshot(h * e) - snapshot(-h * e)) / (2 * h) for e in np.eye(4)])
    covariance = np.linalg.inv(2 * slopes @ slopes.T)[2:, 2:]
    many = 20_000
    rotations = direction_error_rad(
        array, np.tile(true, (many, 1)), np.full(many, snr), np.random.default_rng(1)
    )
    moved = np.cross(rotations, true) @ axes.T
    assert np.cov(moved.T) == pytest.approx(covariance, rel=0.05, abs=0.03 * covariance.max())
    assert rotations @ true == pytest.approx(np.zeros(many), abs=1e-12)


def test_zero_snr_adds_no_direction_error() -> None:
    true = in_plane(0.1, 0.2)
    found = direction_error_rad(PANEL, true, np.zeros(2), np.random.default_rng(1))
    assert found.tolist() == [[0.0] * 3] * 2


# --- tracking -----------------------------------------------------------------------------------


@pytest.mark.parametrize("array", [LINE, PANEL], ids=["line", "panel"])
def test_strong_echoes_point_the_beam_at_the_last_echo(array: Array) -> None:
    """The lag is one interval of motion plus the bound's error, and no more."""
    probing = EchoProbing(interval_s=0.01)
    azimuths = -0.5 + 0.3 * 0.01 * np.arange(200)  # 0.3 rad/s
    states = flown(probing, azimuths, np.full(200, 1e8), array)
    assert all(state.served.all() and state.heard.all() for state in states)
    behind = off_rad(np.concatenate([s.pointed for s in states]), in_plane(*azimuths))
    assert behind[0] == 0
    assert behind[1:] == pytest.approx(np.full(199, 0.003), abs=1e-4)


def test_rate_estimate_removes_the_tracking_lag() -> None:
    """The alpha-beta tracker has no lag at a constant rate and keeps the rate through a
    blockage; a beam without a rate is held."""
    azimuths = 0.3 * 0.01 * np.arange(320)
    snr = np.where(np.arange(320) < 300, 1e8, 0.0)
    held = EchoProbing(patience_intervals=50)
    rated = dataclasses.replace(held, position_gain=0.8, rate_gain=0.4)
    for probing, lag, drift in ((held, 0.003, 0.3 * 0.01 * 20), (rated, 0.0, 0.0)):
        states = flown(probing, azimuths, snr)
        assert off_rad(states[299].pointed, in_plane(azimuths[299])) == pytest.approx(
            [lag], abs=2e-4
        )
        # The last echo arrived at 299; now it is 319.
        assert off_rad(states[319].pointed, in_plane(azimuths[319])) == pytest.approx(
            [drift], abs=4e-3
        )


def test_echo_updates_the_estimate_by_the_tracker_gains() -> None:
    """alpha of the innovation, and beta of it per interval; all of it after a sweep."""
    probing = EchoProbing(
        interval_s=0.02, position_gain=0.6, rate_gain=0.3, patience_intervals=0, sweep_beams=1
    )
    rng = np.random.default_rng(1)
    state = step(
        probing,
        LINE,
        started(in_plane(0.5)),
        directions=in_plane(0.51),
        snr=np.array([1e12]),
        rng=rng,
    )
    assert state.pointed == pytest.approx(in_plane(0.5))
    assert state.estimate == pytest.approx(in_plane(0.506), abs=1e-6)
    assert state.turn_radps == pytest.approx(np.array([[0, 0, 0.3 * 0.01 / 0.02]]), abs=1e-4)
    state = step(probing, LINE, state, directions=in_plane(0.51), snr=NO_ECHO, rng=rng)
    state = step(probing, LINE, state, directions=in_plane(0.9), snr=np.array([1e12]), rng=rng)
    assert state.estimate == pytest.approx(in_plane(0.9), abs=1e-6)


def test_missing_echo_holds_the_beam() -> None:
    probing = EchoProbing(patience_intervals=30)
    azimuths = 0.05 * 0.01 * np.arange(40)
    states = flown(probing, azimuths, np.where(np.arange(40) < 10, 1e8, 0.0))
    for state in states[10:]:
        assert np.array_equal(state.pointed, states[9].estimate)
        assert state.served.all()
        assert not state.heard.any()
    assert [int(state.silent[0]) for state in states[8:12]] == [0, 0, 1, 2]


def test_tracking_resumes_while_the_uav_is_in_the_main_lobe() -> None:
    probing = EchoProbing(patience_intervals=30)
    azimuths = np.concatenate([np.zeros(10), np.full(20, 0.9 * HALF_BEAM_RAD)])
    states = flown(probing, azimuths, np.where((np.arange(30) < 10) | (np.arange(30) > 20), 1e6, 0))
    assert all(state.served.all() for state in states)
    assert states[21].heard.all()
    assert off_rad(states[22].pointed, in_plane(azimuths[22])) < 1e-3


def test_uav_outside_the_main_lobe_requires_a_sweep() -> None:
    probing = EchoProbing(interval_s=0.01, dwell_s=0.001, sweep_beams=64, patience_intervals=5)
    assert probing.sweep_intervals == 7
    azimuths = np.where(np.arange(40) < 10, 0.0, 0.2)  # seven beamwidths away
    clear = (np.arange(40) < 10) | (np.arange(40) >= 13)  # blocked for 3
    states = flown(probing, azimuths, np.where(clear, 1e6, 0.0))
    served = [bool(state.served[0]) for state in states]
    heard = [bool(state.heard[0]) for state in states]
    # 10 to 15: six intervals without echo, one above the limit; 16 to 22: the sweep.
    assert served == [True] * 16 + [False] * 7 + [True] * 17
    assert heard == [True] * 10 + [False] * 12 + [True] * 18
    assert off_rad(states[23].pointed, in_plane(0.2)) < 1e-3
    assert states[22].silent.tolist() == [0]


def test_sweeps_repeat_until_one_ends_with_an_echo() -> None:
    probing = EchoProbing(interval_s=0.01, dwell_s=0.001, sweep_beams=30, patience_intervals=2)
    states = flown(probing, np.zeros(30), np.where(np.arange(30) < 14, 0.0, 1e6))
    # No echo 0 to 2; sweeps 3-5, 6-8, 9-11, and 12-14, which ends without blockage.
    assert [bool(s.served[0]) for s in states] == [True] * 3 + [False] * 12 + [True] * 15
    assert [bool(s.heard[0]) for s in states] == [False] * 14 + [True] * 16


def test_lost_track_resets_the_rate() -> None:
    probing = EchoProbing(patience_intervals=1, rate_gain=0.5, position_gain=0.9, sweep_beams=20)
    azimuths = 0.003 * np.arange(60)
    snr = np.where((np.arange(60) < 20) | (np.arange(60) > 40), 1e8, 0.0)
    states = flown(probing, azimuths, snr)
    assert np.linalg.norm(states[19].turn_radps) == pytest.approx(0.3, rel=0.05)
    sweeping = [state for state in states if state.sweep_left[0] or not state.served[0]]
    assert len(sweeping) > 2
    assert all(not state.turn_radps.any() for state in sweeping)


def test_side_lobe_echo_counts_only_if_enabled() -> None:
    """The first side lobe of a linear array, 13.3 dB down at 1.43 null widths, with a strong
    echo."""
    side = math.asin(1.43 * 2 / 64)
    probing = EchoProbing(patience_intervals=100)
    any_lobe = dataclasses.replace(probing, lobe_db=math.inf)
    assert alignment(LINE, in_plane(0.0), in_plane(side))[0] == pytest.approx(0.047, abs=0.003)
    azimuths = np.array([0.0, side, side])
    assert not flown(probing, azimuths, np.full(3, 1e6))[1].heard[0]
    assert flown(any_lobe, azimuths, np.full(3, 1e6))[1].heard[0]


@pytest.mark.parametrize(("spare_db", "heard"), [(0.1, True), (-0.1, False)])
def test_mispointing_weakens_the_echo_below_detection(spare_db: float, heard: bool) -> None:
    probing = EchoProbing(detection_snr_db=13.0)
    there = in_plane(HALF_BEAM_RAD)
    lost_db = -10 * math.log10(float(alignment(LINE, in_plane(0.0), there)[0]))
    snr = np.array([10 ** ((13.0 + lost_db + spare_db) / 10)])
    state = step(
        probing,
        LINE,
        started(in_plane(0.0)),
        directions=there,
        snr=snr,
        rng=np.random.default_rng(1),
    )
    assert bool(state.heard[0]) is heard


@pytest.mark.parametrize(("spare_db", "heard"), [(0.1, True), (-0.1, False)])
def test_codebook_loss_weakens_the_sweep_echo(spare_db: float, heard: bool) -> None:
    probing = EchoProbing(patience_intervals=0, sweep_beams=1, sweep_loss_db=3.9)
    rng = np.random.default_rng(1)
    lost = step(
        probing, LINE, started(in_plane(0.0)), directions=in_plane(0.0), snr=NO_ECHO, rng=rng
    )
    assert lost.sweep_left.tolist() == [1]
    snr = np.array([10 ** ((13.0 + 3.9 + spare_db) / 10)])
    state = step(probing, LINE, lost, directions=in_plane(1.0), snr=snr, rng=rng)
    assert not state.served[0]
    assert bool(state.heard[0]) is heard


def test_mispointed_echo_has_a_larger_error() -> None:
    """The estimation error follows the echo strength left after mispointing."""
    probing = EchoProbing()
    many = 4000
    start, there = started(np.tile(in_plane(0.0), (many, 1))), in_plane(HALF_BEAM_RAD)
    state = step(
        probing,
        LINE,
        start,
        directions=np.tile(there, (many, 1)),
        snr=np.full(many, 1000.0),
        rng=np.random.default_rng(3),
    )
    left = float(alignment(LINE, in_plane(0.0), there)[0]) * 1000.0
    wanted = math.sqrt(6 / (left / 64 * 64 * (64**2 - 1))) / math.pi
    errors = np.arctan2(state.estimate[:, 1], state.estimate[:, 0]) - HALF_BEAM_RAD
    assert np.std(errors) == pytest.approx(wanted, rel=0.05)


@settings(max_examples=examples(25), deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.floats(0.1, 1))
def test_random_blockages_keep_the_tracker_state_valid(
    seed: int, rate_gain: float, gain: float
) -> None:
    """Random flights and blockages: unit vectors, tangential rates, sweeps of known duration."""
    probing = EchoProbing(
        patience_intervals=2, sweep_beams=25, rate_gain=rate_gain, position_gain=gain
    )
    rng = np.random.default_rng(seed)
    true = rng.normal(size=(3, 3))
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    state = started(true)
    for _ in range(40):
        true = true + 0.02 * rng.normal(size=(3, 3))
        true /= np.linalg.norm(true, axis=1, keepdims=True)
        before, snr = state, 10 ** rng.uniform(-1, 5, 3)
        state = step(probing, PANEL, state, directions=true, snr=snr, rng=rng)
        for vectors in (state.pointed, state.estimate):
            assert np.linalg.norm(vectors, axis=1) == pytest.approx(np.ones(3))
        assert np.abs(np.sum(state.turn_radps * state.estimate, axis=1)).max() < 1e-9
        assert np.array_equal(state.served, before.sweep_left == 0)
        assert (state.silent[state.heard] == 0).all()
        assert (state.sweep_left[state.heard] == 0).all()
        assert ((state.sweep_left >= 0) & (state.sweep_left <= 3)).all()
        assert (state.silent <= 2).all() or (state.sweep_left[state.silent > 2] > 0).all()


def test_uav_tracks_are_independent_and_seeded() -> None:
    probing = EchoProbing(patience_intervals=1)
    true = in_plane(-0.5, 0.1, 0.7)

    def run(snr_of_last: float, seed: int) -> EchoState:
        rng, state = np.random.default_rng(seed), started(true)
        for _ in range(5):
            state = step(
                probing,
                PANEL,
                state,
                directions=true,
                snr=np.array([100.0, 50.0, snr_of_last]),
                rng=rng,
            )
        return state

    first, again, other, alone = run(70.0, 1), run(70.0, 1), run(70.0, 2), run(0.0, 1)
    assert np.array_equal(first.estimate, again.estimate)
    assert not np.allclose(first.estimate, other.estimate, atol=1e-9)
    assert np.array_equal(first.estimate[:2], alone.estimate[:2])
    assert alone.sweep_left.tolist()[:2] == [0, 0]
    assert alone.sweep_left[2] > 0


def test_step_does_not_modify_its_arguments() -> None:
    state, true = started(in_plane(0.0, 0.1)), in_plane(0.01, 0.11)
    before = [np.copy(getattr(state, f.name)) for f in dataclasses.fields(state)]
    step(
        EchoProbing(),
        PANEL,
        state,
        directions=true,
        snr=np.array([1e6, 0.0]),
        rng=np.random.default_rng(1),
    )
    after = [getattr(state, f.name) for f in dataclasses.fields(state)]
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))
    assert np.array_equal(true, in_plane(0.01, 0.11))


@pytest.mark.parametrize(
    "bad",
    [
        {"interval_s": 0.0},
        {"interval_s": math.inf},
        {"dwell_s": 0.0},
        {"dwell_s": 0.02},
        {"cross_section_m2": 0.0},
        {"cross_section_m2": math.nan},
        {"detection_snr_db": math.nan},
        {"lobe_db": 0.0},
        {"sweep_loss_db": -1.0},
        {"patience_intervals": -1},
        {"sweep_beams": 0},
        {"position_gain": 0.0},
        {"position_gain": 1.1},
        {"rate_gain": -0.1},
        {"rate_gain": 2.0},
        {"rate_gain": math.nan},
    ],
)
def test_invalid_probing_settings_are_rejected(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        EchoProbing(**bad)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("beams", "dwell_s", "intervals"), [(1, 1e-3, 1), (10, 1e-3, 1), (11, 1e-3, 2), (64, 0.01, 64)]
)
def test_a_sweep_takes_whole_intervals(beams: int, dwell_s: float, intervals: int) -> None:
    assert EchoProbing(sweep_beams=beams, dwell_s=dwell_s).sweep_intervals == intervals
