"""Encoders of the messages that the service sends.

A payload is encoded once; its frame is built per peer, since every peer has its own sequence
numbers. Fields are laid out as on the wire: by size, largest first, then extensions
(https://mavlink.io/en/guide/serialization.html). ``tests/mavlink/wire/test_encode.py`` compares
every message with pymavlink's generated dialect.
"""

import math
import struct
from dataclasses import dataclass
from typing import Final, NamedTuple

from fastcrc import crc16

from companion.mavlink.wire.crc_extra import CRC_EXTRA
from companion.mavlink.wire.framing import MAGIC_V1, MAGIC_V2
from companion.values import Source

HEARTBEAT: Final = 0
GLOBAL_POSITION_INT: Final = 33
REQUEST_DATA_STREAM: Final = 66
COMMAND_LONG: Final = 76
TIMESYNC: Final = 111
NAMED_VALUE_FLOAT: Final = 251
STATUSTEXT: Final = 253
UTM_GLOBAL_POSITION: Final = 340

MAV_CMD_SET_MESSAGE_INTERVAL: Final = 511

_ONBOARD_CONTROLLER: Final = 18  # MAV_TYPE
_NO_AUTOPILOT: Final = 8  # MAV_AUTOPILOT_INVALID
_ACTIVE: Final = 4  # MAV_STATE
_MAVLINK_VERSION: Final = 3


class Outgoing(NamedTuple):
    """Message to send: its sender, its id, and its payload at full length."""

    source: Source
    msgid: int
    payload: bytes


def pack(message: Outgoing, seq: int, version: int = 2, compat_flags: int = 0) -> bytes:
    """Build the frame of a message: MAVLink 2, unsigned, with trailing zeros cut; or MAVLink 1.

    ``compat_flags`` (MAVLink 2) are those that a receiver ignores if it does not know them.

    A payload with extension fields cannot be sent as MAVLink 1. Omit them from a payload that may
    be sent as either version.
    """
    seed = bytes([CRC_EXTRA[message.msgid]])
    if version == 1:
        body = bytes([len(message.payload), seq, *message.source, message.msgid]) + message.payload
        magic = MAGIC_V1
    else:
        payload = message.payload.rstrip(b"\0") or b"\0"  # the first byte is never cut
        head = bytes([len(payload), 0, compat_flags, seq, *message.source])
        body = head + message.msgid.to_bytes(3, "little") + payload
        magic = MAGIC_V2
    return bytes([magic]) + body + struct.pack("<H", crc16.mcrf4xx(body + seed))


def heartbeat(source: Source) -> Outgoing:
    """Encode the HEARTBEAT of an active onboard controller without an autopilot."""
    payload = struct.pack(
        "<IBBBBB", 0, _ONBOARD_CONTROLLER, _NO_AUTOPILOT, 0, _ACTIVE, _MAVLINK_VERSION
    )
    return Outgoing(source, HEARTBEAT, payload)


def statustext(source: Source, severity: int, text: str) -> Outgoing:
    """Encode STATUSTEXT without its extensions; ``severity`` is a MAV_SEVERITY.

    The text is cut to 50 characters; those outside ASCII become question marks.
    """
    payload = struct.pack("<B50s", severity, text.encode("ascii", "replace"))
    return Outgoing(source, STATUSTEXT, payload)


def named_value_float(source: Source, boot_ms: int, name: str, value: float) -> Outgoing:
    """Encode NAMED_VALUE_FLOAT; the name is cut to 10 ASCII characters."""
    payload = struct.pack("<If10s", boot_ms, value, name.encode("ascii", "replace"))
    return Outgoing(source, NAMED_VALUE_FLOAT, payload)


