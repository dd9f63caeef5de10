"""The interval of a sender's clock offset under adversarial links and clocks.

Every case gives the behaviour of clock and link. The truth must always lie in the interval,
within the declared limits: a drift of 250 ppm, and a least latency no longer than the median of
its visible part (or 25 ms).
"""

import math
import random
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples, rounds

from companion.mavlink.clock.estimates import ClockChange, ClockEstimate
from companion.mavlink.clock.floor import RECENT, Floor
from companion.mavlink.clock.lateness import FOLLOWED, FOLLOWED_NS
from companion.mavlink.clock.sender_clock import SenderClock

MS = 1_000_000
S = 1_000_000_000
EPOCH_NS = 1_700_000_000 * S
BOOT_S = 7_000.0
Latency = Callable[[float, random.Random], float]
"""Latency in seconds of a frame sent a time after the epoch."""


def answers(
    latency: Latency,
    *,
    seconds: float = 60.0,
    rate_hz: float = 20.0,
    moved: Callable[[float], float] = lambda _t: 0.0,
    trips_s: float | None = None,
    seed: int = 0,
) -> list[tuple[float, float, ClockEstimate, ClockChange | None]]:
    """Return time, estimate error (s), estimate, and reported change.

    ``moved`` is the lag that the sender's clock has accumulated; ``trips_s`` the time between
    round trips, whose ways both have the link's latency.
    """
    rng = random.Random(seed)
    made: list[tuple[float, float, float | None]] = []
    for n in range(int(seconds * rate_hz)):
        made.append((n / rate_hz + latency(n / rate_hz, rng), n / rate_hz, None))
    for n in range(1, int(seconds / trips_s) if trips_s else 0):
        assert trips_s is not None
        there = n * trips_s + latency(n * trips_s, rng)
        made.append((there + latency(there, rng), n * trips_s, there))
    clock, found = SenderClock(), []

    def boot_s(t: float) -> float:
        return BOOT_S + t - moved(t)

    for arrived, sent, answered in sorted(made, key=lambda one: one[0]):
        arrival_ns = EPOCH_NS + round(arrived * S)
        if answered is None:
            clock.observe(arrival_ns, math.floor(boot_s(sent) * 1e3))
        else:
            clock.timesync(EPOCH_NS + round(sent * S), arrival_ns, round(boot_s(answered) * S))
        change = clock.change
        for later in (0.0, 0.03):
            estimate = clock.estimate(arrival_ns + round(later * S))
            assert estimate is not None
            truth = EPOCH_NS / S - BOOT_S + moved(arrived + later)
            found.append((arrived + later, truth - estimate.offset_ns / S, estimate, change))
            change = None
    return found


def outside_s(off: float, estimate: ClockEstimate) -> float:
    return max(off - estimate.before_s, -off - estimate.after_s)


def jitter(least: float, most: float) -> Latency:
    return lambda _t, rng: rng.uniform(least, most)


LINKS: dict[str, Latency] = {
    "ramp of .02 to 1 s over 20 s": lambda t, _: 0.02 + 0.98 * min(1.0, max(0.0, t - 2) / 20),
    "ramp and back": lambda t, _: 0.02 + 0.9 * max(0.0, 1 - abs(t - 25) / 15),
    "step from .02 to .5 s": lambda t, _: 0.02 if t < 5 else 0.5,
    "first frame fast, others at .3 s": lambda t, _: 0.02 if t == 0 else 0.3,
    "sawtooth of 0 to .8 s": lambda t, _: 0.8 * (t / 5 % 1),
    "first sixteen slow": lambda t, rng: (0.5 if t < 0.8 else 0.02) + rng.uniform(0, 0.01),
    "fast, then slow within a piece": lambda t, rng: (
        rng.uniform(0.01, 0.015) if t % 3.75 < 0.8 else rng.uniform(0.3, 0.31)
    ),
    "the last fast frame long ago": lambda t, rng: 0.01 if t < 1 else rng.uniform(0.5, 0.505),
    "bursts": lambda t, _: 0.01 + (3.0 - t % 3.0 if t % 12 > 9 else 0.0),
    "lognormal radio": lambda _t, rng: rng.lognormvariate(math.log(0.6), 0.79),
}


@pytest.mark.parametrize("name", LINKS)
@pytest.mark.parametrize("rate_hz", [1.2, 8.0, 20.0])
def test_offset_interval_holds_on_every_link(name: str, rate_hz: float) -> None:
    for seed in range(rounds(1, 4)):
        for at, off, estimate, _ in answers(LINKS[name], rate_hz=rate_hz, seconds=90, seed=seed):
            assert outside_s(off, estimate) <= 0, f"{name} at {at:.2f} s"


def test_uncertainty_has_no_step_when_fast_frames_leave_the_window() -> None:
    found = answers(LINKS["the last fast frame long ago"], seconds=200)
    doubts = [one.uncertainty_s for at, _, one, _ in found if at > 30]  # late frames are followed
    assert min(doubts) > 0.45
    assert max(abs(b - a) for a, b in pairwise(doubts)) < 0.05


