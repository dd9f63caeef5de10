"""Decoded fields equal pymavlink's; a field is None exactly if it is not marked as valid."""

import math
import struct
from collections import Counter
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect
from support import examples

from companion.mavlink.wire.decode import DECODED, decode
from companion.mavlink.wire.remote_id import READ as REMOTE_ID
from companion.values import (
    AdsbVehicle,
    AltitudeDatum,
    Attitude,
    EstimatorStatus,
    Frame,
    GnssStatus,
    Message,
    Presence,
    Reason,
    Rejection,
    Report,
    Source,
    SystemTime,
)

Make = Callable[..., Frame]
T_NS = 1_700_000_000_123_456_789
HERE = (473977419, 85455938)


def as_frame(raw: bytes) -> Frame:
    v2 = raw[0] == 0xFD
    source = Source(raw[5], raw[6]) if v2 else Source(raw[3], raw[4])
    msgid = int.from_bytes(raw[7:10], "little") if v2 else raw[5]
    return Frame(t_ns=T_NS, link="udpin:x", source=source, msgid=msgid, raw=raw)


def sent(message: dialect.MAVLink_message) -> Frame:
    """Return the message as pymavlink sends it over MAVLink 2, with trailing zeros truncated."""
    return as_frame(bytes(message.pack(dialect.MAVLink(None, 7, 3))))


def sent_v1(message: dialect.MAVLink_message, size: int) -> Frame:
    """Return the message over MAVLink 1: its first ``size`` bytes, without extension fields.

    (pymavlink packs the extensions into version 1 as well.)
    """
    whole = bytes(message.pack(dialect.MAVLink(None, 7, 3), force_mavlink1=True))
    body = bytes([size]) + whole[2 : 6 + size]
    crc = dialect.x25crc(body + bytes([message.crc_extra])).crc
    raw = whole[:1] + body + crc.to_bytes(2, "little")
    assert dialect.MAVLink(None).decode(bytearray(raw)).get_msgId() == message.get_msgId()
    return as_frame(raw)


def position(lat: int = HERE[0], lon: int = HERE[1], hdg: int = 0, **other: int) -> Frame:
    named = {"alt": 0, "relative_alt": 0, "vx": 0, "vy": 0, "vz": 0} | other
    return sent(
        dialect.MAVLink_global_position_int_message(
            other.get("time_boot_ms", 5),
            lat,
            lon,
            named["alt"],
            named["relative_alt"],
            named["vx"],
            named["vy"],
            named["vz"],
            hdg,
        )
    )


def adsb(
    flags: int = 0xFFFF,
    *,
    lat: int = HERE[0],
    lon: int = HERE[1],
    altitude_type: int = 0,
    altitude: int = 0,
    heading: int = 0,
    speed: int = 0,
    climb: int = 0,
    tslc: int = 0,
    icao: int = 0x4CA7B3,
    callsign: bytes = b"EIN123",
    emitter_type: int = 3,
) -> Frame:
    return sent(
        dialect.MAVLink_adsb_vehicle_message(
            icao, lat, lon, altitude_type, altitude, heading, speed, climb, callsign,
            emitter_type, tslc, flags, 1200,
        )
    )  # fmt: skip


def attitude(angles: list[float]) -> Frame:
    return sent(dialect.MAVLink_attitude_message(77, *angles))


def gps_raw_int(
    satellites: int = 9, h_acc: int = 0, v_acc: int = 0, vel_acc: int = 0
) -> dialect.MAVLink_message:
    return dialect.MAVLink_gps_raw_int_message(
        1, 3, *HERE, 488_000, 80, 120, 500, 100, satellites, 1, h_acc, v_acc, vel_acc, 5, 6
    )


def report(frame: Frame) -> Report:
    found = decode(frame)
    assert isinstance(found, Report), found
    return found


def traffic(frame: Frame) -> AdsbVehicle:
    found = decode(frame)
    assert isinstance(found, AdsbVehicle), found
    return found


