"""A boot clock in hindsight: late frames, bursts, a stalled clock, a restart."""

import numpy as np
import pytest

from companion.studies.truth.hindsight import BootClock, boot_clock, least

S = 1_000_000_000
EPOCH_NS = 1_700_000_000 * S


def stream(late_s: np.ndarray, stands_s: float = 0.0) -> tuple[BootClock, np.ndarray]:
    """Ten timestamps per second and their true times; the clock stalls at half of them."""
    n = len(late_s)
    made_ns = EPOCH_NS + np.arange(n, dtype=np.int64) * (S // 10)
    boot_ns = made_ns - EPOCH_NS + 5 * S
    made_ns[n // 2 :] += round(stands_s * S)
    arrival_ns = np.maximum.accumulate(made_ns + np.round(late_s * S).astype(np.int64))
    return boot_clock(arrival_ns, boot_ns), made_ns


def off_ms(found: BootClock, made_ns: np.ndarray) -> np.ndarray:
    return np.asarray((found.made_ns - made_ns) * 1e-6)


def test_stalled_clock_is_correct_before_and_after() -> None:
    late_s = np.abs(np.random.default_rng(2).normal(0.0, 0.004, 600))
    clock, made_ns = stream(late_s, stands_s=0.18)
    assert np.abs(off_ms(clock, made_ns)).max() < 5


def test_late_bursts_do_not_move_the_clock() -> None:
    """Messages are held for up to 5 s and arrive at once: the clock continues unchanged."""
    late_s = np.full(900, 0.001)
    for begin, length in ((0, 12), (100, 50), (400, 30), (890, 10)):
        late_s[begin : begin + length] += np.arange(length, 0, -1) * 0.1
    clock, made_ns = stream(late_s)
    assert off_ms(clock, made_ns) == pytest.approx(1.0, abs=1e-3)


def test_restart_begins_a_new_boot_period() -> None:
    first, made_ns = stream(np.full(300, 0.002))
    boot_ns = np.concatenate([first.boot_ns, first.boot_ns - 100])
    arrival_ns = np.concatenate([first.arrival_ns, first.arrival_ns + 60 * S])
    clock = boot_clock(arrival_ns, boot_ns)
    assert clock.life.tolist() == [0] * 300 + [1] * 300
    assert clock.made_ns[300:] == pytest.approx(made_ns + 60 * S + 2_000_000, abs=200)
    asked_ns = clock.boot_ns[[10, 10]]
    placed = clock.node_ns(asked_ns + 30_000_000, np.array([0, 1]))
    assert np.diff(placed)[0] == pytest.approx(60 * S + 100, abs=200)


def test_range_minimum_matches_direct_computation() -> None:
    rng = np.random.default_rng(1)
    values = rng.integers(-1000, 1000, 70)
    starts = rng.integers(0, 69, 200)
    stops = starts + 1 + rng.integers(0, 70 - starts)
    expected = [values[a:b].min() for a, b in zip(starts, stops, strict=True)]
    assert least(values, starts, stops).tolist() == expected
