"""JSON of Remote ID receivers, converted to the OPEN_DRONE_ID messages of a MAVLink receiver.

Each object holds what one radio sent. Two formats are read, distinguished by their keys:

- DroneScout's (https://github.com/BluemarkInnovations/RemoteID-MQTT-subscriber, ``mqtt_sub.py``):
  ``UASdata`` is the structure ODID_UAS_Data of ``libopendroneid/opendroneid.h``
  (https://github.com/opendroneid/opendroneid-core-c) in base64, with every accuracy;
- rid_capture's (https://github.com/sxjack/unix_rid_capture): whole metres, m/s and seconds, and no
  accuracies.

Objects follow one another, with or without new lines between them.
"""

import base64
import json
import math
import struct
from collections.abc import Iterator
from typing import Any, Final

from companion.mavlink.wire.encode import Outgoing
from companion.mavlink.wire.foreign import ForeignSplitter, Items
from companion.mavlink.wire.remote_id import BASIC_ID, LOCATION, SYSTEM
from companion.values import Reason, Source

SENDER: Final = Source(0, 236)  # sender of the frames: no system, MAV_COMP_ID_ODID_TXRX_1
OBJECT_MAX: Final = 16 << 10  # longest object, bytes; a longer one is garbage
_UNKNOWN_STAMP_S: Final = 65_535.0
_BY_SECOND: Final = 10  # MAV_ODID_TIME_ACC of a stamp in whole seconds
_BASIC_ID = struct.Struct("<2x20sBB20s")
_LOCATION = struct.Struct("<iiffffHHh2x20s7B")
_SYSTEM = struct.Struct("<24xH4x20s4x")
_UAS_LOCATION = struct.Struct("<ifffddffifiiiiif")
_AT = {"location": 64, "system": 808, "valid": 892, "end": 914}


_STATUS: Final = {"debug", "status"}  # keys of objects about the receiver itself


class _FormatError(Exception):
    """Error of an object in another format than those that are read."""


class RidJson(ForeignSplitter):
    """Converter of the objects of one peer to frames."""

    sender = SENDER

    def _parse(self, t_ns: int, data: bytes) -> Items:
        *lines, self._pending = (self._pending + data).replace(b"\0", b"\n").split(b"\n")
        kept = self._lines(lines, OBJECT_MAX)
        out = [item for line in kept if line.strip() for item in self._object(t_ns, line)]
        # A datagram ends without a new line.
        is_end = self._is_end and not self._overlong
        if is_end and self._pending.rstrip().endswith(b"}"):
            whole = _parsed(self._pending)
            if whole is not None:
                out += self._object(t_ns, self._pending)
                self._pending = b""
        self._drop_overlong(OBJECT_MAX)
        return out

    def _object(self, t_ns: int, text: bytes) -> Items:
        if self._is_skipped():
            self._complete += 1
            return []
        found = _parsed(text)
        if found is None:
            self._stray += len(text) + 1
            return []
        self._complete += 1
        try:
            return [self._frame(t_ns, Outgoing(SENDER, *one)) for one in list(_messages(found))]
        except _FormatError as why:
            return self._refused(t_ns, Reason.UNKNOWN_MESSAGE, str(why))
        except (ValueError, struct.error, OverflowError) as why:
            return self._refused(t_ns, Reason.MALFORMED, str(why)[:80], LOCATION)


def _parsed(text: bytes) -> dict[str, Any] | None:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _messages(found: dict[str, Any]) -> Iterator[tuple[int, bytes]]:
    """Yield message ids and payloads of an object; nothing for a status of the receiver.

    Raises ``_FormatError`` for an object of another format.
    """
    data = found.get("data")
    if isinstance(data, dict) and isinstance(data.get("UASdata"), str):
        yield from _uas_data(_mac(data.get("MAC address")), base64.b64decode(data["UASdata"]))
    elif "uav id" in found or "uav latitude" in found:
        yield from _captured(_mac(found.get("mac")), found)
    elif not _STATUS & set(found):
        raise _FormatError("object of an unknown format")


def _mac(text: object) -> bytes:
    if not isinstance(text, str) or len(text) > 64:
        raise ValueError("no address")
    mac = bytes.fromhex(text.replace(":", "").replace("-", ""))
    if not 0 < len(mac) <= 20 or not any(mac):
        raise ValueError("no address")
    return mac


