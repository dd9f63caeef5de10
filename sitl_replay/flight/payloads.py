"""Payloads of vehicles' messages: one function per message.

Layouts follow https://mavlink.io/en/messages/common.html in wire order: largest first, then
extensions. Payloads are encoded with ``struct`` for speed, since a thousand vehicles send thousands
of frames a second; ``tests/sitl_replay`` decodes them with pymavlink.
"""

import math
import struct
from collections.abc import Callable
from typing import Final, NamedTuple

from companion.mavlink.wire.decode import ATTITUDE, GPS_RAW_INT, HEARTBEAT, SYSTEM_TIME
from companion.mavlink.wire.encode import Outgoing
from companion.mavlink.wire.positions import GLOBAL_POSITION_INT
from companion.mavlink.wire.transponder import ADSB_VEHICLE
from companion.tracking.geodesy import LocalFrame
from companion.values import AltitudeDatum
from sitl_replay.flight.fleet import Vehicle
from sitl_replay.flight.motion import Motion
from sitl_replay.flight.relay import Relayed, Valid

# As ArduPilot sends it when armed, in guided mode, flying: MAV_MODE_FLAG custom mode, stabilised,
# guided, manual input, armed.
BASE_MODE: Final = 1 | 16 | 8 | 64 | 128
ARDUPILOT: Final = 3  # MAV_AUTOPILOT
ACTIVE: Final = 4  # MAV_STATE
MAVLINK_VERSION: Final = 3
RTK_FIXED: Final = 6  # GPS_FIX_TYPE

# Height of the geoid above the ellipsoid at the origin. Positions are computed with 0 instead, an
# error of micrometres at these ranges.
GEOID_HEIGHT_M: Final = 47.4
PRESSURE_OFFSET_M: Final = -64.0
"""Error of pressure altitude in the scenarios, metres: 1021 hPa at sea level."""

UNKNOWN_U16: Final = 0xFFFF
COURSE_SPEED_MIN_MPS: Final = 0.1

_HEARTBEAT: Final = struct.Struct("<IBBBBB")
_GLOBAL_POSITION_INT: Final = struct.Struct("<IiiiihhhH")
_ATTITUDE: Final = struct.Struct("<Iffffff")
_GPS_RAW_INT: Final = struct.Struct("<QiiiHHHHBBiIIII")
_SYSTEM_TIME: Final = struct.Struct("<QI")
_ADSB_VEHICLE: Final = struct.Struct("<IiiiHHhHHB9sBB")


class Sample(NamedTuple):
    """State of one vehicle at the time of a message."""

    local: LocalFrame  # the carrier's local frame
    home_alt_m: float  # reference of relative altitudes
    vehicle: Vehicle  # the sender
    t_s: float  # since the start of the scenario
    boot_ms: int  # on the vehicle's clock
    unix_us: int  # on the clock of its GNSS receiver


Builder = Callable[[Sample], Outgoing]


def heartbeat(sample: Sample) -> Outgoing:
    """Encode HEARTBEAT of an ArduPilot copter or plane, armed and in guided mode."""
    airframe = sample.vehicle.airframe
    payload = _HEARTBEAT.pack(
        airframe.guided_mode, airframe.mav_type, ARDUPILOT, BASE_MODE, ACTIVE, MAVLINK_VERSION
    )
    return Outgoing(sample.vehicle.source, HEARTBEAT, payload)


def global_position_int(sample: Sample) -> Outgoing:
    """Encode GLOBAL_POSITION_INT: degE7, mm above mean sea level and home, cm/s NED, cdeg."""
    vehicle = sample.vehicle
    position_ned_m, (north_mps, east_mps, down_mps) = vehicle.trajectory(sample.t_s)
    lat_deg, lon_deg, alt_m = sample.local.place(*position_ned_m)
    payload = _GLOBAL_POSITION_INT.pack(
        sample.boot_ms,
        round(lat_deg * 1e7),
        round(lon_deg * 1e7),
        round(alt_m * 1e3),
        round((alt_m - sample.home_alt_m) * 1e3),
        round(100 * north_mps),
        round(100 * east_mps),
        round(100 * down_mps),
        _bearing_cdeg(vehicle.attitude(sample.t_s).yaw_rad),
    )
    return Outgoing(vehicle.source, GLOBAL_POSITION_INT, payload)


