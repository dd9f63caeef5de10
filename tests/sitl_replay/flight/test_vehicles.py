"""The schedule, decoded by pymavlink's generated parser, against its scenario."""

import hashlib
import itertools
import math
import time
from collections import defaultdict
from typing import Any

import numpy as np
import pymap3d
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.mavlink.wire.decode import decode
from companion.values import Frame, Reason, Rejection, Report, Source
from sitl_replay.flight import scenario
from sitl_replay.flight.fleet import Airframe
from sitl_replay.flight.scenario import Scenario, Vehicle
from sitl_replay.flight.vehicles import JITTER_S, Transmission, schedule

EPOCH_NS = 1_760_000_000_000_000_000
DURATION_S = 5.0


# Scenarios in which every vehicle has its own id; the others follow below.
@pytest.fixture(scope="module", params=[name for name in scenario.BUILDERS if name != "shared-id"])
def flight(request: pytest.FixtureRequest) -> Scenario:
    return scenario.BUILDERS[request.param](5)


@pytest.fixture(scope="module")
def sent(flight: Scenario) -> list[Transmission]:
    return list(schedule(flight, seed=3, epoch_ns=EPOCH_NS, duration_s=DURATION_S))


@pytest.fixture(scope="module")
def messages(sent: list[Transmission]) -> dict[str, list[tuple[float, Vehicle, Any]]]:
    """By message: send time, sender, message decoded by pymavlink."""
    parser = dialect.MAVLink(None)
    decoded = defaultdict(list)
    for t_s, vehicle, raw in sent:
        (message,) = parser.parse_buffer(raw)
        decoded[message.get_type()].append((t_s, vehicle, message))
    return decoded


def sampled_s(vehicle: Vehicle, message: Any) -> float:
    """Scenario time of a message from its boot clock."""
    return float((message.time_boot_ms - vehicle.uptime_ms) / 1000)


def test_frames_are_mavlink_2_with_their_vehicle_ids(sent: list[Transmission]) -> None:
    for _, vehicle, raw in sent:
        assert raw[0] == 0xFD
        assert tuple(raw[5:7]) == vehicle.source


def test_sequence_numbers_count_per_vehicle(sent: list[Transmission]) -> None:
    numbers = defaultdict(list)
    for _, vehicle, raw in sent:
        numbers[vehicle.source].append(raw[4])
    for found in numbers.values():
        assert found == [n % 256 for n in range(len(found))]
    assert len(numbers) == 6


def test_sequence_numbers_wrap() -> None:
    carrier = [t.raw[4] for t in schedule(scenario.hover(1), duration_s=12) if t.raw[5] == 5]
    assert len(carrier) > 256
    assert carrier[255:258] == [255, 0, 1]


def test_send_times_are_sorted_and_within_the_duration(sent: list[Transmission]) -> None:
    times_s = [t_s for t_s, _, _ in sent]
    assert times_s == sorted(times_s)
    assert times_s[0] >= 0.0
    assert DURATION_S - 0.1 < times_s[-1] < DURATION_S


def test_schedule_without_duration_is_endless(flight: Scenario, sent: list[Transmission]) -> None:
    endless = schedule(flight, seed=3, epoch_ns=EPOCH_NS)
    longer = list(itertools.islice(endless, len(sent) + 1))
    assert longer[:-1] == sent
    assert longer[-1].t_s >= DURATION_S


def test_schedule_is_determined_by_the_seed(flight: Scenario, sent: list[Transmission]) -> None:
    again = list(schedule(flight, seed=3, epoch_ns=EPOCH_NS, duration_s=DURATION_S))
    other = list(schedule(flight, seed=4, epoch_ns=EPOCH_NS, duration_s=DURATION_S))
    assert again == sent
    assert [t.t_s for t in other] != [t.t_s for t in sent]


def test_adding_a_uav_leaves_other_frames_unchanged() -> None:
    few, many = (
        [t for t in schedule(scenario.paper(uavs), duration_s=3.0) if t.raw[5] <= 3]
        for uavs in (3, 4)
    )
    assert few == many


