"""JSON of Remote ID receivers: two formats, in fragments and datagrams, and invalid input."""

import base64
import json
import math
import struct
from itertools import pairwise
from typing import Any

import link_support
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect

from companion.mavlink.wire.decode import decode
from companion.mavlink.wire.rid_json import OBJECT_MAX, SENDER, RidJson
from companion.values import Frame, Reason, Rejection, RemoteId, Source

MAC = "ac:67:b2:09:50:d4"
# As printed by https://github.com/sxjack/unix_rid_capture, with a location.
CAPTURED = (
    b'{ "mac" : "ac:67:b2:09:50:d4", "operator" : "GBR-OP-ZZZZZZZZZZZZ", "uav id" : "SERIAL.1", '
    b'"uav latitude" :    51.500000, "uav longitude" :    -0.100000, "uav altitude" : 120, '
    b'"uav heading" : 90, "uav speed" : 15, "seconds" : 1234, "base latitude" :    0.000000, '
    b'"base longitude" :    0.000000, "unix time" : 1546300800 }\n'
)


def uas_data(**changed: Any) -> bytes:
    """Return ODID_UAS_Data as a C compiler lays it out on a 64-bit machine: ids, location,
    system.
    """
    at: dict[str, Any] = {
        "course": 45.0, "speed": 15.5, "climb": 2.0, "lat": 62.683472, "lon": 21.974944,
        "baro": -1000.0, "geo": 120.5, "stamp": 1234.5, "horizontal": 10, "vertical": 4,
        "count": 1, "valid": (1, 0, 1), "id": b"1588E0123456789ABCDE", "time": 1,
    } | changed  # fmt: skip
    data = bytearray(920)
    struct.pack_into("<ii21s", data, 0, 2, 1, at["id"])
    struct.pack_into("<ifff", data, 64, 2, at["course"], at["speed"], at["climb"])
    struct.pack_into("<dd", data, 80, at["lat"], at["lon"])
    struct.pack_into("<ffif", data, 96, at["baro"], at["geo"], 0, 50.0)
    struct.pack_into("<iiiii", data, 112, at["horizontal"], at["vertical"], 0, 3, at["time"])
    struct.pack_into("<f", data, 132, at["stamp"])
    struct.pack_into("<H", data, 808 + 24, at["count"])
    data[892:895] = bytes(at["valid"])
    data[912] = 1
    return bytes(data)


def scouted(uas: bytes, **changed: Any) -> bytes:
    data = {"sensor ID": "ds1", "RSSI": -47, "timestamp": 1, "MAC address": MAC, "type": "BT5"}
    body = data | {"UASdata": base64.b64encode(uas).decode()} | changed
    return json.dumps({"protocol": 1.0, "data": body}).encode()


def fed(data: bytes) -> list[Frame | Rejection]:
    return link_support.fed(RidJson("rid:x"), 7, data)


def said(data: bytes) -> RemoteId:
    """Return the reported location, the last of the frames."""
    *_, last = fed(data)
    found = decode(last) if isinstance(last, Frame) else last
    assert isinstance(found, RemoteId), found
    return found


def test_dronescout_object_decodes_like_pymavlink() -> None:
    frames = [one for one in fed(scouted(uas_data())) if isinstance(one, Frame)]
    mav: Any = dialect.MAVLink(None)
    named, group, placed = [mav.decode(bytearray(one.raw)) for one in frames]
    assert bytes(named.uas_id) == b"1588E0123456789ABCDE" and named.id_type == 1
    assert (
        bytes(placed.id_or_mac)[:6]
        == bytes(named.id_or_mac)[:6]
        == bytes.fromhex(MAC.replace(":", ""))
    )
    assert (placed.latitude, placed.longitude) == (626_834_720, 219_749_440)
    assert (placed.altitude_geodetic, placed.altitude_barometric) == (120.5, -1000.0)
    assert (placed.direction, placed.speed_horizontal, placed.speed_vertical) == (4500, 1550, 200)
    assert (placed.horizontal_accuracy, placed.vertical_accuracy, placed.speed_accuracy) == (
        10,
        4,
        3,
    )
    assert (placed.timestamp, placed.timestamp_accuracy, group.area_count) == (1234.5, 1, 1)


