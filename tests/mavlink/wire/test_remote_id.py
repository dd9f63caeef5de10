"""Remote ID: messages made by pymavlink, published message packs, and invalid input."""

import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect

from companion.mavlink.trust.remote_id import ADDRESSES_MAX, DATUM_NS, NAMED_NS, RemoteIds
from companion.mavlink.wire.decode import decode
from companion.mavlink.wire.encode import Outgoing, pack
from companion.mavlink.wire.remote_id import LOCATION, MESSAGE_PACK, READ
from companion.values import AltitudeDatum, Frame, Reason, Rejection, RemoteId, Report, Source

S = 1_000_000_000
RECEIVER = Source(9, 236)
MAC = bytes.fromhex("ac67b20950d4")
# A location from the worked example of https://github.com/tuupola/librid.
PACKED = bytes.fromhex("12202d3e0420bd5c25401c190d0000c10834084a0339300100")
NAMED = b"\x02\x12" + b"1588E0123456789ABCDE" + bytes(3)  # protocol 2, basic id: serial number
GROUP = b"\x42" + bytes(9) + b"\x03\0" + bytes(13)  # system: three aircraft


def padded(data: bytes, size: int = 20) -> list[int]:
    return list(data.ljust(size, b"\0"))


def framed(message: Any, t_ns: int = 7, source: Source = RECEIVER) -> Frame:
    mav = dialect.MAVLink(None, srcSystem=source.sysid, srcComponent=source.compid)
    raw = bytes(message.pack(mav))
    return Frame(t_ns=t_ns, link="udp", source=source, msgid=message.get_msgId(), raw=raw)


def basic_id(text: bytes = b"1588E0123456789ABCDE", kind: int = 1, mac: bytes = MAC) -> Any:
    return dialect.MAVLink_open_drone_id_basic_id_message(0, 0, padded(mac), kind, 2, padded(text))


def location(mac: bytes = MAC, **changed: Any) -> Any:
    fields: dict[str, Any] = {
        "target_system": 0, "target_component": 0, "id_or_mac": padded(mac), "status": 2,
        "direction": 4500, "speed_horizontal": 1550, "speed_vertical": 200,
        "latitude": 626_834_720, "longitude": 219_749_440, "altitude_barometric": -1000.0,
        "altitude_geodetic": 120.5, "height_reference": 0, "height": 50.0,
        "horizontal_accuracy": 10, "vertical_accuracy": 4, "barometer_accuracy": 0,
        "speed_accuracy": 3, "timestamp": 1234.5, "timestamp_accuracy": 1,
    }  # fmt: skip
    return dialect.MAVLink_open_drone_id_location_message(**(fields | changed))


def packed(*messages: bytes, mac: bytes = MAC, size: int = 25, count: int | None = None) -> Any:
    count = len(messages) if count is None else count
    return dialect.MAVLink_open_drone_id_message_pack_message(
        0, 0, padded(mac), size, count, padded(b"".join(messages), 225)
    )


def said(message: Any, t_ns: int = 7, source: Source = RECEIVER) -> RemoteId:
    found = decode(framed(message, t_ns, source))
    assert isinstance(found, RemoteId), found
    return found


def reported(message: Any, t_ns: int = 7) -> Report:
    found = said(message, t_ns).report
    assert found is not None
    return found


def test_location_message_is_decoded() -> None:
    """Packed by pymavlink; 15.5 m/s to the north-east and 2 m/s up."""
    report = reported(location())
    assert (report.lat_deg, report.lon_deg) == pytest.approx((62.683472, 21.974944))
    assert (report.alt_m, report.alt_datum) == (120.5, AltitudeDatum.GEOMETRIC)
    assert report.velocity_ne_mps == pytest.approx((15.5 * 0.5**0.5, 15.5 * 0.5**0.5))
    assert report.velocity_down_mps == -2.0
    assert report.accuracy == pytest.approx((6.17, 6.17, 0.617, 0.15), rel=1e-3)


def test_message_pack_decodes_like_single_messages() -> None:
    """The published example, against the same fields in a single MAVLink message."""
    found = said(packed(NAMED, PACKED))
    assert (found.uas_id, found.aircraft) == ("1588E0123456789ABCDE", None)
    assert found.report is not None
    assert found.report == reported(location())
    assert said(packed(NAMED, PACKED, GROUP)).aircraft == 3