def global_position_int(
    source: Source,
    boot_ms: int,
    place: tuple[float, float, float],
    *,
    relative_alt_m: float,
    velocity_ned_mps: tuple[float, float, float],
    heading_deg: float | None,
) -> Outgoing:
    """Encode GLOBAL_POSITION_INT; ``place`` is latitude and longitude (degrees), metres.

    Speeds are clipped to the range of the message.
    """
    lat_deg, lon_deg, alt_m = place
    speeds = (max(-32_767, min(32_767, round(speed * 100))) for speed in velocity_ned_mps)
    payload = struct.pack(
        "<IiiiihhhH",
        boot_ms,
        *(round(lat_deg * 1e7), round(lon_deg * 1e7)),
        *(round(alt_m * 1e3), round(relative_alt_m * 1e3)),
        *speeds,
        65_535 if heading_deg is None else round(heading_deg * 100) % 36_000,
    )
    return Outgoing(source, GLOBAL_POSITION_INT, payload)


@dataclass(frozen=True, slots=True, kw_only=True)
class UtmPosition:
    """Content of UTM_GLOBAL_POSITION; None: unknown.

    lat_deg, lon_deg  WGS84
    horizontal_m, vertical_m
                      sent as its uncertainties
    """

    utc_ns: int  # time of the position
    lat_deg: float
    lon_deg: float
    hae_m: float | None  # height above the ellipsoid
    relative_alt_m: float | None  # height above home
    velocity_ned_mps: tuple[float, float, float]  # over ground
    horizontal_m: float
    vertical_m: float
    every_s: float  # interval between messages


def utm_global_position(source: Source, said: UtmPosition) -> Outgoing:
    """Encode UTM_GLOBAL_POSITION; its flags (UTM_DATA_AVAIL_FLAGS) state which fields are known.

    The vehicle's own UAS id is unknown, and stays empty. Values are clipped to the range of the
    message.
    """
    flags = 1 | 4 | 32 | 64  # time, position, both velocities
    flags |= 0 if said.hae_m is None else 8
    flags |= 0 if said.relative_alt_m is None else 16
    speeds = (max(-32_767, min(32_767, round(speed * 100))) for speed in said.velocity_ned_mps)
    off = (min(65_535, math.ceil(one * 1e3)) for one in (said.horizontal_m, said.vertical_m))
    payload = struct.pack(
        "<Q7i3h4H18sBB",
        said.utc_ns // 1000,
        *(round(said.lat_deg * 1e7), round(said.lon_deg * 1e7)),
        *(round((one or 0.0) * 1e3) for one in (said.hae_m, said.relative_alt_m)),
        *(0, 0, 0),  # of the next waypoint
        *speeds,
        *off,
        0,  # accuracy of the velocity: unknown
        min(65_535, round(said.every_s * 100)),
        b"",
        0,  # UTM_FLIGHT_STATE_UNKNOWN
        flags,
    )
    return Outgoing(source, UTM_GLOBAL_POSITION, payload)


def set_message_interval(
    source: Source, target: Source, msgid: int, interval_us: int, confirmation: int = 0
) -> Outgoing:
    """Encode COMMAND_LONG with MAV_CMD_SET_MESSAGE_INTERVAL; the target answers with COMMAND_ACK.

        msgid         requested message
        interval_us   its interval, microseconds
        confirmation  number of earlier transmissions of this command without an answer

    Source: https://mavlink.io/en/services/command.html.
    """
    payload = struct.pack(
        "<7fHBBB",
        *(float(msgid), float(interval_us), 0.0, 0.0, 0.0, 0.0, 0.0),
        *(MAV_CMD_SET_MESSAGE_INTERVAL, target.sysid, target.compid, confirmation),
    )
    return Outgoing(source, COMMAND_LONG, payload)


def request_data_stream(source: Source, target: Source, stream: int, rate_hz: int) -> Outgoing:
    """Encode REQUEST_DATA_STREAM, the predecessor of SET_MESSAGE_INTERVAL.

    It is not acknowledged.
    """
    payload = struct.pack("<HBBBB", rate_hz, target.sysid, target.compid, stream, 1)
    return Outgoing(source, REQUEST_DATA_STREAM, payload)


def timesync(source: Source, sent_ns: int) -> Outgoing:
    """Encode a TIMESYNC request: the peer returns ``sent_ns`` with its own time."""
    return Outgoing(source, TIMESYNC, struct.pack("<qq", 0, sent_ns))
