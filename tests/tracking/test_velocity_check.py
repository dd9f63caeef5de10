"""Velocities that the positions contradict: detection, and the bound assumed afterwards."""

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.tracking.velocity_check import APART_NS, SETTING, VelocityCheck
from companion.values import Fix, FloatArray, Refuted, ReportNoise

S = 1_000_000_000
A_MPS2 = 4.0
NOISE = ReportNoise(horizontal_m=1.0, vertical_m=1.0, position_m=1.4, velocity_mps=0.5)
MakeFix = Callable[..., Fix]
Wrong = Callable[[FloatArray], FloatArray]


def circle(
    fix: MakeFix, wrong: Wrong, *, step_s: float = 0.1, speed_mps: float = 15.0, time_s: float = 30
) -> list[Fix]:
    """Return reports of a circle of 60 m, with positions that are true and velocities that are
    not."""
    fixes = []
    for n in range(round(time_s / step_s)):
        turn = speed_mps / 60 * n * step_s
        place = 60 * np.array([math.cos(turn), math.sin(turn), 0.0])
        velocity = speed_mps * np.array([-math.sin(turn), math.cos(turn), 0.0])
        fixes.append(fix(round(n * step_s * S), place, wrong(velocity), noise=NOISE))
    return fixes


def refuted(check: VelocityCheck, fixes: list[Fix]) -> list[tuple[float, Refuted]]:
    looked = [(one.sender_ns / S, check.look(one, A_MPS2)) for one in fixes]
    return [(at_s, found) for at_s, found in looked if found is not None]


WRONG: dict[str, Wrong] = {
    "zero": lambda _: np.zeros(3),
    "reversed": lambda v: -v,
    "turned by a right angle": lambda v: np.array([-v[1], v[0], 0.0]),
    "in another unit": lambda v: 1.944 * v,
}


