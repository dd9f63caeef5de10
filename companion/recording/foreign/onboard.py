"""Samples in the onboard log of one vehicle, whatever its format.

All times are microseconds of the vehicle's boot clock. Arrays of one kind of sample have the same
length and are in order of time.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Final

import numpy as np

from companion.recording.foreign.gps_time import GpsTime
from companion.recording.stamps import LARGEST_LEAP_NS
from companion.values import BoolArray, FloatArray, IntArray, Reason

REBOOT_US: Final = 10_000_000  # a larger step back of a boot clock is a reboot, not disorder
NEAR_US: Final = 500_000
"""Largest time between a position and the velocity or heading that is combined with it."""
_NEAR: Final = 4
_STAMP_JUMP_US: Final = 120_000_000
"""Largest deviation of a stamp from its neighbours' median in the file; else an outlier.

In a log with minutes between its samples, the deviation may be as large as four intervals.
"""
METRES_PER_DEGREE: Final = 111_195.0


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class OnboardPositions:
    """Positions that the autopilot estimated.

    lat_1e7, lon_1e7  (N,), 1e-7 degrees
    """

    boot_us: IntArray  # (N,)
    lat_1e7: IntArray
    lon_1e7: IntArray
    alt_m: FloatArray  # (N,), above mean sea level
    height_m: FloatArray  # (N,), above home
    velocity_ned_mps: FloatArray  # (N, 3)
    heading_deg: FloatArray  # (N,), from true north; NaN: unknown


@dataclass(frozen=True, slots=True, eq=False)
class Attitudes:
    """Attitudes: roll, pitch and yaw (N, 3), rad, and body rates (N, 3), rad/s."""

    boot_us: IntArray
    euler_rad: FloatArray
    rates_radps: FloatArray


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Fixes:
    """Reports of the satellite receiver in use, each an array (N,)."""

    boot_us: IntArray
    unix_us: IntArray  # the time of the fix; 0: unknown
    fix_type: IntArray  # MAVLink's GPS_FIX_TYPE
    satellites: IntArray
    lat_1e7: IntArray
    lon_1e7: IntArray
    alt_m: FloatArray
    accuracies: FloatArray  # (N, 3): horizontal m, vertical m, speed m/s; NaN: unknown
    speed_mps: FloatArray  # over ground
    course_deg: FloatArray  # over ground, from true north

    @property
    def velocity_mps(self) -> FloatArray:
        """Velocities over ground (N, 2), north and east."""
        course = np.radians(self.course_deg)
        return np.stack([np.cos(course), np.sin(course)], axis=1) * self.speed_mps[:, None]

    def fixed(self) -> "Fixes | None":
        """Return the fixes that have a position; None without any."""
        rows = self.fix_type >= 3
        if not rows.any():
            return None
        return Fixes(**{one.name: getattr(self, one.name)[rows] for one in fields(self)})

    def positions(self, velocity_ned_mps: FloatArray, heading_deg: FloatArray) -> OnboardPositions:
        """Return the receiver's positions, for a log without estimated ones."""
        return OnboardPositions(
            boot_us=self.boot_us,
            lat_1e7=self.lat_1e7,
            lon_1e7=self.lon_1e7,
            alt_m=self.alt_m,
            height_m=self.alt_m - self.alt_m[0],
            velocity_ned_mps=velocity_ned_mps,
            heading_deg=heading_deg,
        )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Truth:
    """The simulator's true positions, and quaternions (N, 4), wxyz, that rotate body to NED."""

    boot_us: IntArray
    lat_1e7: IntArray
    lon_1e7: IntArray
    alt_m: FloatArray
    velocity_ned_mps: FloatArray
    ned_from_body: FloatArray


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Onboard:
    """Samples in the onboard log of one vehicle."""

    sysid: int | None  # its MAVLink system id, if the log has it
    compid: int  # its component id
    mav_type: int  # MAV_TYPE
    autopilot: int  # MAV_AUTOPILOT
    positions: OnboardPositions | None
    attitudes: Attitudes | None = None
    fixes: Fixes | None = None
    truth: Truth | None = None
    armed: tuple[tuple[int, bool], ...] = ()  # boot times and whether it was armed from then on
    clock: GpsTime | None = None  # its boot clock on GPS time; None if the log has no GPS time
    lost: Mapping[Reason, int] = field(default_factory=dict)  # unusable parts of the file
    incomplete_bytes: int = 0  # of a record in which the file ends
    notes: tuple[str, ...] = ()  # substitutions for missing data, for the user


# --- usable samples -------------------------------------------------------------------------------


def time_ordered(boot_us: IntArray) -> tuple[IntArray, int]:
    """Return the rows of samples in order of time, and the number of rows with an outlier stamp.

    ``boot_us`` (N,) is in the order of the file. A stamp is an outlier, and dropped, if it is
    minutes off the median of its neighbours; of several samples with one time the first is kept.
    Time starts again after a reboot.
    """
    if not len(boot_us):
        return np.zeros(0, dtype=np.int64), 0
    padded = np.pad(boot_us, _NEAR, mode="symmetric")  # so that the first stamp may be one, too
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * _NEAR + 1)
    middle = np.sort(around, axis=1)[:, _NEAR]
    apart = np.maximum(boot_us, middle).astype(np.uint64) - np.minimum(boot_us, middle).astype(
        np.uint64
    )
    spacing_us = int(np.median(np.abs(np.diff(middle)))) if len(middle) > 1 else 0
    most_us = max(_STAMP_JUMP_US, _NEAR * spacing_us)
    sound = (apart <= np.uint64(most_us)) & (boot_us >= 0)
    rows: IntArray = np.flatnonzero(sound)
    life = np.cumsum(np.diff(middle[rows], prepend=middle[rows][:1]) < -REBOOT_US)
    order = np.lexsort((boot_us[rows], life))
    rows = rows[order]
    fresh = np.ones(len(rows), dtype=bool)
    fresh[1:] = (np.diff(boot_us[rows]) != 0) | (np.diff(life[order]) != 0)
    return rows[fresh], int((~sound).sum())


