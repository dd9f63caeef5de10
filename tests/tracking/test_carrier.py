"""Attitudes and their prediction, against scipy rotations and integrated kinematics."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import tracks
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support import rounds

from companion.tracking import carrier
from companion.tracking.geodesy import LocalFrame
from companion.values import Attitude, Fix, FloatArray, Source

HELD = carrier.AttitudeBounds(0.02, 0.0)
ANGLES = st.floats(-math.pi, math.pi)
RATES = st.tuples(*[st.floats(-3.0, 3.0)] * 3)
S = 1_000_000_000


def oracle(roll_rad: float, pitch_rad: float, yaw_rad: float) -> FloatArray:
    """Return scipy's matrix from body to NED coordinates: intrinsic yaw, pitch, roll."""
    return Rotation.from_euler("ZYX", [yaw_rad, pitch_rad, roll_rad]).as_matrix().T


def proper(matrix: FloatArray) -> None:
    assert matrix @ matrix.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1.0)


@given(ANGLES, ANGLES, ANGLES)
def test_attitude_matrix_follows_the_mavlink_convention(
    roll: float, pitch: float, yaw: float
) -> None:
    turned = carrier.body_from_ned(roll, pitch, yaw)
    proper(turned)
    assert turned == pytest.approx(oracle(roll, pitch, yaw), abs=1e-12)


@pytest.mark.parametrize(
    ("angles_rad", "ned", "body"),
    [
        ((0, 0, math.pi / 2), (0, 1, 0), (1, 0, 0)),  # heading east: east is ahead
        ((0, math.pi / 6, 0), (0, 0, 1), (-0.5, 0, math.sqrt(0.75))),  # nose up: down is behind
        ((math.pi / 6, 0, 0), (0, 0, 1), (0, 0.5, math.sqrt(0.75))),  # right wing low
    ],
)
def test_attitude_signs(
    angles_rad: tuple[float, float, float], ned: tuple[int, int, int], body: tuple[float, ...]
) -> None:
    assert carrier.body_from_ned(*angles_rad) @ ned == pytest.approx(body, abs=1e-12)


def integrated(rates: FloatArray, interval_s: float) -> FloatArray:
    """Integrate dC/dt = -[rates]x C from C = 1 by Runge-Kutta."""
    x, y, z = rates
    slope = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turned, steps = np.eye(3), 400
    h = interval_s / steps
    for _ in range(steps):
        k1 = slope @ turned
        k2 = slope @ (turned + h / 2 * k1)
        k3 = slope @ (turned + h / 2 * k2)
        turned = turned + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope @ (turned + h * k3))
    return turned


@given(RATES, st.floats(-2.0, 2.0))
def test_constant_rates_match_integrated_kinematics(
    rates: tuple[float, float, float], interval_s: float
) -> None:
    later = carrier.later_body_from_body(np.array(rates), interval_s)
    proper(later)
    assert later == pytest.approx(integrated(np.array(rates), interval_s), abs=1e-7)


def test_positive_yaw_rate_turns_right() -> None:
    """Positive yaw rate is to the right: heading 0 becomes heading 0.3 rad."""
    later = carrier.later_body_from_body(np.array([0, 0, 0.6]), 0.5)
    assert later @ oracle(0, 0, 0) == pytest.approx(oracle(0, 0, 0.3), abs=1e-12)
    assert carrier.later_body_from_body(np.zeros(3), 5.0).tolist() == np.eye(3).tolist()


def test_fixed_station_is_level_and_faces_its_heading() -> None:
    local = LocalFrame(47.4, 8.5, 500.0)
    station = carrier.fixed(7, local, (48.0, 9.5, 100.0), math.radians(90.0))
    assert station.valid_at_ns == 7
    assert (station.bound_m, station.attitude_bound_rad, station.age_s) == (0.0, 0.0, None)
    assert station.velocity_ned_mps is not None
    assert station.velocity_ned_mps.tolist() == [0, 0, 0]
    assert station.body_rates_radps.tolist() == [0, 0, 0]
    assert station.position_ned_m == pytest.approx(local.position_ned_m(48.0, 9.5, 100.0))
    # Up, north and east of it: below, left, ahead.
    for place, body in (
        ((48.0, 9.5, 110.0), (0, 0, -10)),
        ((48.0001, 9.5, 100.0), (0, -11.12, 0)),
        ((48.0, 9.5001, 100.0), (7.46, 0, 0)),
    ):
        offset = local.position_ned_m(*place) - station.position_ned_m
        assert station.body_from_local @ offset == pytest.approx(body, abs=0.02)
    proper(station.body_from_local)


