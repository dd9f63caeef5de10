"""A sender's stamps on the node's timeline, held against the lower envelope by brute force."""

import random
import tracemalloc
from itertools import accumulate

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.mavlink.clocks import WINDOW_NS, Reading, SenderClock

MS = 1_000_000
S = 1_000_000_000
EPOCH_NS = 1_700_000_000 * S
WRAP_MS = 1 << 32


def place_all(stamps: list[tuple[int, int]], clock: SenderClock | None = None) -> list[Reading]:
    """Readings of (arrival after the epoch in ms, boot in ms), in order."""
    clock = clock or SenderClock()
    return [clock.place(EPOCH_NS + arrival_ms * MS, boot_ms) for arrival_ms, boot_ms in stamps]


def brute_force(stamps: list[tuple[int, int]]) -> list[int]:
    """Each stamp's time: boot plus the least (arrival - boot) of the window up to it."""
    times = []
    for n, (arrival_ms, boot_ms) in enumerate(stamps):
        recent = [a - b for a, b in stamps[: n + 1] if a * MS >= arrival_ms * MS - WINDOW_NS]
        times.append(EPOCH_NS + (boot_ms + min(recent)) * MS)
    return times


def stamped(steps: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """(arrival, boot) of (gap before it, latency), all in ms."""
    arrivals = accumulate(gap for gap, _ in steps)
    return [(at, 100_000 + at - late) for at, (_, late) in zip(arrivals, steps, strict=True)]


# No latency as long as what is taken for a reboot; gaps longer than the window.
STEPS = st.tuples(st.integers(0, 9_000) | st.integers(0, 70_000), st.integers(0, 4_000))
STAMPS = st.lists(STEPS, min_size=1, max_size=60).map(stamped)


@settings(max_examples=300)
@given(STAMPS)
def test_the_lower_envelope_of_the_window(stamps: list[tuple[int, int]]) -> None:
    readings = place_all(stamps)
    assert [reading.t_ns for reading in readings] == brute_force(stamps)
    assert not any(reading.rebooted for reading in readings)
    for reading, (arrival_ms, _) in zip(readings, stamps, strict=True):
        arrival_ns = EPOCH_NS + arrival_ms * MS
        assert reading.latency_s == pytest.approx((arrival_ns - reading.t_ns) / S, abs=1e-9)


@settings(max_examples=300)
@given(
    st.lists(
        st.tuples(st.integers(0, 100_000), st.integers(0, WRAP_MS - 1)), min_size=1, max_size=40
    ),
    st.integers(0, S),
)
def test_never_later_than_the_arrival(steps: list[tuple[int, int]], delay_ns: int) -> None:
    """Whatever the sender stamps: leaps, reboots, wraps and nonsense."""
    clock = SenderClock(delay_ns)
    arrival_ns = EPOCH_NS
    for gap_ms, boot_ms in steps:
        arrival_ns += gap_ms * MS
        reading = clock.place(arrival_ns, boot_ms)
        assert reading.t_ns <= arrival_ns - delay_ns
        assert reading.latency_s >= 0.0


def test_a_time_does_not_depend_on_how_late_the_report_came() -> None:
    stamps = [(n * 100, 5_000 + n * 100) for n in range(20)]
    for late_ms in (0, 16, 627, 3_810):
        *_, reading = place_all([*stamps, (2_000 + late_ms, 7_000)])
        assert reading.t_ns == EPOCH_NS + 2_000 * MS
        assert reading.latency_s == pytest.approx(late_ms / 1000)


def test_the_best_frame_of_the_last_minute_counts() -> None:
    """The fast frame of the beginning holds for a minute, and then no longer."""
    clock = SenderClock()
    clock.place(EPOCH_NS, 1_000)
    for second in range(1, 70):
        reading = clock.place(EPOCH_NS + second * S, 700 + second * 1_000)
        held = second * S <= WINDOW_NS
        assert reading.latency_s == pytest.approx(0.3 if held else 0.0), second


# --- reboots and late frames --------------------------------------------------------------------


@pytest.mark.parametrize("back_ms", [1_200, 4_800, 9_900])
def test_a_late_frame_is_no_reboot(back_ms: int) -> None:
    stamps = [(n * 200, 300_000 + n * 200) for n in range(50)]
    readings = place_all([*stamps, (9_810, 309_800 - back_ms), (10_000, 310_000)])
    assert not any(reading.rebooted for reading in readings)
    late, after = readings[-2:]
    assert late.t_ns == EPOCH_NS + (9_800 - back_ms) * MS
    assert late.latency_s == pytest.approx(back_ms / 1000 + 0.01)
    assert after.t_ns == EPOCH_NS + 10_000 * MS


@pytest.mark.parametrize("back_ms", [48_000, 260_000])
def test_a_reboot_is_told_once_and_the_clock_begins_anew(back_ms: int) -> None:
    stamps = [(n * 200, 300_000 + n * 200) for n in range(50)]
    again = [(10_000 + n * 200, 309_800 - back_ms + n * 200) for n in range(20)]
    readings = place_all([*stamps, *again])
    assert [n for n, reading in enumerate(readings) if reading.rebooted] == [50]
    for reading, (arrival_ms, _) in zip(readings, [*stamps, *again], strict=True):
        assert reading.t_ns == EPOCH_NS + arrival_ms * MS  # nothing of the old offset is left
        assert reading.latency_s == 0.0


def test_late_frames_are_measured_from_the_newest_stamp() -> None:
    """Six steps back of 3 s from one another are one reboot, at 10 s below the newest."""
    stamps = [(0, 100_000), *((10 * n, 100_000 - 3_000 * n) for n in range(1, 7))]
    assert [n for n, r in enumerate(place_all(stamps)) if r.rebooted] == [4]


def test_a_late_frame_after_a_reboot_is_late() -> None:
    stamps = [(0, 100_000), (100, 2_000), (200, 2_100), (300, 1_500)]
    readings = place_all(stamps)
    assert [reading.rebooted for reading in readings] == [False, True, False, False]
    assert readings[-1].latency_s == pytest.approx(0.7)


# --- the wrap of 32-bit milliseconds ------------------------------------------------------------


def test_the_wrap_is_neither_a_reboot_nor_a_leap() -> None:
    start_ms = WRAP_MS - 5_000
    stamps = [(n * 100, (start_ms + n * 100) % WRAP_MS) for n in range(200)]
    readings = place_all(stamps)
    assert stamps[0][1] > stamps[-1][1]
    assert not any(reading.rebooted for reading in readings)
    assert all(reading.latency_s == 0.0 for reading in readings)


def test_a_late_frame_from_before_the_wrap() -> None:
    stamps = [(0, WRAP_MS - 1_000), (1_500, 500), (1_600, WRAP_MS - 700), (1_700, 700)]
    readings = place_all(stamps)
    assert not any(reading.rebooted for reading in readings)
    assert [reading.latency_s for reading in readings] == pytest.approx([0.0, 0.0, 1.3, 0.0])


def test_a_reboot_after_the_wrap() -> None:
    stamps = [(0, WRAP_MS - 1_000), (1_500, 500), (101_500, 100_500), (102_000, 700)]
    readings = place_all(stamps)
    assert [reading.rebooted for reading in readings] == [False, False, False, True]
    assert [reading.latency_s for reading in readings] == pytest.approx([0.0] * 4)


# --- delay, drift, memory -----------------------------------------------------------------------


def test_a_known_delay_is_taken_off_every_time() -> None:
    rng = random.Random(5)
    stamps = [(n * 100 + rng.randrange(90), 1_000 + n * 100) for n in range(100)]
    plain = place_all(stamps)
    shifted = place_all(stamps, SenderClock(250 * MS))
    for a, b in zip(plain, shifted, strict=True):
        assert b.t_ns == a.t_ns - 250 * MS
        assert b.latency_s == pytest.approx(a.latency_s + 0.25)


@pytest.mark.parametrize("drift", [100e-6, -100e-6])
def test_a_clock_that_drifts_is_followed(drift: float) -> None:
    """100 ppm for an hour are 360 ms; what is left is the drift of one window, 6 ms."""
    rng = random.Random(6)
    clock = SenderClock()
    for n in range(3_600 * 5):
        true_ns = n * S // 5
        boot_ms = round((true_ns * (1 + drift)) / MS) + 10_000
        latency_ns = rng.choice([0, 5, 40, 400]) * MS
        reading = clock.place(EPOCH_NS + true_ns + latency_ns, boot_ms)
        off_ms = (reading.t_ns - EPOCH_NS - true_ns) / MS
        if n > 50:
            assert abs(off_ms) < 7.0
    assert not reading.rebooted


def test_memory_is_that_of_one_window() -> None:
    """A slow sender is the worst case: every offset is above the one before."""
    clock = SenderClock()
    sizes = []
    tracemalloc.start()
    try:
        for n in range(1, 20 * 600 + 1):  # 20 windows at 10 Hz
            clock.place(EPOCH_NS + n * 100 * MS, n * 98)
            if n in (2 * 600, 20 * 600):
                sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert sizes[0] > 600 * 16  # it does remember the window
    assert sizes[1] < 1.2 * sizes[0]