@pytest.mark.parametrize("step_s", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("name", WRONG)
def test_wrong_velocities_are_refuted_within_seconds(
    fix: MakeFix, name: str, step_s: float
) -> None:
    check = VelocityCheck()
    fixes = circle(fix, WRONG[name], step_s=step_s)
    found = refuted(check, fixes)
    assert found[0][0] <= 5.0
    assert {one.setting for _, one in found} == {SETTING}
    true = circle(fix, lambda v: v, step_s=step_s)
    worst_mps = max(
        math.dist(one.velocity_ned_mps or (), two.velocity_ned_mps or ())
        for one, two in zip(fixes, true, strict=True)
    )
    assert max(one.proven for _, one in found) <= worst_mps + NOISE.velocity_mps
    raised = check.noise(NOISE, fixes[-1].sender_ns).velocity_mps
    assert raised > 0.5 * worst_mps
    later = check.noise(NOISE, fixes[-1].sender_ns + 600 * S).velocity_mps
    assert NOISE.velocity_mps < later < 0.1 * raised


@pytest.mark.parametrize("step_s", [0.1, 1.0])
@pytest.mark.parametrize("factor", [-1.0, 0.0])
def test_wrong_climb_rates_are_refuted(fix: MakeFix, factor: float, step_s: float) -> None:
    check = VelocityCheck()
    fixes = []
    for n in range(round(30 / step_s)):
        phase = n * step_s / 5
        down_m, down_mps = 20 * math.sin(phase), 4 * math.cos(phase)
        place, velocity = [3 * n * step_s, 0, down_m], [3, 0, factor * down_mps]
        fixes.append(fix(round(n * step_s * S), place, velocity, noise=NOISE))
    found = refuted(check, fixes)
    assert found[0][0] <= 5.0
    assert NOISE.velocity_mps < check.noise(NOISE, fixes[-1].sender_ns).velocity_mps < 20.0


def test_bound_is_raised_once_if_it_is_enough(fix: MakeFix) -> None:
    check, notices = VelocityCheck(), 0
    for one in circle(fix, WRONG["reversed"]):
        given = one._replace(noise=check.noise(NOISE, one.sender_ns))
        notices += check.look(given, A_MPS2) is not None
    assert notices < 20  # within the first seconds; the deviation of five seconds is the largest


@st.composite
def honest(draw: st.DrawFn) -> list[tuple[float, FloatArray, FloatArray]]:
    """Times, positions and velocities of a lawful flight: each error as large as is allowed.

    It flies in a horizontal plane, or in a vertical line.
    """
    is_vertical = draw(st.booleans())
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    steps_s = draw(st.lists(st.sampled_from([0.05, 0.1, 0.3, 1.0, 1.9]), min_size=3, max_size=80))
    place, velocity, at_s, out = np.zeros(3), np.array([draw(st.floats(-60, 60)), 0, 0]), 0.0, []
    same = draw(st.booleans())  # the same error each time, or a new one
    off = rng.uniform(-1, 1, 2)
    for step_s in steps_s:
        for part_s in (step_s / 2, step_s / 2):  # there and back is the worst case
            acceleration = np.zeros(3)
            acceleration[:2] = rng.choice([-1, 1], 2) * A_MPS2 / math.sqrt(2)
            place = place + velocity * part_s + acceleration * part_s**2 / 2
            velocity = velocity + acceleration * part_s
        at_s += step_s
        off = off if same else rng.uniform(-1, 1, 2)
        unit = np.array([*off, 0.0]) / np.linalg.norm(off)
        there = place + unit * NOISE.horizontal_m, velocity + unit * NOISE.velocity_mps
        turned = [one[[1, 2, 0]] * [0, 0, 1] if is_vertical else one for one in there]
        out.append((at_s, turned[0], turned[1]))
    return out


@settings(max_examples=examples(200), deadline=None)
@given(flight=honest())
def test_lawful_reports_are_never_refuted(
    fix: MakeFix, flight: list[tuple[float, FloatArray, FloatArray]]
) -> None:
    check = VelocityCheck()
    fixes = [fix(round(at_s * S), place, velocity, noise=NOISE) for at_s, place, velocity in flight]
    assert refuted(check, fixes) == []
    assert check.noise(NOISE, fixes[-1].sender_ns) is NOISE


@pytest.mark.parametrize("axis", [0, 2])
@pytest.mark.parametrize("step_s", [0.1, 1.0])
def test_worst_lawful_reports_are_not_refuted(fix: MakeFix, step_s: float, axis: int) -> None:
    """All errors grow in one direction, and so do manoeuvres that no velocity shows."""
    steps = round(5 / step_s)
    fixes = []
    for n in range(steps + 1):
        unseen_m = n * A_MPS2 * step_s**2 / 4  # there and back at full acceleration
        error_m = NOISE.horizontal_m * (2 * n / steps - 1)
        place = np.roll([unseen_m + error_m, 0.0, 0.0], axis)
        velocity = np.roll([-NOISE.velocity_mps, 0.0, 0.0], axis)
        fixes.append(fix(round(n * step_s * S), place, velocity, noise=NOISE))
    assert refuted(VelocityCheck(), fixes) == []


@pytest.mark.parametrize("jump_m", [5.0, 50.0])
def test_single_jump_of_the_position_is_no_wrong_velocity(fix: MakeFix, jump_m: float) -> None:
    """An estimator that is reset moves the positions once."""
    fixes = circle(fix, lambda v: v)
    moved = [
        one._replace(position_ned_m=(one.position_ned_m[0] + jump_m, *one.position_ned_m[1:]))
        for one in fixes[100:]
    ]
    assert refuted(VelocityCheck(), fixes[:100] + moved) == []


def test_reports_without_velocity_or_far_apart_are_not_compared(fix: MakeFix) -> None:
    still = circle(fix, WRONG["zero"])
    silent = [one._replace(velocity_ned_mps=None) for one in still]
    mixed = [
        one if n % 5 else other for n, (one, other) in enumerate(zip(still, silent, strict=True))
    ]
    assert refuted(VelocityCheck(), silent) == refuted(VelocityCheck(), mixed) == []
    far = circle(fix, WRONG["zero"], step_s=APART_NS / S + 0.1)
    assert refuted(VelocityCheck(), far) == []


def test_late_reports_are_left_out(fix: MakeFix) -> None:
    fixes = circle(fix, lambda v: v)
    late = [one for pair in pairwise(fixes) for one in reversed(pair)]
    assert refuted(VelocityCheck(), late) == []