def test_message_rates_match_the_schedule(
    flight: Scenario, messages: dict[str, list[tuple[float, Vehicle, Any]]]
) -> None:
    seldom = flight.name == "swarm"
    for vehicle in flight.vehicles:
        attitude_s = 0.05 if vehicle is flight.carrier else 1.0 if seldom else 0.2
        sparse = seldom and vehicle is not flight.carrier
        intervals_s = {
            "HEARTBEAT": 1.0,
            "GPS_RAW_INT": 5.0 if sparse else 0.5,
            "SYSTEM_TIME": 10.0 if sparse else 1.0,
            "GLOBAL_POSITION_INT": vehicle.report_interval_s,
            "ATTITUDE": attitude_s,
        }
        for name, interval_s in intervals_s.items():
            times_s = np.array([t_s for t_s, sender, _ in messages[name] if sender is vehicle])
            assert abs(len(times_s) - DURATION_S / interval_s) <= 1
            # Jitter does not accumulate.
            grid_s = times_s[:1] + interval_s * np.arange(len(times_s))
            assert (np.abs(times_s - grid_s) <= JITTER_S).all()
    relayed = {"ADSB_VEHICLE"} if flight.name == "adsb" else set()
    assert set(messages) == {*intervals_s, *relayed}


def test_swarm_sends_the_stated_frame_rate() -> None:
    flight = scenario.swarm(100)
    sent = [t.vehicle for t in schedule(flight, duration_s=20.0)]
    by_carrier = sum(vehicle is flight.carrier for vehicle in sent)
    assert by_carrier / 20.0 == pytest.approx(34.0, abs=0.3)
    assert (len(sent) - by_carrier) / 20.0 / 100 == pytest.approx(6.3, abs=0.1)
    assert {uav.report_interval_s for uav in flight.uavs} == {0.25}


def test_vehicles_send_at_different_phases(
    messages: dict[str, list[tuple[float, Vehicle, Any]]],
) -> None:
    first_s = [t_s for t_s, _, _ in messages["HEARTBEAT"]][:6]
    assert max(first_s) - min(first_s) > 0.1
    assert min(np.diff(first_s)) > 0.0


def test_timestamps_precede_sending_by_the_jitter_at_most(
    messages: dict[str, list[tuple[float, Vehicle, Any]]],
) -> None:
    for name in ("GLOBAL_POSITION_INT", "ATTITUDE", "SYSTEM_TIME"):
        late_s = [t_s - sampled_s(vehicle, m) for t_s, vehicle, m in messages[name]]
        assert min(late_s) >= 0.0
        assert max(late_s) <= JITTER_S + 0.001


def test_global_position_int(
    flight: Scenario, messages: dict[str, list[tuple[float, Vehicle, Any]]]
) -> None:
    for _, vehicle, message in messages["GLOBAL_POSITION_INT"]:
        t_s = sampled_s(vehicle, message)
        position_ned_m, velocity_ned_mps = vehicle.trajectory(t_s)
        read_ned_m = pymap3d.geodetic2ned(
            message.lat / 1e7, message.lon / 1e7, message.alt / 1e3, *flight.origin
        )
        # Half of 1e-7 degree is 5.6 mm; half of a millimetre.
        assert read_ned_m[:2] == pytest.approx(position_ned_m[:2], abs=0.006)
        assert read_ned_m[2] == pytest.approx(position_ned_m[2], abs=0.001)
        assert message.relative_alt / 1e3 == pytest.approx(25.0 + message.alt / 1e3 - 513.0)
        read_mps = [message.vx / 100, message.vy / 100, message.vz / 100]
        assert read_mps == pytest.approx(velocity_ned_mps, abs=0.00501)
        turn_deg = message.hdg / 100 - math.degrees(vehicle.attitude(t_s).yaw_rad)
        assert math.remainder(turn_deg, 360.0) == pytest.approx(0.0, abs=0.00501)
        assert 0 <= message.hdg < 36_000


def test_downward_velocity_is_positive() -> None:
    # No scenario descends, so this one does: GLOBAL_POSITION_INT's vz is positive down.
    def sinking(t_s: float) -> scenario.Motion:
        return scenario.Motion((0.0, 0.0, 3.0 * t_s), (0.0, 0.0, 3.0))

    uav = scenario.Vehicle(
        source=Source(9, 1),
        trajectory=sinking,
        attitude=scenario.Sway(),
        report_interval_s=0.1,
        attitude_interval_s=0.2,
        uptime_ms=1000,
    )
    falling = scenario.Scenario(
        name="sink",
        description="",
        origin=scenario.ORIGIN,
        home_alt_m=488.0,
        carrier=scenario.CARRIER,
        uavs=(uav,),
    )
    parser = dialect.MAVLink(None)
    read = [parser.parse_buffer(t.raw)[0] for t in schedule(falling, duration_s=2) if t[1] is uav]
    reports = [m for m in read if m.get_type() == "GLOBAL_POSITION_INT"]
    assert {m.vz for m in reports} == {300}
    assert reports[-1].alt < reports[0].alt - 4000


