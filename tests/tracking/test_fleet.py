"""Tracks: how they begin, age, refuse and are forgotten."""

from collections.abc import Callable

import numpy as np
import pytest

from companion.tracking import observer
from companion.tracking.fleet import Ages, Fleet
from companion.tracking.observer import Bounds, PositionModel
from companion.values import Estimate, Fix, Reason, Rejection, TrackState

MakeFix = Callable[..., Fix]
S = 1_000_000_000
MODEL = PositionModel(Bounds(30.0, 8.0, 1.5, 0.4), alpha=0.5)
AGES = Ages(2.0, 15.0, 60.0)


def same_time(_uav: str, node_ns: int) -> int:
    """A sender whose timeline is the node's."""
    return node_ns


@pytest.fixture
def fleet() -> Fleet:
    return Fleet(MODEL, AGES, same_time)


@pytest.mark.parametrize(
    ("age_s", "state"),
    [
        (-1.0, "live"), (0.0, "live"), (2.0, "live"), (2.001, "coasting"), (14.999, "coasting"),
        (15.001, "stale"), (59.999, "stale"), (60.001, "lost"), (1e6, "lost"),
    ],
)  # fmt: skip
def test_tracks_age(fleet: Fleet, fix: MakeFix, age_s: float, state: str) -> None:
    fleet.accept(fix(100 * S, [0, 0, 0]))
    now_ns = 100 * S + round(age_s * 1e9)
    track = fleet.track("1:1", now_ns, now_ns + S)
    assert track is not None
    assert track.state == state
    assert fleet.states(now_ns, ["1:1", "2:1"]) == {"1:1": TrackState(state)}
    # The time asked for is another matter.
    assert track.age_s == pytest.approx(age_s + 1.0)


def test_a_first_report_is_its_own_estimate(fleet: Fleet, fix: MakeFix) -> None:
    first = fleet.accept(fix(100 * S, [1, 2, 3], late_ns=S // 4))
    assert isinstance(first, Estimate)
    assert first.position_ned_m.tolist() == [1, 2, 3]
    assert (first.innovation_m, first.dt_s) == (None, None)
    assert first.bound_m == pytest.approx(1.5)
    track = fleet.track("1:1", 100 * S, 100 * S)
    assert track is not None
    assert (track.reports, track.dt_s, track.gamma, track.innovation_m) == (1, None, None, None)
    assert track.unknown_input_mps is None
    assert track.velocity_ned_mps is None
    assert track.latency_s == pytest.approx(0.25)


def test_a_second_report_is_judged_by_the_prediction_made_for_it(
    fleet: Fleet, fix: MakeFix
) -> None:
    first, second = fix(100 * S, [0, 0, 0], [10, 0, 0]), fix(101 * S, [13, 4, 0], [10, 0, 0])
    fleet.accept(first)
    found = fleet.accept(second)
    assert isinstance(found, Estimate)
    expected = observer.predict(observer.begin(first, MODEL), 101 * S, MODEL)
    assert found.position_ned_m == pytest.approx([10, 0, 0])
    assert found.bound_m == expected.bound_m
    assert found.innovation_m == pytest.approx(5.0)
    assert found.dt_s == pytest.approx(1.0)
    track = fleet.track("1:1", 101 * S, 102 * S)
    assert track is not None
    assert track.reports == 2
    assert track.dt_s == pytest.approx(1.0)
    assert track.innovation_m == pytest.approx(5.0)
    assert track.velocity_ned_mps == pytest.approx(np.array([10.0, 0, 0]))
    assert fleet.newest("1:1") is second


def test_gamma_is_that_of_the_worst_interval(fleet: Fleet, fix: MakeFix) -> None:
    """Without feedthrough and velocity mu* = b^2 / alpha: the longest interval counts."""
    for t_s in (100, 101, 104, 105):
        fleet.accept(fix(t_s * S, [0, 0, 0]))
    track = fleet.track("1:1", 105 * S, 105 * S)
    assert track is not None
    # (b^2 - (1 - a) 0) / a at b = 3, a = .5
    assert track.gamma == pytest.approx(np.sqrt(9 / 0.5))
    assert track.dt_s == pytest.approx(1.0)


@pytest.mark.parametrize("older_ns", [0, 1, S])
def test_a_report_out_of_order_is_rejected_and_changes_nothing(
    fleet: Fleet, fix: MakeFix, older_ns: int
) -> None:
    fleet.accept(fix(100 * S, [0, 0, 0]))
    newest = fix(101 * S, [1, 0, 0])
    fleet.accept(newest)
    before = fleet.track("1:1", 102 * S, 102 * S)
    late = fleet.accept(fix(101 * S - older_ns, [50, 0, 0], late_ns=3 * S))
    assert isinstance(late, Rejection)
    assert (late.reason, late.source) == (Reason.OUT_OF_ORDER, "1:1")
    assert late.t_ns == 104 * S - older_ns
    after = fleet.track("1:1", 102 * S, 102 * S)
    assert before is not None
    assert after is not None
    assert after.position_ned_m.tolist() == before.position_ned_m.tolist()
    assert (after.reports, after.latency_s) == (2, before.latency_s)
    assert fleet.newest("1:1") is newest


def test_a_restart_begins_anew(fleet: Fleet, fix: MakeFix) -> None:
    fleet.accept(fix(100 * S, [0, 0, 0]))
    fleet.accept(fix(100 * S, [0, 0, 0], uav="2:1"))
    assert fleet.uavs == ["1:1", "2:1"]
    fleet.restart("1:1")
    fleet.restart("9:1")  # never seen
    assert fleet.uavs == ["2:1"]
    assert fleet.track("1:1", 0, 0) is None
    assert fleet.newest("1:1") is None
    assert fleet.states(0, ["1:1"]) == {}
    found = fleet.accept(fix(50 * S, [7, 0, 0]))
    assert isinstance(found, Estimate)
    assert found.dt_s is None


def test_tracks_do_not_touch_one_another(fix: MakeFix) -> None:
    both, alone = Fleet(MODEL, AGES, same_time), Fleet(MODEL, AGES, same_time)
    for t_s in range(100, 110):
        made = fix(t_s * S, [t_s, 0, 0])
        both.accept(made)
        alone.accept(made)
        both.accept(fix(t_s * S + 7, [0, -t_s, 5], uav="2:1"))
    a, b = both.track("1:1", 110 * S, 110 * S), alone.track("1:1", 110 * S, 110 * S)
    assert a is not None
    assert b is not None
    assert a.position_ned_m.tolist() == b.position_ned_m.tolist()
    assert a.bound_m == b.bound_m