def test_rid_capture_object_has_only_a_time_accuracy() -> None:
    found = said(CAPTURED)
    assert found.report is not None and found.heard_as == MAC.replace(":", "")
    assert (found.report.lat_deg, found.report.lon_deg) == pytest.approx((51.5, -0.1))
    assert found.report.alt_m == 120
    assert found.report.velocity_ne_mps == pytest.approx((0, 15), abs=1e-9)
    assert found.report.velocity_down_mps is None
    assert found.report.accuracy == (None, None, None, pytest.approx(1.05))
    name, _ = fed(CAPTURED)
    assert isinstance(name, Frame)
    identified = decode(name)
    assert isinstance(identified, RemoteId) and identified.uas_id == "SERIAL.1"
    assert len(fed(b'{"mac": "01:02", "uav id": "X"}\n')) == 1
    assert fed(b'{ "debug" : "rx packets 92 (0)" }\n') == fed(b'{"status": {"sensor ID": 1}}') == []


@pytest.mark.parametrize(
    ("changed", "field", "value"),
    [
        ({"course": 361.0}, "heading_deg", None), ({"speed": 255.0}, "velocity_ne_mps", None),
        ({"climb": 63.0}, "velocity_down_mps", None), ({"stamp": math.nan}, "boot_ms", None),
        ({"stamp": 65535.0}, "boot_ms", None), ({"climb": math.nan}, "velocity_down_mps", None),
    ],
)  # fmt: skip
def test_unknown_fields_are_none(changed: Any, field: str, value: Any) -> None:
    assert getattr(said(scouted(uas_data(**changed))).report, field) is value


def test_undefined_accuracy_codes_are_unknown() -> None:
    for code in (-1, 16, 99, 2**31 - 1):
        report = said(scouted(uas_data(horizontal=code, vertical=code, time=code))).report
        assert report is not None and report.accuracy is not None
        assert report.accuracy.horizontal_m is report.accuracy.vertical_m is None
        assert report.accuracy.time_s is None


@pytest.mark.parametrize(
    "data",
    [
        scouted(uas_data(lat=91.0)), scouted(uas_data(lon=math.nan)), scouted(b""),
        scouted(uas_data()[:900]), scouted(b"", UASdata="é"), scouted(b"", UASdata="A"),
        scouted(uas_data(), **{"MAC address": "zz"}), scouted(uas_data(), **{"MAC address": None}),
        CAPTURED.replace(b"51.500000", b"1e999"), CAPTURED.replace(b"51.500000", b'"51"'),
        CAPTURED.replace(b"51.500000", b"NaN"),
    ],
)  # fmt: skip
def test_implausible_messages_are_rejected(data: bytes) -> None:
    (found,) = fed(data)
    assert isinstance(found, Rejection), found
    assert found.reason is Reason.MALFORMED and found.detail


@pytest.mark.parametrize(
    "data", [b"x", b"[]", b"{", b"\xff\xfe", b"[" * 5000, b'{"mac": ' + b"9" * 5000 + b"}"]
)
def test_invalid_json_object_is_counted_in_bytes(data: bytes) -> None:
    assert fed(data + b"\n") == [
        Rejection(t_ns=7, source="rid:x", reason=Reason.GARBAGE, count=len(data) + 1)
    ]


STREAM = CAPTURED + scouted(uas_data()) + b"\n" + CAPTURED.strip()


@given(st.lists(st.integers(1, len(STREAM) - 1), max_size=9))
def test_split_input_gives_the_same_result(cuts: list[int]) -> None:
    at = [0, *sorted(cuts), len(STREAM)]
    splitter = RidJson("x")
    pieces = [STREAM[a:b] for a, b in pairwise(at)]
    whole = link_support.fed(RidJson("x"), 7, STREAM)
    assert len(whole) == 7  # two per rid_capture object, three per DroneScout object
    assert [one for piece in pieces for one in link_support.fed(splitter, 7, piece)] == whole
    assert splitter.finish(8) == []


def test_endless_object_uses_bounded_memory() -> None:
    splitter = RidJson("x")
    found = [one for _ in range(500) for one in splitter.feed(7, b'{"a":"' + b"M" * 200)]
    assert len(splitter._pending) <= OBJECT_MAX
    found += splitter.feed(7, b"}\n" + CAPTURED)
    lost = sum(one.count for one in found if isinstance(one, Rejection))
    assert lost == 500 * 206 + 2
    assert sum(isinstance(one, Frame) for one in found) == 2


@given(st.binary(max_size=920).map(scouted) | st.binary(max_size=60))
def test_arbitrary_bytes_never_raise(data: bytes) -> None:
    for found in fed(data + b"\n"):
        assert isinstance(found, Rejection) or isinstance(decode(found), RemoteId | Rejection)


def test_rid_frames_use_system_0_and_a_receiver_component() -> None:
    assert Source(sysid=0, compid=236) == SENDER
