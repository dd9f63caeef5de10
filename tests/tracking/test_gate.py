"""The gate: rejection of impossible reports, and reacquisition from rejected ones."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from companion.tracking.gate import GateSettings, Suspects, is_frozen, refusal
from companion.tracking.observers.estimates import Prediction
from companion.tracking.observers.kinematic import KinematicModel, KinematicObserver
from companion.values import Fix, Reason, ReportNoise

MakeFix = Callable[..., Fix]
S = 1_000_000_000
OBSERVER = KinematicObserver(KinematicModel(30.0, 5.0))
PREDICTED = Prediction(
    position_ned_m=np.array([100.0, 0, -50]),
    velocity_ned_mps=None,
    bound_m=99.0,
    horizontal_m=10.0,
    vertical_m=4.0,
    velocity_bound_mps=None,
    mu_s2=None,
)
NOISE = ReportNoise(
    horizontal_m=3.0, vertical_m=2.0, position_m=math.hypot(3.0, 2.0), velocity_mps=0.5
)


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        ((100, 0, -50), None),
        ((100 + 7.7, 10.3, -50), None),  # 12.86 m
        ((100 + 13.01, 0, -50), Reason.UNREACHABLE),
        ((100 - 9.5, 9.5, -50), Reason.UNREACHABLE),  # 13.4 m, though each axis is off by less
        ((100, 0, -44.01), None),
        ((100, 0, -43.99), Reason.ALTITUDE_JUMP),
        ((100, 0, -56.01), Reason.ALTITUDE_JUMP),
        ((100, 12.9, -55.9), None),  # on the edge of the cylinder
        ((100, 13.1, -90), Reason.UNREACHABLE),
    ],
)
def test_report_outside_the_reachable_cylinder_is_rejected(
    fix: MakeFix, place: tuple[float, ...], reason: Reason | None
) -> None:
    """The report's own noise is added: 10 + 3 m horizontally, 4 + 2 m vertically."""
    found = refusal(PREDICTED, fix(0, place, noise=NOISE))
    assert (None if found is None else found[0]) is reason


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        ((100 + 15.99, 0, -50), None),
        ((100 + 16.01, 0, -50), Reason.UNREACHABLE),
        ((100, 0, -50 + 8.99), None),
        ((100, 0, -50 - 8.99), None),
        ((100, 0, -50 - 9.01), Reason.ALTITUDE_JUMP),
    ],
)
def test_gate_allows_for_the_feedthrough_lead(
    fix: MakeFix, place: tuple[float, ...], reason: Reason | None
) -> None:
    """Horizontally and vertically: 3 m more than the noise bound."""
    found = refusal(PREDICTED, fix(0, place, noise=NOISE), lead_m=3.0)
    assert (None if found is None else found[0]) is reason


def test_rejection_states_deviation_and_limit(fix: MakeFix) -> None:
    found = refusal(PREDICTED, fix(0, [130, 40, -50], noise=NOISE))
    assert found == (Reason.UNREACHABLE, "50.0 m from the prediction, at most 13.0 m possible")
    found = refusal(PREDICTED, fix(0, [100, 0, -90], noise=NOISE))
    assert found == (Reason.ALTITUDE_JUMP, "40.0 m above the prediction, at most 6.0 m possible")
    found = refusal(PREDICTED, fix(0, [100, 0, -10], noise=NOISE))
    assert found == (Reason.ALTITUDE_JUMP, "40.0 m below the prediction, at most 6.0 m possible")


@pytest.mark.parametrize(
    ("moved", "velocity", "after_s", "frozen"),
    [
        ((0, 0, 0), (5, 0, 0), 1.0, True),
        ((0, 0, 0), (0, 0, -2), 1.0, True),
        ((0, 0, 0), (5, 0, 0), 0.05, False),  # 0.25 m may be below the resolution
        ((0, 0, 0), (0.9, 0, 0), 10.0, False),  # hovering
        ((0, 0, 0), None, 10.0, False),
        ((0.01, 0, 0), (5, 0, 0), 1.0, False),
        ((0, 0.01, 0), (5, 0, 0), 1.0, False),
        ((0, 0, 0.01), (5, 0, 0), 1.0, False),
    ],
)
def test_frozen_positions_are_recognised(
    fix: MakeFix,
    moved: tuple[float, ...],
    velocity: tuple[float, ...] | None,
    after_s: float,
    frozen: bool,
) -> None:
    assert is_frozen(fix(0, [0, 0, 0]), fix(round(after_s * S), moved, velocity)) == frozen