def earliest_us(stamps_us: IntArray) -> int:
    """Return the earliest of the first stamps, but none that is far from most of them."""
    first_us = stamps_us[: 2 * _NEAR + 1]
    if not len(first_us):
        return 0
    apart_us = np.abs(first_us - np.median(first_us))
    return int(first_us[apart_us <= LARGEST_LEAP_NS / 1000].min())


def on_earth(lat_1e7: IntArray, lon_1e7: IntArray, *others: FloatArray) -> BoolArray:
    """Return a mask of positions (N,) on Earth whose other values (N,) are finite and plausible."""
    sound: BoolArray = (np.abs(lat_1e7) <= 900_000_000) & (np.abs(lon_1e7) <= 1_800_000_000)
    for other in others:
        sound &= np.isfinite(other) & (np.abs(other) < 1e6)
    return sound


def sound_rows(values: FloatArray, most: float) -> BoolArray:
    """Return a mask of the rows (N, K) whose numbers are all finite and smaller than ``most``."""
    return np.array((np.abs(values) < most).all(axis=1))  # false for NaN


def vectors_between(
    at_us: IntArray, boot_us: IntArray, values: FloatArray, gap_us: int, most: float = 1e4
) -> FloatArray:
    """Interpolate like ``between`` for (N, K), using only rows that pass ``sound_rows``."""
    sound = sound_rows(values, most)
    return between(at_us, boot_us[sound], values[sound], gap_us)


def headings_between(at_us: IntArray, boot_us: IntArray, heading_rad: FloatArray) -> FloatArray:
    """Interpolate headings at other times (M,), degrees; NaN if no sample is near."""
    sound = np.isfinite(heading_rad) & (np.abs(heading_rad) < 1e3)
    if not sound.any():
        return np.full(len(at_us), np.nan)
    return between(at_us, boot_us[sound], np.degrees(np.unwrap(heading_rad[sound])), NEAR_US)


def between(at_us: IntArray, boot_us: IntArray, values: FloatArray, gap_us: int) -> FloatArray:
    """Interpolate ``values`` (N,) or (N, K) linearly at other times (M,); NaN if no sample is near.

    ``gap_us`` is the largest distance to the nearest sample.
    """
    if not len(boot_us):
        return np.full((len(at_us), *values.shape[1:]), np.nan)
    from_us = int(boot_us[0])
    x, known = (at_us - from_us).astype(np.float64), (boot_us - from_us).astype(np.float64)
    columns = values.reshape(len(boot_us), -1).T
    found: FloatArray = np.stack([np.interp(x, known, column) for column in columns], axis=1)
    after = np.clip(np.searchsorted(boot_us, at_us), 0, len(boot_us) - 1)
    before = np.clip(after - 1, 0, None)
    apart = np.minimum(np.abs(boot_us[after] - at_us), np.abs(boot_us[before] - at_us))
    found[apart > gap_us] = np.nan
    return found.reshape(len(at_us), *values.shape[1:])


def velocities_of(
    boot_us: IntArray, lat_1e7: IntArray, lon_1e7: IntArray, alt_m: FloatArray
) -> FloatArray:
    """Return velocities (N, 3), NED, m/s, from adjacent positions; 0 for a single position."""
    if len(boot_us) < 2:
        return np.zeros((len(boot_us), 3))
    t_s = _ascending_s(boot_us)
    scale = METRES_PER_DEGREE * 1e-7
    north = (lat_1e7 - lat_1e7[0]) * scale
    east_1e7 = np.unwrap(lon_1e7 - lon_1e7[0], period=3_600_000_000)  # over the antimeridian too
    east = east_1e7 * scale * np.cos(np.radians(lat_1e7 * 1e-7))
    place = np.stack([north, east, -(alt_m - alt_m[0])], axis=1)
    velocity: FloatArray = np.gradient(place, t_s, axis=0)
    return velocity


def _ascending_s(boot_us: IntArray) -> FloatArray:
    """Return times in seconds since the first, made strictly ascending across reboots."""
    t_s = (boot_us - boot_us[0]) * 1e-6
    ascending_s: FloatArray = np.maximum.accumulate(t_s) + np.arange(len(t_s)) * 1e-9
    return ascending_s


def body_rates_of(boot_us: IntArray, euler_rad: FloatArray) -> FloatArray:
    """Return body rates (N, 3), rad/s, from adjacent attitudes; 0 for a single attitude.

    The rates of roll, pitch and yaw give those of the body by the kinematics of Euler angles.
    """
    if len(boot_us) < 2:
        return np.zeros((len(boot_us), 3))
    t_s = _ascending_s(boot_us)
    roll, pitch, yaw = np.unwrap(euler_rad, axis=0).T
    by_roll, by_pitch, by_yaw = (np.gradient(angle, t_s) for angle in (roll, pitch, yaw))
    return np.stack(
        [
            by_roll - by_yaw * np.sin(pitch),
            by_pitch * np.cos(roll) + by_yaw * np.sin(roll) * np.cos(pitch),
            -by_pitch * np.sin(roll) + by_yaw * np.cos(roll) * np.cos(pitch),
        ],
        axis=1,
    )


def euler_of(quaternions: FloatArray) -> FloatArray:
    """Return roll, pitch and yaw (N, 3), rad, of quaternions (N, 4), wxyz, ned from body."""
    w, x, y, z = quaternions.T
    return np.stack(
        [
            np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0)),
            np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        ],
        axis=1,
    )
