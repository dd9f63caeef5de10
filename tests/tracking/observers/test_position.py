"""The position observer against adversaries: simulated UAVs that use the full bounds."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support import examples, rounds

from companion.tracking.observers.position import PositionModel, PositionObserver, PositionState
from companion.values import Fix, FloatArray, ReportNoise

MakeFix = Callable[..., Fix]
SPEED_MPS, ACCELERATION_MPS2 = 30.0, 8.0
NOISE = ReportNoise(
    horizontal_m=1.2, vertical_m=0.9, position_m=math.hypot(1.2, 0.9), velocity_mps=0.4
)  # 1.5 m in space
NOISE_M = 1.5
# For adversaries of the stacked model, whose velocity is constant between reports.
STILL_MPS2 = 1e-9
S = 1_000_000_000
ROUNDING_M = 1e-6


def inside(vector: FloatArray, norm: float) -> FloatArray:
    """Return the nearest vector that is no longer than ``norm``."""
    length = float(np.sqrt(vector @ vector))
    return vector if length <= norm else vector * (norm / length)


@dataclass
class Adversary:
    """Vectors of bounded norm: anywhere in the ball, on its surface, or along one direction."""

    rng: np.random.Generator
    along: FloatArray
    kind: str

    def __call__(self, norm: float) -> FloatArray:
        if self.kind == "steady":
            return norm * self.along
        if self.kind == "switching":
            return norm * self.along * float(self.rng.choice([-1.0, 1.0]))
        vector: FloatArray = self.rng.standard_normal(3)
        vector *= norm / np.sqrt(vector @ vector)
        return vector if self.kind == "surface" else vector * float(self.rng.uniform())


def adversaries(count: int) -> Iterator[Adversary]:
    """Yield seeded adversaries of each kind in turn."""
    for seed in range(count):
        rng = np.random.default_rng(seed)
        along = rng.standard_normal(3)
        kind = ("ball", "surface", "steady", "switching")[seed % 4]
        yield Adversary(rng, along / np.sqrt(along @ along), kind)


def interval_ns(rng: np.random.Generator) -> int:
    """Draw an interval from 20 ms to 3 s, short ones more often."""
    return int(10 ** rng.uniform(7.3, 9.5))


def observing(
    alpha: float | None = None,
    feedthrough_s: float = 0.0,
    velocity_lead_s: float = 0.2,
    *,
    acceleration_max_mps2: float = ACCELERATION_MPS2,
) -> PositionObserver:
    model = PositionModel(
        speed_max_mps=SPEED_MPS,
        acceleration_max_mps2=acceleration_max_mps2,
        alpha=alpha,
        feedthrough_s=feedthrough_s,
        velocity_lead_s=velocity_lead_s,
    )
    return PositionObserver(model)


def advance(state: PositionState | None, fix: Fix, observer: PositionObserver) -> PositionState:
    if state is None:
        return observer.begin(fix)
    return observer.after(state, observer.predict(state, fix.sender_ns), fix)


def norm_m(vector: FloatArray) -> float:
    return float(np.sqrt(vector @ vector))


@pytest.mark.parametrize("alpha", [None, 0.5])
@pytest.mark.parametrize("feedthrough_s", [0.0, 0.5, -0.3])
def test_error_stays_within_bound_with_positions_only(
    fix: MakeFix, feedthrough_s: float, alpha: float | None
) -> None:
    """Only speed and noise are bounded; the sender's lead uses the same mean velocity."""
    observer = observing(alpha, feedthrough_s, acceleration_max_mps2=STILL_MPS2)
    worst = 0.0
    for adversary in adversaries(400):
        position, t_ns, state = np.zeros(3), 17 * S, None
        for _ in range(12):
            velocity, b_ns = adversary(SPEED_MPS), interval_ns(adversary.rng)
            report = position + feedthrough_s * velocity + adversary(NOISE_M)
            state = advance(state, fix(t_ns, report), observer)
            for part in (0.0, adversary.rng.uniform(), 1.0):
                asked_ns = round(part * b_ns)
                found = observer.predict(state, t_ns + asked_ns)
                truth = position + velocity * (asked_ns * 1e-9)
                error_m = norm_m(found.position_ned_m - truth)
                assert error_m <= found.bound_m + ROUNDING_M
                worst = max(worst, error_m / found.bound_m)
            position = position + velocity * (b_ns * 1e-9)
            t_ns += b_ns
    assert worst > 0.8


