"""A receiver's measurements: errors within the stated bound, seeds, rates and times."""

import math
import random
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support import examples

from companion.values import FloatArray, Observation, reason_invalid
from sitl_replay.flight import scenario
from sitl_replay.receiver.model import (
    OUTLIER_REACH_RAD,
    Measured,
    ReceiverModel,
    measurements,
    rotation,
    within,
)

FLIGHT = scenario.paper(4)
ANGLES = st.tuples(*[st.floats(-3.0, 3.0)] * 3)
EXACT = ReceiverModel(bound_rad=1e-9, latency_s=0.0)
EPOCH_NS = 1_760_000_000_000_000_000


def measured(model: ReceiverModel, seconds: float = 2.0, **other: Any) -> list[Measured]:
    return list(measurements(FLIGHT, model, epoch_ns=EPOCH_NS, duration_s=seconds, **other))


def direction(observation: Observation) -> FloatArray:
    """Return the unit vector of a direction in the array's frame, by the conventions."""
    assert observation.azimuth_rad is not None
    assert observation.elevation_rad is not None
    level = math.cos(observation.elevation_rad)
    return np.array(
        [
            level * math.cos(observation.azimuth_rad),
            level * math.sin(observation.azimuth_rad),
            -math.sin(observation.elevation_rad),
        ]
    )


def apart_rad(a: FloatArray, b: FloatArray) -> float:
    return math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b))


def time_s(one: Measured) -> float:
    return (one.observation.measured_ns - EPOCH_NS) * 1e-9


@settings(max_examples=examples(60), deadline=None)
@given(
    mount=ANGLES,
    error=ANGLES,
    bound_deg=st.floats(0.01, 30.0),
    bias=st.floats(0.0, 1.0),
    outliers=st.floats(0.0, 1.0),
    seed=st.integers(0, 1000),
)
def test_error_is_within_the_bound_except_for_outliers(
    *,
    mount: tuple[float, float, float],
    error: tuple[float, float, float],
    bound_deg: float,
    bias: float,
    outliers: float,
    seed: int,
) -> None:
    """The truth is that of the mounted array, by scipy from the vehicles' motion."""
    bound_rad = math.radians(bound_deg)
    model = ReceiverModel(
        mount_rad=mount,
        mount_error_rad=error,
        bound_rad=bound_rad,
        bias_rad=bias * bound_rad,
        outliers=outliers,
        latency_s=0.1,
    )
    mounted = Rotation.from_euler("ZYX", mount[::-1]) * Rotation.from_euler("ZYX", error[::-1])
    for one in measured(model, 1.0, seed=seed):
        t_s = time_s(one)
        pose = FLIGHT.carrier.attitude(t_s)
        body = Rotation.from_euler("ZYX", [pose.yaw_rad, pose.pitch_rad, pose.roll_rad])
        (motion,) = FLIGHT.truth(one.measured, t_s)
        seen = (body * mounted).inv().apply(motion.position_ned_m)
        truth = seen / np.linalg.norm(seen)
        assert truth == pytest.approx(one.truth, abs=1e-5)  # times are floats of 1e-7 s
        assert one.observation.bound_rad == bound_rad
        reach_rad = OUTLIER_REACH_RAD if one.is_outlier else bound_rad
        assert apart_rad(direction(one.observation), one.truth) <= reach_rad + 1e-12
        assert reason_invalid(one.observation) is None
        assert one.observation.uav == one.measured


def test_azimuth_is_positive_to_the_right_and_elevation_above() -> None:
    """1:1 hovers north-west of the carrier, 4:1 north-east and above, which faces north."""
    flight = scenario.hover(4)
    first = {one.measured: one for one in measurements(flight, EXACT, duration_s=0.3)}
    assert math.degrees(first["1:1"].observation.azimuth_rad or 0) == pytest.approx(-60, abs=2.5)
    assert math.degrees(first["4:1"].observation.azimuth_rad or 0) == pytest.approx(60, abs=2.5)
    above_deg = math.degrees(math.asin(30.0 / math.hypot(225.0, 30.0)))
    elevation_deg = math.degrees(first["4:1"].observation.elevation_rad or 0)
    assert elevation_deg == pytest.approx(above_deg, abs=1.5)


