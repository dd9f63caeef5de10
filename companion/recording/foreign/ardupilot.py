"""Interpretation of ArduPilot's DataFlash log.

Meanings and units: https://ardupilot.org/copter/docs/logmessages.html. POS is the position that
GLOBAL_POSITION_INT sends; its velocity is that of the estimator core in use (XKF1, or NKF1 of the
older estimator, by XKF4.PI and ATT.AEKF). SIM and SIM2 come from the simulator.
"""

from typing import Final

import numpy as np

from companion.recording.foreign.columns import Bytes
from companion.recording.foreign.dataflash import DataflashTable, table, walk
from companion.recording.foreign.onboard import (
    NEAR_US,
    Attitudes,
    Fixes,
    Onboard,
    OnboardPositions,
    Truth,
    body_rates_of,
    headings_between,
    on_earth,
    sound_rows,
    time_ordered,
    vectors_between,
    velocities_of,
)
from companion.recording.foreign.receiver import count, fixes_of, times
from companion.values import BoolArray, FloatArray, IntArray, Reason

_WANTED: Final = (
    "POS", "ATT", "GPS", "GPA", "XKF1", "XKF4", "NKF1", "NKF4", "RATE", "SIM", "SIM2", "PARM",
    "VER", "ARM",
)  # fmt: skip
_IDS: Final = (b"MAV_SYSID", b"SYSID_THISMAV")
_ARDUPILOT: Final = 3
_BY_BUILD: Final = {1: 10, 2: 2, 3: 1, 4: 5, 7: 12, 12: 7, 13: 4}
"""MAV_TYPE by VER.BU (AP_Vehicle_Type.h): rover, copter, plane, tracker, sub, blimp, helicopter."""
_BY_FRAME: Final = {1: 2, 2: 13, 3: 14, 4: 14, 5: 13, 6: 4, 7: 15, 8: 3, 9: 3, 11: 4, 13: 4}
"""MAV_TYPE by FRAME_CLASS of a copter."""
_VTOL: Final = 22


def read(data: Bytes) -> Onboard:
    """Return the samples of a DataFlash log; unusable samples are counted."""
    walked = walk(data, _WANTED)
    tables = {name: table(data, walked, name) for name in _WANTED}
    lost: dict[Reason, int] = {}
    count(lost, Reason.GARBAGE, walked.lost)
    count(lost, Reason.MALFORMED, walked.refused)
    for name in _WANTED:
        if name not in ("PARM", "VER"):
            tables[name] = _timed(tables[name], lost)
    sysid, mav_type = _identity(tables["PARM"], tables["VER"])
    fixes, clock = fixes_of(tables["GPS"], tables["GPA"], lost)
    notes: list[str] = []
    return Onboard(
        sysid=sysid,
        compid=1,
        mav_type=mav_type,
        autopilot=_ARDUPILOT,
        positions=_positions(tables, fixes, lost, notes),
        attitudes=_attitudes(tables["ATT"], tables["RATE"], lost),
        fixes=fixes,
        truth=_truth(tables["SIM"], tables["SIM2"], lost),
        armed=_armed(tables["ARM"]),
        clock=clock,
        lost=lost,
        incomplete_bytes=walked.rest,
        notes=tuple(notes),
    )


def _timed(of: DataflashTable, lost: dict[Reason, int]) -> DataflashTable:
    """Return the rows in order of time, including several of one time from cores or receivers."""
    boot_us = times(of)
    if len(boot_us) != len(of):
        count(lost, Reason.MALFORMED, len(of))
        return of.rows(np.zeros(0, dtype=np.int64))
    which = next((name for name in ("C", "I") if of.integers(name) is not None), None)
    number = None if which is None else of.integers(which)
    if number is None:
        rows, wild = time_ordered(boot_us)
        count(lost, Reason.BAD_STAMP, wild)
        return of.rows(rows)
    number = number & 0xFF  # cores and receivers are bytes
    parts = []
    for each in np.unique(number).tolist():
        (mine,) = np.nonzero(number == each)
        rows, wild = time_ordered(boot_us[mine])
        count(lost, Reason.BAD_STAMP, wild)
        parts.append(mine[rows])
    return of.rows(np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64))


