"""Noise that a link adds to reports."""

import numpy as np
import pytest

from companion.studies.prediction.noisy_frames import noise
from companion.studies.prediction.radio_link import RadioLink


@pytest.mark.parametrize(("noise_m", "noise_mps"), [(2.0, 0.0), (0.0, 0.5), (2.0, 0.5)])
def test_positions_and_velocities_have_their_own_noise(noise_m: float, noise_mps: float) -> None:
    link = RadioLink(name="noisy", noise_m=noise_m, noise_mps=noise_mps)
    found = noise(np.random.default_rng(1), 4000, link)
    assert found.position_ned_m.std() == pytest.approx(noise_m, rel=0.1)
    assert found.velocity_ned_mps.std() == pytest.approx(noise_mps, rel=0.1)