def rejected(frame: Frame) -> Reason:
    """Return the reason, after checking the rejection's source and message id."""
    found = decode(frame)
    assert isinstance(found, Rejection), found
    assert (found.t_ns, found.source, found.count) == (T_NS, "7:3", 1)
    assert found.msgid == frame.msgid
    return found.reason


# --- whole log against pymavlink ----------------------------------------------------------------


def expected(m: dialect.MAVLink_message, t_ns: int, link: str) -> Message | None:
    """Return pymavlink's field value in exact decimal units."""
    source = Source(m.get_srcSystem(), m.get_srcComponent())
    match m.get_type():
        case "HEARTBEAT":
            return Presence(
                t_ns=t_ns,
                source=source,
                mav_type=m.type,
                autopilot=m.autopilot,
                is_armed=bool(m.base_mode & 128),
            )
        case "SYSTEM_TIME":
            return SystemTime(
                t_ns=t_ns, source=source, unix_us=m.time_unix_usec or None, boot_ms=m.time_boot_ms
            )
        case "ATTITUDE":
            return Attitude(
                t_ns=t_ns,
                source=source,
                boot_ms=m.time_boot_ms,
                roll_rad=m.roll,
                pitch_rad=m.pitch,
                yaw_rad=m.yaw,
                rollspeed_radps=m.rollspeed,
                pitchspeed_radps=m.pitchspeed,
                yawspeed_radps=m.yawspeed,
            )
        case "EKF_STATUS_REPORT":
            knows = m.flags & dialect.EKF_ATTITUDE != 0
            either = dialect.EKF_POS_HORIZ_REL | dialect.EKF_POS_HORIZ_ABS
            places = m.flags & either != 0 and m.flags & dialect.EKF_CONST_POS_MODE == 0
            return EstimatorStatus(
                t_ns=t_ns,
                source=source,
                link=link,
                knows_attitude=knows,
                knows_position=places,
                is_absolute=m.flags & dialect.EKF_POS_HORIZ_ABS != 0
                and m.flags & dialect.EKF_GPS_GLITCHING == 0,
                compass_ratio=m.compass_variance,
            )
        case "GPS_RAW_INT":
            h_acc, v_acc, vel_acc = (
                value / 1000 or None for value in (m.h_acc, m.v_acc, m.vel_acc)
            )
            return GnssStatus(
                t_ns=t_ns,
                source=source,
                fix_type=m.fix_type,
                alt_m=m.alt * 1e-3,
                h_acc_m=h_acc,
                v_acc_m=v_acc,
                vel_acc_mps=vel_acc,
                time_us=m.time_usec,
            )
        case "GLOBAL_POSITION_INT":
            return Report(
                t_ns=t_ns,
                uav=str(source),
                source=source,
                lat_deg=m.lat / 1e7,
                lon_deg=m.lon / 1e7,
                alt_m=m.alt / 1000,
                alt_datum=AltitudeDatum.MSL,
                relative_alt_m=m.relative_alt / 1000,
                velocity_ne_mps=(m.vx / 100, m.vy / 100),
                velocity_down_mps=m.vz / 100,
                heading_deg=m.hdg / 100,
                boot_ms=m.time_boot_ms,
                tslc_s=None,
            )
        case "ADSB_VEHICLE":
            course, speed = math.radians(m.heading / 100), m.hor_velocity / 100
            datums = (AltitudeDatum.PRESSURE, AltitudeDatum.GEOMETRIC)
            return AdsbVehicle(
                t_ns=t_ns,
                icao=m.ICAO_address,
                source=source,
                callsign=m.callsign,
                position_deg=(m.lat / 1e7, m.lon / 1e7),
                alt_m=m.altitude / 1000,
                alt_datum=datums[m.altitude_type],
                heading_deg=m.heading / 100,
                velocity_ne_mps=(speed * math.cos(course), speed * math.sin(course)),
                velocity_down_mps=-m.ver_velocity / 100,
                tslc_s=float(m.tslc),
            )
    return None


