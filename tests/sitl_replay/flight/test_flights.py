"""Trajectories of each scenario: derivatives, limits, attitudes and encounters."""

import itertools
import math
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.values import FloatArray
from sitl_replay.flight import scenario
from sitl_replay.flight.attitudes import Banked, Leaning
from sitl_replay.flight.flights import SWING_RADPS, WIND_MPS, wind_course_rad
from sitl_replay.flight.motion import GRAVITY_MPS2, Flight, Path
from sitl_replay.flight.paths import Racetrack, Ramp, Swing, Tour
from sitl_replay.flight.scenario import BUILDERS, Vehicle

NEW = [name for name in BUILDERS if name not in ("paper", "hover")]
STEP_S = 1e-4


def sampled(uav: Vehicle, times_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Positions and velocities, one row per time."""
    motions = [uav.trajectory(float(t_s)) for t_s in times_s]
    return np.array([m[0] for m in motions]), np.array([m[1] for m in motions])


def path_of(uav: Vehicle) -> Path:
    assert isinstance(uav.trajectory, Flight)
    return uav.trajectory.path


@given(st.sampled_from(NEW), st.integers(0, 1000), st.integers(3, 40), st.floats(0.0, 7200.0))
@settings(max_examples=examples(150), deadline=None)
def test_velocity_acceleration_and_heading_rate_are_derivatives(
    name: str, seed: int, uavs: int, t_s: float
) -> None:
    uav = BUILDERS[name](uavs, seed).uavs[-1]
    (before, here, after) = (uav.trajectory(t_s + d) for d in (-STEP_S, 0.0, STEP_S))
    slope = (np.array(after[0]) - before[0]) / (2 * STEP_S)
    assert slope == pytest.approx(here[1], abs=1e-5)
    path = path_of(uav)
    points = [path(t_s + d) for d in (-STEP_S, 0.0, STEP_S)]
    for order in range(3):
        slope = (np.array(points[2][order]) - points[0][order]) / (2 * STEP_S)
        # The jerk is continuous, but its slope jumps at the start of a ramp: tolerate half a step.
        assert slope == pytest.approx(points[1][order + 1], abs=2e-3 if order == 2 else 1e-5)
    turned_rad = math.remainder(points[2].heading_rad - points[0].heading_rad, math.tau)
    assert turned_rad / (2 * STEP_S) == pytest.approx(points[1].heading_rate_radps, abs=1e-5)


@pytest.mark.parametrize(
    ("name", "speed_mps", "acceleration_mps2"),
    # The path's own limits, plus the gusts of a windy hour.
    [("waypoints", 12.5, 3.5), ("racetrack", 32.0, 7.0), ("crossing", 10.001, 2.5),
     ("mirror", 10.001, 2.5), ("swarm", 13.001, 2.85), ("adsb", 12.5, 3.5),
     ("shared-id", 8.001, 1.61)],
)  # fmt: skip
def test_speeds_and_accelerations_stay_within_limits(
    name: str, speed_mps: float, acceleration_mps2: float
) -> None:
    for uav in BUILDERS[name](12, seed=1).uavs:
        _, velocities = sampled(uav, np.arange(0.0, 150.0, 0.1))
        accelerations = np.diff(velocities, axis=0) / 0.1
        assert np.linalg.norm(velocities, axis=1).max() <= speed_mps
        assert np.linalg.norm(accelerations, axis=1).max() <= acceleration_mps2


@pytest.mark.parametrize("name", NEW)
def test_copter_tilt_and_plane_bank_stay_moderate(name: str) -> None:
    steepest_deg = 30.001 if name == "racetrack" else 20.0
    for uav in BUILDERS[name](8, seed=3).uavs:
        poses = np.array([uav.attitude(t_s) for t_s in np.arange(0.0, 150.0, 0.5)])
        assert np.degrees(np.abs(poses[:, :2])).max() <= steepest_deg
        assert np.degrees(np.abs(poses[:, :2])).max() >= 3.0
        assert np.abs(poses[:, 2]).max() <= math.pi


def test_copter_tilt_produces_its_acceleration() -> None:
    # The body's up axis by an explicit rotation matrix; the thrust acts along it.
    # Tours accelerate along the nose, orbits and swings across it.
    fleets = (scenario.waypoints(4, seed=2), scenario.crossing(4), scenario.swarm(4))
    for uav in (uav for fleet in fleets for uav in fleet.uavs):
        leaning = uav.attitude
        assert isinstance(leaning, Leaning)
        for t_s in np.arange(0.0, 100.0, 1.3):
            roll, pitch, yaw = leaning(t_s)[:3]
            up = -np.array(
                [
                    math.cos(yaw) * math.sin(pitch) * math.cos(roll)
                    + math.sin(yaw) * math.sin(roll),
                    math.sin(yaw) * math.sin(pitch) * math.cos(roll)
                    - math.cos(yaw) * math.sin(roll),
                    math.cos(pitch) * math.cos(roll),
                ]
            )
            thrust = np.array(leaning.path(t_s).acceleration_ned_mps2) - (0, 0, GRAVITY_MPS2)
            assert thrust / np.linalg.norm(thrust) == pytest.approx(up, abs=1e-9)


def tours() -> Iterator[Tour]:
    for uav in scenario.waypoints(20, seed=5).uavs:
        path = path_of(uav)
        assert isinstance(path, Tour)
        yield path


def test_tours_stop_at_every_waypoint_and_turn_there() -> None:
    for tour in tours():
        assert len(tour.legs) in (5, 6)
        ends_ned_m = [*(leg.start_ned_m for leg in tour.legs[1:]), tour.legs[0].start_ned_m]
        for leg, end_s, end_ned_m in zip(tour.legs, tour.ends_s, ends_ned_m, strict=True):
            for standing_s in (1e-6, 2.0, 3.999):
                now = tour(end_s - standing_s - tour.offset_s)
                assert now.position_ned_m == pytest.approx(end_ned_m, abs=1e-6)
                assert now.velocity_ned_mps == pytest.approx((0, 0, 0), abs=1e-9)
            flying = tour(end_s - 4.0 - leg.moving_s / 2 - tour.offset_s)
            course_rad = math.atan2(*flying.velocity_ned_mps[1::-1])
            assert math.remainder(flying.heading_rad - course_rad, math.tau) == pytest.approx(0)
            assert math.hypot(*flying.velocity_ned_mps) == pytest.approx(leg.speed_mps)


def test_heading_matches_the_next_leg_at_its_start() -> None:
    for tour in tours():
        for leg, after in itertools.pairwise((*tour.legs, tour.legs[0])):
            left_rad = leg.at(leg.duration_s).heading_rad - after.at(0.0).heading_rad
            assert math.remainder(left_rad, math.tau) == pytest.approx(0.0, abs=1e-9)
            assert abs(leg.turn_rad) <= math.pi


def test_tours_differ_per_seed() -> None:
    first, second = (path_of(scenario.waypoints(1, seed).uavs[0]) for seed in (1, 2))
    assert math.dist(first(0.0).position_ned_m, second(0.0).position_ned_m) > 1.0


def test_tours_reach_their_speed_or_acceleration_limits() -> None:
    for tour in tours():
        for leg in tour.legs:
            climb_mps = abs(leg.direction[2]) * leg.speed_mps
            full = leg.length_m == pytest.approx(leg.speed_mps * leg.ramp_s)
            assert leg.speed_mps <= 12.0 + 1e-9
            assert climb_mps <= 3.0 + 1e-9
            assert full or leg.speed_mps == pytest.approx(12.0) or climb_mps == pytest.approx(3.0)
            peak = max(
                math.hypot(*leg.at(t_s).acceleration_ned_mps2)
                for t_s in np.linspace(0.0, leg.moving_s, 400)
            )
            assert 2.9 < peak <= 3.0 + 1e-9


def test_ramp_is_smooth_at_both_ends() -> None:
    assert Ramp.at(0.0) == (0.0, 0.0, 0.0, 0.0)
    assert Ramp.at(1.0) == pytest.approx((0.5, 1.0, 0.0, 0.0))


def racetracks(seed: int) -> Iterator[tuple[Vehicle, Racetrack]]:
    for uav in scenario.racetrack(10, seed).uavs:
        path = path_of(uav)
        assert isinstance(path, Racetrack)
        yield uav, path


def test_racetracks_are_closed_stadiums_at_one_speed() -> None:
    for _, path in racetracks(1):
        times_s = np.linspace(-path.offset_s, path.lap_s - path.offset_s, 4001)
        points = [path(t_s) for t_s in times_s]
        positions = np.array([point.position_ned_m for point in points])
        assert positions[0] == pytest.approx(positions[-1], abs=1e-6)
        assert positions[:-1].mean(axis=0) == pytest.approx(path.centre_ned_m, abs=1e-6)
        # The polygon with this many corners is shorter than the lap by less than 1e-6.
        around_m = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
        assert around_m == pytest.approx(path.speed_mps * path.lap_s, rel=1e-6)
        speeds = [math.hypot(*point.velocity_ned_mps) for point in points]
        assert speeds == pytest.approx([path.speed_mps] * len(speeds))
        assert 20.0 <= path.speed_mps <= 30.0
        straight = [point.heading_rate_radps == 0.0 for point in points]
        share = 2 * path.straight_m / path.speed_mps / path.lap_s
        assert np.mean(straight) == pytest.approx(share, abs=0.002)


@pytest.mark.parametrize("seed", [1, 2])
def test_bank_angle_is_that_of_a_coordinated_turn_in_wind(seed: int) -> None:
    course_rad = wind_course_rad(seed)
    wind_mps = WIND_MPS * np.array([math.cos(course_rad), math.sin(course_rad)])
    for uav, path in racetracks(seed):
        for t_s in np.arange(0.0, path.lap_s, 0.9):
            pose = uav.attitude(t_s)
            air_mps = np.array(path(t_s).velocity_ned_mps[:2]) - wind_mps
            assert pose.yaw_rad == pytest.approx(math.atan2(air_mps[1], air_mps[0]))
            ahead, behind = (uav.attitude(t_s + d).yaw_rad for d in (1e-4, -1e-4))
            turn_radps = math.remainder(ahead - behind, math.tau) / 2e-4
            airspeed_mps = float(np.linalg.norm(air_mps))
            assert GRAVITY_MPS2 * math.tan(pose.roll_rad) == pytest.approx(
                airspeed_mps * turn_radps, abs=1e-3
            )
            assert math.degrees(pose.pitch_rad) == pytest.approx(3.0)


def test_bank_angle_without_wind_follows_speed_and_radius() -> None:
    for _, path in racetracks(1):
        turning_s = path.straight_m / path.speed_mps + path.turn_s / 2 - path.offset_s
        bank_rad = Banked(path, (0.0, 0.0), 0.0)(turning_s).roll_rad
        assert math.tan(bank_rad) == pytest.approx(
            path.speed_mps**2 / (path.radius_m * GRAVITY_MPS2)
        )


def pairs(name: str) -> Iterator[tuple[Vehicle, Vehicle]]:
    fleet = BUILDERS[name](20)
    yield from zip(fleet.uavs[::2], fleet.uavs[1::2], strict=True)


def direction(uav: Vehicle, t_s: float) -> FloatArray:
    position = np.array(uav.trajectory(t_s).position_ned_m)
    return position / np.linalg.norm(position)


def meetings_s(uav: Vehicle) -> FloatArray:
    """Times at which the swing is at its middle."""
    path = path_of(uav)
    assert isinstance(path, Swing)
    first_s = (-path.phase_rad % math.pi) / SWING_RADPS
    return first_s + math.pi / SWING_RADPS * np.arange(4)


MIRROR = np.array([-1.0, 1.0, 1.0])  # mirrored at the east-west line: north to south


@pytest.mark.parametrize(("name", "image"), [("crossing", np.ones(3)), ("mirror", MIRROR)])
def test_pairs_align_in_direction_and_separate_again(name: str, image: FloatArray) -> None:
    for near, far in pairs(name):
        for meeting_s in meetings_s(near):
            apart_rad = np.linalg.norm(
                direction(near, meeting_s) - image * direction(far, meeting_s)
            )
            assert apart_rad < 1e-9
            # Between encounters they are well separated, first on one side, then on the other.
            quarter_s = math.pi / SWING_RADPS / 2
            east = [
                direction(near, t_s)[1] - direction(far, t_s)[1]
                for t_s in (meeting_s - quarter_s, meeting_s + quarter_s)
            ]
            assert min(map(abs, east)) > 2 * math.sin(math.radians(1.0))
            assert east[0] * east[1] < 0.0


def test_crossing_pairs_have_different_ranges() -> None:
    for near, far in pairs("crossing"):
        ranges_m = [np.linalg.norm(uav.trajectory(0.0).position_ned_m) for uav in (near, far)]
        assert ranges_m[1] == pytest.approx(1.6 * ranges_m[0])


def test_mirrored_pairs_are_in_front_of_and_behind_the_array() -> None:
    for t_s in np.arange(0.0, 60.0, 2.0):
        for before, behind in pairs("mirror"):
            assert direction(before, t_s)[0] > 0.3
            assert direction(behind, t_s)[0] < -0.3


@pytest.mark.parametrize("name", ["crossing", "mirror"])
def test_odd_uav_count_is_supported(name: str) -> None:
    assert len(BUILDERS[name](5).uavs) == 5


@pytest.mark.parametrize("uavs", [100, 1000])
def test_swarm_is_spread_out_without_collisions(uavs: int) -> None:
    fleet = scenario.swarm(uavs, seed=4).uavs
    for t_s in (0.0, 33.3, 1234.5):
        positions = np.array([uav.trajectory(t_s).position_ned_m for uav in fleet])
        for index, position in enumerate(positions[:-1]):
            apart_m = np.linalg.norm(positions[index + 1 :] - position, axis=1)
            assert apart_m.min() >= 40.0 - 1e-6
        assert np.ptp(positions, axis=0) == pytest.approx([3000.0, 3000.0, 360.0], rel=0.1)
        assert np.linalg.norm(positions, axis=1).min() > 200.0


def test_swarm_layers_are_equally_filled() -> None:
    heights_m = [-uav.trajectory(0.0).position_ned_m[2] for uav in scenario.swarm(100).uavs]
    counts = {height: len(list(same)) for height, same in itertools.groupby(sorted(heights_m))}
    assert counts == {40.0 * layer: 10 for layer in range(1, 11)}