@pytest.mark.parametrize("alpha", [None, 0.3])
@pytest.mark.parametrize("velocity_lead_s", [0.2, 0.01, 2.0])
def test_error_stays_within_bound_with_positions_and_velocities(
    fix: MakeFix, velocity_lead_s: float, alpha: float | None
) -> None:
    """Speed, acceleration and both noises bounded; a report may come without its velocity."""
    observer = observing(alpha, 0.0, velocity_lead_s)
    worst = 0.0
    for adversary in adversaries(rounds(60, 400)):
        rng = adversary.rng
        position, velocity = np.zeros(3), adversary(SPEED_MPS)
        t_ns, state, due_ns = 17 * S, None, 0
        for _ in range(40):
            if due_ns <= 0:
                report = position + adversary(NOISE_M)
                speeds = velocity + adversary(NOISE.velocity_mps)
                told = speeds if rng.uniform() < 0.9 else None
                state = advance(state, fix(t_ns, report, told), observer)
                due_ns = interval_ns(rng)
            assert state is not None
            found = observer.predict(state, t_ns)
            error_m = norm_m(found.position_ned_m - position)
            assert error_m <= found.bound_m + ROUNDING_M
            worst = max(worst, error_m / found.bound_m)
            step_ns = min(due_ns, int(rng.uniform(0.01, 1.0) * S))
            step_s = step_ns * 1e-9
            wanted = velocity + adversary(ACCELERATION_MPS2) * step_s
            after = inside(wanted, SPEED_MPS)  # at most the wanted acceleration
            position = position + (velocity + after) / 2 * step_s
            velocity, t_ns, due_ns = after, t_ns + step_ns, due_ns - step_ns
    assert worst > 0.5


