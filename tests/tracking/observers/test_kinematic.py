"""The kinematic observer against adversaries: flights that use the full bounds."""

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support import examples, rounds

from companion.settings.files import kinematic_design
from companion.settings.model import Settings
from companion.tracking.observers.estimates import Prediction
from companion.tracking.observers.kinematic import (
    GainSchedule,
    KinematicModel,
    KinematicObserver,
    KinematicState,
    deadbeat,
    scheduled,
)
from companion.values import Fix, FloatArray, ReportNoise

MakeFix = Callable[..., Fix]
S = 1_000_000_000
SPEED_MPS, ACCELERATION_MPS2 = 30.0, 8.0
NOISE = ReportNoise(
    horizontal_m=1.5, vertical_m=2.5, position_m=math.hypot(1.5, 2.5), velocity_mps=0.4
)
ROUNDING = 1e-6
GAINS: dict[str, GainSchedule] = {
    "deadbeat": deadbeat,
    "blend": lambda t: (0.8, 0.6 * t, 0.0, 0.7),
    "fading": lambda t: (1 - math.exp(-abs(t)), t * 0.5, 0.0, 1 - math.exp(-2 * abs(t))),
    "of both": lambda t: (0.6 + 0.1 * t, 0.4 * t, 0.15, 0.8),
    "beyond": lambda t: (1.3, 1.5 * t, -0.1, 1.2),
    "none": lambda _: (0.0, 0.0, 0.0, 0.0),
    "table": scheduled(kinematic_design(Settings())),
}


def observing(name: str = "deadbeat", **changed: float) -> KinematicObserver:
    limits = {"speed_max_mps": SPEED_MPS, "acceleration_max_mps2": ACCELERATION_MPS2} | changed
    return KinematicObserver(KinematicModel(**limits, gain=GAINS[name]))


def advance(state: KinematicState | None, fix: Fix, observer: KinematicObserver) -> KinematicState:
    if state is None:
        return observer.begin(fix)
    return observer.after(state, observer.predict(state, fix.sender_ns), fix)


def unit(rng: np.random.Generator, size: int = 3) -> FloatArray:
    vector: FloatArray = rng.standard_normal(size)
    return vector / np.sqrt(vector @ vector)


