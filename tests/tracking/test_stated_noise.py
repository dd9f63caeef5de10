"""Which of a receiver's stated accuracies bound a report."""

import math

from hypothesis import given
from hypothesis import strategies as st

from companion.tracking.noise import SETTLED_NS, StatedNoise
from companion.values import ReportNoise

S = 1_000_000_000
DEFAULT = ReportNoise(horizontal_m=2.5, vertical_m=5.0, position_m=5.6, velocity_mps=0.5)


def stated(horizontal_m: float) -> ReportNoise:
    vertical_m = 2 * horizontal_m
    return ReportNoise(
        horizontal_m=horizontal_m,
        vertical_m=vertical_m,
        position_m=math.hypot(horizontal_m, vertical_m),
        velocity_mps=0.1,
    )


def test_better_accuracy_counts_once_the_autopilot_may_have_followed() -> None:
    """As when a receiver finds its RTK fix in flight."""
    noise, found = StatedNoise(DEFAULT), {}
    for n in range(200):
        t_s = n / 10
        if n % 2 == 0:
            noise.add(round(t_s * S) + 1, stated(0.9 if t_s < 10.0 else 0.1))
        found[t_s] = noise.since(round(t_s * S)).horizontal_m
    settled_s = 10.0 + SETTLED_NS / S
    assert {metres for t_s, metres in found.items() if 0.5 < t_s < settled_s} == {0.9}
    assert {metres for t_s, metres in found.items() if t_s > settled_s + 0.5} == {0.1}


def test_worse_accuracy_counts_at_once() -> None:
    noise = StatedNoise(DEFAULT)
    noise.add(S, stated(0.1))
    noise.add(10 * S, stated(0.9))
    assert noise.since(10 * S + 1) == stated(0.9)


def test_first_statement_replaces_the_default() -> None:
    noise = StatedNoise(DEFAULT)
    noise.add(S, stated(0.1))
    assert noise.since(S + 1) == stated(0.1)


@given(
    accuracies_m=st.lists(st.floats(0.1, 5.0), min_size=1, max_size=80),
    step_ms=st.integers(20, 2000),
)
def test_bound_is_the_largest_of_the_last_seconds(accuracies_m: list[float], step_ms: int) -> None:
    noise, step_ns = StatedNoise(DEFAULT), step_ms * 1_000_000
    for number, metres in enumerate(accuracies_m, start=1):
        noise.add(number * step_ns, stated(metres))
        replaced_since = number * step_ns - SETTLED_NS
        recent_m = [
            one
            for place, one in enumerate(accuracies_m[:number], start=1)
            if place == number or (place + 1) * step_ns >= replaced_since
        ]
        assert noise.since(number * step_ns + 1).horizontal_m >= max(recent_m)
        if step_ms >= 200:  # fewer than are merged
            assert noise.since(number * step_ns + 1).horizontal_m == max(recent_m)