def assert_same(found: object, wanted: object) -> None:
    assert type(found) is type(wanted)
    for name in getattr(wanted, "__dataclass_fields__", {}):
        have, want = getattr(found, name), getattr(wanted, name)
        if isinstance(want, float) or (isinstance(want, tuple) and not isinstance(want, Source)):
            # Exact up to the last bits of the factors 1e-7, 1e-3 and 1e-2.
            assert have == pytest.approx(want, rel=1e-14, abs=1e-13), name
        else:
            assert have == want and type(have) is type(want), name


def test_decoded_log_equals_pymavlink(cut_frames: list[bytes]) -> None:
    mav = dialect.MAVLink(None)
    seen: Counter[str] = Counter()
    for raw in cut_frames:
        frame = as_frame(raw)
        message = mav.decode(bytearray(raw))
        found, wanted = decode(frame), expected(message, T_NS, frame.link)
        assert_same(found, wanted)
        assert (found is None) == (frame.msgid not in DECODED)
        seen[message.get_type()] += found is not None
    assert +seen == {
        "GLOBAL_POSITION_INT": 1125,
        "ATTITUDE": 1250,
        "GPS_RAW_INT": 625,
        "HEARTBEAT": 250,
        "SYSTEM_TIME": 125,
        "EKF_STATUS_REPORT": 125,
        "ADSB_VEHICLE": 125,
    }


def test_reported_velocities_match_position_changes(cut_frames: list[bytes]) -> None:
    """Checks signs and units: reported velocities match the changes of position."""
    track = [
        report(as_frame(raw)) for raw in cut_frames if raw[7:10] == b"\x21\0\0" and raw[5] == 1
    ]
    assert len(track) == 250
    a, b = track[0], track[10]
    assert a.boot_ms is not None and b.boot_ms is not None
    dt_s = (b.boot_ms - a.boot_ms) / 1000
    assert a.velocity_ne_mps is not None and b.velocity_ne_mps is not None
    north_m, east_m = (b.lat_deg - a.lat_deg) * 111_195, (b.lon_deg - a.lon_deg) * 75_400
    for moved_m, first, last in zip(
        (north_m, east_m), a.velocity_ne_mps, b.velocity_ne_mps, strict=True
    ):
        assert moved_m == pytest.approx(dt_s * (first + last) / 2, abs=0.6)
    assert math.hypot(north_m, east_m) > 3.0


# --- GLOBAL_POSITION_INT ------------------------------------------------------------------------


def test_position_units_and_signs() -> None:
    found = report(
        position(
            -338765432, -1791234567, 35999, alt=-1500, relative_alt=-2, vx=-1234, vy=5, vz=-321
        )
    )
    assert found.lat_deg == pytest.approx(-33.8765432, abs=1e-12)
    assert found.lon_deg == pytest.approx(-179.1234567, abs=1e-12)
    assert found.alt_m == pytest.approx(-1.5)
    assert found.relative_alt_m == pytest.approx(-0.002)
    assert found.velocity_ne_mps == pytest.approx((-12.34, 0.05))
    assert found.velocity_down_mps == pytest.approx(-3.21)  # climbing: vz is positive down
    assert found.heading_deg == pytest.approx(359.99)
    assert (found.uav, found.source, found.boot_ms, found.tslc_s) == ("7:3", (7, 3), 5, None)
    assert found.alt_datum is AltitudeDatum.MSL


def test_heading_65535_is_unknown_and_0_is_north() -> None:
    assert report(position(hdg=65535)).heading_deg is None
    assert report(position(hdg=0)).heading_deg == 0.0


@pytest.mark.parametrize("make", [position, adsb])
@pytest.mark.parametrize(
    ("lat", "lon"), [(0, 0), (353, -129), (-1, 0), (440_000, 0), (0, -440_000), (310_000, 310_000)]
)
def test_positions_near_0_0_are_rejected(make: Make, lat: int, lon: int) -> None:
    assert rejected(make(lat=lat, lon=lon)) is Reason.ZERO_POSITION