def test_directions_are_those_from_a_carrier_that_is_elsewhere() -> None:
    """A carrier 300 m north of its usual place has the UAVs of the north behind it."""
    usual = scenario.hover(4)
    away = replace(usual.carrier, trajectory=scenario.Hover((300.0, 0.0, 0.0)))
    for one in measurements(replace(usual, carrier=away), EXACT, duration_s=0.3):
        assert abs(one.observation.azimuth_rad or 0) > math.pi / 2


def test_mount_error_turns_the_array_but_not_what_the_settings_say() -> None:
    """An array that is yawed to the right sees everything further to the left."""
    straight = measured(EXACT)
    turned = measured(replace(EXACT, mount_error_rad=(0.0, 0.0, 0.1)))
    for a, b in zip(straight, turned, strict=True):
        yawed = (b.observation.azimuth_rad or 0) - (a.observation.azimuth_rad or 0)
        assert math.remainder(yawed + 0.1, math.tau) == pytest.approx(0.0, abs=1e-6)
        assert b.observation.elevation_rad == pytest.approx(a.observation.elevation_rad, abs=1e-6)
    both = rotation(0.0, 0.2, 0.0) @ rotation(0.0, 0.0, 0.3)
    assert both == pytest.approx(rotation(0.0, 0.2, 0.3), abs=1e-12)


def test_errors_fill_their_range() -> None:
    bound_rad = math.radians(2.0)
    whole = measured(ReceiverModel(bound_rad=bound_rad), 30.0)
    errors = [apart_rad(direction(one.observation), one.truth) for one in whole]
    assert max(errors) > 0.98 * bound_rad
    # Uniform over the solid angle: a quarter within half the angle.
    assert np.mean(np.array(errors) < bound_rad / 2) == pytest.approx(0.25, abs=0.04)
    biased = measured(ReceiverModel(bound_rad=bound_rad, bias_rad=bound_rad), 30.0)
    errors = [apart_rad(direction(one.observation), one.truth) for one in biased]
    assert max(errors) > 0.9 * bound_rad
    # Constant: one rotation takes the truth of all UAVs to what is measured.
    found, _ = Rotation.align_vectors(
        [direction(one.observation) for one in biased], [one.truth for one in biased]
    )
    assert found.magnitude() == pytest.approx(bound_rad, rel=1e-3)
    assert all(
        apart_rad(found.apply(one.truth), direction(one.observation)) < 1e-6 for one in biased
    )


def test_outliers_are_anywhere_within_60_degrees() -> None:
    wrong = [one for one in measured(ReceiverModel(outliers=1.0), 30.0) if one.is_outlier]
    off = [apart_rad(direction(one.observation), one.truth) for one in wrong]
    assert len(wrong) == len(measured(ReceiverModel(), 30.0))
    assert 0.9 * OUTLIER_REACH_RAD < max(off) <= OUTLIER_REACH_RAD
    assert np.mean(off) > 0.5 * OUTLIER_REACH_RAD


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_shares_of_wrong_and_lost_measurements(share: float) -> None:
    full = measured(ReceiverModel(), 60.0)
    outliers = measured(ReceiverModel(outliers=share), 60.0)
    assert np.mean([one.is_outlier for one in outliers]) == pytest.approx(share, abs=0.03)
    swapped = measured(ReceiverModel(swapped=share), 60.0)
    wrong = [one for one in swapped if one.observation.uav != one.measured]
    assert len(wrong) / len(full) == pytest.approx(share, abs=0.03)
    names = {vehicle.name for vehicle in FLIGHT.uavs}
    assert {one.observation.uav for one in swapped} <= names
    if share:
        pairs = Counter((one.measured, one.observation.uav) for one in wrong)
        assert len(pairs) == 12
    kept = measured(ReceiverModel(lost=share), 60.0)
    assert len(kept) / len(full) == pytest.approx(1.0 - share, abs=0.03)


