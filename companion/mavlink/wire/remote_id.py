"""Decoder of Remote ID: OPEN_DRONE_ID messages of receivers, and ASTM F3411 messages in packs.

Sources: https://mavlink.io/en/services/opendroneid.html for the former; for the 25 bytes of a
message in a pack ASTM F3411-22a, 5.4.5 (ASD-STAN prEN 4709-002 has the same), as
``libopendroneid/opendroneid.h`` of https://github.com/opendroneid/opendroneid-core-c lays them out.

A receiver identifies the sender of a broadcast by its radio's address (``id_or_mac``). Messages
without one are from a vehicle to its own transmitter, and are ignored: it reports itself.
"""

import math
import re
import struct
from dataclasses import dataclass, replace
from typing import Final

from companion.mavlink.wire import accuracy
from companion.mavlink.wire.payload import unpack
from companion.values import Accuracy, AltitudeDatum, Frame, RemoteId, Report, UavKind

BASIC_ID: Final = 12900
LOCATION: Final = 12901
SYSTEM: Final = 12904
MESSAGE_PACK: Final = 12915
RECEIVERS: Final = range(236, 239)  # components that receive others (MAV_COMP_ID_ODID_TXRX_1 to 3)
_UNPLACED: Final = (0, 0)
_NO_ALTITUDE_M: Final = -1000.0
_MESSAGE_BYTES: Final = 25
_PACK_MAX: Final = 9
_HOUR_MS: Final = 3_600_000
_PLAIN: Final = re.compile(r"[A-Za-z0-9._-]{1,20}")

_BASIC_ID = struct.Struct("<xx20sBx20s")
_LOCATION = struct.Struct("<iiffxxxxfHHhxx20sxxBBxBB")
_SYSTEM = struct.Struct("<24xH2x2x20s4x")
_PACK = struct.Struct("<xx20sBB225s")


def remote_id(frame: Frame) -> RemoteId | None:
    """Decode a message of a Remote ID receiver; None for a vehicle's own. Raises ``ValueError``."""
    said = _READERS[frame.msgid](frame)
    is_own = frame.source.compid not in RECEIVERS
    if (is_own or said.uas_id is None) and not any(bytes.fromhex(said.heard_as)):
        return None
    return said


def _message(frame: Frame, heard_as: bytes) -> RemoteId:
    return RemoteId(t_ns=frame.t_ns, source=frame.source, heard_as=heard_as.rstrip(b"\0").hex())


def _basic_id(frame: Frame) -> RemoteId:
    heard_as, kind, uas_id = unpack(frame, _BASIC_ID)
    return _add_id(_message(frame, heard_as), kind, uas_id)


def _location(frame: Frame) -> RemoteId:
    lat, lon, baro_m, geo_m, stamp_s, course, speed, climb, heard_as, *codes = unpack(
        frame, _LOCATION
    )
    if not all(map(math.isfinite, (baro_m, geo_m, stamp_s))):
        raise ValueError("height or time is not finite")
    horizontal, vertical, at_speed, at_time = codes
    return _located(
        _message(frame, heard_as),
        _Place(
            lat_1e7=lat,
            lon_1e7=lon,
            baro_m=baro_m,
            geo_m=geo_m,
            stamp_s=stamp_s if 0 <= stamp_s <= 3600 else None,
            course_deg=course * 0.01 if course <= 36_000 else None,
            speed_mps=speed * 0.01 if speed < 25_500 else None,
            climb_mps=climb * 0.01 if abs(climb) <= 6200 else None,
            codes=(horizontal, vertical, at_speed, at_time),
        ),
    )


def _system(frame: Frame) -> RemoteId:
    count, heard_as = unpack(frame, _SYSTEM)
    return replace(_message(frame, heard_as), aircraft=count)


def _pack(frame: Frame) -> RemoteId:
    heard_as, size, count, messages = unpack(frame, _PACK)
    if size != _MESSAGE_BYTES or not 0 < count <= _PACK_MAX:
        raise ValueError(f"invalid pack of {count} messages of {size} bytes")
    said = _message(frame, heard_as)
    for at in range(0, count * size, size):
        said = _add_message(said, messages[at : at + size])
    return said


def _add_message(said: RemoteId, message: bytes) -> RemoteId:
    match message[0] >> 4:
        case 0:
            return _add_id(said, message[1] >> 4, message[2:22])
        case 1:
            return _located(said, _packed_place(message))
        case 4:
            return replace(said, aircraft=int.from_bytes(message[10:12], "little"))
        case _:
            return said


_PACKED = struct.Struct("<xBBBbiiHHxxBBHBx")


