"""Reachable sets at uncertain times, against simulated motions and an exact search."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.tracking.reach import reach
from companion.values import Fix, FloatArray, Limits, ReportNoise, SenderTime

S = 1_000_000_000
NOISE = ReportNoise(horizontal_m=1.2, vertical_m=0.9, position_m=1.5, velocity_mps=0.4)
LIMITS = Limits(60.0, 5.0)
VECTOR = st.tuples(*[st.floats(-1, 1)] * 3)


def unit(vector: tuple[float, ...]) -> FloatArray:
    size = math.sqrt(sum(x * x for x in vector))
    return np.array(vector) / size if size > 1e-3 else np.array([1.0, 0.0, 0.0])


@settings(max_examples=examples(500))
@given(
    way=VECTOR,
    speed=st.floats(0, 25),
    age_s=st.floats(0, 3),
    before_s=st.floats(0, 1),
    after_s=st.floats(0, 1),
    when=st.floats(0, 1),
    wrong=VECTOR,
    fast=VECTOR,
    push=VECTOR,
    aside=VECTOR,
    off_m=st.floats(0, 4),
)
def test_reachable_set_contains_every_motion(
    *,
    fix: Callable[..., Fix],
    way: tuple[float, ...],
    speed: float,
    age_s: float,
    before_s: float,
    after_s: float,
    when: float,
    wrong: tuple[float, ...],
    fast: tuple[float, ...],
    push: tuple[float, ...],
    aside: tuple[float, ...],
    off_m: float,
) -> None:
    """Full noise and acceleration, any time between the ends, any predicted position."""
    velocity = speed * unit(way)
    made = fix(0, [0, 0, 0], velocity, noise=NOISE)
    at_s = age_s - before_s + when * (before_s + after_s)
    error = unit(wrong) * 1.5
    error[:2] *= min(1.0, 1.2 / max(1e-9, math.hypot(error[0], error[1])))
    error[2] = max(-0.9, min(0.9, error[2]))
    truth = error + (velocity + 0.4 * unit(fast)) * at_s + 5.0 * unit(push) * at_s**2 / 2
    predicted = velocity * age_s + off_m * unit(aside)
    found = reach(
        made,
        LIMITS,
        predicted,
        SenderTime(node_ns=0, sender_ns=round(age_s * S), before_s=before_s, after_s=after_s),
    )
    off = predicted - truth
    assert float(np.linalg.norm(off)) <= found.bound_m + 1e-6
    assert math.hypot(off[0], off[1]) <= found.horizontal_m + 1e-6
    assert abs(off[2]) <= found.vertical_m + 1e-6
    assert float(np.linalg.norm(truth - found.center_ned_m)) <= found.radius_m + 1e-6


@pytest.mark.parametrize(("age_s", "before_s", "after_s"), [(0.2, 0.0, 0.0), (1.2, 0.1, 0.5)])
def test_reachable_bound_and_ball_are_minimal(
    fix: Callable[..., Fix], age_s: float, before_s: float, after_s: float
) -> None:
    """Against the farthest possible position and the smallest ball around all of them."""
    noise = NOISE._replace(horizontal_m=1.5, vertical_m=1.5)
    velocity = np.array([8.0, 3.0, 0.0])
    made = fix(0, [0, 0, 0], velocity, noise=noise)
    at = SenderTime(node_ns=0, sender_ns=round(age_s * S), before_s=before_s, after_s=after_s)
    predicted = velocity * age_s + np.array([0.0, 0.4, 0.0])
    found = reach(made, LIMITS, predicted, at)
    times = np.linspace(age_s - before_s, age_s + after_s, 201)
    centres = times[:, None] * velocity
    radii = 1.5 + np.abs(times) * 0.4 + 2.5 * times**2
    exact_m = float(np.max(np.linalg.norm(predicted - centres, axis=1) + radii))
    assert found.bound_m == pytest.approx(exact_m, rel=1e-9)
    grid = np.linspace(times[0] - 1, times[-1] + 1, 4001)[:, None] * velocity
    balls = np.max(np.linalg.norm(grid[:, None] - centres, axis=2) + radii, axis=1)
    assert found.radius_m == pytest.approx(float(balls.min()), rel=1e-3)


def test_speed_limit_bounds_a_long_gap(fix: Callable[..., Fix]) -> None:
    made = fix(0, [0, 0, 0], [10, 0, 0], noise=NOISE)
    found = reach(
        made,
        LIMITS,
        np.zeros(3),
        SenderTime(node_ns=0, sender_ns=60 * S, before_s=0.0, after_s=0.0),
    )
    assert found.radius_m == pytest.approx(1.5 + 60 * 60)
    assert found.center_ned_m == (0, 0, 0)
