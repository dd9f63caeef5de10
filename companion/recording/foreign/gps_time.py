"""Unix time of a boot clock, from the GPS times of fixes in the log of one vehicle.

Each fix has its GPS time, and the boot time at which the autopilot received it. The difference is
the offset of the clocks, less the delay of the receiver. A line is fitted to the differences: its
slope is the drift of the boot clock, and the deviations from it are the uncertainty. A delay common
to all fixes cannot be observed (``RECEIVER_LAG_S``).

GPS time is ahead of UTC by the leap seconds since 1980 (IERS Bulletin C).
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.values import FloatArray, IntArray

RECEIVER_LAG_S: Final = 0.2
"""Largest usual delay from a fix until the receiver delivers it, seconds.

The relative time of two logs is uncertain by the difference of their receivers.
"""
GPS_EPOCH_S: Final = 315_964_800  # 1980-01-06, Unix time
WEEK_S: Final = 604_800
_LEAPS: Final = (
    (1_483_228_800, 18), (1_435_708_800, 17), (1_341_100_800, 16), (1_230_768_000, 15),
    (1_136_073_600, 14),
)  # fmt: skip
"""Unix times, and by how many seconds GPS time is ahead from then on; 13 before 2006."""
FIRST_UNIX_US: Final = 1_104_537_600_000_000  # 2005: no such log is older
LAST_UNIX_US: Final = 4_102_444_800_000_000  # the year 2100; other times are invalid
_APART_US: Final = 1_000_000
"""Largest difference between offsets of one clock, us; larger for a receiver without the time."""
_POINTS: Final = 100
_DRIFT_SPAN_US: Final = 60_000_000
_DRIFT_MAX: Final = 1e-3
_RESOLUTION_S: Final = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class GpsTime:
    """Boot clock in Unix time: ``boot + offset + drift * (boot - at)``."""

    offset_us: int
    drift: float
    at_us: int
    uncertainty_s: float  # 95th percentile of the fixes' deviations, at least a millisecond
    fixes: int  # number of fixes used

    def unix_us(self, boot_us: IntArray) -> IntArray:
        """Return Unix times (N,) of boot times (N,), microseconds."""
        drifted: IntArray = np.round(self.drift * (boot_us - self.at_us)).astype(np.int64)
        return boot_us + self.offset_us + drifted


def unix_us(week: IntArray, week_ms: IntArray) -> IntArray:
    """Return Unix times (N,), us, from GPS weeks and milliseconds of the week; 0 if impossible."""
    possible = (week > 0) & (week < 10_000) & (week_ms >= 0) & (week_ms < WEEK_S * 1000)
    gps_s = GPS_EPOCH_S + np.where(possible, week, 0) * WEEK_S
    ahead_s = np.full(len(week), 13)
    for since_s, seconds in reversed(_LEAPS):
        ahead_s[gps_s >= since_s] = seconds
    found = (gps_s - ahead_s) * 1_000_000 + np.where(possible, week_ms, 0) * 1000
    return np.where(possible & (found >= FIRST_UNIX_US), found, 0)


def fit(boot_us: IntArray, fixed_us: IntArray) -> GpsTime | None:
    """Fit a boot clock to fixes, given the boot times of their reception and their Unix times.

    A Unix time of 0 is unknown. Returns None without a fix, or if most fixes contradict each other.
    """
    sound = (fixed_us >= FIRST_UNIX_US) & (fixed_us <= LAST_UNIX_US) & (boot_us >= 0)
    sound &= boot_us < FIRST_UNIX_US
    boot_us, apart_us = boot_us[sound], (fixed_us - np.where(sound, boot_us, 0))[sound]
    if not len(boot_us):
        return None
    middle_us = int(np.median(apart_us))
    agree = np.abs(apart_us - middle_us) <= _APART_US
    if agree.sum() * 2 <= len(agree):
        return None
    boot_us, stray_us = boot_us[agree], (apart_us[agree] - middle_us).astype(np.float64)
    at_us = int(np.median(boot_us))
    drift = _slope((boot_us - at_us).astype(np.float64), stray_us)
    left_us = stray_us - drift * (boot_us - at_us)
    level_us = float(np.median(left_us))
    uncertainty_s = float(np.quantile(np.abs(left_us - level_us), 0.95)) * 1e-6
    return GpsTime(
        offset_us=middle_us + round(level_us),
        drift=drift,
        at_us=at_us,
        uncertainty_s=max(_RESOLUTION_S, uncertainty_s),
        fixes=len(boot_us),
    )


def _slope(x: FloatArray, y: FloatArray) -> float:
    """Return the median slope between pairs of points (Theil and Sen); 0 if they span no minute."""
    rows = np.unique(np.linspace(0, len(x) - 1, _POINTS).astype(np.int64))
    x, y = x[rows], y[rows]
    one, other = np.triu_indices(len(x), 1)
    far = np.abs(x[other] - x[one]) >= _DRIFT_SPAN_US
    if not far.any():
        return 0.0
    slope = float(np.median((y[other] - y[one])[far] / (x[other] - x[one])[far]))
    return slope if abs(slope) <= _DRIFT_MAX else 0.0
