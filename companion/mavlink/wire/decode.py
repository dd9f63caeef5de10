"""Decoders of MAVLink messages: one function per message, from a frame to a value.

Sources: the message definitions of https://mavlink.io/en/messages/common.html. MAVLink 2 truncates
trailing zero bytes of a payload, and a version 1 frame has no extension fields: both are read as
zeros, as the standard requires. Where zero means "not sent" the value is None.

Over 300 lines: one short function for each message.
"""

import math
import struct
from collections.abc import Callable
from typing import Final

from companion.mavlink.wire import accuracy, attitudes, cot_link, positions, remote_id
from companion.mavlink.wire.payload import unpack
from companion.mavlink.wire.transponder import ADSB_VEHICLE, SENDER
from companion.values import (
    AdsbVehicle,
    AltitudeDatum,
    Attitude,
    EstimatorStatus,
    Frame,
    GnssHeading,
    GnssStatus,
    Message,
    Presence,
    Reason,
    Rejection,
    RemoteId,
    Report,
    StatedAttitude,
    SystemTime,
)

HEARTBEAT: Final = 0
SYSTEM_TIME: Final = 2
GPS_RAW_INT: Final = attitudes.GPS_RAW_INT
ATTITUDE: Final = 30
EKF_STATUS_REPORT: Final = 193

POSE: Final = positions.OWN | {ATTITUDE}
"""Messages in which vehicles report their own position or attitude, stamped by their boot clock."""

PREDICTION: Final = "a prediction that a companion passed on"
NULL_ISLAND_RADIUS_M: Final = 5000.0
"""Distance from 0 N 0 E within which positions are rejected.

Estimators without a fix drift there by some metres (docs/field-notes.md 1).
"""
_METRES_PER_DEGREE: Final = 111_195.0

# ADSB_FLAGS. Flag 256 is ignored: BARO_VALID in some programs, "retransmitted" in others (PX4).
_COORDS, _ALTITUDE, _HEADING, _VELOCITY, _CALLSIGN, _VERTICAL = 1, 2, 4, 8, 16, 128
_DATUM: Final = {0: AltitudeDatum.PRESSURE, 1: AltitudeDatum.GEOMETRIC}  # ADSB_ALTITUDE_TYPE
_ICAO_MAX: Final = 0xFF_FFFF


class _RefusedError(Exception):
    """Internal error: the message must be rejected, for the reason that it contains."""

    def __init__(self, reason: Reason, detail: str = "") -> None:
        super().__init__(reason)
        self.reason = reason
        self.detail = detail


def decode(frame: Frame) -> Message | Rejection | None:
    """Decode a frame. Returns None for messages without a decoder or without relevant content.

    A frame with unusable fields gives a ``Rejection`` with its reason.
    """
    decoder = _DECODERS.get(frame.msgid)
    if decoder is None:
        return None
    try:
        return decoder(frame)
    except _RefusedError as why:
        return Rejection(
            t_ns=frame.t_ns,
            source=str(frame.source),
            reason=why.reason,
            msgid=frame.msgid,
            detail=why.detail,
        )


def _position(lat_1e7: int, lon_1e7: int) -> tuple[float, float]:
    """Return latitude and longitude in degrees.

    Rejects coordinates out of range, and coordinates sent before a fix.
    """
    lat_deg, lon_deg = lat_1e7 * 1e-7, lon_1e7 * 1e-7
    if abs(lat_deg) > 90.0 or abs(lon_deg) > 180.0:
        raise _RefusedError(Reason.MALFORMED, f"latitude {lat_deg}, longitude {lon_deg}")
    if math.hypot(lat_deg, lon_deg) * _METRES_PER_DEGREE < NULL_ISLAND_RADIUS_M:
        raise _RefusedError(Reason.ZERO_POSITION)
    return lat_deg, lon_deg


def _own_position(frame: Frame) -> Report:
    if positions.is_passed_on(frame):
        raise _RefusedError(Reason.DUPLICATE, PREDICTION)
    said = positions.read(frame)
    lat_deg, lon_deg = _position(said.lat_1e7, said.lon_1e7)
    velocity = said.velocity_ned_mps
    return Report(
        t_ns=frame.t_ns,
        uav=str(frame.source),
        source=frame.source,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        alt_m=said.alt_m,
        alt_datum=AltitudeDatum.MSL,
        relative_alt_m=said.relative_alt_m,
        velocity_ne_mps=None if velocity is None else velocity[:2],
        velocity_down_mps=None if velocity is None else velocity[2],
        heading_deg=said.heading_deg,
        boot_ms=said.boot_ms,
        tslc_s=None,
        accuracy=said.accuracy,
        alt_step_m=said.alt_step_m,
    )