# --- identity -------------------------------------------------------------------------------------


def _identity(parameters: DataflashTable, versions: DataflashTable) -> tuple[int | None, int]:
    """Return system id (None: unknown) and MAV_TYPE (0, generic: unknown)."""
    values: dict[bytes, float] = {}
    said = parameters.values("Name", "S")
    if said is not None and "Value" in parameters:
        names = np.char.rstrip(said.astype("S16"), b"\0")
        numbers = parameters.numbers("Value")
        for name in (*_IDS, b"FRAME_CLASS", b"Q_ENABLE"):
            (rows,) = np.nonzero(names == name)
            if len(rows) and np.isfinite(numbers[rows[-1]]):
                values[name] = float(numbers[rows[-1]])
    ids = [int(values[name]) for name in _IDS if 0 < values.get(name, 0.0) <= 255]
    builds = versions.integers("BU")
    build = int(builds[-1]) if builds is not None and len(builds) else _build(values)
    mav_type = _BY_BUILD.get(build, 0)
    if mav_type == 2:
        mav_type = _BY_FRAME.get(int(values.get(b"FRAME_CLASS", 1)), 2)
    if mav_type == 1 and values.get(b"Q_ENABLE"):
        mav_type = _VTOL
    return (ids[0] if ids else None), mav_type


def _build(values: dict[bytes, float]) -> int:
    """Return the kind of vehicle by parameters that only this kind has; 0 if unknown."""
    if b"Q_ENABLE" in values:
        return 3
    return 2 if b"FRAME_CLASS" in values else 0


def _armed(of: DataflashTable) -> tuple[tuple[int, bool], ...]:
    state = of.integers("ArmState")
    if state is None:
        return ()
    return tuple(zip(times(of).tolist(), (state != 0).tolist(), strict=True))


# --- motion ---------------------------------------------------------------------------------------


def _positions(
    tables: dict[str, DataflashTable],
    fixes: Fixes | None,
    lost: dict[Reason, int],
    notes: list[str],
) -> OnboardPositions | None:
    pos, attitude = tables["POS"], tables["ATT"]
    lat_1e7, lon_1e7 = pos.integers("Lat"), pos.integers("Lng")
    if lat_1e7 is None or lon_1e7 is None or not len(pos):
        return None if fixes is None else _received(fixes, tables, notes)
    alt_m, height_m = pos.numbers("Alt"), pos.numbers("RelHomeAlt")
    height_m = np.where(np.isfinite(height_m), height_m, alt_m - alt_m[0])
    sound = on_earth(lat_1e7, lon_1e7, alt_m, height_m)
    count(lost, Reason.MALFORMED, int((~sound).sum()))
    boot_us = times(pos)[sound]
    lat_1e7, lon_1e7, alt_m = lat_1e7[sound], lon_1e7[sound], alt_m[sound]
    velocity = _velocities(boot_us, tables)
    if np.isnan(velocity).any():
        between_m = velocities_of(boot_us, lat_1e7, lon_1e7, alt_m)
        velocity = _filled(velocity, boot_us, fixes, between_m, notes)
    heading = _headings(boot_us, attitude)
    if not len(boot_us):
        return None
    return OnboardPositions(
        boot_us=boot_us,
        lat_1e7=lat_1e7,
        lon_1e7=lon_1e7,
        alt_m=alt_m,
        height_m=height_m[sound],
        velocity_ned_mps=velocity,
        heading_deg=heading,
    )


def _received(
    fixes: Fixes, tables: dict[str, DataflashTable], notes: list[str]
) -> OnboardPositions | None:
    fixed = fixes.fixed()
    if fixed is None:
        return None
    notes.append("no POS: positions are those of the GNSS receiver")
    way = velocities_of(fixed.boot_us, fixed.lat_1e7, fixed.lon_1e7, fixed.alt_m)
    velocity = _filled(np.full_like(way, np.nan), fixed.boot_us, fixes, way, notes)
    return fixed.positions(velocity, _headings(fixed.boot_us, tables["ATT"]))