@pytest.mark.parametrize("make", [position, adsb])
@pytest.mark.parametrize(
    ("lat", "lon"),
    [
        (460_000, 0),
        (0, -460_000),
        (330_000, 330_000),
        (0, 100_000_000),
        (514_778_000, 0),
        (900_000_000, 0),
        (-900_000_000, 1_800_000_000),
        (1, -1_800_000_000),
    ],
)
def test_positions_elsewhere_on_earth_are_accepted(make: Make, lat: int, lon: int) -> None:
    found = decode(make(lat=lat, lon=lon))
    assert isinstance(found, Report | AdsbVehicle)
    place = (found.lat_deg, found.lon_deg) if isinstance(found, Report) else found.position_deg
    assert place == pytest.approx((lat / 1e7, lon / 1e7), abs=1e-12)


@pytest.mark.parametrize("make", [position, adsb])
@pytest.mark.parametrize(
    ("lat", "lon"),
    [
        (900_000_001, 0),
        (-900_000_001, 0),
        (0, 1_800_000_001),
        (HERE[0], -1_800_000_001),
        (2**31 - 1, 2**31 - 1),
        (-(2**31), HERE[1]),
    ],
)
def test_position_off_the_earth_is_malformed(make: Make, lat: int, lon: int) -> None:
    assert rejected(make(lat=lat, lon=lon)) is Reason.MALFORMED


# --- ADSB_VEHICLE -------------------------------------------------------------------------------


def test_adsb_flags_match_the_dialect() -> None:
    """One flag at a time; no other field is set."""
    names = {
        dialect.ADSB_FLAGS_VALID_COORDS: "position_deg",
        dialect.ADSB_FLAGS_VALID_ALTITUDE: "alt_m",
        dialect.ADSB_FLAGS_VALID_HEADING: "heading_deg",
        dialect.ADSB_FLAGS_VALID_VELOCITY: None,  # a speed without a course is no velocity
        dialect.ADSB_FLAGS_VALID_CALLSIGN: "callsign",
        dialect.ADSB_FLAGS_VALID_SQUAWK: None,
        dialect.ADSB_FLAGS_SIMULATED: None,
        dialect.ADSB_FLAGS_VERTICAL_VELOCITY_VALID: "velocity_down_mps",
        dialect.ADSB_FLAGS_BARO_VALID: None,
        dialect.ADSB_FLAGS_SOURCE_UAT: None,
    }
    assert names.keys() == dialect.enums["ADSB_FLAGS"].keys() - {dialect.ADSB_FLAGS_ENUM_END}
    fields = {name for name in names.values() if name} | {"velocity_ne_mps", "alt_datum"}
    for flag, name in names.items():
        found = traffic(adsb(flag, altitude=1, heading=2, speed=3, climb=4))
        there = {field for field in fields if getattr(found, field) is not None}
        assert there == {name, "alt_datum" if name == "alt_m" else name} - {None}


