"""Acceleration models, selected by the errors of past predictions."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.tracking.history import ReportHistory
from companion.tracking.observers.kinematic import KinematicModel, KinematicObserver
from companion.tracking.past_predictions import (
    ACCELERATION_MODELS,
    CONSTANT_VELOCITY,
    WINDOWS,
    AccelerationModel,
    PastPredictions,
    _PastPrediction,
    fading_response,
    fed_forward,
    usual_error_m,
)
from companion.values import Fix
from companion.values.newest import Newest

S = 1_000_000_000
OBSERVER = KinematicObserver(KinematicModel(60.0, 20.0))
Place = Callable[[float], tuple[list[float], list[float]]]


def circling(radius_m: float, speed_mps: float) -> Place:
    def at(t_s: float) -> tuple[list[float], list[float]]:
        a = speed_mps / radius_m * t_s
        place = [radius_m * math.sin(a), -radius_m * math.cos(a), 0.0]
        return place, [speed_mps * math.cos(a), speed_mps * math.sin(a), 0.0]

    return at


def flown(
    fix: Callable[..., Fix],
    place: Place,
    interval_s: float,
    *,
    seconds: float,
    noise_mps: float = 0.0,
    noise_m: float = 0.0,
) -> PastPredictions:
    rng, history, hindsight = np.random.default_rng(1), None, PastPredictions()
    for n in range(int(seconds / interval_s)):
        t_s = n * interval_s
        position, velocity = (np.array(one) for one in place(t_s))
        made = fix(
            round(t_s * S),
            position + rng.normal(0, noise_m, 3),
            velocity + rng.normal(0, noise_mps, 3),
        )
        if history is None:
            history = ReportHistory(OBSERVER, made, 5 * S)
        else:
            history.insert(len(history.entries), made)
        hindsight.smooth(made)
        if hindsight.is_due(made.sender_ns):
            slopes = dict(zip([w[0] for w in WINDOWS], history.accelerations(WINDOWS), strict=True))
            hindsight.add(made, tuple(slopes.get(way.window_s) for way in ACCELERATION_MODELS))
    return hindsight


def test_noisy_straight_flight_selects_constant_velocity(fix: Callable[..., Fix]) -> None:
    straight: Place = lambda t_s: ([10 * t_s, 0, 0], [10, 0, 0])  # noqa: E731
    assert (
        flown(fix, straight, 0.9, seconds=120, noise_mps=0.5, noise_m=1.0).model
        is CONSTANT_VELOCITY
    )


def test_tight_turn_selects_a_short_window(fix: Callable[..., Fix]) -> None:
    """An aeroplane's: over five seconds the acceleration rotates by one radian."""
    way = flown(fix, circling(110.0, 22.0), 0.1, seconds=60, noise_mps=0.05, noise_m=0.05).model
    assert 0 < way.window_s <= 2.5


def test_slow_noisy_turn_selects_an_acceleration_model(fix: Callable[..., Fix]) -> None:
    assert (
        flown(fix, circling(60.0, 5.0), 0.1, seconds=60, noise_mps=0.05, noise_m=0.02).model
        is not CONSTANT_VELOCITY
    )


def test_model_is_constant_velocity_before_any_evaluation(fix: Callable[..., Fix]) -> None:
    assert flown(fix, circling(110.0, 22.0), 0.1, seconds=1.0).model is CONSTANT_VELOCITY
    assert usual_error_m(PastPredictions().usual_errors, 1.0) is None


def test_error_p95_covers_19_of_20_errors(fix: Callable[..., Fix]) -> None:
    """Over noisy reports at the evaluated ages: 19 of 20 errors, and not many more."""
    place = circling(60.0, 8.0)
    hindsight = flown(fix, place, 0.2, seconds=120, noise_mps=0.2, noise_m=0.5)
    rng, covered, count = np.random.default_rng(2), 0, 2000
    usual_m = usual_error_m(hindsight.usual_errors, 1.0)
    assert usual_m is not None
    for _ in range(count):
        t_s = rng.uniform(0, 100)
        position, velocity = (np.array(one) for one in place(t_s))
        later, _ = place(t_s + 1.0)
        noise_m = (
            0.5 if hindsight.smoothing_offset == (0.0, 0.0, 0.0) else 0.5 * math.sqrt(0.35 / 1.65)
        )
        told = position + rng.normal(0, noise_m, 3) + (velocity + rng.normal(0, 0.2, 3))
        acceleration = np.array([-velocity[1], velocity[0], 0]) * 8.0 / 60.0
        told = told + acceleration * (0.0 if hindsight.model is CONSTANT_VELOCITY else 0.48)
        seen = np.array(later) + rng.normal(0, 0.5, 3)
        covered += float(np.linalg.norm(told - seen)) <= usual_m
    assert 0.9 <= covered / count <= 0.99
    ages = [usual_error_m(hindsight.usual_errors, age) for age in (0.0, 0.25, 1.0, 3.0, 10.0)]
    assert ages == sorted(ages)  # type: ignore[type-var]