def test_attitude(messages: dict[str, list[tuple[float, Vehicle, Any]]]) -> None:
    for _, vehicle, message in messages["ATTITUDE"]:
        read = (message.roll, message.pitch, message.yaw)
        rates = (message.rollspeed, message.pitchspeed, message.yawspeed)
        pose = vehicle.attitude(sampled_s(vehicle, message))
        assert (*read, *rates) == pytest.approx(pose, rel=1e-6, abs=1e-9)


def test_paper_uavs_face_their_direction_of_flight() -> None:
    calm = scenario.paper(gust=0.0)
    for uav in calm.uavs:
        north_mps, east_mps, _ = uav.trajectory(4.2).velocity_ned_mps
        off_rad = uav.attitude(4.2).yaw_rad - math.atan2(east_mps, north_mps)
        assert abs(math.remainder(off_rad, math.tau)) <= math.radians(0.5)


def test_gps_raw_int(
    flight: Scenario, messages: dict[str, list[tuple[float, Vehicle, Any]]]
) -> None:
    for _, vehicle, message in messages["GPS_RAW_INT"]:
        t_s = (message.time_usec // 1000 - vehicle.uptime_ms) / 1000
        north_mps, east_mps, _ = vehicle.trajectory(t_s).velocity_ned_mps
        speed_mps = math.hypot(north_mps, east_mps)
        position_ned_m = vehicle.trajectory(t_s).position_ned_m
        read_ned_m = pymap3d.geodetic2ned(
            message.lat / 1e7, message.lon / 1e7, message.alt / 1e3, *flight.origin
        )
        assert read_ned_m == pytest.approx(position_ned_m, abs=0.006)
        assert message.vel / 100 == pytest.approx(speed_mps, abs=0.00501)
        if speed_mps > 0.1:
            course_deg = math.degrees(math.atan2(east_mps, north_mps))
            off_deg = math.remainder(message.cog / 100 - course_deg, 360.0)
            assert off_deg == pytest.approx(0.0, abs=0.00501)
        else:
            assert message.cog == 0xFFFF
        assert message.fix_type >= dialect.GPS_FIX_TYPE_DGPS
        # The accuracies cover the quantisation errors.
        assert message.h_acc / 1e3 >= 0.006 * math.sqrt(2)
        assert message.v_acc / 1e3 >= 0.0005
        assert message.vel_acc / 1e3 >= 0.005 * math.sqrt(3)
        assert 0 < message.eph < 0xFFFF
        assert 0 < message.epv < 0xFFFF


def test_heartbeat(messages: dict[str, list[tuple[float, Vehicle, Any]]]) -> None:
    for _, vehicle, message in messages["HEARTBEAT"]:
        plane = vehicle.airframe is Airframe.PLANE
        copter_or_plane = (
            (dialect.MAV_TYPE_FIXED_WING, dialect.PLANE_MODE_GUIDED)
            if plane
            else (dialect.MAV_TYPE_QUADROTOR, dialect.COPTER_MODE_GUIDED)
        )
        assert (message.type, message.custom_mode) == copter_or_plane
        assert message.autopilot == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA
        assert message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED
        assert message.base_mode & dialect.MAV_MODE_FLAG_GUIDED_ENABLED
        assert message.system_status == dialect.MAV_STATE_ACTIVE


def test_system_time_has_a_constant_offset_per_vehicle(
    messages: dict[str, list[tuple[float, Vehicle, Any]]],
) -> None:
    offsets_us = defaultdict(set)
    for t_s, vehicle, message in messages["SYSTEM_TIME"]:
        offsets_us[vehicle.source].add(message.time_unix_usec - 1000 * message.time_boot_ms)
        sent_us = EPOCH_NS // 1000 + 1e6 * t_s
        assert 0 <= sent_us - message.time_unix_usec <= 1e6 * JITTER_S + 1000
    # One offset per vehicle, and no two vehicles booted at the same time.
    assert all(len(found) == 1 for found in offsets_us.values())
    assert len(set.union(*offsets_us.values())) == len(offsets_us)
    assert len(offsets_us) > 1


@pytest.mark.parametrize("name", ["paper", "swarm"])
def test_largest_fleet_can_be_encoded(name: str) -> None:
    fleet = scenario.BUILDERS[name](scenario.MAX_UAVS)
    assert {t.vehicle.source for t in schedule(fleet, duration_s=1.1)} == {
        vehicle.source for vehicle in fleet.vehicles
    }


def test_frames_equal_those_packed_by_pymavlink(sent: list[Transmission]) -> None:
    # Decoded and encoded again by the generated dialect, with truncated zeros and checksum.
    parser = dialect.MAVLink(None)
    for _, vehicle, raw in sent:
        (message,) = parser.parse_buffer(raw)
        packer = dialect.MAVLink(None, *vehicle.source)
        packer.seq = raw[4]
        garbled = message.get_type() == "ADSB_VEHICLE" and not message.flags & 16
        assert garbled or message.pack(packer) == raw


LIKE_OTHERS = ("racetrack", "mirror", "crossing")
"""Scenarios that send what others send as well."""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(one, marks=pytest.mark.full if one in LIKE_OTHERS else ())
        for one in scenario.BUILDERS
    ],
)
def test_service_decodes_each_vehicle_position(name: str) -> None:
    # Long enough to include stops, turns and encounters; one frame in 40 is sufficient.
    flight = scenario.BUILDERS[name](6, seed=4)
    reports = 0
    for t_s, vehicle, raw in itertools.islice(
        schedule(flight, 1, EPOCH_NS, duration_s=90.0), 0, None, 40
    ):
        frame = Frame(t_ns=round(t_s * 1e9), link="a", source=vehicle.source, msgid=raw[7], raw=raw)
        read = decode(frame)
        if isinstance(read, Rejection):  # an aircraft without a position
            assert (name, read.reason) == ("adsb", Reason.NO_POSITION)
        if not isinstance(read, Report) or read.boot_ms is None:
            continue
        reports += 1
        position_ned_m, velocity_ned_mps = vehicle.trajectory(
            (read.boot_ms - vehicle.uptime_ms) / 1000
        )
        read_ned_m = pymap3d.geodetic2ned(read.lat_deg, read.lon_deg, read.alt_m, *flight.origin)
        assert read_ned_m == pytest.approx(position_ned_m, abs=0.006)
        assert read.velocity_ne_mps == pytest.approx(velocity_ned_mps[:2], abs=0.00501)
        assert read.velocity_down_mps == pytest.approx(velocity_ned_mps[2], abs=0.00501)
        assert read.uav == str(vehicle.source)
        assert read.source.sysid != 255
    assert reports > 20


