"""Vehicles like Betaflight's: positions of the receiver, stamped in microseconds when sent."""

import math
from collections.abc import Iterator

import pymavlink.dialects.v20.all as dialect
import pytest

from companion import Frame, Pipeline, Settings, Tick
from companion.values import Notice, Output, Update
from tests.pipeline.test_assumptions import ALT_M, LAT, LON, M_PER_DEG, START_NS, S, sent

UAV, CARRIER = "1:1", "5:1"
ENDS_S, LAG_S, LATE_S = 40.0, 0.35, 0.03
SPEED_MPS, RADIUS_M = 12.0, 80.0
BOOT_US = (1 << 32) - 20_000_000  # the stamps wrap around within the flight


def true_m(t_s: float) -> tuple[float, float]:
    angle = SPEED_MPS / RADIUS_M * t_s
    return 200 + RADIUS_M * math.cos(angle), RADIUS_M * math.sin(angle)


def velocity_mps(t_s: float) -> tuple[float, float]:
    angle = SPEED_MPS / RADIUS_M * t_s
    return -SPEED_MPS * math.sin(angle), SPEED_MPS * math.cos(angle)


def vehicle(source: str, t_s: float, *, is_still: bool) -> Iterator[Frame]:
    """Return what the firmware sends at a time."""
    boot_us = BOOT_US + round(t_s * 1e6)
    boot_ms = boot_us // 1000
    (north_m, east_m), v_mps = true_m(t_s - LAG_S), velocity_mps(t_s - LAG_S)
    if is_still:
        north_m = east_m = 0.0
        v_mps = 0.0, 0.0
    lat_1e7 = round((LAT + north_m / M_PER_DEG) * 1e7)
    lon_1e7 = round((LON + east_m / M_PER_DEG / math.cos(math.radians(LAT))) * 1e7)
    alt_mm = round((ALT_M + 50.0) * 1000)
    arrives_s, tenth = t_s + LATE_S, round(t_s * 10)
    yield sent(arrives_s, source, dialect.MAVLink_attitude_message(boot_ms, 0, 0, 0.1, 0, 0, 0))
    if tenth % 2 == 0:
        status = dialect.MAVLink_gps_raw_int_message(
            boot_us, 3, lat_1e7, lon_1e7, alt_mm, 100, 100, 0, 0, 12, 0, 600, 900, 300, 0, 0
        )
        yield sent(arrives_s, source, status)
        moved = (round(100 * one) for one in (*v_mps, 0.0))
        position = dialect.MAVLink_global_position_int_message(
            boot_us % (1 << 32), lat_1e7, lon_1e7, alt_mm, 0, *moved, 65535
        )
        yield sent(arrives_s, source, position)
    if tenth % 10 == 0:
        yield sent(arrives_s, source, dialect.MAVLink_heartbeat_message(2, 0, 128, 0, 4, 3))
        yield sent(arrives_s, source, dialect.MAVLink_system_time_message(0, boot_ms))


@pytest.mark.parametrize(
    ("center", "doubt_ns"),
    [(CARRIER, 0), (f"{LAT},{LON},{ALT_M}", 0), (f"{LAT},{LON},{ALT_M}", S // 50)],
    ids=["carrier", "UAV", "shared by another node"],
)
def test_stamps_in_microseconds_are_converted(center: str, doubt_ns: int) -> None:
    """The carrier's attitudes count milliseconds beside its positions."""
    pipeline = Pipeline(Settings().override(center={"source": center}))
    outputs: list[Output] = []
    served, errors = [], []
    for n in range(round(ENDS_S * 10)):
        t_s = n / 10
        events = list(vehicle(CARRIER, t_s, is_still=True)) if center == CARRIER else []
        if t_s >= 3.0:  # the carrier's position is the origin
            sent_now = vehicle(UAV, t_s, is_still=False)
            events += [frame._replace(doubt_ns=doubt_ns) for frame in sent_now]
        for event in (*events, Tick(START_NS + round((t_s + 0.05) * S))):
            outputs += pipeline.step(event)
        update = outputs[-1] if isinstance(outputs[-1], Update) else pipeline.last_update
        if update is None or t_s < 8.0:
            continue
        served.append(UAV in update.beams.uavs)
        (track,) = (one for one in update.tracks if one.uav == UAV)
        north_m, east_m = true_m((track.valid_at_ns - START_NS) * 1e-9)
        at = track.position_ned_m
        error_m = math.hypot(at[0] - north_m, at[1] - east_m)
        errors.append((error_m, track.horizontal_bound_m))
    assert all(served)
    assert [one for one in errors if one[0] > one[1]] == []
    texts = [one.text for one in outputs if isinstance(one, Notice)]
    told = [text for text in texts if "stamps in microseconds" in text]
    assert len(told) == (2 if center == CARRIER else 1)
    assert not any("was restarted" in text or "again" in text for text in texts)
