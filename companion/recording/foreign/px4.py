"""Interpretation of PX4's ULog: topics to samples.

Meanings and units: https://docs.px4.io/main/en/msg_docs/. GLOBAL_POSITION_INT is built as in PX4,
from vehicle_global_position and the velocity of vehicle_local_position; ``*_groundtruth`` is the
simulator's truth.
"""

from typing import Final

import numpy as np

from companion.recording.foreign import gps_time, ulog
from companion.recording.foreign.columns import Bytes
from companion.recording.foreign.gps_time import GpsTime
from companion.recording.foreign.onboard import (
    NEAR_US,
    Attitudes,
    Fixes,
    Onboard,
    OnboardPositions,
    Truth,
    body_rates_of,
    euler_of,
    headings_between,
    on_earth,
    time_ordered,
    vectors_between,
    velocities_of,
)
from companion.recording.foreign.receiver import count
from companion.recording.foreign.ulog import UlogTable, table, walk
from companion.values import BoolArray, FloatArray, IntArray, Reason

_GLOBAL: Final = "vehicle_global_position"
_LOCAL: Final = "vehicle_local_position"
_ATTITUDE: Final = "vehicle_attitude"
_RATES: Final = "vehicle_angular_velocity"
_GPS: Final = ("vehicle_gps_position", "sensor_gps")
_WANTED: Final = (
    _GLOBAL, _LOCAL, _ATTITUDE, _RATES, *_GPS, "vehicle_status", "home_position",
    f"{_GLOBAL}_groundtruth", f"{_LOCAL}_groundtruth", f"{_ATTITUDE}_groundtruth",
)  # fmt: skip
_PX4: Final = 12
_ARMED: Final = 2

Lost = dict[Reason, int]


class UnknownFlagsError(Exception):
    """Error of a ULog file with unknown incompatibility flags."""


def read(data: Bytes) -> Onboard:
    """Return the samples of a ULog; unusable samples are counted.

    Raises ``UnknownFlagsError`` if the file requires an unsupported feature.
    """
    walked = walk(data, _WANTED)
    if walked.unknown:
        raise UnknownFlagsError
    lost: Lost = {}
    count(lost, Reason.GARBAGE, walked.lost)
    count(lost, Reason.MALFORMED, walked.refused)
    tables = {name: _timed(table(data, walked, name), lost) for name in _WANTED}
    gps = _timed(table(data, walked, *_GPS), {})
    fixes, clock = _fixes(gps, lost)
    notes = [f"dropouts of the logger: {walked.dropouts}"] if walked.dropouts else []
    status = tables["vehicle_status"]
    sysid, compid, mav_type = _identity(walked, status)
    return Onboard(
        sysid=sysid,
        compid=compid,
        mav_type=mav_type,
        autopilot=_PX4,
        positions=_positions(tables, fixes, lost, notes),
        attitudes=_attitudes(tables, lost),
        fixes=fixes,
        truth=_truth(tables, lost),
        armed=_armed(status),
        clock=clock,
        lost=lost,
        incomplete_bytes=walked.rest,
        notes=tuple(notes),
    )


def _times(of: UlogTable) -> IntArray:
    """Return the times of samples: the time of their input if known, else of publication."""
    sampled = of.integers("timestamp_sample")
    found = of.integers("timestamp") if sampled is None or not sampled.all() else sampled
    return np.zeros(0, dtype=np.int64) if found is None else found


def _timed(of: UlogTable, lost: Lost) -> UlogTable:
    times = _times(of)
    if len(times) != len(of):
        count(lost, Reason.MALFORMED, len(of))
        return of.rows(np.zeros(0, dtype=np.int64))
    rows, wild = time_ordered(times)
    count(lost, Reason.BAD_STAMP, wild)
    return of.rows(rows)


def _identity(walked: ulog.UlogIndex, status: UlogTable) -> tuple[int | None, int, int]:
    """Return system id (None: unknown), component id and MAV_TYPE, by parameters or else status."""

    def stated(parameter: str, column: str) -> int | None:
        value = walked.parameters.get(parameter)
        values = status.integers(column)
        if value is None and values is not None and len(values):
            value = float(values[-1])
        return int(value) if value is not None and 0 < value <= 255 else None

    sysid = stated("MAV_SYS_ID", "system_id")
    return sysid, stated("MAV_COMP_ID", "component_id") or 1, stated("MAV_TYPE", "system_type") or 0


