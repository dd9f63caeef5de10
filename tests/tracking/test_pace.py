"""Silence timeout relative to a UAV's own report interval."""

import random
from collections.abc import Callable

import pytest

from companion.tracking.pace import ReportTiming
from companion.values import Fix

S = 1_000_000_000


def heard(fix: Callable[..., Fix], interval_s: float, latencies_s: list[float]) -> ReportTiming:
    pace = ReportTiming()
    for n, late_s in enumerate(latencies_s):
        pace.add(fix(round(n * interval_s * S), [n, 0, 0], late_ns=round(late_s * S)))
    return pace


@pytest.mark.parametrize(
    ("interval_s", "late_s", "silence_s"), [(0.1, 0.01, 2.0), (0.9, 0.3, 2.7), (5.0, 0.3, 15.0)]
)
def test_silence_timeout_is_three_intervals_within_limits(
    fix: Callable[..., Fix], interval_s: float, late_s: float, silence_s: float
) -> None:
    pace = heard(fix, interval_s, [late_s] * 10)
    assert pace.silence_s(2.0, 15.0) == pytest.approx(silence_s)


def test_silence_timeout_is_the_minimum_before_an_interval_is_known(
    fix: Callable[..., Fix],
) -> None:
    assert heard(fix, 1.0, [0.1, 0.1]).silence_s(2.0, 15.0) == 2.0


@pytest.mark.parametrize("seed", range(5))
def test_slow_radio_does_not_alternate_states(fix: Callable[..., Fix], seed: int) -> None:
    """1.2 reports per second, a tenth of them lost, up to some seconds late, over one hour."""
    rng, pace, changes, coasts = random.Random(seed), ReportTiming(), 0, False
    arrivals = sorted(
        (n / 1.2 + min(6.0, rng.lognormvariate(-0.5, 0.79)), n / 1.2)
        for n in range(4000)
        if rng.random() > 0.1
    )
    newest_s = 0.0
    for came_s, made_s in arrivals:
        age_s = came_s - newest_s
        coasted = age_s > pace.silence_s(2.0, 15.0)
        changes += coasted and not coasts
        coasts = coasted
        if made_s > newest_s:
            newest_s = made_s
            pace.add(fix(round(made_s * S), [made_s, 0, 0], late_ns=round((came_s - made_s) * S)))
    assert changes < 60
