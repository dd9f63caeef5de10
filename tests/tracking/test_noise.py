"""Error bounds on the reports of relayed aircraft."""

import math

import numpy as np
import pytest

from companion.tracking.noise import (
    ADSB_NOISE_M,
    ADSB_VELOCITY_NOISE_MPS,
    GEOID_M,
    QUANTISATION,
    relayed,
)
from companion.values import Accuracy, AltitudeDatum


@pytest.mark.parametrize(
    ("velocity", "way_m"), [((30.0, -40.0, 0.0), 50.0), ((0.0, 0.0, 12.0), 12.0), (None, 90.0)]
)
def test_one_second_time_resolution_adds_distance_flown(
    velocity: tuple[float, ...] | None, way_m: float
) -> None:
    """At the reported speed, or at the speed limit if none is reported."""
    told = None if velocity is None else np.array(velocity)
    found = relayed(told, 0.0, speed_max_mps=90.0)
    assert found.horizontal_m == pytest.approx(ADSB_NOISE_M + way_m)
    assert found.vertical_m == pytest.approx(ADSB_NOISE_M + way_m)
    assert found.position_m == pytest.approx(math.sqrt(2) * (ADSB_NOISE_M + way_m))
    assert found.velocity_mps == ADSB_VELOCITY_NOISE_MPS


@pytest.mark.parametrize("age_s", [1.5, 10.0])
def test_altitude_age_adds_possible_climb_to_the_bound(age_s: float) -> None:
    """Affects the vertical and the 3-D bound, not the horizontal one."""
    velocity = np.array([30.0, 40.0, 0.0])
    fresh, old = (
        relayed(velocity, 0.0, speed_max_mps=90.0),
        relayed(velocity, age_s, speed_max_mps=90.0),
    )
    assert old.horizontal_m == fresh.horizontal_m
    assert old.vertical_m == pytest.approx(fresh.vertical_m + 90.0 * age_s)
    assert old.position_m == pytest.approx(math.hypot(old.horizontal_m, old.vertical_m))


def test_stated_accuracy_replaces_the_default() -> None:
    """Field by field, times the configured factor; the geoid error is added unscaled."""
    still = np.zeros(3)
    told = Accuracy(horizontal_m=6.0, vertical_m=20.0, velocity_mps=0.5)
    found = relayed(
        still, 0.0, speed_max_mps=90.0, accuracy=told, datum=AltitudeDatum.GEOMETRIC, factor=3.0
    )
    assert found.horizontal_m == pytest.approx(18.0)
    assert found.vertical_m == pytest.approx(60.0 + GEOID_M)
    assert found.velocity_mps == pytest.approx(1.5)
    by_pressure = relayed(
        still, 0.0, speed_max_mps=90.0, accuracy=told, datum=AltitudeDatum.PRESSURE, factor=3.0
    )
    assert by_pressure.vertical_m == ADSB_NOISE_M
    partly = relayed(
        still,
        0.0,
        speed_max_mps=90.0,
        accuracy=Accuracy(velocity_mps=0.5),
        datum=AltitudeDatum.GEOMETRIC,
        factor=3.0,
    )
    assert (partly.horizontal_m, partly.vertical_m) == (ADSB_NOISE_M, ADSB_NOISE_M + GEOID_M)
    exact = relayed(
        still,
        0.0,
        speed_max_mps=90.0,
        accuracy=Accuracy(horizontal_m=0.0, vertical_m=0.0, velocity_mps=0.0),
        datum=AltitudeDatum.GEOMETRIC,
        factor=3.0,
    )
    assert (exact.horizontal_m, exact.velocity_mps) == (QUANTISATION, QUANTISATION)


def test_stated_accuracy_is_ignored_when_disabled() -> None:
    told = Accuracy(horizontal_m=6.0, vertical_m=20.0, velocity_mps=0.5, time_s=0.1)
    found = relayed(
        np.ones(3),
        0.0,
        speed_max_mps=90.0,
        accuracy=told,
        datum=AltitudeDatum.GEOMETRIC,
        factor=None,
    )
    assert found == relayed(
        np.ones(3), 0.0, speed_max_mps=90.0, accuracy=None, datum=AltitudeDatum.GEOMETRIC
    )


def test_geoid_conversion_error_adds_to_the_height_bound() -> None:
    still, told = np.zeros(3), Accuracy(horizontal_m=6.0, vertical_m=20.0, velocity_mps=0.5)
    found = relayed(
        still,
        0.0,
        speed_max_mps=90.0,
        accuracy=told,
        datum=AltitudeDatum.MSL,
        factor=3.0,
        geoid_error_m=4.0,
    )
    assert found.vertical_m == pytest.approx(60.0 + 4.0)
    unstated = relayed(
        still,
        0.0,
        speed_max_mps=90.0,
        accuracy=None,
        datum=AltitudeDatum.MSL,
        factor=3.0,
        geoid_error_m=4.0,
    )
    assert unstated.vertical_m == ADSB_NOISE_M + 4.0


def test_better_known_time_adds_less_distance() -> None:
    velocity = np.array([30.0, 40.0, 0.0])
    found = relayed(
        velocity,
        0.0,
        speed_max_mps=90.0,
        accuracy=Accuracy(horizontal_m=2.0, time_s=0.1),
        datum=None,
        factor=3.0,
    )
    assert found.horizontal_m == pytest.approx(6.0 + 5.0)