def _packed_place(message: bytes) -> "_Place":
    flags, course, speed, climb, lat, lon, baro, geo, codes, more, stamp, at_time = _PACKED.unpack(
        message
    )
    course_deg = course + 180 * (flags >> 1 & 1)
    speed_mps = 0.75 * speed + 63.75 if flags & 1 else 0.25 * speed
    return _Place(
        lat_1e7=lat,
        lon_1e7=lon,
        baro_m=baro * 0.5 + _NO_ALTITUDE_M,
        geo_m=geo * 0.5 + _NO_ALTITUDE_M,
        stamp_s=stamp * 0.1 if stamp <= 36_000 else None,
        course_deg=float(course_deg) if course_deg <= 360 else None,
        speed_mps=speed_mps if speed_mps < 255 else None,
        climb_mps=climb * 0.5 if abs(climb) <= 124 else None,
        codes=(codes & 15, codes >> 4, more & 15, at_time & 15),
    )


_READERS: Final = {BASIC_ID: _basic_id, LOCATION: _location, SYSTEM: _system, MESSAGE_PACK: _pack}
READ: Final = frozenset(_READERS)  # message ids that remote_id reads


def _add_id(said: RemoteId, kind: int, uas_id: bytes) -> RemoteId:
    """Add an id unless a better kind is known: serial number, registration, flight id."""
    name = uas_id.rstrip(b"\0 ")
    if not name or kind == 0 or (said.id_kind is not None and said.id_kind <= kind):
        return said
    text = name.decode("latin-1")
    plain = kind in (1, 2) and _PLAIN.fullmatch(text) is not None
    return replace(said, uas_id=text if plain else uas_id.hex(), id_kind=kind)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Place:
    """Location in a Remote ID message: 1e-7 degrees, metres, m/s (climb is positive up), codes."""

    lat_1e7: int
    lon_1e7: int
    baro_m: float
    geo_m: float
    stamp_s: float | None
    course_deg: float | None
    speed_mps: float | None
    climb_mps: float | None
    codes: tuple[int, int, int, int]


def _located(said: RemoteId, at: _Place) -> RemoteId:
    if (at.lat_1e7, at.lon_1e7) == _UNPLACED:
        return said
    if abs(at.lat_1e7) > 900_000_000 or abs(at.lon_1e7) > 1_800_000_000:
        place = f"latitude {at.lat_1e7 * 1e-7}, longitude {at.lon_1e7 * 1e-7}"
        raise ValueError(f"{place} out of range")
    datum, alt_m = AltitudeDatum.GEOMETRIC, at.geo_m
    if alt_m <= _NO_ALTITUDE_M:
        datum, alt_m = AltitudeDatum.PRESSURE, at.baro_m
    if alt_m <= _NO_ALTITUDE_M:
        return replace(said, is_flat=True)
    velocity = None
    if at.speed_mps is not None and at.course_deg is not None:
        course = math.radians(at.course_deg)
        velocity = (at.speed_mps * math.cos(course), at.speed_mps * math.sin(course))
    report = Report(
        t_ns=said.t_ns,
        uav=UavKind.REMOTE_ID.uav(said.heard_as),
        source=said.source,
        lat_deg=at.lat_1e7 * 1e-7,
        lon_deg=at.lon_1e7 * 1e-7,
        alt_m=alt_m,
        alt_datum=datum,
        relative_alt_m=None,
        velocity_ne_mps=velocity,
        velocity_down_mps=None if at.climb_mps is None else -at.climb_mps,
        heading_deg=at.course_deg,
        boot_ms=None if at.stamp_s is None else _of_hour(said.t_ns, at.stamp_s),
        tslc_s=None,
        accuracy=_accuracy(*at.codes),
    )
    return replace(said, report=report)


def _accuracy(horizontal: int, vertical: int, speed: int, time: int) -> Accuracy:
    """Decode accuracy codes; the stamp's accuracy, in steps of 0.1 s, gains half a step."""
    known = accuracy.remote_id(horizontal, vertical, speed)
    return known._replace(time_s=0.1 * time + 0.05 if 0 < time < 16 else None)


def _of_hour(t_ns: int, stamp_s: float) -> int:
    """Convert a stamp of seconds after the full hour to milliseconds of a continuous 32-bit clock.

    The hour is the one that puts the stamp nearest to its arrival.
    """
    stamp_ms = round(stamp_s * 1e3)
    hours = round((t_ns // 1_000_000 - stamp_ms) / _HOUR_MS)
    return (hours * _HOUR_MS + stamp_ms) & 0xFFFF_FFFF
