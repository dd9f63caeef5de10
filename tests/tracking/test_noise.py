"""Bounds on what a relayed aircraft's report may be off."""

import math

import numpy as np
import pytest

from companion.tracking.noise import ADSB_NOISE_M, ADSB_VELOCITY_NOISE_MPS, relayed


@pytest.mark.parametrize(
    ("velocity", "way_m"), [((30.0, -40.0, 0.0), 50.0), ((0.0, 0.0, 12.0), 12.0), (None, 90.0)]
)
def test_a_time_in_whole_seconds_is_worth_the_way_flown_in_one(
    velocity: tuple[float, ...] | None, way_m: float
) -> None:
    """At the speed that is reported, or at the greatest there is."""
    told = None if velocity is None else np.array(velocity)
    found = relayed(told, 0.0, speed_max_mps=90.0)
    assert found.horizontal_m == pytest.approx(ADSB_NOISE_M + way_m)
    assert found.vertical_m == pytest.approx(ADSB_NOISE_M + way_m)
    assert found.position_m == pytest.approx(math.sqrt(2) * (ADSB_NOISE_M + way_m))
    assert found.velocity_mps == ADSB_VELOCITY_NOISE_MPS


@pytest.mark.parametrize("age_s", [1.5, 10.0])
def test_an_altitude_of_another_time_is_worth_what_can_be_climbed_between(age_s: float) -> None:
    """In height, and in space; where it is on the map has nothing to do with it."""
    velocity = np.array([30.0, 40.0, 0.0])
    fresh, old = relayed(velocity, 0.0, 90.0), relayed(velocity, age_s, 90.0)
    assert old.horizontal_m == fresh.horizontal_m
    assert old.vertical_m == pytest.approx(fresh.vertical_m + 90.0 * age_s)
    assert old.position_m == pytest.approx(math.hypot(old.horizontal_m, old.vertical_m))
