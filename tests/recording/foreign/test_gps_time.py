"""Boot clock aligned to GPS time: drift, late fixes, receivers without time, leap seconds."""

from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.recording.foreign import gps_time

EPOCH_US = 1_795_000_000_000_000


def clock(seconds: int, drift: float, late_us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Boot times of fixes and the Unix times of these fixes."""
    made_us = np.arange(seconds * 5, dtype=np.int64) * 200_000 + 5_000_000
    unix_us = EPOCH_US + np.round(made_us * (1 + drift)).astype(np.int64)
    return made_us + late_us, unix_us


@given(st.floats(-4e-4, 4e-4), st.integers(0, 2**32))
def test_gps_clock_fit_follows_drift_and_jitter(drift: float, seed: int) -> None:
    late_us = np.random.default_rng(seed).integers(0, 40_000, 5 * 600)
    boot_us, unix_us = clock(600, drift, late_us)
    found = gps_time.fit(boot_us, unix_us)
    assert found is not None
    error_us = found.unix_us(boot_us - late_us) - unix_us
    # A delay common to all fixes is unobservable: here half of the jitter.
    assert (
        np.abs(error_us + 20_000).max() < 12_000
    )  # over 3000 seeds: median 1.7 ms, maximum 9.1 ms
    assert 0.015 < found.uncertainty_s < 0.025


def test_no_clock_without_valid_gps_time() -> None:
    boot_us = np.arange(50, dtype=np.int64) * 200_000
    assert gps_time.fit(boot_us, np.zeros(50, dtype=np.int64)) is None
    assert gps_time.fit(boot_us[:0], boot_us[:0]) is None
    wild = EPOCH_US + np.random.default_rng(1).integers(0, 10**12, 50)
    assert gps_time.fit(boot_us, wild) is None


def test_clock_fit_ignores_outlier_fixes() -> None:
    boot_us, unix_us = clock(100, 0.0, np.zeros(500, dtype=np.int64))
    unix_us[::5] -= 604_800_000_000  # a week behind, before the receiver knew the week
    found = gps_time.fit(boot_us, unix_us)
    assert found is not None
    assert (found.offset_us, found.fixes, found.drift) == (EPOCH_US, 400, 0.0)


@pytest.mark.parametrize(
    ("utc", "leaps"),
    [
        (datetime(2016, 12, 31, 23, 59, 59, tzinfo=UTC), 17),
        (datetime(2017, 1, 1, tzinfo=UTC), 18),
        (datetime(2012, 6, 30, 23, 59, 59, tzinfo=UTC), 15),
        (datetime(2012, 7, 1, 0, 0, 30, tzinfo=UTC), 16),
        (datetime(2026, 11, 22, tzinfo=UTC), 18),
    ],
)
def test_gps_time_to_utc_applies_leap_seconds(utc: datetime, leaps: int) -> None:
    gps_ms = round((utc.timestamp() - 315_964_800 + leaps) * 1000)
    week, week_ms = divmod(gps_ms, 604_800_000)
    (found,) = gps_time.unix_us(np.array([week]), np.array([week_ms]))
    off_s = found * 1e-6 - utc.timestamp()
    # On the day of a leap second the previous count may apply.
    assert abs(off_s) <= (1 if utc.month in (1, 7) or utc.second == 59 else 0)


@pytest.mark.parametrize(("week", "week_ms"), [(0, 5), (-3, 5), (2000, -1), (2000, 604_800_000)])
def test_invalid_gps_weeks_yield_no_time(week: int, week_ms: int) -> None:
    assert gps_time.unix_us(np.array([week]), np.array([week_ms])).tolist() == [0]