@settings(max_examples=examples(200), deadline=None)
@given(
    st.floats(1.1, 40.0), st.floats(-3.2, 3.2), st.floats(-16.0, 16.0), st.floats(-16.0, 16.0),
    st.floats(0.0, 10.0),
)  # fmt: skip
def test_coordinated_turn_rotates_the_velocity(
    speed_mps: float, heading: float, across_mps2: float, along_mps2: float, ahead_s: float
) -> None:
    """Against small integration steps; at most as far from straight flight as the lateral
    acceleration allows."""
    way = AccelerationModel(window_s=1.0, min_velocities=3, decay_s=3.0, turns=True)
    direction = np.array([math.cos(heading), math.sin(heading)])
    aside = np.array([-direction[1], direction[0]])
    given = along_mps2 * direction + across_mps2 * aside
    velocity = speed_mps * direction
    (north, east, down), gained = fed_forward(
        way, (*given.tolist(), 1.0), (*velocity.tolist(), 0.0), ahead_s
    )
    turned = max(min(across_mps2 / speed_mps * ahead_s, math.pi), -math.pi)
    angles = heading + turned * (np.arange(2000) + 0.5) / 2000
    headings = np.array([np.cos(angles), np.sin(angles)])
    expected = speed_mps * ahead_s * (headings.mean(axis=1) - direction)
    assert np.allclose([north, east], expected, atol=1e-4 * (1 + speed_mps * ahead_s))
    last = speed_mps * np.array([math.cos(heading + turned), math.sin(heading + turned)])
    assert np.allclose(velocity + gained[:2], last, atol=1e-6)
    assert math.hypot(north, east) <= abs(across_mps2) * ahead_s**2 / 2 + 1e-6
    assert (down, gained[2]) == fading_response(ahead_s, 3.0)


def test_stationary_uav_uses_decaying_acceleration() -> None:
    turning, straight = (
        AccelerationModel(window_s=1.0, min_velocities=3, decay_s=3.0, turns=True),
        AccelerationModel(window_s=1.0, min_velocities=3, decay_s=3.0),
    )
    stands = (0.5, -0.5, 1.0)
    for ahead_s in (0.1, 2.0):
        found = (fed_forward(way, (1.0, 2.0, -1.0), stands, ahead_s) for way in (turning, straight))
        assert next(found) == next(found)


def test_steady_circle_selects_the_turn_model(fix: Callable[..., Fix]) -> None:
    assert flown(
        fix, circling(60.0, 12.0), 0.8, seconds=60, noise_mps=0.05, noise_m=0.05
    ).model.turns


def test_noisy_positions_are_smoothed(fix: Callable[..., Fix]) -> None:
    """Half of the noise is removed, also in a turn; a good receiver is hardly smoothed."""
    straight: Place = lambda t_s: ([10 * t_s, 0, 0], [10, 0, 0])  # noqa: E731
    for place in (straight, circling(60.0, 8.0)):
        rng, history, hindsight, off = np.random.default_rng(3), None, PastPredictions(), []
        for n in range(200):
            t_s = 0.8 * n
            position, velocity = (np.array(one) for one in place(t_s))
            made = fix(round(t_s * S), position + rng.normal(0, 3.0, 3), velocity)
            history = history or ReportHistory(OBSERVER, made, 5 * S)
            hindsight.smooth(made)
            hindsight.add(made, (None,) * len(ACCELERATION_MODELS))
            off.append(
                [np.array(made.position_ned_m) - position,
                 np.array(made.position_ned_m) + hindsight.smoothing_offset - position]
            )  # fmt: skip
        reported, taken = (np.array(off)[100:, which] for which in (0, 1))
        assert np.sqrt((taken**2).mean()) < 0.65 * np.sqrt((reported**2).mean())
    assert math.hypot(*flown(fix, circling(60.0, 8.0), 0.8, seconds=60).smoothing_offset) < 0.05


def test_gap_disables_smoothing(fix: Callable[..., Fix]) -> None:
    hindsight = PastPredictions()
    for n in range(60):
        made = fix(round(n * 6.0 * S), np.array([5.0 * (-1) ** n, 0, 0]), np.zeros(3))
        hindsight.smooth(made)
        hindsight.add(made, (None,) * len(ACCELERATION_MODELS))
        assert hindsight.smoothing_offset == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("decay_s", [3.0, 10.0])
def test_decaying_acceleration_matches_its_integral(decay_s: float) -> None:
    """Against the integral, for velocity and position."""
    times = np.linspace(0, 2.0, 20001)
    speeds = np.concatenate([[0], np.cumsum(np.exp(-(times[:-1] + 5e-5) / decay_s) * 1e-4)])
    way, gain = fading_response(2.0, decay_s)
    assert gain == pytest.approx(speeds[-1], rel=1e-6)
    assert way == pytest.approx(float(np.trapezoid(speeds, times)), rel=1e-6)


VECTORS = st.tuples(*[st.floats(-20.0, 20.0)] * 3)


@given(st.lists(st.none() | VECTORS, min_size=7, max_size=7), VECTORS, VECTORS, st.floats(0.1, 5.0))
def test_errors_of_all_models_at_once_are_those_of_each(
    accelerations: list[tuple[float, float, float] | None],
    velocity: tuple[float, float, float],
    offset: tuple[float, float, float],
    ahead_s: float,
) -> None:
    made = _PastPrediction(
        sender_ns=0,
        position=(1.0, 2.0, 3.0),
        velocity=velocity,
        accelerations=(None, *accelerations),  # the first model has none
        smoothing_offset=offset,
    )
    there = (30.0, -20.0, 10.0)
    squares_m2 = made.square_errors_m2(there, ahead_s)
    each_m = [made.error_m(model, there, ahead_s) for model in range(2 * len(ACCELERATION_MODELS))]
    assert [math.sqrt(one) for one in squares_m2] == pytest.approx(each_m)


def test_newest_values_are_kept_up_to_the_limit() -> None:
    kept = Newest[int](3)
    for value in range(5):
        kept.append(value)
    assert kept == [2, 3, 4]