def test_uavs_with_a_shared_id_keep_separate_clocks() -> None:
    flight = scenario.shared_id(4)
    sent = list(schedule(flight, duration_s=8.0))
    twins = [[t for t in sent if t.vehicle is uav] for uav in flight.uavs[:2]]
    for one in twins:
        assert {tuple(t.raw[5:7]) for t in one} == {(1, 1)}
        assert [t.raw[4] for t in one] == [n % 256 for n in range(len(one))]
    clocks_ms = [
        [int.from_bytes(t.raw[10:14], "little") for t in one if t.raw[7] == 33] for one in twins
    ]
    assert max(clocks_ms[0]) < min(clocks_ms[1])
    # Their phases differ too: each has its own timers and jitter.
    assert twins[0][0].t_s != twins[1][0].t_s


# SHA-256 over 20 s of four UAVs, made by pymavlink's message objects and pymap3d before frames
# were written with struct: the demo and other tests rely on these flights.
GOLDEN = {
    ("paper", 0): "ebe5aea8ef15fe3c922f5b7fa8322d154de54925d90ad3ac278b6ab72392b28b",
    ("paper", 7): "aa3d037ace9361c75cfb8a4e67527338df39e6751d2006a71c3cfcdd170ada9f",
    ("hover", 3): "6fc0f96a8c29633f5b3810a2e216401e0794a7bdd1229d1718f02241e589bb5d",
}


@pytest.mark.parametrize(("name", "seed"), GOLDEN)
def test_scenario_frames_match_their_golden_digests(name: str, seed: int) -> None:
    digest = hashlib.sha256()
    for sent in schedule(scenario.BUILDERS[name](4), seed, EPOCH_NS, duration_s=20.0):
        digest.update(f"{sent.t_s!r} {sent.raw.hex()}\n".encode())
    assert digest.hexdigest() == GOLDEN[name, seed]


@pytest.mark.benchmark
def test_swarm_frames_are_generated_faster_than_real_time() -> None:
    frames = schedule(scenario.swarm(1000))
    next(frames)
    start_s = time.perf_counter()
    count = sum(1 for _ in itertools.islice(frames, 30_000))
    assert count / (time.perf_counter() - start_s) > 15_000