def test_errors_do_not_depend_on_each_others_shares() -> None:
    """Runs with other shares have the same noise, so that they can be compared."""
    plain = measured(ReceiverModel(), 5.0)
    other = measured(ReceiverModel(outliers=0.3, swapped=0.3), 5.0)
    for a, b in zip(plain, other, strict=True):
        assert (a.t_s, a.measured) == (b.t_s, b.measured)
        if not b.is_outlier:
            assert a.observation.azimuth_rad == b.observation.azimuth_rad
    kept = measured(ReceiverModel(lost=0.5), 5.0)
    found = [one.observation for one in plain]
    assert all(one.observation in found for one in kept)


def test_same_seed_gives_the_same_measurements() -> None:
    model = ReceiverModel(outliers=0.1, swapped=0.1, lost=0.1, jitter_s=0.2, bias_rad=0.01)

    def sent(seed: int) -> list[tuple[float, Observation]]:
        return [(one.t_s, one.observation) for one in measured(model, 3.0, seed=seed)]

    assert sent(3) == sent(3)
    assert sent(3) != sent(4)


def test_another_uav_does_not_change_the_others() -> None:
    fewer = [
        (one.t_s, one.observation)
        for one in measurements(scenario.paper(3), ReceiverModel(), epoch_ns=EPOCH_NS, duration_s=2)
    ]
    more = measured(ReceiverModel(), 2.0)
    assert fewer == [(one.t_s, one.observation) for one in more if one.measured != "4:1"]


@pytest.mark.parametrize("rate_hz", [0.5, 10.0, 30.0, 1000.0])
def test_every_uav_is_measured_at_the_rate(rate_hz: float) -> None:
    seconds = 20.0 if rate_hz < 100 else 1.0
    found = measured(replace(EXACT, rate_hz=rate_hz), seconds)
    assert len(found) == pytest.approx(4 * seconds * rate_hz, abs=4)
    for uav in ("1:1", "4:1"):
        times_s = [time_s(one) for one in found if one.measured == uav]
        steps = [b - a for a, b in pairwise(times_s)]
        assert steps == pytest.approx([1.0 / rate_hz] * len(steps), abs=1.1e-3)


@settings(max_examples=examples(40), deadline=None)
@given(latency_s=st.floats(0.0, 0.5), jitter_s=st.floats(0.0, 0.5), seed=st.integers(0, 100))
def test_measurements_are_sent_in_order_after_latency_and_jitter(
    latency_s: float, jitter_s: float, seed: int
) -> None:
    model = replace(EXACT, latency_s=latency_s, jitter_s=jitter_s)
    found = measured(model, 2.0, seed=seed)
    sent_s = [one.t_s for one in found]
    assert sent_s == sorted(sent_s)
    assert all(t_s < 2.0 for t_s in sent_s)
    delays_s = [one.t_s - time_s(one) for one in found]
    assert all(latency_s - 1e-6 <= delay_s <= latency_s + jitter_s + 1e-6 for delay_s in delays_s)
    assert all(one.observation.t_ns == EPOCH_NS + round(one.t_s * 1e9) for one in found)
    if jitter_s > 0.1:
        assert max(delays_s) - min(delays_s) > 0.7 * jitter_s


def test_nothing_is_measured_in_silent_intervals() -> None:
    model = replace(EXACT, silent_s=((1.0, 0.5), (3.0, 1.0)))
    found, whole = measured(model, 5.0), measured(EXACT, 5.0)
    meant = [
        one.observation
        for one in whole
        if not (1.0 <= time_s(one) < 1.5 or 3.0 <= time_s(one) < 4.0)
    ]
    assert [one.observation for one in found] == meant
    assert len(meant) < len(whole)


@given(st.floats(0.0, math.pi), st.integers(0, 1000), ANGLES)
def test_random_directions_are_within_their_reach(
    reach_rad: float, seed: int, angles: tuple[float, float, float]
) -> None:
    direction = rotation(*angles)[0]
    found = within(random.Random(seed), direction, reach_rad)
    assert float(np.linalg.norm(found)) == pytest.approx(1.0, abs=1e-12)
    assert apart_rad(found, direction) <= reach_rad + 1e-12