def test_carrier_attitude_is_predicted_to_the_time_of_use(fix: Callable[..., Fix]) -> None:
    """Its rates act for as long as its attitude is older than the track's time."""
    local = LocalFrame(47.4, 8.5, 500.0)
    far = (49.0, 12.0)
    track = tracks.track(
        np.array([1.0, 2, 3]),
        uav="5:1",
        valid_at_ns=12 * S,
        age_s=0.5,
        velocity_ned_mps=np.array([4.0, 5, 6]),
        bound_m=4.5,
        horizontal_bound_m=3.6,
        vertical_bound_m=2.7,
    )
    attitude = Attitude(
        t_ns=0,
        source=Source(5, 1),
        boot_ms=0,
        roll_rad=0.2,
        pitch_rad=-0.1,
        yaw_rad=1.0,
        rollspeed_radps=0.3,
        pitchspeed_radps=-0.2,
        yawspeed_radps=0.5,
    )
    newest = _at(fix, *far)
    found = carrier.moving(
        local,
        track,
        newest,
        attitude=attitude,
        since_ns=S + S // 4,
        doubt_s=0.0,
        bounds=HELD,
        contradicted=None,
    )
    rates = np.array([0.3, -0.2, 0.5])
    then = oracle(0.2, -0.1, 1.0) @ local.local_from_ned(*far).T
    assert found.body_from_local == pytest.approx(integrated(rates, 1.25) @ then, abs=1e-9)
    proper(found.body_from_local)
    assert (found.valid_at_ns, found.bound_m, found.age_s) == (12 * S, 4.5, 0.5)
    assert found.attitude_bound_rad == 0.02
    assert found.position_ned_m.tolist() == [1, 2, 3]
    assert found.velocity_ned_mps is not None
    assert found.velocity_ned_mps.tolist() == [4, 5, 6]
    assert found.body_rates_radps.tolist() == [0.3, -0.2, 0.5]
    silent = replace(track, velocity_ned_mps=None)
    unknown = carrier.moving(
        local,
        silent,
        newest,
        attitude=attitude,
        since_ns=S + S // 4,
        doubt_s=0.0,
        bounds=HELD,
        contradicted=None,
    )
    assert unknown.velocity_ned_mps is None


def _at(make: Callable[..., Fix], lat_deg: float, lon_deg: float) -> Fix:
    made = make(0, [0, 0, 0])
    return made._replace(report=made.report._replace(lat_deg=lat_deg, lon_deg=lon_deg))


@settings(max_examples=rounds(30, 300))
@given(
    rates=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    way=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    age_s=st.floats(-0.3, 2.0),
    doubt_s=st.floats(0.0, 0.4),
    late=st.floats(-1.0, 1.0),
    off_rad=st.floats(0.0, 0.1),
)
def test_attitude_bound_covers_every_rotation(
    *,
    rates: tuple[float, float, float],
    way: tuple[float, float, float],
    age_s: float,
    doubt_s: float,
    late: float,
    off_rad: float,
) -> None:
    """A body with growing rates about any axis, a clock error, and a wrong report."""
    most = 4.0
    push = np.array(way)
    push = push * most / max(1e-9, float(np.linalg.norm(push)))
    bounds = carrier.AttitudeBounds(off_rad, most)
    true_s = age_s + late * doubt_s
    steps = 100
    truth = Rotation.from_rotvec([off_rad, 0, 0])
    for n in range(steps):
        at_s = (n + 0.5) / steps * true_s
        truth = truth * Rotation.from_rotvec((np.array(rates) + push * at_s) * true_s / steps)
    carried = Rotation.from_rotvec(np.array(rates) * age_s)
    off = float((truth.inv() * carried).magnitude())
    assert off <= bounds.at(float(np.linalg.norm(rates)), age_s, doubt_s) + 1e-3


