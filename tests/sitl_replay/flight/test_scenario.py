"""Trajectories and attitudes: their derivatives, and the figures of the paper (MATH.md 8)."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from companion.values import Source
from sitl_replay.flight import scenario
from sitl_replay.flight.scenario import BUILDERS, Circle, Pose, Sway, Vehicle

STEP_S = 1e-5
TIMES_S = (0.0, 0.37, 3.1, 12.9, 61.3)
ALL = [
    pytest.param(vehicle, id=f"{name}-{vehicle.source}")
    for name, build in BUILDERS.items()
    for vehicle in build(6).vehicles
]


@pytest.mark.parametrize("vehicle", ALL)
@pytest.mark.parametrize("t_s", TIMES_S)
def test_velocity_is_the_derivative_of_position(vehicle: Vehicle, t_s: float) -> None:
    after = np.array(vehicle.trajectory(t_s + STEP_S).position_ned_m)
    before = np.array(vehicle.trajectory(t_s - STEP_S).position_ned_m)
    slope_mps = (after - before) / (2 * STEP_S)
    assert slope_mps == pytest.approx(vehicle.trajectory(t_s).velocity_ned_mps, abs=1e-4)


def rotation(pose: Pose) -> Rotation:
    """Rotation from body to NED."""
    return Rotation.from_euler("ZYX", [pose.yaw_rad, pose.pitch_rad, pose.roll_rad])


@pytest.mark.parametrize("vehicle", ALL)
@pytest.mark.parametrize("t_s", TIMES_S)
def test_body_rates_are_the_derivative_of_the_attitude(vehicle: Vehicle, t_s: float) -> None:
    # The rotation between two times, in the body frame, is what gyroscopes measure.
    before = rotation(vehicle.attitude(t_s - STEP_S))
    after = rotation(vehicle.attitude(t_s + STEP_S))
    measured_radps = (before.inv() * after).as_rotvec() / (2 * STEP_S)
    assert measured_radps == pytest.approx(vehicle.attitude(t_s)[3:], abs=1e-7)


def test_body_rates_are_correct_at_large_tilt() -> None:
    # At ±1° the cross terms are negligible: a large sway verifies the signs.
    sway = Sway(turn_rate_radps=0.4, amplitude_rad=0.8)
    for t_s in TIMES_S:
        turn = rotation(sway(t_s - STEP_S)).inv() * rotation(sway(t_s + STEP_S))
        assert turn.as_rotvec() / (2 * STEP_S) == pytest.approx(sway(t_s)[3:], abs=1e-6)


def test_carrier_hovers_facing_north_within_a_degree() -> None:
    carrier = scenario.paper().carrier
    poses = np.array([carrier.attitude(t_s)[:3] for t_s in np.arange(0.0, 120.0, 0.05)])
    assert np.abs(poses).max() <= math.radians(1.0)
    assert np.abs(poses).max(axis=0).min() > math.radians(0.3)
    assert carrier.trajectory(77.0) == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert str(carrier.source) == "5:1"


def test_paper_scenario_has_the_published_speeds_and_radii() -> None:
    calm = scenario.paper(gust=0.0)
    for vehicle, radius_m in zip(calm.uavs, (100, 150, 200, 250), strict=True):
        motions = [vehicle.trajectory(t_s) for t_s in np.arange(0.0, 13.0, 0.01)]
        ranges_m = np.array([math.hypot(*m.position_ned_m[:2]) for m in motions])
        speeds_mps = np.array([math.hypot(*m.velocity_ned_mps) for m in motions])
        assert np.abs(ranges_m - radius_m).max() < 1e-9
        assert np.abs(speeds_mps - radius_m / 2).max() < 1e-9
    assert math.hypot(*calm.uavs[3].trajectory(5.0).velocity_ned_mps) == pytest.approx(125.0)


def test_paper_scenario_velocity_matches_the_printed_formula() -> None:
    # MATH.md 8, with its gust term as a velocity; north first, a quarter turn apart.
    t_s = 2.3
    for index, vehicle in enumerate(scenario.paper().uavs):
        speed_mps, phase_rad = 0.5 * (100 + 50 * index), index * math.pi / 2
        slow, fast = 0.5 * t_s + phase_rad, 5.0 * t_s + phase_rad
        expected = (
            speed_mps * math.cos(slow) + speed_mps / 5 * math.cos(fast),
            -speed_mps * math.sin(slow) - speed_mps / 5 * math.sin(fast),
            0.0,
        )
        assert vehicle.trajectory(t_s).velocity_ned_mps == pytest.approx(expected)


def test_gusts_keep_circles_centred_on_the_carrier() -> None:
    circle = Circle(radius_m=100.0, rate_radps=0.5, phase_rad=0.0, height_m=0.0)
    period_s = math.tau / 0.5
    positions = [circle(t_s).position_ned_m for t_s in np.linspace(0, period_s, 1000, False)]
    assert np.mean(positions, axis=0) == pytest.approx((0, 0, 0), abs=1e-9)
    assert circle(3.0).position_ned_m == pytest.approx(circle(3.0 + period_s).position_ned_m)


def test_uavs_differ_in_height_and_report_interval() -> None:
    uavs = scenario.paper(8).uavs
    assert [-uav.trajectory(1.0).position_ned_m[2] for uav in uavs] == [0, 10, 20, 30] * 2
    assert [uav.report_interval_s for uav in uavs] == [0.10, 0.15, 0.20, 0.25] * 2


@pytest.mark.parametrize("name", BUILDERS)
def test_large_fleet_has_unique_ids_and_encodable_speeds(name: str) -> None:
    fleet = BUILDERS[name](scenario.MAX_UAVS)
    sources = {vehicle.source for vehicle in fleet.vehicles}
    names = {vehicle.name for vehicle in fleet.vehicles}
    assert len(fleet.vehicles) == len(names) == scenario.MAX_UAVS + 1 == 1001
    assert len(sources) == 1001 - (name == "shared-id")
    assert {source.sysid for source in sources} == set(range(1, 251))
    assert [source for source in sources if source.sysid == 5] == [scenario.CARRIER.source]
    assert {source.compid for source in sources} == {1, 2, 3, 4, 5}
    assert len({vehicle.uptime_ms for vehicle in fleet.vehicles}) == 1001
    for uav in fleet.uavs:
        assert math.hypot(*uav.trajectory(9.0).velocity_ned_mps) < 1.2 * 125.0 + 1e-6


def test_component_ids_extend_exhausted_system_ids() -> None:
    ids = [str(uav.source) for uav in scenario.swarm(1000).uavs]
    assert ids[:6] == ["1:1", "2:1", "3:1", "4:1", "6:1", "7:1"]
    assert ids[247:251] == ["249:1", "250:1", "1:2", "2:2"]
    assert ids[999] == "4:5"


@pytest.mark.parametrize("name", BUILDERS)
@pytest.mark.parametrize("uavs", [-1, 0, 1001])
def test_fleet_size_out_of_range_is_rejected(name: str, uavs: int) -> None:
    with pytest.raises(ValueError, match=r"allowed: .* to 1000"):
        BUILDERS[name](uavs)


@pytest.mark.parametrize(("name", "fewest"), [("adsb", 3), ("shared-id", 2)])
def test_too_few_uavs_for_a_scenario_are_rejected(name: str, fewest: int) -> None:
    with pytest.raises(ValueError, match=f"^{fewest - 1} UAVs; allowed: {fewest} to 1000$"):
        BUILDERS[name](fewest - 1)
    assert len(BUILDERS[name](fewest).uavs) == fewest


@pytest.mark.parametrize("name", sorted(set(BUILDERS) - {"hover"}))
def test_adding_a_uav_leaves_other_trajectories_unchanged(name: str) -> None:
    few, many = BUILDERS[name](5, seed=2), BUILDERS[name](6, seed=2)
    for one, same in zip(few.uavs, many.uavs[:5], strict=True):
        assert (one.name, one.trajectory(8.0)) == (same.name, same.trajectory(8.0))


SEEDED = ("waypoints", "racetrack", "swarm", "adsb")


@pytest.mark.parametrize("name", BUILDERS)
def test_random_scenarios_are_determined_by_the_seed(name: str) -> None:
    here, again, other = (
        [uav.trajectory(31.0) for uav in BUILDERS[name](4, seed).uavs] for seed in (1, 1, 2)
    )
    assert here == again
    assert (here != other) == (name in SEEDED)


def test_truth_is_looked_up_by_id() -> None:
    flight = scenario.adsb(4)
    (third,) = flight.truth("3:1", 12.0)
    assert (third,) == flight.truth(Source(3, 1), 12.0) == flight.truth("icao:F00006", 12.0)
    assert third == flight.uavs[2].trajectory(12.0)
    assert flight.truth("5:1", 12.0) == (((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),)
    assert len(flight.truth("icao:F00001", 12.0)) == 1
    assert flight.truth("77:1", 12.0) == ()


def test_two_uavs_share_one_id() -> None:
    flight = scenario.shared_id(4)
    assert [str(uav.source) for uav in flight.uavs] == ["1:1", "1:1", "2:1", "3:1"]
    for t_s in np.arange(0.0, 200.0, 1.7):
        one, two = flight.truth("1:1", t_s)
        assert 500.0 < math.dist(one.position_ned_m, two.position_ned_m) < 700.0


def test_hovering_uavs_are_spread_in_front_of_the_array() -> None:
    motions = [uav.trajectory(0.0).position_ned_m for uav in scenario.hover(5).uavs]
    azimuths_deg = [math.degrees(math.atan2(east, north)) for north, east, _ in motions]
    assert azimuths_deg == pytest.approx([-60, -30, 0, 30, 60])
    (alone,) = scenario.hover(1).uavs
    assert alone.trajectory(0.0).position_ned_m == pytest.approx((150.0, 0.0, 0.0))