def attitude(sample: Sample) -> Outgoing:
    """Encode ATTITUDE: radians and rad/s, as in ``motion.Pose``."""
    payload = _ATTITUDE.pack(sample.boot_ms, *sample.vehicle.attitude(sample.t_s))
    return Outgoing(sample.vehicle.source, ATTITUDE, payload)


def gps_raw_int(sample: Sample) -> Outgoing:
    """Encode GPS_RAW_INT of a receiver with an RTK fix; reports are within its accuracies."""
    motion = sample.vehicle.trajectory(sample.t_s)
    lat_deg, lon_deg, alt_m = sample.local.place(*motion.position_ned_m)
    speed_mps, course_cdeg = _over_ground(motion)
    payload = _GPS_RAW_INT.pack(
        sample.boot_ms * 1000,
        round(lat_deg * 1e7),
        round(lon_deg * 1e7),
        round(alt_m * 1e3),
        60,  # eph
        90,  # epv
        round(100 * speed_mps),
        course_cdeg,
        RTK_FIXED,
        17,  # satellites
        round((alt_m + GEOID_HEIGHT_M) * 1e3),
        20,  # h_acc, mm
        30,  # v_acc, mm
        50,  # vel_acc, mm/s
        0,  # hdg_acc: not known
    )
    return Outgoing(sample.vehicle.source, GPS_RAW_INT, payload)


def system_time(sample: Sample) -> Outgoing:
    """Encode SYSTEM_TIME: the same time on the GNSS clock and on the boot clock."""
    payload = _SYSTEM_TIME.pack(sample.unix_us, sample.boot_ms)
    return Outgoing(sample.vehicle.source, SYSTEM_TIME, payload)


def adsb_vehicle(sample: Sample, told: Relayed) -> Outgoing:
    """Encode ADSB_VEHICLE: mm above its datum, course over ground, vertical speed **up**.

    A field without its flag contains the garbage of the contact. A stationary aircraft has no
    course.
    """
    _, contact, tslc_s = told
    aircraft, valid = contact.aircraft, contact.valid
    motion = aircraft.trajectory(contact.t_s)
    lat_deg, lon_deg, alt_m = sample.local.place(*motion.position_ned_m)
    geometric = aircraft.datum is AltitudeDatum.GEOMETRIC
    alt_m += GEOID_HEIGHT_M if geometric else PRESSURE_OFFSET_M
    speed_mps, course_cdeg = _over_ground(motion)
    if course_cdeg == UNKNOWN_U16:
        valid &= ~Valid.HEADING
    climb_mps = -motion.velocity_ned_mps[2]
    garbage = _ADSB_VEHICLE.unpack(contact.garbage)

    def field_or_garbage(flag: Valid, at: int, value: int | bytes) -> int | bytes:
        return value if flag in valid else garbage[at]

    payload = _ADSB_VEHICLE.pack(
        aircraft.icao,
        field_or_garbage(Valid.COORDS, 1, round(lat_deg * 1e7)),
        field_or_garbage(Valid.COORDS, 2, round(lon_deg * 1e7)),
        field_or_garbage(Valid.ALTITUDE, 3, round(alt_m * 1e3)),
        field_or_garbage(Valid.HEADING, 4, course_cdeg),
        field_or_garbage(Valid.VELOCITY, 5, round(100 * speed_mps)),
        field_or_garbage(Valid.VERTICAL_VELOCITY, 6, round(100 * climb_mps)),
        valid,
        field_or_garbage(Valid.SQUAWK, 8, aircraft.squawk),
        field_or_garbage(Valid.ALTITUDE, 9, int(geometric)),
        field_or_garbage(Valid.CALLSIGN, 10, aircraft.callsign.encode("ascii")),
        aircraft.emitter_type,
        tslc_s,
    )
    return Outgoing(sample.vehicle.source, ADSB_VEHICLE, payload)


def _over_ground(motion: Motion) -> tuple[float, int]:
    """Return speed in m/s and course in centidegrees, ``UNKNOWN_U16`` if stationary."""
    north_mps, east_mps, _ = motion.velocity_ned_mps
    speed_mps = math.hypot(north_mps, east_mps)
    moving = speed_mps > COURSE_SPEED_MIN_MPS
    return speed_mps, _bearing_cdeg(math.atan2(east_mps, north_mps)) if moving else UNKNOWN_U16


def _bearing_cdeg(angle_rad: float) -> int:
    return round(100 * math.degrees(angle_rad)) % 36_000