def _armed(status: UlogTable) -> tuple[tuple[int, bool], ...]:
    state = status.integers("arming_state")
    if state is None:
        return ()
    return tuple(zip(_times(status).tolist(), (state == _ARMED).tolist(), strict=True))


def _degrees(of: UlogTable, old: str, new: str) -> IntArray:
    """Return latitudes or longitudes in 1e-7 degrees; old logs have integers, new ones degrees."""
    whole = of.integers(old)
    if whole is not None:
        return whole
    degrees = of.numbers(new) if new in of else of.numbers(old)
    sound = np.isfinite(degrees) & (np.abs(degrees) < 1e3)
    return np.where(sound, np.round(np.where(sound, degrees, 0.0) * 1e7), 1 << 40).astype(np.int64)


def _fixes(gps: UlogTable, lost: Lost) -> tuple[Fixes | None, GpsTime | None]:
    lat_1e7, lon_1e7 = (_degrees(gps, "lat", "latitude_deg"), _degrees(gps, "lon", "longitude_deg"))
    alt_m = gps.numbers("alt") * 1e-3 if "alt" in gps else gps.numbers("altitude_msl_m")
    sound = on_earth(lat_1e7, lon_1e7, alt_m, gps.numbers("fix_type"))
    count(lost, Reason.MALFORMED, int((~sound).sum()))
    gps = gps.rows(sound)
    if not len(gps):
        return None, None
    boot_us, fix_type = _times(gps), gps.numbers("fix_type").astype(np.int64)
    unix = gps.integers("time_utc_usec")
    unix_us = np.where(fix_type >= 3, 0 if unix is None else unix, 0)
    satellites = gps.numbers("satellites_used")
    accuracies = [gps.numbers(name) for name in ("eph", "epv", "s_variance_m_s")]
    fixes = Fixes(
        boot_us=boot_us,
        unix_us=unix_us,
        fix_type=fix_type,
        satellites=np.where(np.isfinite(satellites), satellites, 255).astype(np.int64),
        lat_1e7=lat_1e7[sound],
        lon_1e7=lon_1e7[sound],
        alt_m=alt_m[sound],
        accuracies=np.stack([np.where(each > 0, each, np.nan) for each in accuracies], axis=1),
        speed_mps=gps.numbers("vel_m_s"),
        course_deg=np.degrees(gps.numbers("cog_rad")),
    )
    return fixes, gps_time.fit(boot_us, unix_us)


def _positions(
    tables: dict[str, UlogTable], fixes: Fixes | None, lost: Lost, notes: list[str]
) -> OnboardPositions | None:
    place, local = tables[_GLOBAL], tables[_LOCAL]
    if not len(place):
        return None if fixes is None else _received(fixes, local, notes)
    lat_1e7, lon_1e7, alt_m = _place(place)
    sound = on_earth(lat_1e7, lon_1e7, alt_m)
    count(lost, Reason.MALFORMED, int((~sound).sum()))
    place, boot_us = place.rows(sound), _times(place)[sound]
    lat_1e7, lon_1e7, alt_m = lat_1e7[sound], lon_1e7[sound], alt_m[sound]
    if not len(boot_us):
        return None
    older = np.stack([place.numbers(name) for name in ("vel_n", "vel_e", "vel_d")], axis=1)
    velocity = np.where(np.isfinite(older), older, _velocities(boot_us, local))
    missing: BoolArray = np.array(np.isnan(velocity).any(axis=1))
    if missing.any():
        notes.append(f"no estimated velocity at {missing.sum()} of {len(boot_us)} positions")
        way = velocities_of(boot_us, lat_1e7, lon_1e7, alt_m)
        velocity = np.where(missing[:, None], way, velocity)
    home_m = tables["home_position"].numbers("alt")
    home_m = home_m[np.isfinite(home_m)]
    height_m = alt_m - (home_m[-1] if len(home_m) else alt_m[0])
    yaw = place.numbers("yaw")
    heading = np.where(np.isfinite(yaw), np.degrees(yaw), _headings(boot_us, local))
    return OnboardPositions(
        boot_us=boot_us,
        lat_1e7=lat_1e7,
        lon_1e7=lon_1e7,
        alt_m=alt_m,
        height_m=height_m,
        velocity_ned_mps=velocity,
        heading_deg=heading,
    )