@settings(max_examples=examples(400))
@given(
    flags=st.integers(0, 0xFFFF),
    altitude_type=st.integers(0, 3),
    altitude=st.integers(-(2**31), 2**31 - 1),
    heading=st.integers(0, 0xFFFF),
    speed=st.integers(0, 0xFFFF),
    climb=st.integers(-(2**15), 2**15 - 1),
    tslc=st.integers(0, 255),
)
def test_adsb_field_is_none_exactly_when_its_flag_is_clear(
    *,
    flags: int,
    altitude_type: int,
    altitude: int,
    heading: int,
    speed: int,
    climb: int,
    tslc: int,
) -> None:
    found = traffic(
        adsb(
            flags,
            altitude_type=altitude_type,
            altitude=altitude,
            heading=heading,
            speed=speed,
            climb=climb,
            tslc=tslc,
        )
    )
    datum = {
        dialect.ADSB_ALTITUDE_TYPE_PRESSURE_QNH: AltitudeDatum.PRESSURE,
        dialect.ADSB_ALTITUDE_TYPE_GEOMETRIC: AltitudeDatum.GEOMETRIC,
    }.get(altitude_type)
    has_altitude = flags & dialect.ADSB_FLAGS_VALID_ALTITUDE and datum
    has_heading = flags & dialect.ADSB_FLAGS_VALID_HEADING and heading <= 36_000
    has_speed = flags & dialect.ADSB_FLAGS_VALID_VELOCITY
    has_climb = flags & dialect.ADSB_FLAGS_VERTICAL_VELOCITY_VALID
    place = pytest.approx((HERE[0] / 1e7, HERE[1] / 1e7), abs=1e-12)
    assert found.position_deg == (place if flags & dialect.ADSB_FLAGS_VALID_COORDS else None)
    assert found.alt_m == (pytest.approx(altitude / 1000) if has_altitude else None)
    assert found.alt_datum is (datum if has_altitude else None)
    assert found.heading_deg == (pytest.approx(heading / 100) if has_heading else None)
    assert found.velocity_down_mps == (pytest.approx(-climb / 100) if has_climb else None)
    if has_speed and has_heading:
        course = math.radians(heading / 100)
        ahead = (speed / 100 * math.cos(course), speed / 100 * math.sin(course))
        assert found.velocity_ne_mps == pytest.approx(ahead, abs=1e-9)
    else:
        assert found.velocity_ne_mps is None
    assert found.callsign == ("EIN123" if flags & dialect.ADSB_FLAGS_VALID_CALLSIGN else None)
    assert found.tslc_s == tslc
    assert (found.icao, found.uav, found.source) == (0x4CA7B3, "icao:4CA7B3", (7, 3))


def test_adsb_position_without_its_flag_is_not_checked() -> None:
    for place in ({"lat": 0, "lon": 0}, {"lat": 2**31 - 1}):
        assert traffic(adsb(0xFFFF & ~1, **place)).position_deg is None


def test_adsb_climb_is_positive_up() -> None:
    assert traffic(adsb(climb=250)).velocity_down_mps == pytest.approx(-2.5)
    assert traffic(adsb(heading=9000, speed=1000)).velocity_ne_mps == pytest.approx((0.0, 10.0))


@pytest.mark.parametrize("flags", [0, 0xFFFF])
def test_icao_address_is_24_bits_and_not_0(flags: int) -> None:
    for icao in (0, 1 << 24, 0xFFFF_FFFF):
        assert rejected(adsb(flags, icao=icao)) is Reason.MALFORMED
    assert traffic(adsb(flags, icao=1)).uav == "icao:000001"
    assert traffic(adsb(flags, icao=0xFF_FFFF)).uav == "icao:FFFFFF"


@pytest.mark.parametrize(
    ("padded", "callsign"),
    [
        (b"", None),
        (b"EZY85MH", "EZY85MH"),
        (b"N12345  ", "N12345"),
        (b"SIM 5590\0", "SIM 5590"),
        (b"123456789", "123456789"),  # not terminated by a zero
        (b"        ", None),
        (b"AB\0garb", "AB"),
        (b"\xe9\xfe\xff", None),
        (b"A\x07B", None),
    ],
)
def test_callsign_keeps_printable_characters(padded: bytes, callsign: str | None) -> None:
    assert traffic(adsb(callsign=padded)).callsign == callsign


# --- truncated and missing fields ---------------------------------------------------------------


