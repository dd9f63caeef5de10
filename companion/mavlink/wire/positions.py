"""Table of the messages that carry positions, the only place where they are listed.

To add a message with a vehicle's own position, write its reader and a row in ``POSITIONS``. The
message is then decoded, compared between peers and nodes, shared within a fleet, timed and exported
like the others.
"""

import struct
from collections.abc import Callable
from typing import Final, NamedTuple

from companion.mavlink.wire.cot_link import TUNNEL
from companion.mavlink.wire.framing import MAGIC_V2
from companion.mavlink.wire.payload import unpack
from companion.mavlink.wire.remote_id import LOCATION, MESSAGE_PACK
from companion.mavlink.wire.transponder import ADSB_VEHICLE
from companion.values import Accuracy, Frame, Vector

PASSED_ON: Final = 0x80
"""Compatibility flag of a prediction that a companion sends under a vehicle's id ([out]).

The MAVLink 2 guide defines no such flag; receivers ignore those that they do not know.
"""
GLOBAL_POSITION_INT: Final = 33
HIGH_LATENCY2: Final = 235


class OwnPosition(NamedTuple):
    """Position that a vehicle sent of itself; a field is None if its message lacks it.

    lat_1e7, lon_1e7  WGS84, 1e-7 degrees
    """

    boot_ms: int  # milliseconds since the vehicle's boot when the position was true
    lat_1e7: int
    lon_1e7: int
    alt_m: float  # height above mean sea level
    relative_alt_m: float | None  # height above home
    velocity_ned_mps: Vector | None  # north, east, down
    heading_deg: float | None  # from true north, clockwise
    accuracy: Accuracy | None = None  # accuracy that the message states
    alt_step_m: float = 0.0  # resolution of heights in the message


class PositionMessage(NamedTuple):
    """Message that carries a position: its MAVLink name, and its reader.

    ``read`` is None if the message relays another aircraft's position (see ``decode``).
    """

    name: str
    read: Callable[[Frame], OwnPosition] | None = None


_GLOBAL_POSITION_INT = struct.Struct("<IiiiihhhH")


def _global_position_int(frame: Frame) -> OwnPosition:
    """Read GLOBAL_POSITION_INT: ``vz`` is positive down, ``hdg`` 65535 is unknown."""
    boot_ms, lat, lon, alt_mm, rel_mm, vx, vy, vz, hdg = unpack(frame, _GLOBAL_POSITION_INT)
    return OwnPosition(
        boot_ms=boot_ms,
        lat_1e7=lat,
        lon_1e7=lon,
        alt_m=alt_mm * 1e-3,
        relative_alt_m=rel_mm * 1e-3,
        velocity_ned_mps=(vx * 1e-2, vy * 1e-2, vz * 1e-2),
        heading_deg=hdg * 1e-2 if hdg <= 36_000 else None,
    )


_HIGH_LATENCY2 = struct.Struct("<Iii2xh10xB7x2B")  # up to eph and epv


def _high_latency2(frame: Frame) -> OwnPosition:
    """Read HIGH_LATENCY2, sent every few seconds over a satellite modem or another slow link.

    Its heights are whole metres. It has a ground speed and a heading, but no velocity: in wind,
    heading and course differ. ``eph`` and ``epv`` are the largest errors since the previous
    message, 0.1 m; 0 and 255 are unknown. https://mavlink.io/en/messages/common.html#HIGH_LATENCY2
    """
    boot_ms, lat, lon, alt_m, heading, eph, epv = unpack(frame, _HIGH_LATENCY2)
    horizontal_m, vertical_m = (None if dm in (0, 255) else dm * 0.1 for dm in (eph, epv))
    return OwnPosition(
        boot_ms=boot_ms,
        lat_1e7=lat,
        lon_1e7=lon,
        alt_m=float(alt_m),
        relative_alt_m=None,
        velocity_ned_mps=None,
        heading_deg=heading * 2.0 if heading < 180 else None,
        accuracy=Accuracy(horizontal_m=horizontal_m, vertical_m=vertical_m),
        alt_step_m=1.0,
    )


POSITIONS: Final = {
    GLOBAL_POSITION_INT: PositionMessage("GLOBAL_POSITION_INT", _global_position_int),
    HIGH_LATENCY2: PositionMessage("HIGH_LATENCY2", _high_latency2),
    ADSB_VEHICLE: PositionMessage("ADSB_VEHICLE"),
    LOCATION: PositionMessage("OPEN_DRONE_ID_LOCATION"),
    MESSAGE_PACK: PositionMessage("OPEN_DRONE_ID_MESSAGE_PACK"),
    TUNNEL: PositionMessage("TUNNEL"),
}
"""Messages that carry a position, or may carry one, by id."""
_READERS: Final = {msgid: one.read for msgid, one in POSITIONS.items() if one.read is not None}
OWN: Final = frozenset(_READERS)  # messages in which vehicles report their own positions


def is_passed_on(frame: Frame) -> bool:
    """Return whether a position is a companion's prediction, which must not become new data."""
    raw = frame.raw
    return raw[0] == MAGIC_V2 and bool(raw[3] & PASSED_ON)


def read(frame: Frame) -> OwnPosition:
    """Read the position in a frame of a message in ``OWN``, without checks."""
    return _READERS[frame.msgid](frame)