@settings(max_examples=rounds(15, 150))
@given(
    st.lists(st.tuples(st.floats(0.3, 15), st.floats(0, 1.5), st.floats(0, 0.3)), min_size=1,
             max_size=12),
    st.floats(-250e-6, 250e-6),
    st.sampled_from([1.2, 5.0, 20.0]),
    st.integers(0, 10_000),
)  # fmt: skip
def test_offset_interval_holds_under_changing_latency(
    spells: list[tuple[float, float, float]], drift: float, rate_hz: float, seed: int
) -> None:
    """Periods of varying latency and jitter, in any order, on any clock within its drift.

    Every tenth frame is fast, so that the assumption on the least latency holds.
    """
    ends = np.cumsum([length for length, _, _ in spells])

    def latency(t: float, rng: random.Random) -> float:
        _, base, spread = spells[min(int(np.searchsorted(ends, t)), len(spells) - 1)]
        return 0.02 if round(t * rate_hz) % 10 == 0 else 0.02 + base + rng.uniform(0, spread)

    seconds = min(90.0, float(ends[-1]) + 3)
    found = answers(latency, rate_hz=rate_hz, seconds=seconds, moved=lambda t: drift * t, seed=seed)
    for at, off, estimate, _ in found:
        assert outside_s(off, estimate) <= 0, at