_ADSB_VEHICLE = struct.Struct("<IiiiHHhHHB9sBB")


def _adsb_vehicle(frame: Frame) -> AdsbVehicle:
    """Decode an aircraft relayed by a receiver; a field counts only if its own flag is set.

    ``ver_velocity`` is positive up; ``heading`` is the course over ground. A speed without a course
    gives no velocity, an altitude of an undefined type no altitude. An address of 0 or of more than
    24 bits (ICAO Annex 10) is rejected. Accuracies and a finer age are appended if this program
    wrote the message (``transponder``).
    """
    fields = unpack(frame, _ADSB_VEHICLE)
    icao, lat, lon, alt_mm, heading_cdeg, speed_cmps, climb_cmps, flags = fields[:8]
    altitude_type, callsign, _, tslc_s = fields[9:]
    if not 0 < icao <= _ICAO_MAX:
        raise _RefusedError(Reason.MALFORMED, f"ICAO address {icao:#x} has more than 24 bits")
    heading_deg = heading_cdeg * 1e-2 if flags & _HEADING and heading_cdeg <= 36_000 else None
    velocity_ne_mps = None
    if flags & _VELOCITY and heading_deg is not None:
        course, speed_mps = math.radians(heading_deg), speed_cmps * 1e-2
        velocity_ne_mps = (speed_mps * math.cos(course), speed_mps * math.sin(course))
    datum = _DATUM.get(altitude_type) if flags & _ALTITUDE else None
    appended = frame.payload[38:43].ljust(5, b"\0") if frame.source == SENDER else bytes(5)
    return AdsbVehicle(
        t_ns=frame.t_ns,
        icao=icao,
        source=frame.source,
        callsign=_callsign(callsign) if flags & _CALLSIGN else None,
        position_deg=_position(lat, lon) if flags & _COORDS else None,
        alt_m=alt_mm * 1e-3 if datum is not None else None,
        alt_datum=datum,
        heading_deg=heading_deg,
        velocity_ne_mps=velocity_ne_mps,
        velocity_down_mps=-climb_cmps * 1e-2 if flags & _VERTICAL else None,
        tslc_s=tslc_s + appended[3] / 256,
        accuracy=accuracy.adsb(*appended[:3], time_error_s=appended[4] / 10),
    )


def _callsign(padded: bytes) -> str | None:
    """Return the callsign up to the first zero byte, stripped; None if empty or unprintable."""
    text = padded.partition(b"\0")[0].decode("latin-1").strip()
    return text if text and text.isascii() and text.isprintable() else None


_ATTITUDE = struct.Struct("<Iffffff")


TURN_RAD: Final = 6.3
RATE_MAX_RADPS: Final = 75.0
"""Largest rate that a gyroscope can measure: the widest range on board is 4000 degrees a second."""


def _attitude(frame: Frame) -> Attitude:
    """Decode body attitude (FRD from NED, radians) and body rates (rad/s)."""
    boot_ms, *angles = unpack(frame, _ATTITUDE)
    if not all(map(math.isfinite, angles)):
        raise _RefusedError(Reason.MALFORMED, "angle or rate is not finite")
    if max(map(abs, angles[:3])) > TURN_RAD or max(map(abs, angles[3:])) > RATE_MAX_RADPS:
        raise _RefusedError(Reason.MALFORMED, "angle or rate is out of range")
    roll_rad, pitch_rad, yaw_rad, rollspeed_radps, pitchspeed_radps, yawspeed_radps = angles
    return Attitude(
        t_ns=frame.t_ns,
        source=frame.source,
        boot_ms=boot_ms,
        roll_rad=roll_rad,
        pitch_rad=pitch_rad,
        yaw_rad=yaw_rad,
        rollspeed_radps=rollspeed_radps,
        pitchspeed_radps=pitchspeed_radps,
        yawspeed_radps=yawspeed_radps,
    )


_HEARTBEAT = struct.Struct("<IBBBBB")


def _heartbeat(frame: Frame) -> Presence:
    _, mav_type, autopilot, base_mode, *_ = unpack(frame, _HEARTBEAT)
    armed = bool(base_mode & 128)  # MAV_MODE_FLAG_SAFETY_ARMED
    return Presence(
        t_ns=frame.t_ns, source=frame.source, mav_type=mav_type, autopilot=autopilot, is_armed=armed
    )