def _place(of: UlogTable) -> tuple[IntArray, IntArray, FloatArray]:
    return _degrees(of, "", "lat"), _degrees(of, "", "lon"), of.numbers("alt")


def _received(fixes: Fixes, local: UlogTable, notes: list[str]) -> OnboardPositions | None:
    fixed = fixes.fixed()
    if fixed is None:
        return None
    notes.append("no vehicle_global_position: positions are those of the GNSS receiver")
    velocity = velocities_of(fixed.boot_us, fixed.lat_1e7, fixed.lon_1e7, fixed.alt_m)
    level = fixed.velocity_mps
    velocity[:, :2] = np.where(np.isfinite(level), level, velocity[:, :2])
    return fixed.positions(velocity, _headings(fixed.boot_us, local))


def _velocities(boot_us: IntArray, local: UlogTable) -> FloatArray:
    velocity = np.stack([local.numbers(name) for name in ("vx", "vy", "vz")], axis=1)
    return vectors_between(boot_us, _times(local), velocity, NEAR_US)


def _headings(boot_us: IntArray, local: UlogTable) -> FloatArray:
    heading = local.numbers("heading" if "heading" in local else "yaw")
    return headings_between(boot_us, _times(local), heading)


def _turns(of: UlogTable, lost: Lost) -> tuple[IntArray, FloatArray]:
    """Return times (N,) and attitude quaternions (N, 4) of length 1."""
    quaternions = of.numbers("q", 4)
    length = np.linalg.norm(quaternions, axis=1) if len(of) else np.zeros(0)
    sound = np.abs(length - 1) < 0.1
    count(lost, Reason.MALFORMED, int((~sound).sum()))
    return _times(of)[sound], quaternions[sound] / length[sound, None]


def _attitudes(tables: dict[str, UlogTable], lost: Lost) -> Attitudes | None:
    boot_us, quaternions = _turns(tables[_ATTITUDE], lost)
    if not len(boot_us):
        return None
    euler = euler_of(quaternions)
    gyro = tables[_RATES]
    rates = vectors_between(boot_us, _times(gyro), gyro.numbers("xyz", 3), NEAR_US // 5, 1e3)
    return Attitudes(
        boot_us, euler, np.where(np.isnan(rates), body_rates_of(boot_us, euler), rates)
    )


def _truth(tables: dict[str, UlogTable], lost: Lost) -> Truth | None:
    of = tables[f"{_GLOBAL}_groundtruth"]
    lat_1e7, lon_1e7, alt_m = _place(of)
    sound = on_earth(lat_1e7, lon_1e7, alt_m)
    count(lost, Reason.MALFORMED, int((~sound).sum()))
    boot_us = _times(of)[sound]
    lat_1e7, lon_1e7, alt_m = lat_1e7[sound], lon_1e7[sound], alt_m[sound]
    if not len(boot_us):
        return None
    velocity = _velocities(boot_us, tables[f"{_LOCAL}_groundtruth"])
    made = velocities_of(boot_us, lat_1e7, lon_1e7, alt_m)
    velocity = np.where(np.isnan(velocity), made, velocity)
    turned_at, quaternions = _turns(tables[f"{_ATTITUDE}_groundtruth"], lost)
    near = np.zeros((len(boot_us), 4))
    if len(turned_at):
        row = np.clip(np.searchsorted(turned_at, boot_us), 0, len(turned_at) - 1)
        close = np.abs(turned_at[row] - boot_us) < NEAR_US // 10
        near = np.where(close[:, None], quaternions[row], 0.0)
    return Truth(
        boot_us=boot_us,
        lat_1e7=lat_1e7,
        lon_1e7=lon_1e7,
        alt_m=alt_m,
        velocity_ned_mps=velocity,
        ned_from_body=near,
    )