@pytest.mark.parametrize(
    "batch", [4, 7, *(pytest.param(n, marks=pytest.mark.full) for n in (8, 13)), 16]
)
def test_offset_interval_holds_on_a_batching_link(batch: int) -> None:
    """The median of the visible latency is half a batch; every n-th frame may have none of it."""
    for phase in range(0, batch, rounds(1 + batch // 5, 1)):

        def latency(t: float, _rng: random.Random, phase: int = phase) -> float:
            return 0.0125 * batch + 0.05 * ((round(t * 20) + phase) % batch)

        found = answers(latency, seconds=75)
        assert max(outside_s(off, one) for at, off, one, _ in found if at > 2) <= 0


# --- clocks -------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [10.0, 50.0])
@pytest.mark.parametrize("stood_s", [0.13, 0.18, 1.5])
def test_stalled_clock_is_reported_within_a_second(rate_hz: float, stood_s: float) -> None:
    """Three frames reveal it; the interval keeps the old offset too, as the link may be the
    cause.
    """
    found = answers(
        jitter(0.003, 0.007),
        seconds=30 + 20 * stood_s,
        rate_hz=rate_hz,
        moved=lambda t: min(stood_s, max(0.0, t - 20)),
    )
    told = [at for at, _, _, change in found if change is not None]
    assert len(told) >= 1
    assert 20 < told[0] < 21.6 + stood_s
    for at, off, estimate, _ in found:
        if not 20 <= at <= 20 + stood_s + 3 / rate_hz + 0.04:
            assert outside_s(off, estimate) <= 0, at
    followed_s = 22 + stood_s + 1.5 * min(FOLLOWED * stood_s, FOLLOWED_NS / S)
    assert all(abs(off) < 0.02 for at, off, _, _ in found if at > followed_s)


@pytest.mark.parametrize("slower_s", [0.1, 0.3, 1.0])
def test_temporarily_slow_link_does_not_move_the_estimate(slower_s: float) -> None:
    """It is reported as a possible change, and the most likely offset stays."""
    lasts_s = 0.6 * min(FOLLOWED * slower_s, FOLLOWED_NS / S)

    def latency(t: float, rng: random.Random) -> float:
        return rng.uniform(0.003, 0.007) + slower_s * (20 < t % 40 < 20 + lasts_s)

    found = answers(latency, seconds=90)
    assert 1 <= sum(change is not None for *_, change in found) <= 2
    assert all(abs(off) < 0.02 for at, off, *_ in found if at > 1)


def test_estimate_returns_after_a_fast_period() -> None:
    """Frames placed before their possible arrival are rare exceptions."""

    def latency(t: float, rng: random.Random) -> float:
        return rng.uniform(0.303, 0.307) - 0.25 * (round(20 * t) in (500, 501, 900))

    found = answers(latency)
    for at, off, *_ in found:
        exception = any(0 <= at - quick_s < 2.2 for quick_s in (25.0, 45.0))
        assert at < 2 or exception or abs(off + 0.3) < 0.03, at


def test_steady_link_reports_no_change() -> None:
    for name, rate_hz in (("lognormal radio", 1.2), ("lognormal radio", 8.0)):
        for seed in range(rounds(2, 5)):
            found = answers(LINKS[name], rate_hz=rate_hz, seconds=300, seed=seed)
            assert sum(change is not None for *_, change in found) <= 1
    for seed in range(rounds(2, 5)):
        found = answers(lambda _t, rng: rng.lognormvariate(math.log(0.016), 0.5), seed=seed)
        assert not any(change for *_, change in found)


# --- round trips --------------------------------------------------------------------------------


def slow(t: float) -> float:
    """5000 ppm slow for 5 s, twice, and equally fast in between."""
    return 0.005 * (min(5.0, max(0.0, t - 30)) - min(5.0, max(0.0, t - 50)))


@pytest.mark.parametrize("trips_s", [1.0, 5.0])
def test_round_trips_follow_a_temporarily_slow_clock(trips_s: float) -> None:
    for seed in range(rounds(2, 5)):

        def busy(_t: float, rng: random.Random) -> float:
            late = rng.expovariate(1 / 0.02) if rng.random() < 0.3 else 0.0
            return rng.uniform(0.002, 0.008) + late

        found = answers(busy, seconds=90, rate_hz=50, moved=slow, trips_s=trips_s, seed=seed)
        late = [(off, one) for at, off, one, _ in found if at > 2 * trips_s]
        assert np.percentile([one.uncertainty_s for _, one in late], 99) < 0.05
        # Between two round trips the clock may drift beyond the known interval.
        assert max(outside_s(off, one) for off, one in late) <= 0.01


def test_slow_round_trips_do_not_override_good_stamps() -> None:
    found = answers(jitter(0.002, 0.008), trips_s=5.0, seconds=40)
    poor = answers(
        lambda t, rng: rng.uniform(0.002, 0.008) if t * 20 % 1 < 1e-6 else 4.0, trips_s=4.9921
    )
    assert found[-1][2].uncertainty_s < 0.02
    assert poor[-1][2].uncertainty_s < 0.05


# --- floor --------------------------------------------------------------------------------------


@settings(max_examples=examples(200))
@given(
    st.lists(st.tuples(st.integers(1, 3 * S), st.integers(0, 2 * S)), min_size=1, max_size=120),
    st.floats(-250e-6, 250e-6),
)
def test_upper_bound_lies_between_offset_and_every_stamp(
    steps: list[tuple[int, int]], drift: float
) -> None:
    """For any latency the truth is below the bound, and no aged stamp is.

    The largest latency of a minute is known but for the part that no stamp shows.
    """
    floor, x_ns = Floor(60 * S, 250e-6), 10 * S
    latencies: list[tuple[int, int]] = []
    for step_ns, latency_ns in steps:
        x_ns += step_ns
        latencies.append((x_ns, latency_ns))
        offset_ns = 5 * S + drift * x_ns
        floor.add(x_ns, round(offset_ns + latency_ns))
        seen = floor.heights(x_ns)
        assert seen.upper_bound >= offset_ns - 2
        assert seen.upper_bound <= offset_ns + latency_ns + 2
        assert seen.highest >= seen.upper_bound
        assert floor.at(x_ns) <= offset_ns + latency_ns + 2
        largest_ns = max(one for at_ns, one in latencies if at_ns > x_ns - 56 * S)
        assert floor.largest_ns >= largest_ns - (seen.upper_bound - offset_ns) - 5


@pytest.mark.parametrize("by_ns", [0, S // 2, 3 * S])
def test_largest_latency_outlasts_a_step_of_the_clock(by_ns: int) -> None:
    floor = Floor(60 * S, 250e-6)
    for n in range(100):
        floor.add(n * S // 10, 5 * S + (S if n == 50 else 0))
    floor.restart_at(5 * S + by_ns, 10 * S)
    floor.add(10 * S, 5 * S + by_ns)
    assert floor.largest_ns == pytest.approx(S, abs=3 * MS)


def test_memory_is_bounded() -> None:
    floor, rng = Floor(60 * S, 250e-6), random.Random(1)
    for n in range(20_000):
        floor.add(n * 20 * MS, rng.randrange(100 * MS))
    assert len(floor._visible._samples) <= 257
    assert len(floor._visible._pieces) <= 16
    assert len(floor._recent) == RECENT


@pytest.mark.parametrize(("late_s", "is_jump"), [(4.0, False), (6.0, True), (9.0, True)])
def test_delay_that_no_frame_can_have_is_reported_as_a_jump(late_s: float, is_jump: bool) -> None:
    """From then on the bound does not cover that the link became slower."""
    clock, jumps = SenderClock(), []
    for n in range(600):
        t_s = n / 10
        clock.observe(round((t_s + (late_s if t_s > 20 else 0.02)) * S), 5000 + n * 100)
        if clock.change is not None and clock.change.leapt:
            jumps.append((t_s, clock.change.step_s))
    assert len(jumps) == is_jump
    for t_s, step_s in jumps:
        assert 30.0 < t_s + late_s < 55.0
        assert step_s == pytest.approx(late_s, abs=0.1)


@pytest.mark.parametrize("rate", [0.0, -0.5])
def test_clock_of_a_log_whose_arrivals_stand_still_can_be_read(rate: float) -> None:
    """Or run backwards: no line of arrivals over stamps has that slope."""
    clock = SenderClock()
    for n in range(900):
        clock.observe(EPOCH_NS + round(rate * n * S / 10), 100_000 + 100 * n)
    assert clock.sender_ns(EPOCH_NS + S) > 0
    reading = clock.reading()
    assert reading is not None and reading.drift == 0.0
    assert reading.time(EPOCH_NS + S)[1] > 0.0
