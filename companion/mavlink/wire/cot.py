"""Parser of Cursor on Target events, from XML and from TAK's protobuf.

Sources: the schema ``Event.xsd`` of MITRE (MP090284) for the fields: ``ce`` and ``le`` are standard
deviations in metres where they are errors, 9999999 where they are unknown, as is ``hae``; and
``takproto`` (https://github.com/snstac/takproto) for the protobuf of TAK's protocol, version 1.
Document types, and so entities, are rejected.
"""

import math
import re
import struct
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any, Final, NamedTuple
from xml.parsers import expat

DEPTH_MAX: Final = 32  # deepest nesting of elements
UNKNOWN: Final = 9_999_999.0
"""In place of an unknown height or accuracy in XML."""
UNKNOWN_LEAST: Final = 999_999.0
"""The same in TAK's protobuf: an accuracy of at least this is unknown."""
SPEED_MAX_MPS: Final = 1000.0  # speeds from which on they count as unknown
OWN: Final = "uav-companion-beams."
"""Prefix of the ids of events that this program writes about other aircraft."""
_TIME_MAX_MS: Final = 1 << 48
_AIR: Final = re.compile(r"a-[a-zA-Z.]-A(-.*)?")


class CotEvent(NamedTuple):
    """Cursor on Target event: id, type, how it was determined, time (Unix, ms), position, motion.

    ``ce_m`` and ``le_m`` are standard deviations; None: unknown.
    """

    uid: str
    kind: str
    how: str
    time_ms: int
    lat_deg: float
    lon_deg: float
    hae_m: float | None
    ce_m: float | None
    le_m: float | None
    course_deg: float | None = None
    speed_mps: float | None = None
    slope_deg: float | None = None

    @property
    def is_aircraft(self) -> bool:
        """Whether the event is the position of an airborne object (type a-?-A)."""
        return _AIR.fullmatch(self.kind) is not None


def from_xml(text: bytes) -> CotEvent:
    """Parse one event from XML. Raises ``ValueError``."""
    found: dict[str, dict[str, str]] = {}
    depth = 0

    def begun(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > DEPTH_MAX:
            raise ValueError(f"XML elements nested deeper than {DEPTH_MAX}")
        if name in ("event", "point", "track"):
            found.setdefault(name, attributes)

    def ended(_: str) -> None:
        nonlocal depth
        depth -= 1

    def refused(*_: Any) -> None:
        raise ValueError("document type (DTD) is not allowed")

    parser = expat.ParserCreate("utf-8")
    parser.StartElementHandler, parser.EndElementHandler = begun, ended
    parser.StartDoctypeDeclHandler = refused
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        raise ValueError(f"malformed XML: {error}") from error
    event, point = found.get("event", {}), found.get("point", {})
    track = found.get("track", {})
    try:
        time_ms = _time_ms(event["time"])
        uid, kind, how = event["uid"], event["type"], event.get("how", "")
        place = [float(point[key]) for key in ("lat", "lon", "hae", "ce", "le")]
        motion = [float(track.get(key, "nan")) for key in ("course", "speed", "slope")]
    except KeyError as missing:
        raise ValueError(f"{missing.args[0]} is missing") from missing
    return _checked(uid, kind=kind, how=how, time_ms=time_ms, place=place, motion=motion)


def _time_ms(text: str) -> int:
    at = datetime.fromisoformat(text)
    return round((at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp() * 1e3)


def _checked(
    uid: str, *, kind: str, how: str, time_ms: int, place: list[float], motion: list[float]
) -> CotEvent:
    lat_deg, lon_deg, hae_m, ce_m, le_m = place
    course_deg, speed_mps, slope_deg = motion
    if not 0 <= time_ms < _TIME_MAX_MS:
        raise ValueError(f"time {time_ms} ms is out of range")
    if not uid:
        raise ValueError("uid is missing")
    has_slope = -90 < slope_deg < 90
    if has_slope and speed_mps * abs(math.tan(math.radians(slope_deg))) >= SPEED_MAX_MPS:
        has_slope = False
    if not (abs(lat_deg) <= 90 and abs(lon_deg) <= 180):
        raise ValueError(f"latitude {lat_deg}, longitude {lon_deg} out of range")
    return CotEvent(
        uid=uid,
        kind=kind,
        how=how,
        time_ms=time_ms,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        hae_m=hae_m if -12_000 < hae_m < 100_000 else None,
        ce_m=ce_m if 0 < ce_m < UNKNOWN_LEAST else None,
        le_m=le_m if 0 < le_m < UNKNOWN_LEAST else None,
        course_deg=course_deg if 0 <= course_deg <= 360 else None,
        speed_mps=speed_mps if 0 <= speed_mps < SPEED_MAX_MPS else None,
        slope_deg=slope_deg if has_slope else None,
    )


# --- TAK's protobuf -----------------------------------------------------------------------------


def from_protobuf(message: bytes) -> CotEvent | None:
    """Parse a TakMessage; None if it contains no event. Raises ``ValueError``."""
    body = dict(_fields(message)).get(2)
    if body is None:
        return None
    event = dict(_fields(_bytes(body)))
    detail = dict(_fields(_bytes(event.get(15, b""))))
    track = dict(_fields(_bytes(detail.get(7, b""))))
    place = [_double(event.get(number, 0.0)) for number in range(10, 15)]
    # Absent fields are zero; the whole track is absent if there is none.
    absent = 0.0 if 7 in detail else math.nan
    motion = [_double(track.get(number, absent)) for number in (2, 1)]
    names = [_bytes(event.get(number, b"")).decode("utf-8") for number in (5, 1, 9)]
    time_ms = event.get(6)
    if not isinstance(time_ms, int):
        raise ValueError("time is missing")
    uid, kind, how = names
    return _checked(
        uid, kind=kind, how=how, time_ms=time_ms, place=place, motion=[*motion, math.nan]
    )


def _fields(message: bytes) -> Iterator[tuple[int, int | float | bytes]]:
    """Yield number and value of each field (https://protobuf.dev/programming-guides/encoding/)."""
    at = 0
    while at < len(message):
        tag, at = varint(message, at)
        match tag & 7:
            case 0:
                value, at = varint(message, at)
                yield tag >> 3, value
            case 1:
                yield tag >> 3, *struct.unpack_from("<d", _span(message, at, 8))
                at += 8
            case 2:
                size, at = varint(message, at)
                yield tag >> 3, _span(message, at, size)
                at += size
            case 5:
                _span(message, at, 4)
                at += 4
            case _:
                raise ValueError("unknown protobuf wire type")


def varint(message: bytes, at: int) -> tuple[int, int]:
    """Decode a varint; return its value and the index after it. Raises ``ValueError``."""
    value = 0
    for number, byte in enumerate(message[at : at + 10]):
        value |= (byte & 0x7F) << 7 * number
        if byte < 0x80:
            return value, at + number + 1
    raise ValueError("truncated varint")


def _span(message: bytes, at: int, size: int) -> bytes:
    if at + size > len(message):
        raise ValueError("truncated field")
    return message[at : at + size]


def _bytes(value: object) -> bytes:
    if not isinstance(value, bytes):
        raise ValueError("expected a length-delimited field")
    return value


def _double(value: object) -> float:
    if not isinstance(value, float):
        raise ValueError("expected a float field")
    return value
