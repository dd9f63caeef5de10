"""Rate loss of a wrong direction: against explicit sums, and required properties."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.beams.array.elements import Element, ElementPattern
from companion.pipeline import assembly
from companion.settings.model import Settings
from companion.studies.prediction import spectral

ARRAY = assembly.array(Settings())
WAVELENGTH_M = 299_792_458.0 / 30e9


def direction(azimuth_deg: float, elevation_deg: float = 0.0) -> np.ndarray:
    """NED unit vector, (1, 3)."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    level = math.cos(elevation)
    return np.array([[level * math.cos(azimuth), level * math.sin(azimuth), -math.sin(elevation)]])


@pytest.mark.parametrize("off_deg", [0.0, 0.3, 0.79, 1.0, 1.7, 5.0, 20.0])
@pytest.mark.parametrize("bearing_deg", [0.0, 77.0, -130.0])
def test_linear_array_loss_matches_its_array_factor(off_deg: float, bearing_deg: float) -> None:
    """64 elements half a wavelength apart: an explicit sum of phasors."""
    total = sum(
        complex(math.cos(x), math.sin(x))
        for x in (math.pi * m * math.sin(math.radians(off_deg)) for m in range(64))
    )
    expected = abs(total / 64) ** 2
    found = spectral.gains(
        ARRAY, 3.0 * direction(bearing_deg + off_deg), 70.0 * direction(bearing_deg)
    )
    assert found == pytest.approx([expected], abs=1e-9)
    snr = 10**1.5
    lost = spectral.loss_bps_hz(ARRAY, direction(bearing_deg + off_deg), direction(bearing_deg), 15)
    assert lost == pytest.approx(math.log2(1 + snr) - math.log2(1 + snr * expected), abs=1e-9)


def test_gain_is_one_half_at_half_beamwidth() -> None:
    assert spectral.gains(ARRAY, direction(0.79), direction(0)) == pytest.approx([0.5], abs=0.01)


def test_linear_array_ignores_errors_across_its_axis() -> None:
    assert spectral.gains(ARRAY, direction(20, 10), direction(20, -15)) == pytest.approx([1.0])


def test_array_frame_faces_the_uav_and_is_level() -> None:
    rng = np.random.default_rng(1)
    truly = rng.normal(size=(50, 3))
    truly /= np.linalg.norm(truly, axis=1, keepdims=True)
    turns = spectral.array_from_local(np.concatenate([truly, [[0.0, 0.0, 1.0]]]))
    for turn, true in zip(turns, [*truly, np.array([0.0, 0.0, 1.0])], strict=True):
        assert turn @ turn.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1.0)
        assert turn @ true == pytest.approx([1, 0, 0], abs=1e-12)
        assert turn[1, 2] == 0


@settings(deadline=None, max_examples=examples(50))
@given(st.floats(-180, 180), st.floats(-80, 80), st.floats(-30, 30), st.floats(-40, 40))
def test_pointing_error_never_increases_efficiency(
    azimuth: float, elevation: float, off: float, snr_db: float
) -> None:
    truly, towards = direction(azimuth, elevation), direction(azimuth + off, elevation)
    lost = spectral.loss_bps_hz(ARRAY, towards, truly, snr_db)
    assert 0 <= lost <= math.log2(1 + 10 ** (snr_db / 10))


def test_batched_gains_equal_single_gains() -> None:
    """More than one batch."""
    rng = np.random.default_rng(2)
    count = spectral.AT_ONCE // ARRAY.size + 7
    truly = rng.normal(size=(count, 3))
    towards = truly + 0.01 * rng.normal(size=(count, 3))
    rows = [0, 1, count // 2, count - 8, count - 7, count - 1]
    alone = [spectral.gains(ARRAY, towards[row, None], truly[row, None])[0] for row in rows]
    assert spectral.gains(ARRAY, towards, truly)[rows] == pytest.approx(alone, abs=1e-9)


def test_gain_is_zero_where_no_element_radiates() -> None:
    """Behind the array: no beam can be formed there."""
    ahead_only = replace(ARRAY, element=Element(ElementPattern.COSINE, 1.0))
    assert spectral.gains(ahead_only, direction(180), direction(0)) == pytest.approx([0.0])
    assert spectral.loss_bps_hz(ahead_only, direction(180), direction(0), 20) == pytest.approx(
        math.log2(101)
    )