@settings(max_examples=examples(200))
@given(
    hdg=st.sampled_from([0, 1, 255, 256, 35_999]),
    v=st.lists(st.sampled_from([0, 0, 1, -1, 256]), min_size=3, max_size=3),
    alt=st.sampled_from([0, 256, -1]),
)
def test_truncated_trailing_zeros_are_restored(hdg: int, v: list[int], alt: int) -> None:
    found = report(position(hdg=hdg, alt=alt, vx=v[0], vy=v[1], vz=v[2]))
    assert found.heading_deg == pytest.approx(hdg / 100)
    assert found.velocity_ne_mps == pytest.approx((v[0] / 100, v[1] / 100))
    assert found.velocity_down_mps == pytest.approx(v[2] / 100)
    assert found.alt_m == pytest.approx(alt / 1000)


def test_one_byte_payload_is_decoded() -> None:
    frame = sent(dialect.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0))
    assert len(frame.payload) == 1
    assert decode(frame) == Attitude(
        t_ns=T_NS,
        source=Source(7, 3),
        boot_ms=0,
        roll_rad=0,
        pitch_rad=0,
        yaw_rad=0,
        rollspeed_radps=0,
        pitchspeed_radps=0,
        yawspeed_radps=0,
    )
    frame = sent(dialect.MAVLink_heartbeat_message(0, 0, 0, 0, 0, 0))
    assert decode(frame) == Presence(
        t_ns=T_NS, source=Source(7, 3), mav_type=0, autopilot=0, is_armed=False
    )
    assert rejected(sent(dialect.MAVLink_adsb_vehicle_message(
        0, 0, 0, 0, 0, 0, 0, 0, b"", 0, 0, 0, 0
    ))) is Reason.MALFORMED  # fmt: skip
    frame = sent(dialect.MAVLink_gps_raw_int_message(0, 0, 0, 0, 0, 0, 0, 0, 0, 0))
    assert decode(frame) == GnssStatus(
        t_ns=T_NS,
        source=Source(7, 3),
        fix_type=0,
        alt_m=0.0,
        h_acc_m=None,
        v_acc_m=None,
        vel_acc_mps=None,
    )


def test_adsb_payload_truncated_within_its_flags() -> None:
    """One byte of the flags remains, and everything after it is zero."""
    frame = sent(dialect.MAVLink_adsb_vehicle_message(
        1, *HERE, 0, 0, 0, 0, 0, b"", 0, 0, dialect.ADSB_FLAGS_VALID_COORDS, 0
    ))  # fmt: skip
    assert len(frame.payload) == 23
    place = pytest.approx((HERE[0] / 1e7, HERE[1] / 1e7), abs=1e-12)
    assert traffic(frame) == AdsbVehicle(
        t_ns=T_NS,
        icao=1,
        source=Source(7, 3),
        callsign=None,
        position_deg=place,
        alt_m=None,
        alt_datum=None,
        heading_deg=None,
        velocity_ne_mps=None,
        velocity_down_mps=None,
        tslc_s=0.0,
    )


def test_appended_extension_fields_are_ignored() -> None:
    frame = position(hdg=35_999)
    longer = bytes([0xFD, 40]) + frame.raw[2:10] + frame.payload + bytes(range(1, 13)) + b"\0\0"
    assert decode(as_frame(longer)) == decode(frame)


def test_version_1_has_no_extension_fields() -> None:
    message = gps_raw_int(h_acc=1500, v_acc=2500, vel_acc=300)
    found = decode(sent(message))
    assert isinstance(found, GnssStatus)
    accuracies = (found.h_acc_m, found.v_acc_m, found.vel_acc_mps)
    assert accuracies == pytest.approx((1.5, 2.5, 0.3))
    bare = found._replace(h_acc_m=None, v_acc_m=None, vel_acc_mps=None)
    assert decode(sent_v1(message, 30)) == bare


def test_version_1_decodes_like_version_2() -> None:
    message = dialect.MAVLink_global_position_int_message(9, *HERE, 4, 5, 6, -7, 8, 0)
    assert decode(sent_v1(message, 28)) == decode(sent(message))