_UNKNOWN: Final = 0xFFFF_FFFF


def _accuracy(thousandths: int) -> float | None:
    """Return an accuracy in m or m/s; None if not sent, or if all bits are ones."""
    return None if thousandths in (0, _UNKNOWN) else thousandths * 1e-3


def _gps_raw_int(frame: Frame) -> GnssStatus:
    """Decode fix type, position and accuracies; these are extension fields, 0 if not sent."""
    fields = unpack(frame, attitudes.GPS_RAW_INT_FIELDS)
    lat_1e7, lon_1e7 = fields[1:3]
    h_acc, v_acc, vel_acc = fields[11:14]
    return GnssStatus(
        t_ns=frame.t_ns,
        source=frame.source,
        fix_type=fields[8],
        alt_m=fields[3] * 1e-3,
        h_acc_m=_accuracy(h_acc),
        v_acc_m=_accuracy(v_acc),
        vel_acc_mps=_accuracy(vel_acc),
        time_us=fields[0],
        position_deg=(lat_1e7 * 1e-7, lon_1e7 * 1e-7) if lat_1e7 or lon_1e7 else None,
    )


_SYSTEM_TIME = struct.Struct("<QI")


def _system_time(frame: Frame) -> SystemTime:
    """Decode Unix time and boot time, unchecked; Unix time 0 means that the sender has none."""
    unix_us, boot_ms = unpack(frame, _SYSTEM_TIME)
    return SystemTime(
        t_ns=frame.t_ns, source=frame.source, unix_us=unix_us or None, boot_ms=boot_ms
    )


_EKF_STATUS_REPORT = struct.Struct("<fffffH")
_KNOWS_ATTITUDE, _IS_RELATIVE, _IS_ABSOLUTE, _KEEPS_POSITION = 1, 8, 16, 128
_UNINITIALIZED, _REJECTS_GNSS = 1024, 1 << 15


def _ekf_status_report(frame: Frame) -> EstimatorStatus:
    """Decode ArduPilot's estimator status; ``compass_variance`` is a ratio."""
    *_, compass_ratio, _, flags = unpack(frame, _EKF_STATUS_REPORT)
    if not math.isfinite(compass_ratio) or compass_ratio < 0.0:
        raise _RefusedError(Reason.MALFORMED, "compass ratio is negative or not finite")
    has_position = bool(flags & (_IS_RELATIVE | _IS_ABSOLUTE)) and not flags & _KEEPS_POSITION
    return EstimatorStatus(
        t_ns=frame.t_ns,
        source=frame.source,
        link=frame.link,
        knows_attitude=flags & (_KNOWS_ATTITUDE | _UNINITIALIZED) == _KNOWS_ATTITUDE,
        knows_position=has_position and not flags & _UNINITIALIZED,
        is_absolute=flags & (_IS_ABSOLUTE | _REJECTS_GNSS) == _IS_ABSOLUTE,
        compass_ratio=compass_ratio,
    )


def _remote_id(frame: Frame) -> RemoteId | None:
    try:
        return remote_id.remote_id(frame)
    except ValueError as why:
        raise _RefusedError(Reason.MALFORMED, str(why)) from why


def _about_attitude(frame: Frame) -> GnssHeading | StatedAttitude | None:
    try:
        return attitudes.about_attitude(frame)
    except ValueError as why:
        raise _RefusedError(Reason.MALFORMED, str(why)) from why


def _tunnel(frame: Frame) -> Report | None:
    try:
        report = cot_link.report(frame)
    except (ValueError, struct.error) as why:
        raise _RefusedError(Reason.MALFORMED, str(why)) from why
    if report is not None:
        _position(round(report.lat_deg * 1e7), round(report.lon_deg * 1e7))
    return report


_DECODERS: Final[dict[int, Callable[[Frame], Message | None]]] = {
    HEARTBEAT: _heartbeat,
    SYSTEM_TIME: _system_time,
    GPS_RAW_INT: _gps_raw_int,
    ATTITUDE: _attitude,
    **dict.fromkeys(positions.OWN, _own_position),
    EKF_STATUS_REPORT: _ekf_status_report,
    **dict.fromkeys(attitudes.ABOUT_ATTITUDE, _about_attitude),
    ADSB_VEHICLE: _adsb_vehicle,
    cot_link.TUNNEL: _tunnel,
    **dict.fromkeys(remote_id.READ, _remote_id),
}
DECODED: Final = frozenset(_DECODERS)  # message ids that decode reads
