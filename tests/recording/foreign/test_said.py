"""Onboard log samples as frames, decoded by pymavlink and by the product."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.mavlink.wire.decode import decode
from companion.recording.foreign import ardupilot, said
from companion.recording.foreign.onboard import Onboard
from companion.values import Event, Frame, Rejection, Report, Source


@pytest.fixture
def log(aeroplane: Path) -> Onboard:
    return ardupilot.read(np.fromfile(aeroplane, dtype=np.uint8))


def by_peer(events: list[Event]) -> dict[str, list[Any]]:
    """Frames decoded by pymavlink, by message name."""
    link = dialect.MAVLink(None)
    found: dict[str, list[Any]] = {}
    for event in events:
        assert isinstance(event, Frame)
        (message,) = link.parse_buffer(event.raw)
        found.setdefault(message.get_type(), []).append(message)
    return found


def test_each_sample_becomes_one_frame_with_its_values(log: Onboard) -> None:
    heard = by_peer(list(said.frames(log, "x", Source(1, 1), 0.0)))
    positions, attitudes, fixes, truth = log.positions, log.attitudes, log.fixes, log.truth
    assert positions and attitudes and fixes and truth
    reports = heard["GLOBAL_POSITION_INT"]
    assert [each.time_boot_ms for each in reports] == (positions.boot_us // 1000).tolist()
    assert [each.lat for each in reports] == positions.lat_1e7.tolist()
    assert [each.alt for each in reports] == pytest.approx(positions.alt_m * 1e3, abs=0.5)
    said_mps = np.array([(each.vx, each.vy, each.vz) for each in reports]) * 1e-2
    assert said_mps == pytest.approx(positions.velocity_ned_mps, abs=0.005001)
    assert [each.hdg for each in reports] == pytest.approx(
        positions.heading_deg % 360 * 100, abs=0.5
    )
    angles = np.array([(each.roll, each.pitch, each.yaw) for each in heard["ATTITUDE"]])
    turns = np.angle(np.exp(1j * (angles - attitudes.euler_rad)))
    assert np.abs(turns).max() < 1e-6
    assert [each.h_acc for each in heard["GPS_RAW_INT"]] == [300] * 100
    assert [each.fix_type for each in heard["GPS_RAW_INT"]] == fixes.fix_type.tolist()
    assert [each.lat_int for each in heard["SIM_STATE"]] == truth.lat_1e7.tolist()
    assert {each.type for each in heard["HEARTBEAT"]} == {dialect.MAV_TYPE_FIXED_WING}
    assert 19 <= len(heard["HEARTBEAT"]) == len(heard["SYSTEM_TIME"]) <= 22
    told = heard["SYSTEM_TIME"][3]
    assert log.clock is not None
    expected = log.clock.offset_us + told.time_boot_ms * 1000
    assert abs(told.time_unix_usec - expected) < 1000


def test_frames_are_ordered_by_gps_time(log: Onboard) -> None:
    assert log.clock is not None and log.positions is not None
    events = list(said.frames(log, "x", Source(1, 1), 0.0))
    late = list(said.frames(log, "x", Source(1, 1), 0.25))
    times = [event.t_ns for event in events]
    assert times == sorted(times)
    assert [event.t_ns - 250_000_000 for event in late] == times
    reports = [event for event in events if isinstance(event, Frame) and event.msgid == 33]
    expected = log.clock.unix_us(log.positions.boot_us) * 1000
    assert [report.t_ns for report in reports] == expected.tolist()
    assert [event.seq for event in events[:300]] == [n & 255 for n in range(300)]


def test_truth_frame_follows_a_frame_with_its_timestamp(log: Onboard) -> None:
    """Studies date SIM_STATE, which has no timestamp, by the neighbouring messages."""
    assert log.truth is not None
    stamps: list[int] = []
    last_ms = 0
    for event in said.frames(log, "x", Source(1, 1), 0.0):
        assert isinstance(event, Frame)
        if event.msgid in (30, 33):
            last_ms = int.from_bytes(event.payload[:4], "little")
        elif event.msgid == 108:
            stamps.append(last_ms)
    assert stamps == (log.truth.boot_us // 1000).tolist()


def test_out_of_range_values_are_clipped_and_unknown_ones_marked(log: Onboard) -> None:
    at = log.positions
    assert at is not None and log.fixes is not None
    wild = replace(
        log,
        positions=replace(
            at,
            velocity_ned_mps=np.full_like(at.velocity_ned_mps, 1e9),
            heading_deg=np.full_like(at.heading_deg, np.nan),
            height_m=np.full_like(at.height_m, -1e9),
        ),
    )
    frames = list(said.frames(wild, "x", Source(1, 1), 0.0))
    reports = by_peer(frames)["GLOBAL_POSITION_INT"]
    assert (reports[0].vx, reports[0].hdg, reports[0].relative_alt) == (32767, 65535, -(2**31))
    decoded = [decode(each) for each in frames if isinstance(each, Frame) and each.msgid == 33]
    assert isinstance(decoded[0], Report) and decoded[0].heading_deg is None


def test_frames_use_boot_time_without_gps_time(log: Onboard) -> None:
    first = next(iter(said.frames(replace(log, clock=None), "x", Source(1, 1), 0.0)))
    assert first.t_ns == 120_004_784_000 or 120e9 <= first.t_ns < 121e9


def test_time_jump_is_clamped_and_reported(log: Onboard) -> None:
    assert log.positions is not None
    later = log.positions.boot_us.copy()
    later[100:] += 5 * 3_600_000_000
    log = replace(
        log, positions=replace(log.positions, boot_us=later), attitudes=None, fixes=None, truth=None
    )
    events = list(said.frames(log, "x", Source(1, 1), 0.0))
    refused = [event for event in events if isinstance(event, Rejection)]
    assert refused and refused[0].detail.endswith("s after the log's time; the log's time is used")
    assert events[-1].t_ns - events[0].t_ns < 30e9


def test_heartbeats_follow_the_latest_arming(log: Onboard) -> None:
    """Times step back at a reboot: of the states that begin by then, the last in the log counts."""
    assert log.positions is not None
    begin_us = int(log.positions.boot_us[0])
    after_s = ((2, True), (9, False), (5, True), (13, False), (16, True))
    changes = tuple((begin_us + s * 1_000_000 + 500_000, armed) for s, armed in after_s)
    changed = replace(log, armed=changes)
    found = by_peer(list(said.frames(changed, "x", Source(1, 1), 0.0)))
    seconds = [each.time_boot_ms for each in found["SYSTEM_TIME"]]
    expected = [0] * len(seconds)
    for from_us, armed in changes:
        expected = [
            128 * armed if ms * 1000 >= from_us else before
            for ms, before in zip(seconds, expected, strict=True)
        ]
    assert [each.base_mode for each in found["HEARTBEAT"]] == expected
