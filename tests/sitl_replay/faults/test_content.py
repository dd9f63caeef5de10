"""Rewritten frames, decoded by pymavlink's generated dialect."""

import math
import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymap3d.vincenty import vdist
from pymavlink.dialects.v20 import all as dialect
from support import examples

from sitl_replay.faults.content import (
    TIME_BOOT_MS_AT,
    Compass,
    Drift,
    Frozen,
    Glitch,
    Reboot,
    Spoof,
    boot_ms_of,
    msgid_of,
    rewritten,
    sender_of,
    seq_of,
    with_boot_ms,
)
from sitl_replay.flight import scenario
from sitl_replay.flight.vehicles import schedule

KEY = bytes(range(32))
REPORT = dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT


def sending(seq: int = 7, *, signed: bool = False) -> Any:
    sender = dialect.MAVLink(None, srcSystem=9, srcComponent=4)
    sender.seq = seq
    if signed:
        sender.signing.secret_key = KEY
        sender.signing.sign_outgoing = True
        sender.signing.timestamp = 1
    return sender


def read(raw: bytes) -> Any:
    """The one message in a frame; pymavlink checks its checksum."""
    (message,) = dialect.MAVLink(None).parse_buffer(raw)
    assert message.get_type() != "BAD_DATA"
    return message


def fields(raw: bytes) -> dict[str, Any]:
    """All fields of a frame, with its sequence number."""
    message = read(raw)
    said = {name: repr(value) for name, value in message.to_dict().items()}
    return said | {"seq": message.get_seq(), "from": sender_of(raw), "magic": raw[0]}


def made(kind: Any, rng: random.Random) -> Any:
    """A message of the given type with random fields."""
    lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    values: list[Any] = []
    for name, base in zip(kind.fieldnames, kind.fieldtypes, strict=True):
        several = [rng.randint(1, 100) for _ in range(max(1, lengths[name]))]
        values.append(b"abc" if base == "char" else several if lengths[name] else several[0])
    return kind(*values)


def stamped() -> list[Any]:
    return [kind for kind in dialect.mavlink_map.values() if "time_boot_ms" in kind.fieldnames]


def test_table_lists_every_message_with_a_boot_clock() -> None:
    assert set(TIME_BOOT_MS_AT) == {kind.id for kind in stamped()}


@pytest.mark.parametrize(
    ("kind", "v1"),
    [(kind, v1) for kind in stamped() for v1 in (False, True) if kind.id < 256 or not v1],
    ids=str,
)
def test_only_the_boot_clock_field_is_rewritten(kind: Any, v1: bool) -> None:
    raw = made(kind, random.Random(kind.id)).pack(sending(), force_mavlink1=v1)
    new_ms = 0x87654321
    changed = with_boot_ms(raw, new_ms)
    assert fields(changed) == fields(raw) | {"time_boot_ms": str(new_ms)}
    assert boot_ms_of(changed) == new_ms
    assert with_boot_ms(changed, boot_ms_of(raw) or 0) == raw


@given(old_ms=st.integers(0, 2**32 - 1), new_ms=st.integers(0, 2**32 - 1), lon=st.integers(-9, 9))
@settings(max_examples=examples(60))
def test_payload_truncation_of_trailing_zeros_is_kept_consistent(
    old_ms: int, new_ms: int, lon: int
) -> None:
    # All bytes after the longitude are 0, or all after the timestamp, or all.
    make = dialect.MAVLink_global_position_int_message
    raw = make(old_ms, 0, lon, 0, 0, 0, 0, 0, 0).pack(sending())
    assert with_boot_ms(raw, new_ms) == make(new_ms, 0, lon, 0, 0, 0, 0, 0, 0).pack(sending())