@dataclass
class Flight:
    """Piecewise constant accelerations; always below the speed limit."""

    starts_ns: list[int]
    motions: list[tuple[FloatArray, FloatArray, FloatArray]]

    def at(self, t_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return position and velocity."""
        number = bisect_right(self.starts_ns, t_ns) - 1
        position, velocity, acceleration = self.motions[number]
        t_s = (t_ns - self.starts_ns[number]) * 1e-9
        return (
            position + velocity * t_s + acceleration * t_s**2 / 2,
            velocity + acceleration * t_s,
        )


def flown(rng: np.random.Generator, kind: str, start_ns: int, end_ns: int) -> Flight:
    """Draw a flight; ``kind``: accelerations in the ball, on its surface, or alternating along one
    direction."""
    along, flight = unit(rng), Flight([], [])
    position, velocity = rng.normal(0, 1000, 3), unit(rng) * SPEED_MPS * rng.uniform()
    while start_ns < end_ns:
        step_ns = int(10 ** rng.uniform(7.5, 9.7))
        size = ACCELERATION_MPS2 * (rng.uniform() if kind == "ball" else 1.0)
        acceleration = along * rng.choice([-1, 1]) if kind == "bang" else unit(rng)
        acceleration = acceleration * size
        after = velocity + acceleration * (step_ns * 1e-9)
        after *= min(1.0, SPEED_MPS / math.sqrt(after @ after))  # at most the wanted acceleration
        flight.starts_ns.append(start_ns)
        flight.motions.append((position, velocity, (after - velocity) / (step_ns * 1e-9)))
        start_ns += step_ns
        position, velocity = flight.at(start_ns)
    return flight


def noise(rng: np.random.Generator, kind: str) -> tuple[FloatArray, FloatArray]:
    """Draw noise of position within an upright cylinder and of velocity within a ball."""
    share = rng.uniform(size=3) if kind == "ball" else np.ones(3)
    plane = unit(rng, 2) * NOISE.horizontal_m * share[0]
    height = rng.choice([-1, 1]) * NOISE.vertical_m * share[1]
    return np.array([*plane, height]), unit(rng) * NOISE.velocity_mps * share[2]


def check(found: Prediction, truth: tuple[FloatArray, FloatArray]) -> float:
    """Check every bound and return the used share of the position bound."""
    off, off_mps = found.position_ned_m - truth[0], found.velocity_ned_mps - truth[1]
    assert math.hypot(off[0], off[1]) <= found.horizontal_m + ROUNDING
    assert abs(off[2]) <= found.vertical_m + ROUNDING
    assert math.sqrt(off @ off) <= found.bound_m + ROUNDING
    assert found.velocity_bound_mps is not None
    assert math.sqrt(off_mps @ off_mps) <= found.velocity_bound_mps + ROUNDING
    assert found.bound_m <= math.hypot(found.horizontal_m, found.vertical_m) + ROUNDING
    return math.hypot(off[0], off[1]) / found.horizontal_m


def sequences(count: int) -> Iterator[tuple[np.random.Generator, str]]:
    for seed in range(count):
        yield np.random.default_rng(seed), ("ball", "surface", "bang")[seed % 3]


@pytest.mark.parametrize("told", [1.0, 0.8, 0.0], ids=["reported", "sometimes", "never"])
@pytest.mark.parametrize("name", GAINS)
def test_adversaries_stay_within_the_bounds(fix: MakeFix, name: str, told: float) -> None:
    """Irregular reports, some without a velocity; predicted before, at and after each of them."""
    observer = observing(name)
    for rng, kind in sequences(rounds(60, 240)):
        times = np.cumsum(10 ** rng.uniform(7.3, rng.uniform(8.5, 10.3), size=9)).astype(int)
        flight = flown(rng, kind, 0, int(times[-1]) + 5 * S)
        state = None
        for number, t_ns in enumerate(times.tolist()):
            position, velocity = flight.at(t_ns)
            wrong, wrong_mps = noise(rng, kind)
            speeds = velocity + wrong_mps if rng.uniform() < told else None
            made = fix(t_ns, position + wrong, speeds, noise=NOISE)
            state = advance(state, made, observer)
            later_ns = int(times[number + 1]) if number < 8 else t_ns + 5 * S
            earlier_ns = max(0, t_ns - 2 * S)
            for asked_ns in (t_ns, later_ns, *rng.integers(earlier_ns, later_ns, 2).tolist()):
                check(observer.predict(state, asked_ns), flight.at(asked_ns))


@pytest.mark.parametrize("interval_s", [0.05, 0.2, 1.0, 3.0])
@pytest.mark.parametrize("name", ["deadbeat", "blend", "fading"])
@pytest.mark.parametrize("along", [(0.6, -0.8, 0.0), (0.0, 0.0, 1.0)], ids=["plane", "height"])
def test_greedy_adversary_attains_the_bounds(
    fix: MakeFix, name: str, interval_s: float, along: tuple[float, float, float]
) -> None:
    """Noise lags as far as allowed behind a UAV that accelerates throughout."""
    observer, ahead = observing(name, speed_max_mps=1e6), np.array(along)
    acceleration, state, step_ns = ACCELERATION_MPS2 * ahead, None, round(interval_s * S)
    size = NOISE.vertical_m if along[2] else NOISE.horizontal_m
    for number in range(60):
        t_s = number * interval_s
        position, velocity = acceleration * t_s**2 / 2, acceleration * t_s
        report, speeds = position - size * ahead, velocity - NOISE.velocity_mps * ahead
        state = advance(state, fix(number * step_ns, report, speeds, noise=NOISE), observer)
    assert state is not None
    t_s = 60 * interval_s
    truth = (acceleration * t_s**2 / 2, acceleration * t_s)
    found = observer.predict(state, 60 * step_ns)
    check(found, truth)
    bound_m = found.vertical_m if along[2] else found.horizontal_m
    assert (truth[0] - found.position_ned_m) @ ahead >= 0.98 * bound_m
    assert found.velocity_bound_mps is not None
    assert (truth[1] - found.velocity_ned_mps) @ ahead >= 0.98 * found.velocity_bound_mps


def planned(
    rng: np.random.Generator, observer: KinematicObserver, steps: int, most_s: float
) -> tuple[list[float], list[FloatArray]]:
    """Return intervals and, for each, the direction in (position, velocity) along which the error
    must grow to be largest along the position at the end; planned backwards."""
    intervals = np.exp(rng.uniform(np.log(0.05), np.log(most_s), steps)).round(9).tolist()
    goals = [np.array([1.0, 0.0])]
    for dt_s in reversed(intervals):
        gain = np.reshape(observer.model.gain(dt_s), (2, 2))
        goals.append((np.array([[1.0, dt_s], [0.0, 1.0]]) - gain).T @ goals[-1])
    return intervals, goals[::-1][1:]


def bang_bang(goal: FloatArray, dt_s: float) -> FloatArray:
    """Return the largest effect of the acceleration on (position, velocity) along the goal: it
    switches once, where the goal's position and velocity terms balance."""
    switch_s = -goal[1] / goal[0] if goal[0] else -1.0
    if 0 < switch_s < dt_s:
        way, gained = dt_s**2 / 2 - switch_s**2, dt_s - 2 * switch_s
        sign = math.copysign(1.0, goal[0])
    else:
        way, gained = dt_s**2 / 2, dt_s
        sign = math.copysign(1.0, goal[0] * dt_s / 2 + goal[1])
    return ACCELERATION_MPS2 * sign * np.array([way, gained])


@pytest.mark.parametrize("name", ["table", "deadbeat", "blend"])
@pytest.mark.parametrize(
    ("axis", "noise_m"), [((0.6, -0.8, 0.0), 1.5), ((0.0, 0.0, 1.0), 2.5)], ids=["plane", "height"]
)
def test_planned_adversary_approaches_but_never_exceeds_the_bounds(
    fix: MakeFix, name: str, axis: tuple[float, float, float], noise_m: float
) -> None:
    """Noise and acceleration along one axis, each step as planned: never outside, and nearly at the
    bound in the best plan. The speed limit is not reached."""
    rng, along, closest = np.random.default_rng(7), np.array(axis), 0.0
    observer = observing(name, speed_max_mps=1e6)
    for number in range(60):
        intervals, goals = planned(rng, observer, 40, 2.0 if number % 2 else 0.3)
        truth, error, t_s = np.zeros(2), np.zeros(2), 0.0
        wrong = np.array([noise_m, 0.4])
        state: KinematicState | None = None
        for dt_s, goal in zip(intervals, goals, strict=True):
            gain = np.reshape(observer.model.gain(dt_s), (2, 2))
            closed = np.array([[1.0, dt_s], [0.0, 1.0]]) - gain
            sign = -1.0 if goal @ closed @ error < 0 else 1.0
            entered = np.sign(gain.T @ (sign * goal)) * wrong * (1 - 1e-9)
            if state is None:
                entered = wrong
            told = truth + entered
            report = fix(round(t_s * S), along * told[0], along * told[1], noise=NOISE)
            state = advance(state, report, observer)
            push = -bang_bang(sign * goal, dt_s)
            truth = np.array([[1.0, dt_s], [0.0, 1.0]]) @ truth + push
            t_s = round(t_s + dt_s, 9)
            found = observer.predict(state, round(t_s * S))
            off = found.position_ned_m - along * truth[0]
            check(found, (along * truth[0], along * truth[1]))
            bound_m = found.vertical_m if along[2] else found.horizontal_m
            closest = max(closest, float(abs(off @ along)) / bound_m)
            assert found.velocity_ned_mps is not None
            error = np.array([off @ along, found.velocity_ned_mps @ along - truth[1]])
    assert closest > 0.95


def test_prediction_uses_the_gain_of_the_interval(fix: MakeFix) -> None:
    """By explicit matrices: x + L (y - x), propagated by A."""
    observer, t = observing("of both"), 0.7
    state = KinematicState(
        fix=fix(0, [3, 1, 0], [1, 0, 2], noise=NOISE),
        position_ned_m=np.array([1.0, 2, 3]),
        velocity_ned_mps=np.array([4.0, 5, 6]),
        horizontal_m=7.0,
        vertical_m=8.0,
        position_m=10.0,
        velocity_mps=9.0,
        interval_s=1.0,
    )
    a = np.array([[1, t], [0, 1]])
    gain = np.array(GAINS["of both"](t)).reshape(2, 2)
    x = np.array([[1.0, 2, 3], [4, 5, 6]])
    expected = a @ x + gain @ (np.array([[3.0, 1, 0], [1, 0, 2]]) - x)
    found = observer.predict(state, round(t * S))
    assert found.position_ned_m == pytest.approx(expected[0])
    assert found.velocity_ned_mps == pytest.approx(expected[1])
    assert found.mu_s2 is None


@given(
    velocity=st.tuples(*[st.floats(-17, 17)] * 3),
    intervals_ms=st.lists(st.integers(1, 3000), min_size=1, max_size=8),
    asked_ms=st.integers(-3000, 3000),
    name=st.sampled_from(list(GAINS)),
)
def test_constant_velocity_is_tracked_exactly(
    fix: MakeFix,
    velocity: tuple[float, float, float],
    intervals_ms: list[int],
    asked_ms: int,
    name: str,
) -> None:
    """With any gains, forwards and backwards."""
    observer, speeds, t_ns, state = observing(name), np.array(velocity), 17 * S, None
    for after_ms in intervals_ms:
        state = advance(state, fix(t_ns, speeds * (t_ns * 1e-9), speeds), observer)
        t_ns += after_ms * 1_000_000
    assert state is not None
    asked_ns = state.fix.sender_ns + asked_ms * 1_000_000
    found = observer.predict(state, asked_ns)
    assert found.position_ned_m == pytest.approx(speeds * (asked_ns * 1e-9), abs=1e-5)
    assert found.velocity_ned_mps == pytest.approx(speeds, abs=1e-5)


@pytest.mark.parametrize("t_s", [-1.0, 0.3, 2.0])
def test_constant_acceleration_error_is_half_a_t_squared(fix: MakeFix, t_s: float) -> None:
    observer, acceleration, state = observing(), np.array([1.0, -2.0, 0.5]), None
    for at_s in (2.0, 2.5, 4.0):
        report, speeds = acceleration * at_s**2 / 2, acceleration * at_s
        state = advance(state, fix(round(at_s * S), report, speeds), observer)
    assert state is not None
    found = observer.predict(state, round((4.0 + t_s) * S))
    truth = acceleration * (4.0 + t_s) ** 2 / 2
    assert truth - found.position_ned_m == pytest.approx(acceleration * t_s**2 / 2)
    assert acceleration * (4.0 + t_s) - found.velocity_ned_mps == pytest.approx(acceleration * t_s)


def test_velocity_is_estimated_from_positions(fix: MakeFix) -> None:
    """The error halves with each report at equal intervals; the initial velocity is zero."""
    observer, velocity, state = observing(), np.array([10.0, -5.0, 2.0]), None
    missing = []
    for number in range(8):
        state = advance(state, fix(number * S // 2, velocity * number / 2), observer)
        found = observer.predict(state, (number + 1) * S // 2)
        missing.append(float(np.linalg.norm(velocity - found.velocity_ned_mps)))
        assert found.horizontal_m < 100
    assert missing[0] == pytest.approx(math.sqrt(129))
    assert missing[-1] < 0.02 * missing[0]
    assert np.array(missing[2:]) / missing[1:-1] == pytest.approx(0.5)


def test_nearly_simultaneous_positions_do_not_inflate_velocity(fix: MakeFix) -> None:
    """Two receivers that differ by 3 m, 1 ms apart, are not 1500 m/s."""
    observer, state = observing(), None
    for at_ns, north in ((0, 0.0), (S, 10.0), (S + S // 1000, 13.0)):
        state = advance(state, fix(at_ns, [north, 0.0, 0.0]), observer)
    found = observer.predict(state, 2 * S)
    assert float(np.linalg.norm(found.velocity_ned_mps)) < 30.0


@pytest.mark.parametrize("gap_s", [20.0, 60.0])
def test_speed_limit_bounds_a_long_gap(fix: MakeFix, gap_s: float) -> None:
    """The speed limit bounds the UAV's path and that of the prediction, whatever the acceleration
    allows."""
    made = fix(0, [5, 5, 5], [20.0, 0, 0], noise=NOISE)
    observer, free = observing(), observing(speed_max_mps=1e6)
    limited = observer.predict(observer.begin(made), round(gap_s * S))
    unlimited = free.predict(free.begin(made), round(gap_s * S))
    assert limited.position_ned_m == unlimited.position_ned_m
    assert limited.horizontal_m == pytest.approx(1.5 + (30 + 20) * gap_s)
    assert limited.vertical_m == pytest.approx(2.5 + 30 * gap_s)
    assert unlimited.horizontal_m == pytest.approx(1.5 + 0.4 * gap_s + 4.0 * gap_s**2)
    assert limited.horizontal_m < unlimited.horizontal_m
    assert limited.velocity_bound_mps == pytest.approx(50.0)
    # The speed bound assumes that the UAV turns back at once at full speed.
    check(limited, (np.array([5 - 30 * gap_s, 5, 5]), np.array([-30.0, 0, 0])))


@settings(max_examples=examples(100))
@given(seed=st.integers(0, 2**32 - 1), told=st.booleans(), name=st.sampled_from(list(GAINS)))
def test_rotated_inputs_give_rotated_estimates(
    fix: MakeFix, seed: int, told: bool, name: str
) -> None:
    rng, observer = np.random.default_rng(seed), observing(name)
    turn = Rotation.from_euler("z", rng.uniform(-math.pi, math.pi)).as_matrix()
    plain, turned, t_ns = None, None, 0
    for _ in range(6):
        position, velocity = rng.normal(0, 100, 3), rng.normal(0, 20, 3)
        straight = fix(t_ns, position, velocity if told else None)
        rotated = fix(t_ns, turn @ position, turn @ velocity if told else None)
        plain, turned = advance(plain, straight, observer), advance(turned, rotated, observer)
        t_ns += int(10 ** rng.uniform(7.3, 9.5))
        a, b = (observer.predict(state, t_ns) for state in (plain, turned))
        assert b.position_ned_m == pytest.approx(turn @ a.position_ned_m, rel=1e-8, abs=1e-6)
        assert b.velocity_ned_mps == pytest.approx(turn @ a.velocity_ned_mps, rel=1e-8, abs=1e-6)
        assert (b.horizontal_m, b.vertical_m) == pytest.approx((a.horizontal_m, a.vertical_m))
        assert b.velocity_bound_mps == pytest.approx(a.velocity_bound_mps)