def test_attitude_bound_grows_quickly_without_new_attitudes() -> None:
    """A rotation at 60 degrees/s that ended just after the newest attitude, 1.4 s ago."""
    bounds = carrier.AttitudeBounds(math.radians(3.0), math.radians(270.0))
    assert math.degrees(bounds.at(math.radians(60.0), 1.4, 0.0)) > 84.0
    assert bounds.at(1.0, 100.0, 0.0) == math.pi


def turning(rate_degps: float) -> Attitude:
    rate = math.radians(rate_degps)
    return Attitude(
        t_ns=0,
        source=Source(5, 1),
        boot_ms=0,
        roll_rad=0.0,
        pitch_rad=0.0,
        yaw_rad=0.0,
        rollspeed_radps=rate,
        pitchspeed_radps=0.0,
        yawspeed_radps=0.0,
    )


def test_body_rates_refute_and_raise_the_angular_acceleration_limit() -> None:
    """From 0 to 54 degrees/s in 0.25 s, less 2 degrees/s of noise at each end."""
    turns = carrier.AngularAcceleration()
    assert turns.look(turning(0.0), 0, 180.0) is None
    refuted = turns.look(turning(54.0), 250_000_000, 180.0)
    assert refuted is not None
    assert refuted.setting == "center.turn_acceleration_max_degps2"
    assert refuted.proven == pytest.approx(50 / 0.251)
    assert refuted.raised_to == turns.limit_degps2(180.0, 250_000_000)
    assert refuted.raised_to == pytest.approx(1.5 * 50 / 0.251)
    later = turns.limit_degps2(180.0, 120_250_000_000)
    assert 180.0 < later < refuted.raised_to  # it decays


def test_possible_or_implausible_rates_do_not_raise_the_limit() -> None:
    turns = carrier.AngularAcceleration()
    rates = [0.0, 40.0, 0.0, 3000.0, 0.0]  # the third step is 16 times the possible one
    for at, rate in enumerate(rates):
        assert turns.look(turning(rate), at * 250_000_000, 180.0) is None
    assert turns.limit_degps2(180.0, 0) == 180.0
    assert turns.look(turning(90.0), 1_010_000_000, 180.0) is None  # 10 ms after the previous one


def test_contradiction_compares_angle_with_elapsed_time() -> None:
    """Two level attitudes without rates, 90 degrees apart within half a second."""
    before, after = (
        turning(0.0)._replace(t_ns=at_ns, yaw_rad=yaw_rad)
        for at_ns, yaw_rad in ((0, 0.0), (S // 2, math.pi / 2))
    )
    found = carrier.contradiction(before, after, 0.5, HELD)
    assert found is not None
    assert (found.apart_rad, found.apart_s) == pytest.approx((math.pi / 2, 0.5))
    assert found.at(0.25) == pytest.approx(0.75 * math.pi)


@given(st.tuples(ANGLES, ANGLES, ANGLES), st.tuples(*[st.floats(-0.2, 0.2)] * 3), RATES, RATES)
def test_every_contradiction_is_found(
    angles_rad: tuple[float, float, float],
    steps_rad: tuple[float, float, float],
    rates_before: tuple[float, float, float],
    rates_after: tuple[float, float, float],
) -> None:
    """Angles and rates that need no matrix never hide a rotation beyond the errors."""
    made = []
    for steps, rates in (((0.0, 0.0, 0.0), rates_before), (steps_rad, rates_after)):
        roll, pitch, yaw = (angle + step for angle, step in zip(angles_rad, steps, strict=True))
        x, y, z = rates
        one = turning(0.0)._replace(roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw)
        made.append(one._replace(rollspeed_radps=x, pitchspeed_radps=y, yawspeed_radps=z))
    before, after = made
    apart_s, bounds = 0.05, carrier.AttitudeBounds(0.1, 0.0)
    first, second = (oracle(one.roll_rad, one.pitch_rad, one.yaw_rad) for one in made)
    turned = [
        Rotation.from_rotvec(-apart_s * np.array(rates_before)).as_matrix() @ first @ second.T,
        Rotation.from_rotvec(apart_s * np.array(rates_after)).as_matrix() @ second @ first.T,
    ]
    apart_rad = max(Rotation.from_matrix(one).magnitude() for one in turned)
    found = carrier.contradiction(before, after, apart_s, bounds)
    if abs(apart_rad - 0.2) > 1e-9:
        assert (found is not None) == (apart_rad > 0.2)