def test_fast_and_westward_flags_are_decoded() -> None:
    flags = PACKED[1] | 0b11
    fast = PACKED[:1] + bytes([flags, 90, 100]) + PACKED[4:]
    report = said(packed(NAMED, fast)).report
    assert report is not None
    assert report.heading_deg == 270
    assert report.velocity_ne_mps == pytest.approx((0.0, -(100 * 0.75 + 63.75)), abs=1e-9)


@pytest.mark.parametrize(
    ("changed", "field"),
    [
        ({"direction": 36_100}, "heading_deg"), ({"direction": 36_100}, "velocity_ne_mps"),
        ({"speed_horizontal": 25_500}, "velocity_ne_mps"),
        ({"speed_vertical": 6300}, "velocity_down_mps"), ({"timestamp": 65_535.0}, "boot_ms"),
    ],
)  # fmt: skip
def test_unknown_fields_are_none(changed: dict[str, Any], field: str) -> None:
    assert getattr(reported(location(**changed)), field) is None


@pytest.mark.parametrize(
    ("code", "horizontal_m"),
    [
        (0, None),
        (1, 18_520.0),
        (8, 92.6),
        (9, 30.0),
        (12, 1.0),
        (13, None),
        (15, None),
        (255, None),
    ],
)
def test_remote_id_accuracy_codes_are_95_percent_limits(
    code: int, horizontal_m: float | None
) -> None:
    told = reported(location(horizontal_accuracy=code)).accuracy
    assert told is not None
    assert told.horizontal_m == (
        None if horizontal_m is None else pytest.approx(0.617 * horizontal_m, rel=1e-3)
    )


@pytest.mark.parametrize(("code", "time_s"), [(0, None), (1, 0.15), (15, 1.55), (16, None)])
def test_timestamp_accuracy_is_in_tenths_of_a_second(code: int, time_s: float | None) -> None:
    told = reported(location(timestamp_accuracy=code)).accuracy
    assert told is not None and told.time_s == (time_s and pytest.approx(time_s))


def test_pressure_altitude_is_used_without_a_geometric_one() -> None:
    by_pressure = reported(location(altitude_geodetic=-1000.0, altitude_barometric=80.0))
    assert (by_pressure.alt_m, by_pressure.alt_datum) == (80.0, AltitudeDatum.PRESSURE)
    flat = said(location(altitude_geodetic=-1000.0))
    assert (flat.report, flat.is_flat) == (None, True)
    assert said(location(latitude=0, longitude=0)).report is None


