"""The satellite receiver in use, by the GPS and GPA messages of ArduPilot's DataFlash log.

GPA has the accuracy of each GPS message, and the boot time at which the fix was received (SMS).
"""

from typing import Final

import numpy as np

from companion.recording.foreign import gps_time
from companion.recording.foreign.dataflash import DataflashTable
from companion.recording.foreign.gps_time import GpsTime
from companion.recording.foreign.onboard import Fixes, on_earth, time_ordered
from companion.values import FloatArray, IntArray, Reason

_BESIDE_US: Final = 5_000  # GPA is written with its GPS
_LATE_US: Final = 2e6


def times(of: DataflashTable) -> IntArray:
    """Return boot times (N,) of messages, microseconds; empty if the messages have none."""
    exact = of.integers("TimeUS")
    if exact is not None:
        return exact
    before_2015 = of.integers("TimeMS")
    return np.zeros(0, dtype=np.int64) if before_2015 is None else before_2015 * 1000


def count(lost: dict[Reason, int], reason: Reason, number: int) -> None:
    """Add to the counts of unusable data."""
    if number:
        lost[reason] = lost.get(reason, 0) + number


def fixes_of(
    gps: DataflashTable, accuracy: DataflashTable, lost: dict[Reason, int]
) -> tuple[Fixes | None, GpsTime | None]:
    """Return the fixes of the receiver in use, and the boot clock's relation to GPS time."""
    used, instance = gps.integers("U"), gps.integers("I")
    if used is not None and used.any():
        gps = gps.rows(used > 0)
    elif instance is not None and len(instance):
        gps = gps.rows(instance == instance.min())
    lat_1e7, lon_1e7 = gps.integers("Lat"), gps.integers("Lng")
    if not len(gps) or lat_1e7 is None or lon_1e7 is None:
        return None, None
    alt_m, status = gps.numbers("Alt"), gps.numbers("Status")
    sound = on_earth(lat_1e7, lon_1e7, alt_m, status)
    count(lost, Reason.MALFORMED, int((~sound).sum()))
    gps = gps.rows(np.flatnonzero(sound)[_by_time(times(gps)[sound])])
    if not len(gps):
        return None, None
    boot_us = times(gps)
    week, week_ms = gps.numbers("GWk"), gps.numbers("GMS")
    known = np.isfinite(week) & np.isfinite(week_ms) & (gps.numbers("Status") >= 3)
    fixed_us = gps_time.unix_us(
        np.where(known, week, 0).astype(np.int64), np.where(known, week_ms, -1).astype(np.int64)
    )
    beside = _nearest(boot_us, gps, accuracy)
    received_us = np.where(np.isfinite(beside[:, 3]), beside[:, 3] * 1e3, boot_us).astype(np.int64)
    satellites = gps.numbers("NSats")
    places = gps.integers("Lat"), gps.integers("Lng")
    assert places[0] is not None and places[1] is not None
    fixes = Fixes(
        boot_us=boot_us,
        unix_us=fixed_us,
        fix_type=gps.numbers("Status").astype(np.int64),
        satellites=np.where(np.isfinite(satellites), satellites, 255).astype(np.int64),
        lat_1e7=places[0],
        lon_1e7=places[1],
        alt_m=gps.numbers("Alt"),
        accuracies=beside[:, :3],
        speed_mps=gps.numbers("Spd"),
        course_deg=gps.numbers("GCrs"),
    )
    return fixes, gps_time.fit(received_us, fixed_us)


def _by_time(boot_us: IntArray) -> IntArray:
    rows, _ = time_ordered(boot_us)
    return rows


def _nearest(boot_us: IntArray, gps: DataflashTable, accuracy: DataflashTable) -> FloatArray:
    """Return accuracies and boot times of fixes, ms, (N, 4), from GPA; NaN: unknown."""
    found = np.full((len(boot_us), 4), np.nan)
    mine, other = gps.integers("I"), accuracy.integers("I")
    if mine is not None and other is not None and len(mine):
        accuracy = accuracy.rows(other == mine[0])
    theirs = times(accuracy)
    if not len(theirs):
        return found
    rows = np.argsort(theirs, kind="stable")
    nearest = rows[np.clip(np.searchsorted(theirs[rows], boot_us), 0, len(rows) - 1)]
    near = np.abs(theirs[nearest] - boot_us) <= _BESIDE_US
    for column, name in enumerate(("HAcc", "VAcc", "SAcc", "SMS")):
        values = accuracy.numbers(name)[nearest]
        found[:, column] = np.where(near & (values > 0), values, np.nan)
    late_us = boot_us - found[:, 3] * 1e3
    found[~(np.abs(late_us) < _LATE_US), 3] = np.nan  # not a boot time of this clock
    return found
