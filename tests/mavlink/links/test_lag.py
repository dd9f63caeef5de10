"""The machine's arrival lag: its statistics and the behind state."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.mavlink.links.lag import KEPT_NS, LIMIT_NS, SLOT_NS, ArrivalLag

MS = 1_000_000
S = 1000 * MS
BEGIN = 1_800_000_000 * S


def fed(*lags: tuple[float, float]) -> tuple[ArrivalLag, int]:
    """Feed lags in seconds at given seconds; return the lag and the last time."""
    lag = ArrivalLag()
    for at_s, lag_s in lags:
        lag.observe(BEGIN + round(at_s * S), round(lag_s * S))
    return lag, BEGIN + round(lags[-1][0] * S)


def steady(lag_s: float, from_s: float, to_s: float) -> list[tuple[float, float]]:
    """One datagram every 50 ms."""
    return [(from_s + n * 0.05, lag_s) for n in range(round((to_s - from_s) / 0.05))]


def test_lag_is_unknown_without_recent_stamps() -> None:
    assert ArrivalLag().seen(BEGIN) == ArrivalLag().seen(0)
    lag, now_ns = fed((0.0, 0.2))
    assert lag.seen(now_ns).newest_s == pytest.approx(0.2)
    seen = lag.seen(now_ns + KEPT_NS)
    assert (seen.newest_s, seen.p95_s, seen.max_s, seen.behind) == (None, None, None, False)


def test_lag_reports_newest_and_maximum_of_ten_seconds() -> None:
    lag, now_ns = fed((0, 0.9), *steady(0.01, 1, 9.95), (9.96, 0.4), (9.97, 0.02))
    seen = lag.seen(now_ns)
    assert seen.newest_s == pytest.approx(0.02)
    assert seen.max_s == pytest.approx(0.9)
    assert seen.p95_s == pytest.approx(0.01)
    assert lag.seen(now_ns + S).max_s == pytest.approx(0.4)


@given(st.lists(st.tuples(st.integers(0, 300 * MS), st.integers(0, 3 * S)), min_size=1))
def test_lag_maximum_and_p95_are_over_tenths_of_a_second(steps: list[tuple[int, int]]) -> None:
    lag, now_ns, slots = ArrivalLag(), BEGIN, []
    for step_ns, lag_ns in steps:
        now_ns += step_ns
        lag.observe(now_ns, lag_ns)
        if not slots or now_ns - slots[-1][0] >= SLOT_NS:
            slots.append((now_ns, []))
        slots[-1][1].append(lag_ns)
    worst = sorted(max(lags) for at, lags in slots if at > now_ns - KEPT_NS)
    seen = lag.seen(now_ns)
    assert seen.max_s == pytest.approx(worst[-1] / S)
    above = sum(one / S > (seen.p95_s or 0) + 1e-9 for one in worst)
    assert above <= 0.05 * len(worst)
    assert seen.newest_s == pytest.approx(steps[-1][1] / S)


def test_one_wait_above_the_limit_counts_as_behind_for_two_seconds() -> None:
    lag, now_ns = fed(*steady(0.01, 0, 2), (2.0, 0.6), *steady(0.01, 2.1, 3.9))
    assert lag.seen(now_ns).behind
    assert lag.seen(now_ns).longest_s == pytest.approx(0.6)
    lag, now_ns = fed(*steady(0.01, 0, 2), (2.0, 0.6), *steady(0.01, 2.1, 4.2))
    assert not lag.seen(now_ns).behind
    lag, now_ns = fed(*steady(0.01, 0, 2), (2.0, LIMIT_NS / S))
    assert not lag.seen(now_ns).behind


@pytest.mark.parametrize(
    ("apart_s", "behind"), [(0.3, False), (0.5, True), (1.5, True), (2.1, False)]
)
def test_repeated_wait_counts_as_behind(apart_s: float, behind: bool) -> None:
    """After each pause the queue empties: its last datagram is not late at all."""
    late = [(2.0, 0.3), (2.01, 0.0), (2.0 + apart_s, 0.3), (2.01 + apart_s, 0.0)]
    lag, now_ns = fed(*steady(0.01, 0, 2), *late)
    assert lag.seen(now_ns).behind is behind


def test_silence_clears_the_behind_state() -> None:
    lag, now_ns = fed(*steady(0.6, 0, 3))
    assert lag.seen(now_ns + S).behind
    assert not lag.seen(now_ns + 3 * S).behind


def test_event_loop_that_is_held_up_counts_without_any_datagram() -> None:
    lag = ArrivalLag()
    lag.held_up(BEGIN, 600 * MS)
    seen = lag.seen(BEGIN + S)
    assert (seen.behind, seen.newest_s, seen.max_s) == (True, None, None)
    assert seen.longest_s == pytest.approx(0.6)
    assert not lag.seen(BEGIN + 3 * S).behind


def test_datagrams_wait_as_long_as_the_newest_one_for_a_tenth_of_a_second() -> None:
    lag, now_ns = fed((0.0, 0.4), (0.1, 0.3))
    assert lag.waiting_ns(now_ns) == 300 * MS
    assert lag.waiting_ns(now_ns + SLOT_NS) == 300 * MS
    assert lag.waiting_ns(now_ns + SLOT_NS + 1) == 0
