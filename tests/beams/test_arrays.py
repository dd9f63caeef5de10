"""Element positions and beamwidths."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from companion.beams import arrays, steering

EYE = np.eye(3)


def test_elements_stand_along_y() -> None:
    array = arrays.uniform_linear(5, 3e9, 0.5, EYE)
    assert array.size == 5
    assert array.wavelength_m == pytest.approx(299_792_458 / 3e9)
    spacing_m = 0.5 * 299_792_458 / 3e9
    expected = [[0, m * spacing_m, 0] for m in range(5)]
    assert array.elements_m == pytest.approx(np.array(expected))
    assert array.array_from_body is EYE


@pytest.mark.parametrize(
    ("elements", "frequency_hz", "spacing"),
    [(0, 1e9, 0.5), (-1, 1e9, 0.5), (4, 0.0, 0.5), (4, -1e9, 0.5), (4, 1e9, 0.0), (4, 1e9, -0.5)],
)
def test_what_is_no_array_is_refused(elements: int, frequency_hz: float, spacing: float) -> None:
    with pytest.raises(ValueError, match="at least one element"):
        arrays.uniform_linear(elements, frequency_hz, spacing, EYE)


@pytest.mark.parametrize(("elements", "half_deg"), [(64, 0.79), (128, 0.40)])
def test_the_known_half_power_beamwidths(elements: int, half_deg: float) -> None:
    width_rad = arrays.half_power_beamwidth_rad(arrays.uniform_linear(elements, 30e9, 0.5, EYE))
    assert width_rad is not None
    assert round(math.degrees(width_rad) / 2, 2) == half_deg


@pytest.mark.parametrize(("elements", "spacing"), [(2, 0.5), (3, 0.5), (8, 0.7), (64, 0.5)])
def test_the_half_power_beamwidth_is_where_the_power_is_half(elements: int, spacing: float) -> None:
    array = arrays.uniform_linear(elements, 10e9, spacing, EYE)

    def excess(theta_rad: float) -> float:
        direction = np.array([[math.cos(theta_rad), math.sin(theta_rad), 0.0]])
        return float(abs(steering.steering_matrix(array, direction).sum() / elements) ** 2 - 0.5)

    first_null_rad = math.asin(1 / (elements * spacing))
    half_rad = brentq(excess, 0.0, first_null_rad)
    assert arrays.half_power_beamwidth_rad(array) == pytest.approx(2 * half_rad, rel=1e-9)


def test_no_beamwidth_where_there_is_no_beam() -> None:
    assert arrays.half_power_beamwidth_rad(arrays.uniform_linear(1, 1e9, 0.5, EYE)) is None
    # So close together that the power never falls to a half.
    assert arrays.half_power_beamwidth_rad(arrays.uniform_linear(2, 1e9, 0.1, EYE)) is None
