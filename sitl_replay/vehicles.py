"""A scenario as MAVLink 2: what each vehicle says, and when.

Pure: the schedule is a function of the scenario, a seed and the Unix time of its start. A message
is sampled at a whole millisecond, so that its stamp is exactly when its contents are true, and
sent up to ``JITTER_S`` later, as an autopilot's scheduler has it.
"""

import heapq
import itertools
import math
import random
from collections.abc import Callable, Iterator
from operator import attrgetter
from typing import Any, NamedTuple

import pymap3d
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.values import Source
from sitl_replay.scenario import Scenario, Vehicle

JITTER_S = 0.005

# ArduCopter's own words for "armed, in guided mode, flying".
BASE_MODE = (
    dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    | dialect.MAV_MODE_FLAG_GUIDED_ENABLED
    | dialect.MAV_MODE_FLAG_STABILIZE_ENABLED
    | dialect.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
    | dialect.MAV_MODE_FLAG_SAFETY_ARMED
)

# The geoid's height above the ellipsoid at the origin. Positions are computed as if it were 0:
# at these ranges that moves them by micrometres.
GEOID_HEIGHT_M = 47.4

UNKNOWN_U16 = 0xFFFF
SLOWEST_COURSE_MPS = 0.1


class Transmission(NamedTuple):
    """One frame: when it is sent (seconds since the start), by whom, and its bytes."""

    t_s: float
    vehicle: Vehicle
    raw: bytes


class Sample(NamedTuple):
    """A moment of one vehicle at which a message is made.

    ``t_s`` since the start of the scenario, ``boot_ms`` on the vehicle's clock, ``unix_us`` on
    that of its GNSS receiver.
    """

    scenario: Scenario
    vehicle: Vehicle
    t_s: float
    boot_ms: int
    unix_us: int


Builder = Callable[[Sample], Any]


def heartbeat(sample: Sample) -> Any:
    """HEARTBEAT of an ArduPilot quadrotor, armed and in guided mode."""
    return dialect.MAVLink_heartbeat_message(
        type=dialect.MAV_TYPE_QUADROTOR,
        autopilot=dialect.MAV_AUTOPILOT_ARDUPILOTMEGA,
        base_mode=BASE_MODE,
        custom_mode=dialect.COPTER_MODE_GUIDED,
        system_status=dialect.MAV_STATE_ACTIVE,
        mavlink_version=3,
    )


def global_position_int(sample: Sample) -> Any:
    """GLOBAL_POSITION_INT: degE7, mm above mean sea level and above home, cm/s NED, cdeg."""
    lat_deg, lon_deg, alt_m = _geodetic(sample)
    velocity_ned_mps = sample.vehicle.trajectory(sample.t_s).velocity_ned_mps
    north_cmps, east_cmps, down_cmps = (round(100 * v) for v in velocity_ned_mps)
    return dialect.MAVLink_global_position_int_message(
        time_boot_ms=sample.boot_ms,
        lat=round(lat_deg * 1e7),
        lon=round(lon_deg * 1e7),
        alt=round(alt_m * 1e3),
        relative_alt=round((alt_m - sample.scenario.home_alt_m) * 1e3),
        vx=north_cmps,
        vy=east_cmps,
        vz=down_cmps,
        hdg=_bearing_cdeg(sample.vehicle.attitude(sample.t_s).yaw_rad),
    )


def attitude(sample: Sample) -> Any:
    """ATTITUDE: radians and rad/s, as in ``scenario.Pose``."""
    return dialect.MAVLink_attitude_message(sample.boot_ms, *sample.vehicle.attitude(sample.t_s))