def test_unchanged_frame_keeps_its_bytes() -> None:
    message = dialect.MAVLink_attitude_message(1000, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    raw = message.pack(sending(signed=True))
    assert with_boot_ms(raw, 1000) is raw
    assert rewritten(raw, seq=7) is raw
    assert Drift(1.0)(0.0, raw) is raw  # 0.001 ms


def test_rewritten_signed_frame_loses_its_signature() -> None:
    message = dialect.MAVLink_attitude_message(1000, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    raw = message.pack(sending(signed=True))
    assert raw[2] == 1
    changed = with_boot_ms(raw, 2000)
    assert changed[2] == 0
    assert len(changed) == len(raw) - 13
    message.time_boot_ms = 2000
    assert changed == message.pack(sending())


def test_unknown_or_too_short_frames_are_left_unchanged() -> None:
    unknown = bytes([0xFD, 1, 0, 0, 7, 9, 4, 0xFF, 0xFF, 0xFF, 1, 0, 0])
    assert rewritten(unknown, seq=8) is unknown
    short = bytes([0xFE, 2, 7, 9, 4, 30, 1, 0, 0, 0])
    assert boot_ms_of(short) is None
    assert with_boot_ms(short, 5) is short


def reports(count: int, sysid: int = 9, step_ms: int = 100) -> list[tuple[float, bytes]]:
    """Reports every 0.1 s, each at another position."""
    sender = dialect.MAVLink(None, srcSystem=sysid, srcComponent=1)
    out = []
    for number in range(count):
        message = dialect.MAVLink_global_position_int_message(
            50_000 + step_ms * number, 473977420 + 10 * number, 85455940, 5000 + number, 6000,
            100, -200, 3, 36,
        )  # fmt: skip
        sender.seq = (250 + number) % 256
        out.append((number * step_ms / 1000, message.pack(sender)))
    return out


@pytest.mark.parametrize("ppm", [24_000.0, -24_000.0, 0.0])
def test_drift_scales_the_boot_clock(ppm: float) -> None:
    drift = Drift(ppm)
    for t_s, raw in reports(20):
        boot_ms = read(raw).time_boot_ms
        assert fields(drift(t_s, raw)) == fields(raw) | {
            "time_boot_ms": str(round(boot_ms * (1.0 + ppm * 1e-6)))
        }


def test_drifting_clock_wraps_at_32_bits() -> None:
    raw = dialect.MAVLink_attitude_message(2**32 - 1000, *[0.0] * 6).pack(sending())
    expected = (2**32 - 1000 + round((2**32 - 1000) * 0.001)) % 2**32
    assert boot_ms_of(Drift(1000.0)(0.0, raw)) == expected


def test_reboot_resets_boot_clock_and_sequence() -> None:
    reboot = Reboot(1.05)
    before = reports(30)
    after = [(t_s, reboot(t_s, raw)) for t_s, raw in before]
    assert after[:11] == before[:11]  # to 1.0 s
    for number, (raw, new) in enumerate(zip(before[11:], after[11:], strict=True)):
        assert fields(new[1]) == fields(raw[1]) | {
            "time_boot_ms": str(50 + 100 * number),
            "seq": number,
        }


def test_late_frame_of_the_previous_boot_keeps_its_timestamp() -> None:
    reboot = Reboot(0.0)
    frames = [raw for _, raw in reports(3)]
    assert boot_ms_of(reboot(0.0, frames[1])) == 0
    assert boot_ms_of(reboot(0.1, frames[0])) == 50_000
    assert boot_ms_of(reboot(0.1, frames[2])) == 100


def test_every_sender_reboots_with_its_own_clock_and_sequence() -> None:
    reboot = Reboot(1.0)
    seen: dict[tuple[int, int], list[int]] = {}
    stamps: dict[tuple[int, int], list[int]] = {}
    for sent in schedule(scenario.paper(), duration_s=3.0):
        raw = reboot(sent.t_s, sent.raw)
        read(raw)
        if sent.t_s >= 1.0:
            seen.setdefault(sender_of(raw), []).append(seq_of(raw))
            if (boot_ms := boot_ms_of(raw)) is not None:
                stamps.setdefault(sender_of(raw), []).append(boot_ms)
                assert abs(boot_ms / 1000 - (sent.t_s - 1.0)) < 0.02
    assert len(seen) == 5
    for numbers in seen.values():
        assert numbers == [number % 256 for number in range(len(numbers))]
    assert all(len(times) > 5 for times in stamps.values())


POSITION = ("lat", "lon", "alt", "relative_alt")


def test_frozen_repeats_the_last_position() -> None:
    frozen = Frozen(1.0, 0.5)
    before = reports(20)
    last = fields(before[9][1])
    for number, (t_s, raw) in enumerate(before):
        meant = fields(raw)
        if 10 <= number < 15:
            meant |= {name: last[name] for name in POSITION}
        assert fields(frozen(t_s, raw)) == meant
    attitude = dialect.MAVLink_attitude_message(1, *[1.0] * 6).pack(sending())
    assert frozen(1.2, attitude) is attitude


def test_frozen_before_any_report_repeats_the_first_position() -> None:
    frozen = Frozen(0.0, 1.0)
    first, second = (raw for _, raw in reports(2))
    assert frozen(0.0, first) is first
    assert read(frozen(0.1, second)).lat == read(first).lat
    (_, other) = reports(1, sysid=8)[0]
    assert frozen(0.1, other) is other  # each sender has its own direction


@given(
    metres=st.floats(0.0, 10_000.0),
    lat_deg=st.floats(-80.0, 80.0),
    lon_deg=st.floats(-180.0, 180.0),
    seed=st.integers(0, 5),
)
@settings(max_examples=examples(60))
def test_glitch_moves_the_given_number_of_reports(
    metres: float, lat_deg: float, lon_deg: float, seed: int
) -> None:
    glitch = Glitch(at_s=1.0, metres=metres, reports=3, seed=str(seed))
    lat, lon = round(lat_deg * 1e7), round(lon_deg * 1e7)
    bearings_deg = []
    for number in range(6):
        raw = dialect.MAVLink_global_position_int_message(
            1000 + number, lat, lon, 5000, 6000, 1, 2, 3, 4
        ).pack(sending())
        changed = glitch(number * 0.5, raw)
        if not 2 <= number < 5:
            assert changed is raw
            continue
        got = read(changed)
        distance_m, bearing_deg = vdist(lat / 1e7, lon / 1e7, got.lat / 1e7, got.lon / 1e7)
        assert float(distance_m) == pytest.approx(metres, abs=0.02, rel=1e-5)
        bearings_deg.append(float(bearing_deg))
        assert abs(got.lon) <= 1_800_000_000
        moved = {"lat": str(got.lat), "lon": str(got.lon)}
        assert fields(changed) == fields(raw) | moved
    if metres > 10.0:
        assert max(bearings_deg) - min(bearings_deg) < 1e-6


def test_glitch_direction_differs_per_sender_and_seed() -> None:
    places = {
        (read(glitched).lat, read(glitched).lon)
        for seed in ("1", "2")
        for sysid in range(1, 5)
        for t_s, raw in reports(1, sysid)
        for glitched in [Glitch(at_s=0.0, metres=1000.0, reports=1, seed=seed)(t_s, raw)]
    }
    assert len(places) == 8
    lats = [lat - 473977420 for lat, _ in places]
    assert min(lats) < -math.cos(1.0) * 89_000 or max(lats) > math.cos(1.0) * 89_000


def test_message_id_sender_and_sequence_of_both_versions() -> None:
    message = dialect.MAVLink_attitude_message(1, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0)
    for v1 in (False, True):
        raw = message.pack(sending(), force_mavlink1=v1)
        assert (msgid_of(raw), sender_of(raw), seq_of(raw)) == (30, (9, 4), 7)


@given(
    speed_mps=st.floats(0.0, 50.0),
    course_deg=st.floats(0.0, 360.0),
    since_s=st.floats(0.0, 100.0),
    velocity=st.tuples(st.integers(-3000, 3000), st.integers(-3000, 3000)),
)
@settings(max_examples=examples(60))
def test_spoofed_positions_and_velocities_drift_alike(
    speed_mps: float, course_deg: float, since_s: float, velocity: tuple[int, int]
) -> None:
    spoof = Spoof(10.0, speed_mps, course_deg)
    raw = dialect.MAVLink_global_position_int_message(
        1000, 473_977_419, 85_455_938, 5000, 6000, *velocity, 3, 4
    ).pack(sending())
    assert spoof(9.999, raw) is raw
    got, was = read(spoof(10.0 + since_s, raw)), read(raw)
    away_m, bearing_deg = vdist(was.lat / 1e7, was.lon / 1e7, got.lat / 1e7, got.lon / 1e7)
    assert float(away_m) == pytest.approx(speed_mps * since_s, abs=0.02, rel=1e-5)
    if away_m > 10.0:
        assert abs(math.remainder(float(bearing_deg) - course_deg, 360.0)) < 0.2
    course_rad = math.radians(course_deg)
    assert got.vx - was.vx == pytest.approx(100 * speed_mps * math.cos(course_rad), abs=0.51)
    assert got.vy - was.vy == pytest.approx(100 * speed_mps * math.sin(course_rad), abs=0.51)
    unmoved = {name: repr(getattr(got, name)) for name in ("lat", "lon", "vx", "vy")}
    assert fields(spoof(10.0 + since_s, raw)) == fields(raw) | unmoved


def test_spoofed_velocity_stays_in_its_range() -> None:
    raw = dialect.MAVLink_global_position_int_message(1, 2, 3, 4, 5, 32_000, -32_000, 6, 7).pack(
        sending()
    )
    got = read(Spoof(0.0, 300.0, 315.0)(1.0, raw))
    assert (got.vx, got.vy) == (32_767, -32_768)


@given(error_deg=st.floats(-180.0, 180.0), yaw_rad=st.floats(-math.pi, math.pi))
def test_compass_turns_attitude_and_heading(error_deg: float, yaw_rad: float) -> None:
    compass = Compass(error_deg, 5.0)
    raw = dialect.MAVLink_attitude_message(1, 0.1, 0.2, yaw_rad, 0.3, 0.4, 0.5).pack(sending())
    assert compass(4.999, raw) is raw
    turned = compass(5.0, raw)
    got = read(turned)
    apart_rad = math.remainder(got.yaw - yaw_rad - math.radians(error_deg), math.tau)
    assert apart_rad == pytest.approx(0.0, abs=1e-6)
    assert abs(got.yaw) <= math.pi + 1e-6
    assert fields(turned) == fields(raw) | {"yaw": repr(got.yaw)}
    heading_cdeg = round(math.degrees(yaw_rad) * 100) % 36_000
    where = dialect.MAVLink_global_position_int_message(1, 2, 3, 4, 5, 6, 7, 8, heading_cdeg)
    raw = where.pack(sending())
    got = read(compass(5.0, raw))
    apart_cdeg = math.remainder(got.hdg - heading_cdeg - 100 * error_deg, 36_000)
    assert abs(apart_cdeg) < 1.0
    assert got.hdg < 36_000
    assert fields(compass(5.0, raw)) == fields(raw) | {"hdg": repr(got.hdg)}


def test_compass_leaves_unknown_headings_and_other_messages() -> None:
    compass = Compass(10.0, 0.0)
    unknown = dialect.MAVLink_global_position_int_message(1, 2, 3, 4, 5, 6, 7, 8, 65_535)
    for message in (unknown, dialect.MAVLink_heartbeat_message(2, 3, 4, 5, 6, 3)):
        raw = message.pack(sending())
        assert compass(1.0, raw) is raw