def _velocities(boot_us: IntArray, tables: dict[str, DataflashTable]) -> FloatArray:
    """Return the estimator's velocities (N, 3) at times (N,); NaN if unknown."""
    older = tables["ATT"].integers("AEKF")
    second = older is not None and len(older) > 0 and int(np.median(older)) == 2
    names = ("NKF1", "NKF4") if second or not len(tables["XKF1"]) else ("XKF1", "XKF4")
    states, cores = (tables[name] for name in names)
    core, primary = states.integers("C"), cores.integers("PI")
    if core is not None and len(core):
        used = np.full(len(core), core.min())
        if primary is not None and len(primary):
            switched_us = times(cores)
            order = np.argsort(switched_us, kind="stable")
            last = np.searchsorted(switched_us[order], times(states), side="right") - 1
            used = primary[order][np.clip(last, 0, None)]
        states = states.rows(core == used)
    said_us = times(states)
    velocity = np.stack([states.numbers(axis) for axis in ("VN", "VE", "VD")], axis=1)
    order = np.argsort(said_us, kind="stable")
    return vectors_between(boot_us, said_us[order], velocity[order], NEAR_US)


def _filled(
    velocity: FloatArray, boot_us: IntArray, fixes: Fixes | None, way: FloatArray, notes: list[str]
) -> FloatArray:
    """Fill in missing velocities from the receiver's ground velocity, else from positions."""
    missing: BoolArray = np.array(np.isnan(velocity).any(axis=1))
    notes.append(f"no estimated velocity at {missing.sum()} of {len(boot_us)} positions")
    put = way.copy()
    if fixes is not None:
        there = vectors_between(boot_us, fixes.boot_us, fixes.velocity_mps, NEAR_US)
        put[:, :2] = np.where(np.isnan(there), put[:, :2], there)
    return np.where(missing[:, None], put, velocity)


def _headings(boot_us: IntArray, attitude: DataflashTable) -> FloatArray:
    return headings_between(boot_us, times(attitude), np.radians(attitude.numbers("Yaw")))


def _attitudes(
    of: DataflashTable, gyro: DataflashTable, lost: dict[Reason, int]
) -> Attitudes | None:
    angles = np.stack([of.numbers(name) for name in ("Roll", "Pitch", "Yaw")], axis=1)
    sound = sound_rows(angles, 1e4)
    count(lost, Reason.MALFORMED, int((~sound).sum()))
    if not sound.any():
        return None
    boot_us, euler = times(of)[sound], np.radians(angles[sound])
    rates = body_rates_of(boot_us, euler)
    measured = np.radians(np.stack([gyro.numbers(name) for name in ("R", "P", "Y")], axis=1))
    there = vectors_between(boot_us, times(gyro), measured, NEAR_US // 5, 1e3)
    return Attitudes(boot_us, euler, np.where(np.isnan(there), rates, there))


def _truth(sim: DataflashTable, motion: DataflashTable, lost: dict[Reason, int]) -> Truth | None:
    lat_1e7, lon_1e7 = sim.integers("Lat"), sim.integers("Lng")
    if lat_1e7 is None or lon_1e7 is None or not len(sim):
        return None
    alt_m = sim.numbers("Alt")
    turned_by = np.stack([sim.numbers(name) for name in ("Q1", "Q2", "Q3", "Q4")], axis=1)
    sound = on_earth(lat_1e7, lon_1e7, alt_m) & np.isfinite(turned_by).all(axis=1)
    count(lost, Reason.MALFORMED, int((~sound).sum()))
    boot_us = times(sim)[sound]
    lat_1e7, lon_1e7, alt_m = lat_1e7[sound], lon_1e7[sound], alt_m[sound]
    if not len(boot_us):
        return None
    velocity = np.stack([motion.numbers(name) for name in ("VN", "VE", "VD")], axis=1)
    there = vectors_between(boot_us, times(motion), velocity, NEAR_US // 5)
    there = np.where(np.isnan(there), velocities_of(boot_us, lat_1e7, lon_1e7, alt_m), there)
    return Truth(
        boot_us=boot_us,
        lat_1e7=lat_1e7,
        lon_1e7=lon_1e7,
        alt_m=alt_m,
        velocity_ned_mps=there,
        ned_from_body=turned_by[sound],
    )