def _uas_data(mac: bytes, uas: bytes) -> Iterator[tuple[int, bytes]]:
    """Convert ODID_UAS_Data: its ids, the number of aircraft it represents, and its position."""
    if len(uas) < _AT["end"]:
        raise ValueError(f"UASdata has {len(uas)} bytes, needs {_AT['end']}")
    valid = uas[_AT["valid"] :]
    for number in (0, 1):
        if valid[number]:
            ua_type, kind, name = struct.unpack_from("<ii20s", uas, 32 * number)
            yield BASIC_ID, _BASIC_ID.pack(mac, _code(kind), _code(ua_type), name)
    if valid[912 - _AT["valid"]]:
        (count,) = struct.unpack_from("<H", uas, _AT["system"] + 24)
        yield SYSTEM, _SYSTEM.pack(count, mac)
    if valid[2]:
        status, course, speed, climb, lat, lon, baro, geo, _, height, *more = (
            _UAS_LOCATION.unpack_from(uas, _AT["location"])
        )
        horizontal, vertical, barometer, at_speed, at_time = map(_code, more[:5])
        yield (
            LOCATION,
            _location(
                mac,
                lat,
                lon_deg=lon,
                baro_m=baro,
                geo_m=geo,
                height_m=height,
                stamp_s=more[5],
                course_deg=course,
                speed_mps=speed,
                climb_mps=climb,
                status=_code(status),
                codes=(horizontal, vertical, barometer, at_speed, at_time),
            ),
        )


def _captured(mac: bytes, found: dict[str, Any]) -> Iterator[tuple[int, bytes]]:
    """Convert an object of rid_capture; the kind of an id follows from its key alone."""
    for key, kind in (("uav id", 1), ("caa registration", 2)):
        name = found.get(key)
        if isinstance(name, str) and name:
            yield BASIC_ID, _BASIC_ID.pack(mac, kind, 0, name.encode()[:20])
    keys = ("uav latitude", "uav longitude", "uav altitude", "uav heading", "uav speed", "seconds")
    if any(key in found for key in keys):
        lat, lon, geo, course, speed, stamp = [_number(found.get(key)) for key in keys]
        codes = (0, 0, 0, 0, _BY_SECOND)
        nan = math.nan
        yield (
            LOCATION,
            _location(
                mac,
                lat,
                lon_deg=lon,
                baro_m=nan,
                geo_m=geo,
                height_m=nan,
                stamp_s=stamp,
                course_deg=course,
                speed_mps=speed,
                climb_mps=nan,
                status=0,
                codes=codes,
            ),
        )


def _number(value: object) -> float:
    """Return the number in a value; NaN if it has none."""
    return float(value) if isinstance(value, int | float) else math.nan


def _code(value: int) -> int:
    return value if 0 <= value <= 255 else 0


def _location(
    mac: bytes,
    lat_deg: float,
    *,
    lon_deg: float,
    baro_m: float,
    geo_m: float,
    height_m: float,
    stamp_s: float,
    course_deg: float,
    speed_mps: float,
    climb_mps: float,
    status: int,
    codes: tuple[int, int, int, int, int],
) -> bytes:
    """Encode an OPEN_DRONE_ID_LOCATION; values that are out of range or NaN become unknown.

    Raises ``ValueError`` for an invalid position.
    """
    if not (abs(lat_deg) <= 90 and abs(lon_deg) <= 180):
        raise ValueError(f"latitude {lat_deg}, longitude {lon_deg} out of range")
    return _LOCATION.pack(
        round(lat_deg * 1e7),
        round(lon_deg * 1e7),
        *(one if -1000 <= one <= 31_767.5 else -1000.0 for one in (baro_m, geo_m, height_m)),
        stamp_s if 0 <= stamp_s <= 3600 else _UNKNOWN_STAMP_S,
        round(course_deg * 100) if 0 <= course_deg <= 360 else 36_100,
        round(speed_mps * 100) if 0 <= speed_mps <= 254.25 else 25_500,
        round(climb_mps * 100) if abs(climb_mps) <= 62 else 6300,
        *(mac, status, 0, *codes),
    )