@pytest.mark.parametrize(
    ("flags", "knows"), [(0, False), (1, True), (831, True), (830, False), (831 | 1024, False)]
)
def test_estimator_status_flags_its_attitude(flags: int, knows: bool) -> None:
    message = dialect.MAVLink_ekf_status_report_message(flags, 0.1, 0.2, 0.3, 0.4, 0.5)
    found = decode(sent(message))
    assert isinstance(found, EstimatorStatus)
    assert found.knows_attitude is knows
    assert found.compass_ratio == pytest.approx(0.4)


@pytest.mark.parametrize("ratio", [math.nan, math.inf, -0.1])
def test_invalid_compass_ratio_is_malformed(ratio: float) -> None:
    message = dialect.MAVLink_ekf_status_report_message(831, 0.1, 0.2, 0.3, ratio, 0.5)
    found = decode(sent(message))
    assert isinstance(found, Rejection)
    assert found.reason is Reason.MALFORMED


@pytest.mark.parametrize("field", ["h_acc", "v_acc", "vel_acc"])
@pytest.mark.parametrize("unknown", [0, 0xFFFF_FFFF])
def test_accuracy_of_0_or_all_ones_is_unknown(field: str, unknown: int) -> None:
    names = {"h_acc": "h_acc_m", "v_acc": "v_acc_m", "vel_acc": "vel_acc_mps"}
    given_mm = {"h_acc": 1000, "v_acc": 2000, "vel_acc": 3000} | {field: unknown}
    found = decode(sent(gps_raw_int(**given_mm)))
    for key, name in names.items():
        want = None if key == field else pytest.approx(given_mm[key] / 1000)
        assert getattr(found, name) == want


def test_unix_time_of_0_is_none() -> None:
    found = decode(sent(dialect.MAVLink_system_time_message(0, 4321)))
    assert found == SystemTime(t_ns=T_NS, source=Source(7, 3), unix_us=None, boot_ms=4321)
    found = decode(sent(dialect.MAVLink_system_time_message(2**63 + 1, 2**32 - 1)))
    assert found == SystemTime(t_ns=T_NS, source=Source(7, 3), unix_us=2**63 + 1, boot_ms=2**32 - 1)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", range(6))
def test_non_finite_attitude_is_malformed(field: int, bad: float) -> None:
    angles = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    assert isinstance(decode(attitude(angles)), Attitude)
    angles[field] = bad
    assert rejected(attitude(angles)) is Reason.MALFORMED


@pytest.mark.parametrize("field", range(6))
def test_implausible_attitude_is_malformed(field: int) -> None:
    """A rate of 10⁶ rad/s would be extrapolated to any attitude."""
    for most in (6.29, -6.29) if field < 3 else (70.0, -70.0):
        angles = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
        angles[field] = most
        assert isinstance(decode(attitude(angles)), Attitude)
        angles[field] = most * 1.2
        assert rejected(attitude(angles)) is Reason.MALFORMED


def test_attitude_fields_keep_their_order() -> None:
    angles = [struct.unpack("<f", struct.pack("<f", 0.1 * n))[0] for n in range(1, 7)]
    assert decode(attitude(angles)) == Attitude(
        t_ns=T_NS,
        source=Source(7, 3),
        boot_ms=77,
        roll_rad=angles[0],
        pitch_rad=angles[1],
        yaw_rad=angles[2],
        rollspeed_radps=angles[3],
        pitchspeed_radps=angles[4],
        yawspeed_radps=angles[5],
    )


def test_heartbeat_gives_type_and_autopilot() -> None:
    found = decode(sent(dialect.MAVLink_heartbeat_message(2, 3, 128, 99, 4, 3)))
    assert found == Presence(t_ns=T_NS, source=Source(7, 3), mav_type=2, autopilot=3, is_armed=True)


def test_other_messages_are_not_decoded() -> None:
    assert decode(sent(dialect.MAVLink_ping_message(1, 2, 3, 4))) is None
    assert {0, 2, 24, 30, 33, 61, 124, 193, 235, 246, 331, 385} | REMOTE_ID == DECODED