@pytest.mark.parametrize("alpha", [None, 0.5])
def test_error_stays_within_bound_with_sender_lead_and_velocities(
    fix: MakeFix, alpha: float | None
) -> None:
    """Checked at the next report's time, up to which the lead's mean velocity is that of the
    interval."""
    observer = observing(alpha, 0.4)
    for adversary in adversaries(400):
        position, velocity = np.zeros(3), adversary(SPEED_MPS)
        t_ns, state = 17 * S, None
        for _ in range(12):
            b_ns = interval_ns(adversary.rng)
            b_s = b_ns * 1e-9
            wanted = velocity + adversary(ACCELERATION_MPS2) * b_s
            after = inside(wanted, SPEED_MPS)
            mean = (velocity + after) / 2
            report = position + 0.4 * mean + adversary(NOISE_M)
            speeds = velocity + adversary(NOISE.velocity_mps)
            state = advance(state, fix(t_ns, report, speeds), observer)
            position, velocity, t_ns = position + mean * b_s, after, t_ns + b_ns
            found = observer.predict(state, t_ns)
            error_m = norm_m(found.position_ned_m - position)
            assert error_m <= found.bound_m + ROUNDING_M


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("feedthrough_s", [0.5, -0.3])
def test_error_stays_within_bound_with_a_time_lead(
    fix: MakeFix, feedthrough_s: float, told: bool
) -> None:
    """The sender reports a future or past position, where its mean velocity differs from the
    present one."""
    observer = observing(None, feedthrough_s)
    for start_mps, acceleration in ((0.0, 8.0), (-10.0, 8.0), (10.0, -8.0)):

        def place(t_s: float, v: float = start_mps, a: float = acceleration) -> FloatArray:
            return np.array([v * t_s + a * t_s**2 / 2, 0.0, 0.0])

        for b_ns in (S // 10, S // 5, S // 2, S, 2 * S):
            velocity = np.array([start_mps, 0, 0]) if told else None
            report = place(feedthrough_s)
            known = PositionState(fix(0, report, velocity), place(0.0), 0.0)
            found = observer.predict(known, b_ns)
            error_m = norm_m(found.position_ned_m - place(b_ns * 1e-9))
            # The report may also have noise.
            gain = abs(_gain(fix, observer, b_ns)) if not told else 0.0
            assert error_m + gain * NOISE_M <= found.bound_m + ROUNDING_M


@pytest.mark.parametrize("alpha", [None, 0.5])
@pytest.mark.parametrize("feedthrough_s", [0.0, 0.15, 0.5, -0.3])
def test_greedy_adversary_attains_the_bound(
    fix: MakeFix, feedthrough_s: float, alpha: float | None
) -> None:
    """It anticipates the gains and chooses noise and velocity in the worst sense: all of the bound
    is used."""
    observer = observing(alpha, feedthrough_s, acceleration_max_mps2=STILL_MPS2)
    along = np.array([0.6, 0.0, -0.8])
    reached = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        position, t_ns, state, error = np.zeros(3), 17 * S, None, 1.0
        for _ in range(60):
            b_ns = int(rng.uniform(0.05, 1.2) * S)
            b_s = b_ns * 1e-9
            # Sensitivity of the error to this interval's noise and velocity, measured numerically.
            gain = _gain(fix, observer, b_ns)
            push = math.copysign(1.0, (1 - gain) * error)
            noise = push * math.copysign(NOISE_M, gain)
            speed = push * math.copysign(SPEED_MPS, gain * feedthrough_s - b_s)
            report = position + along * (feedthrough_s * speed + noise)
            state = advance(state, fix(t_ns, report), observer)
            position, t_ns = position + along * (speed * b_s), t_ns + b_ns
            found = observer.predict(state, t_ns)
            error = float(along @ (found.position_ned_m - position))
            assert abs(error) <= found.bound_m + ROUNDING_M
        reached.append(abs(error) / found.bound_m)
    assert np.median(reached) >= 0.98
    assert max(reached) >= 0.999


def _gain(fix: MakeFix, observer: PositionObserver, b_ns: int) -> float:
    """Return the weight of a report in the estimate: estimate at 0 m, report at 1 m."""
    estimate = PositionState(fix(0, [1.0, 0.0, 0.0]), np.zeros(3), 0.0)
    return float(observer.predict(estimate, b_ns).position_ned_m[0])


@given(
    velocity=st.tuples(*[st.floats(-17, 17)] * 3),
    intervals_ms=st.lists(st.integers(1, 3000), min_size=1, max_size=8),
    beyond_ms=st.integers(0, 3000),
    told=st.booleans(),
    lead_s=st.floats(0.01, 1.0),
)
def test_constant_velocity_is_tracked_exactly(
    *,
    fix: MakeFix,
    velocity: tuple[float, float, float],
    intervals_ms: list[int],
    beyond_ms: int,
    told: bool,
    lead_s: float,
) -> None:
    """With velocity reported; without, only where the sender's own lead tells it."""
    feedthrough_s = 0.0 if told else 2.0
    observer = observing(None, feedthrough_s, lead_s)
    speeds = np.array(velocity)
    t_ns, state = 17 * S, None
    for after_ms in intervals_ms:
        position = speeds * (t_ns * 1e-9)
        report = position + feedthrough_s * speeds
        made = fix(t_ns, report, speeds if told else None)
        if state is None and not told:
            # The first estimate is exact, so that only the following ones are tested.
            state = PositionState(made, position, 0.0)
        else:
            state = advance(state, made, observer)
        t_ns += after_ms * 1_000_000
    assert state is not None
    asked_ns = state.fix.sender_ns + beyond_ms * 1_000_000
    found = observer.predict(state, asked_ns)
    assert found.position_ned_m == pytest.approx(speeds * (asked_ns * 1e-9), abs=1e-6)


def test_velocity_is_the_last_reported_with_a_growing_bound(fix: MakeFix) -> None:
    observer = observing()
    state = observer.begin(fix(0, [0, 0, 0], [4.0, -2.0, 1.0]))
    found = observer.predict(state, 2 * S)
    assert found.position_ned_m == pytest.approx([8.0, -4.0, 2.0])
    assert found.velocity_ned_mps == pytest.approx([4.0, -2.0, 1.0])
    assert found.velocity_bound_mps == pytest.approx(0.4 + 2 * 8.0)
    assert (found.horizontal_m, found.vertical_m) == (found.bound_m, found.bound_m)
    state = advance(state, fix(2 * S, [9, 9, 9], [5.0, 5.0, 5.0]), observer)
    assert observer.predict(state, 2 * S).velocity_ned_mps == pytest.approx([5.0, 5.0, 5.0])
    silent = observer.predict(observer.begin(fix(0, [0, 0, 0])), S)
    assert (silent.velocity_ned_mps, silent.velocity_bound_mps) == (None, None)


def test_prediction_before_the_report_keeps_the_estimate(fix: MakeFix) -> None:
    """The estimate stays, and its bound grows by the possible path."""
    observer = observing()
    state = observer.begin(fix(10 * S, [1, 2, 3], [20.0, 0, 0]))
    state = advance(state, fix(11 * S, [21, 2, 3], [20.0, 0, 0]), observer)
    at = observer.predict(state, 11 * S)
    earlier = observer.predict(state, 11 * S - S // 2)
    assert earlier.position_ned_m == pytest.approx(at.position_ned_m)
    assert earlier.bound_m == pytest.approx(at.bound_m + 0.5 * SPEED_MPS)
    assert at.bound_m == state.bound_m


def test_first_report_becomes_the_estimate(fix: MakeFix) -> None:
    state = observing(None, -0.5).begin(fix(S, [1, 2, 3]))
    assert state.estimate_ned_m == (1, 2, 3)
    assert state.bound_m == pytest.approx(1.5 + 0.5 * 30.0)


@settings(max_examples=examples(50))
@given(
    seed=st.integers(0, 2**32 - 1),
    told=st.booleans(),
    feedthrough_s=st.sampled_from([0.0, 0.5, -0.3]),
)
def test_rotated_inputs_give_rotated_outputs(
    fix: MakeFix, seed: int, told: bool, feedthrough_s: float
) -> None:
    rng = np.random.default_rng(seed)
    turn = Rotation.random(rng=rng).as_matrix()
    observer = observing(None, feedthrough_s)
    plain: PositionState | None = None
    turned: PositionState | None = None
    t_ns = 0
    for _ in range(6):
        position, velocity = rng.normal(0, 100, 3), rng.normal(0, 20, 3)
        straight = fix(t_ns, position, velocity if told else None)
        rotated = fix(t_ns, turn @ position, turn @ velocity if told else None)
        plain, turned = advance(plain, straight, observer), advance(turned, rotated, observer)
        t_ns += interval_ns(rng)
        a, b = (observer.predict(state, t_ns) for state in (plain, turned))
        assert b.position_ned_m == pytest.approx(turn @ a.position_ned_m, abs=1e-8)
        assert (b.bound_m, b.mu_s2) == (a.bound_m, a.mu_s2)