def test_hourly_stamp_is_unwrapped() -> None:
    """Differences between stamps equal differences between times, across the hour."""
    hour_ns = 1_700_000_000 * S // (3600 * S) * 3600 * S
    before = reported(location(timestamp=3599.0), hour_ns - S // 2).boot_ms
    after = reported(location(timestamp=0.5), hour_ns + S).boot_ms
    late = reported(location(timestamp=3599.5), hour_ns + 9 * S).boot_ms
    assert before is not None and after is not None and late is not None
    assert (after - before, late - before) == (1500, 500)


@pytest.mark.parametrize(
    "message",
    [
        location(latitude=900_000_001), location(longitude=-1_800_000_001),
        location(altitude_geodetic=float("nan")), location(timestamp=float("inf")),
        packed(NAMED, size=24), packed(NAMED, count=10), packed(NAMED, count=0),
        packed(NAMED, PACKED[:5] + struct.pack("<i", 2_000_000_000) + PACKED[9:]),
    ],
)  # fmt: skip
def test_implausible_messages_are_rejected(message: Any) -> None:
    found = decode(framed(message))
    assert isinstance(found, Rejection)
    assert found.reason is Reason.MALFORMED and found.detail


def test_messages_from_vehicle_to_transmitter_are_ignored() -> None:
    assert decode(framed(location(mac=b""), source=Source(1, 1))) is None
    assert (
        decode(framed(location(mac=b""))) is None
    )  # a receiver that does not give the transmitter
    assert isinstance(decode(framed(packed(NAMED, PACKED, mac=b""))), RemoteId)
    assert decode(framed(packed(NAMED, PACKED, mac=b""), source=Source(1, 1))) is None


def test_non_text_ids_are_hexadecimal() -> None:
    assert said(basic_id(b"N.123-x", 2)).uas_id == "N.123-x"
    for text, kind in ((b"\xff\0\x01", 1), (b"a b", 1), (b"../etc", 2), (b"abc", 3), (b"\x01", 4)):
        found = said(basic_id(text, kind)).uas_id
        assert found is not None and bytes.fromhex(found) == text.ljust(20, b"\0")
    assert said(basic_id(b"abc", 0)).uas_id is said(basic_id(b"")).uas_id is None


# --- identities -----------------------------------------------------------------------------


def named(ids: RemoteIds, message: Any, t_ns: int = 7, source: Source = RECEIVER) -> Any:
    return ids.merge(said(message, t_ns, source))


def refused(found: Any) -> Reason:
    assert isinstance(found, Rejection)
    return found.reason


def test_position_gets_the_id_received_from_its_address() -> None:
    ids = RemoteIds()
    assert refused(named(ids, location())) is Reason.NO_IDENTITY
    assert named(ids, basic_id()) is None
    assert named(ids, location()).uav == "rid:1588E0123456789ABCDE"
    other = location(mac=b"\x01\x02")
    assert refused(named(ids, other)) is Reason.NO_IDENTITY
    assert refused(named(ids, location(), source=Source(8, 236))) is Reason.NO_IDENTITY
    assert named(ids, packed(NAMED, PACKED, mac=b"\x01")).uav == "rid:1588E0123456789ABCDE"


def test_serial_number_is_preferred_to_a_session_id() -> None:
    ids = RemoteIds()
    for text, kind, name in ((b"x", 4, "78" + 19 * "00"), (b"N1", 2, "N1"), (b"x", 4, "N1")):
        named(ids, basic_id(text, kind))
        assert named(ids, location()).uav == f"rid:{name}"


def test_id_expires_with_its_address() -> None:
    ids = RemoteIds()
    named(ids, basic_id(), 0)
    assert isinstance(named(ids, location(), NAMED_NS), Report)
    assert isinstance(named(ids, location(), 2 * NAMED_NS), Report)
    assert refused(named(ids, location(), 3 * NAMED_NS + 1)) is Reason.NO_IDENTITY


def test_group_remote_id_is_rejected_as_shared() -> None:
    ids = RemoteIds()
    assert refused(named(ids, packed(NAMED, PACKED, GROUP))) is Reason.SHARED_ID
    system = dialect.MAVLink_open_drone_id_system_message(
        0, 0, padded(MAC), 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0
    )
    assert named(ids, system) is None
    assert isinstance(named(ids, location()), Report)


def test_altitudes_of_two_datums_are_not_mixed() -> None:
    ids = RemoteIds()
    by_pressure = location(altitude_geodetic=-1000.0, altitude_barometric=80.0)
    named(ids, basic_id(), 0)
    assert isinstance(named(ids, location(), 0), Report)
    assert refused(named(ids, by_pressure, DATUM_NS)) is Reason.NO_ALTITUDE
    assert isinstance(named(ids, by_pressure, DATUM_NS + 1), Report)
    assert refused(named(ids, location(altitude_geodetic=-1000.0), S)) is Reason.NO_ALTITUDE


def test_invented_addresses_use_bounded_memory() -> None:
    ids = RemoteIds()
    for number in range(ADDRESSES_MAX + 10):
        named(ids, basic_id(mac=(number + 1).to_bytes(4, "big")))
    assert len(ids._known) == ADDRESSES_MAX


@given(st.sampled_from(sorted(READ)), st.binary(max_size=249), st.integers(235, 239))
def test_arbitrary_payloads_never_raise(msgid: int, payload: bytes, compid: int) -> None:
    source = Source(9, compid)
    frame = Frame(
        t_ns=7,
        link="udp",
        source=source,
        msgid=msgid,
        raw=pack(Outgoing(source, msgid, payload), 0),
    )
    found = decode(frame)
    assert found is None or isinstance(found, Rejection | RemoteId)
    if isinstance(found, RemoteId):
        RemoteIds().merge(found)


@given(st.lists(st.binary(min_size=25, max_size=25), min_size=1, max_size=9))
def test_arbitrary_message_packs_never_raise(messages: list[bytes]) -> None:
    payload = bytes(2) + MAC.ljust(20, b"\0") + bytes([25, len(messages)]) + b"".join(messages)
    frame = Frame(
        t_ns=7,
        link="x",
        source=RECEIVER,
        msgid=MESSAGE_PACK,
        raw=pack(Outgoing(RECEIVER, MESSAGE_PACK, payload), 0),
    )
    assert isinstance(decode(frame), Rejection | RemoteId)
    assert LOCATION in READ