def suspects(fix: MakeFix, times_s: list[float], **changed: float) -> Suspects:
    """Return rejected reports of a UAV that flies north at 10 m/s."""
    run = Suspects(OBSERVER, GateSettings(**changed))
    for t_s in times_s:
        run.add(fix(round(t_s * S), [10 * t_s, 0, 0], [10, 0, 0]))
    return run


@pytest.mark.parametrize(
    ("times_s", "agree"),
    [
        ([], False), ([0, 0.5, 1], True), ([0, 0.5, 0.99], False), ([0, 1], False),
        ([0, 1, 2, 3], True), ([0, 1, 13, 14], False), ([0, 1, 13, 14, 16], True),
    ],
)  # fmt: skip
def test_run_needs_enough_suspects_over_enough_time(
    fix: MakeFix, times_s: list[float], agree: bool
) -> None:
    run = suspects(fix, times_s)
    assert run.agree() is agree
    assert len(suspects(fix, [0, 0.1], reacquire_reports=2, reacquire_s=0.1).take()) == 2


def test_contradicting_suspects_restart_the_run(fix: MakeFix) -> None:
    run = suspects(fix, [0, 1, 2])
    run.add(fix(3 * S, [300, 0, 0], [10, 0, 0]))
    assert not run.agree()
    assert [one.sender_ns for one in run.take()] == [3 * S]
    assert run.take() == []


def test_late_or_duplicate_suspects_are_ignored(fix: MakeFix) -> None:
    run = suspects(fix, [0, 2])
    run.add(fix(2 * S, [20, 0, 0], [10, 0, 0]))
    run.add(fix(S, [10, 0, 0], [10, 0, 0]))
    assert [one.sender_ns for one in run.take()] == [0, 2 * S]


def test_run_stays_consistent_until_it_expires(fix: MakeFix) -> None:
    run = interleaved_run(fix, [0, 1, 2, 3])
    assert run.is_second_vehicle(3 * S)
    assert run.is_second_vehicle(13 * S - 1)
    assert not run.is_second_vehicle(13 * S)


def test_run_without_interleaving_is_not_a_duplicate_id(fix: MakeFix) -> None:
    """A step of a few seconds, after which reports are possible again."""
    run = suspects(fix, [0, 1, 2, 3])
    run.interrupt()
    run.interrupt()
    assert not run.is_second_vehicle(4 * S)
    run.add(fix(5 * S, [50, 0, 0], [10, 0, 0]))
    assert not run.is_second_vehicle(5 * S)
    assert not interleaved_run(fix, [0, 1, 2]).is_second_vehicle(2 * S)


def interleaved_run(fix: MakeFix, times_s: list[float]) -> Suspects:
    """Return a run whose reports alternate with possible ones."""
    run = Suspects(OBSERVER, GateSettings())
    for t_s in times_s:
        run.add(fix(round(t_s * S), [10 * t_s, 0, 0], [10, 0, 0]))
        run.interrupt()
    return run


def test_run_length_is_bounded(fix: MakeFix) -> None:
    run = suspects(fix, [n / 10 for n in range(1000)])
    kept = run.take()
    assert len(kept) <= 100
    assert kept[-1].sender_ns == round(99.9 * S)


@pytest.mark.parametrize("rate_hz", [2, 10, 25, 50])
def test_fast_reports_reacquire_as_soon_as_slow_ones(fix: MakeFix, rate_hz: int) -> None:
    run = suspects(fix, [n / rate_hz for n in range(4 * rate_hz)])
    assert run.agree()


def test_time_uncertainty_adds_distance_at_the_reported_speed(fix: MakeFix) -> None:
    """At 40 m/s, 2 s apart: one millisecond, the drift over 2 s, and the velocity error."""
    noise = NOISE._replace(velocity_mps=0.5, time_s=0.0)
    before, after = (fix(at * S, (80 * at, 0, -50), (40.0, 0, 0), noise=noise) for at in (0, 2))
    settings = GateSettings(drift_max=1e-3)
    assert settings.slack_m(before, after) == pytest.approx(40.5 * (1e-3 + 2e-3), rel=1e-3)
    late = after._replace(noise=noise._replace(time_s=0.02))
    assert settings.slack_m(before, late) == pytest.approx(40.5 * 0.023, rel=0.02)
    still = after._replace(velocity_ned_mps=None)
    assert GateSettings(lead_m=3.0).slack_m(still, still) == 3.0