def gps_raw_int(sample: Sample) -> Any:
    """GPS_RAW_INT of a receiver with an RTK fix, with accuracies that the reports keep."""
    lat_deg, lon_deg, alt_m = _geodetic(sample)
    north_mps, east_mps, _ = sample.vehicle.trajectory(sample.t_s).velocity_ned_mps
    speed_mps = math.hypot(north_mps, east_mps)
    moving = speed_mps > SLOWEST_COURSE_MPS
    course_rad = math.atan2(east_mps, north_mps)
    return dialect.MAVLink_gps_raw_int_message(
        time_usec=sample.boot_ms * 1000,
        fix_type=dialect.GPS_FIX_TYPE_RTK_FIXED,
        lat=round(lat_deg * 1e7),
        lon=round(lon_deg * 1e7),
        alt=round(alt_m * 1e3),
        eph=60,
        epv=90,
        vel=round(100 * speed_mps),
        cog=_bearing_cdeg(course_rad) if moving else UNKNOWN_U16,
        satellites_visible=17,
        alt_ellipsoid=round((alt_m + GEOID_HEIGHT_M) * 1e3),
        h_acc=20,
        v_acc=30,
        vel_acc=50,
    )


def system_time(sample: Sample) -> Any:
    """SYSTEM_TIME: the same instant on the GNSS clock and on the boot clock."""
    return dialect.MAVLink_system_time_message(sample.unix_us, sample.boot_ms)


def schedule(
    scenario: Scenario,
    seed: int = 0,
    epoch_ns: int = 0,
    duration_s: float | None = None,
) -> Iterator[Transmission]:
    """Every frame of the scenario in the order of sending; without end if ``duration_s`` is None.

    ``epoch_ns`` is the Unix time at the start. The same arguments give the same bytes; another
    seed starts the timers in other phases and jitters them otherwise. Each vehicle counts its own
    sequence numbers.
    """
    senders = {vehicle.source: _sender(vehicle.source) for vehicle in scenario.vehicles}
    timers = [
        _timer(vehicle, build, interval_s, seed)
        for vehicle in scenario.vehicles
        for build, interval_s in _messages(vehicle)
    ]
    for due in heapq.merge(*timers, key=attrgetter("send_s")):
        if duration_s is not None and due.send_s >= duration_s:
            return
        vehicle = due.vehicle
        since_start_ms = math.floor(due.sample_s * 1000)
        sample = Sample(
            scenario,
            vehicle,
            t_s=since_start_ms / 1000,
            boot_ms=vehicle.uptime_ms + since_start_ms,
            unix_us=epoch_ns // 1000 + since_start_ms * 1000,
        )
        sender = senders[vehicle.source]
        raw = due.build(sample).pack(sender)
        sender.seq = (sender.seq + 1) % 256
        yield Transmission(due.send_s, vehicle, raw)


class _Due(NamedTuple):
    send_s: float
    sample_s: float
    vehicle: Vehicle
    build: Builder


def _messages(vehicle: Vehicle) -> tuple[tuple[Builder, float], ...]:
    return (
        (heartbeat, 1.0),
        (global_position_int, vehicle.report_interval_s),
        (attitude, vehicle.attitude_interval_s),
        (gps_raw_int, 0.5),
        (system_time, 1.0),
    )


def _timer(vehicle: Vehicle, build: Builder, interval_s: float, seed: int) -> Iterator[_Due]:
    # A generator for each timer: one vehicle more does not change what the others send.
    rng = random.Random(f"{seed} {vehicle.source} {build.__name__}")
    phase_s = rng.uniform(0.0, interval_s)
    for count in itertools.count():
        sample_s = phase_s + count * interval_s
        yield _Due(sample_s + rng.uniform(0.0, JITTER_S), sample_s, vehicle, build)


def _sender(source: Source) -> Any:
    return dialect.MAVLink(None, srcSystem=source.sysid, srcComponent=source.compid)


def _geodetic(sample: Sample) -> tuple[float, float, float]:
    """Latitude and longitude in degrees, altitude in metres above mean sea level."""
    position_ned_m = sample.vehicle.trajectory(sample.t_s).position_ned_m
    lat_deg, lon_deg, alt_m = pymap3d.ned2geodetic(*position_ned_m, *sample.scenario.origin)
    return float(lat_deg), float(lon_deg), float(alt_m)


def _bearing_cdeg(angle_rad: float) -> int:
    return round(100 * math.degrees(angle_rad)) % 36_000
