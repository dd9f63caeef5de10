"""Predicted directions against explicit positions and rotations."""

import numpy as np
import pytest
import tracks
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support import examples

from companion.beams import line_of_sight
from companion.beams.array.geometry import uniform_linear
from companion.values import Carrier, FloatArray, Track


def flying(rng: np.random.Generator, acceleration: FloatArray | None) -> Track:
    place, velocity = rng.uniform(-300, 300, 3), rng.normal(0, 20, 3)
    return tracks.track(
        place,
        uav="a",
        valid_at_ns=9,
        velocity_ned_mps=velocity,
        acceleration_ned_mps2=acceleration,
        set_center_ned_m=place,
    )


@settings(max_examples=examples(50))
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_predicted_directions_match_predicted_positions(seed: int, accelerates: bool) -> None:
    """Velocities, acceleration, rotating body, lever arm and mount, computed for one time at a
    time."""
    rng = np.random.default_rng(seed)
    pose, mount = (m.as_matrix() for m in Rotation.random(2, rng=rng))
    lever, rates = rng.uniform(-3, 3, 3), rng.normal(0, 1, 3)
    array = uniform_linear(
        4, 30e9, spacing_wavelengths=0.5, array_from_body=mount, lever_arm_m=lever
    )
    here, own = rng.uniform(-50, 50, 3), rng.normal(0, 20, 3)
    at = Carrier(
        valid_at_ns=9,
        position_ned_m=here,
        velocity_ned_mps=own,
        body_from_local=pose,
        body_rates_radps=rates,
        bound_m=0.0,
        attitude_bound_rad=0.0,
        age_s=None,
    )
    track = flying(rng, rng.normal(0, 5, 3) if accelerates else None)
    times_s = np.array([0.0, 0.1, 1.0, 7.0])
    found = line_of_sight.directions_ahead(track, at, array, times_s)
    assert found is not None
    assert track.velocity_ned_mps is not None
    for t_s, direction in zip(times_s, found, strict=True):
        there = track.position_ned_m + track.velocity_ned_mps * t_s
        if track.acceleration_ned_mps2 is not None:
            there = there + track.acceleration_ned_mps2 * t_s**2 / 2
        body_from_local = Rotation.from_rotvec(rates * t_s).as_matrix().T @ pose
        eye = here + own * t_s + body_from_local.T @ lever
        seen = mount @ body_from_local @ (there - eye)
        assert direction == pytest.approx(seen / np.linalg.norm(seen), abs=1e-9)


def test_directions_through_the_array_stay_unit_vectors() -> None:
    """A UAV that passes through the array has no direction for one instant."""
    array = uniform_linear(4, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3))
    at = Carrier(
        valid_at_ns=9,
        position_ned_m=np.zeros(3),
        velocity_ned_mps=np.zeros(3),
        body_from_local=np.eye(3),
        body_rates_radps=np.zeros(3),
        bound_m=0.0,
        attitude_bound_rad=0.0,
        age_s=None,
    )
    place, velocity = np.array([0.0, 30.0, 0.0]), np.array([0.0, -10.0, 0.0])
    track = tracks.track(
        place, uav="a", valid_at_ns=9, velocity_ned_mps=velocity, set_center_ned_m=place
    )
    found = line_of_sight.directions_ahead(track, at, array, np.array([2.0, 3.0, 4.0]))
    assert found is not None
    assert found == pytest.approx(np.array([[0, 1, 0], [1, 0, 0], [0, -1, 0]]))


def test_no_directions_are_predicted_without_carrier_velocity() -> None:
    rng = np.random.default_rng(1)
    array = uniform_linear(4, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3))
    unknown = Carrier(
        valid_at_ns=9,
        position_ned_m=np.zeros(3),
        velocity_ned_mps=None,
        body_from_local=np.eye(3),
        body_rates_radps=np.zeros(3),
        bound_m=0.0,
        attitude_bound_rad=0.0,
        age_s=None,
    )
    assert line_of_sight.directions_ahead(flying(rng, None), unknown, array, np.zeros(1)) is None
