"""Gains of links: samples of a cone never claim more than what its guarantee allows."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.beams.array.coverage import EVERYWHERE
from companion.beams.array.geometry import uniform_linear, uniform_rectangular
from companion.beams.array.steering import unit_directions
from companion.beams.worth.link_budget import LinkBudget
from companion.pipeline.link_gains import GainMeter, Site, _frames, _samples
from companion.settings.beams import NeedSettings
from companion.values import Beam, BeamSet, Method, Normalisation

BUDGET = LinkBudget(tx_power_dbm=20.0, bandwidth_hz=50e6, noise_figure_db=7.0)
ARRAYS = (
    uniform_linear(16, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3)),
    uniform_rectangular(
        rows=4, columns=6, frequency_hz=30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3)
    ),
)


def beam(azimuth_rad: float, elevation_rad: float, bound_rad: float | None) -> Beam:
    return Beam(
        uav="1:1",
        azimuth_rad=azimuth_rad,
        elevation_rad=elevation_rad,
        range_m=100.0,
        azimuth_rate_radps=None,
        elevation_rate_radps=None,
        range_rate_mps=None,
        pointing_bound_rad=bound_rad,
        gain_db=10.0,
        loss_db=0.0,
        pointing_p95_rad=0.01,
    )


@given(
    which=st.integers(0, 1),
    azimuth_rad=st.floats(-1.2, 1.2),
    elevation_rad=st.floats(-1.2, 1.2),
    bound_rad=st.floats(0.001, 0.4),
    seed=st.integers(0, 99),
    spare_db=st.floats(-3, 3),
)
@settings(max_examples=examples(60))
def test_a_link_with_its_guarantee_is_never_called_short(
    *,
    which: int,
    azimuth_rad: float,
    elevation_rad: float,
    bound_rad: float,
    seed: int,
    spare_db: float,
) -> None:
    """And with too little gain towards its own direction it always is."""
    array = ARRAYS[which]
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=(array.size, 2)) + 1j * rng.normal(size=(array.size, 2))
    beams = (beam(0.1, 0.0, 0.01), beam(azimuth_rad, elevation_rad, bound_rad))
    beam_set = BeamSet(
        t_ns=0,
        valid_at_ns=0,
        beams=beams,
        weights=weights,
        method=Method.MATCHED,
        normalisation=Normalisation.STREAM,
        condition_number=1.0,
        left_out=(),
    )
    site = Site(array=array, coverage=EVERYWHERE, budget=BUDGET, uav_antennas=4)
    (gains,) = GainMeter(NeedSettings(needed_db=0.0), site).gains(beam_set, [1])
    if gains.guaranteed_db is not None and gains.guaranteed_db > -57.0:  # -60 is the least need
        enough = GainMeter(NeedSettings(needed_db=gains.guaranteed_db - abs(spare_db)), site)
        assert enough.is_short(beam_set, [1], [False]) == [False]
    never = GainMeter(NeedSettings(needed_db=10 * np.log10(array.size) + 0.1), site)
    assert never.is_short(beam_set, [1], [False]) == [True]


@given(
    azimuth_rad=st.floats(-3.1, 3.1), elevation_rad=st.floats(-1.57, 1.57), bound=st.floats(0, 3.1)
)
@settings(max_examples=examples(100))
def test_samples_lie_within_their_cone_and_on_its_edge(
    azimuth_rad: float, elevation_rad: float, bound: float
) -> None:
    units = unit_directions(np.array([azimuth_rad]), np.array([elevation_rad]))
    frames = _frames([beam(azimuth_rad, elevation_rad, bound)])
    samples = _samples(frames, np.array([bound]))[0]
    assert np.allclose(np.linalg.norm(samples, axis=1), 1.0)
    apart = np.arccos(np.clip(samples @ units[0], -1, 1))
    assert apart.max() <= bound + 1e-6
    assert np.sum(np.abs(apart - bound) < 1e-6) >= 8
