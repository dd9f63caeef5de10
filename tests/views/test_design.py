"""The observer design in the API."""

import numpy as np
import pytest

from companion.tracking.design import answers
from companion.values import Limits
from companion.views.design import Assumed, _row


def test_peak_error_uses_the_assumed_bounds() -> None:
    """Acceleration and position noise have different weights and are not interchangeable."""
    gain = np.array([[1.2], [0.8]])
    assumed = Assumed(
        limits=Limits(speed_max_mps=40.0, acceleration_max_mps2=8.0),
        position_noise_m=0.5,
        velocity_noise_mps=0.2,
    )
    bounds = answers.KinematicLimits(
        acceleration_mps2=8.0, position_noise_m=0.5, velocity_noise_mps=None
    )
    shown = _row(0.25, gain, assumed, None)["peak_gain"]
    assert shown == pytest.approx(answers.peak_error_m(0.25, gain, bounds))
    swapped = answers.KinematicLimits(
        acceleration_mps2=0.5, position_noise_m=8.0, velocity_noise_mps=None
    )
    assert shown < 0.9 * answers.peak_error_m(0.25, gain, swapped)
