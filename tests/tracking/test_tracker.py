"""Tracks: start, ageing, rejection and removal."""

import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest
from support import rounds

from companion.tracking.gate import GateSettings
from companion.tracking.observers.kinematic import KinematicModel, KinematicObserver
from companion.tracking.observers.position import PositionModel, PositionObserver
from companion.tracking.track_snapshot import Ages
from companion.tracking.tracker import Tracker, TrackerSettings
from companion.values import (
    Estimate,
    Fix,
    FloatArray,
    Limits,
    Reason,
    Rejection,
    ReportNoise,
    SenderTime,
    Track,
    TrackState,
)

MakeFix = Callable[..., Fix]
S = 1_000_000_000
OBSERVER = PositionObserver(PositionModel(speed_max_mps=30.0, acceleration_max_mps2=8.0, alpha=0.5))
AGES = Ages(2.0, 15.0, 60.0)
SETTINGS = TrackerSettings(limits=Limits(30.0, 8.0), ages=AGES)


def same_time(node_ns: int, bound_s: float = 0.0) -> SenderTime:
    """Return a sender time on the node timeline, known within ``bound_s``."""
    return SenderTime(node_ns=node_ns, sender_ns=node_ns, before_s=bound_s, after_s=bound_s)


@pytest.fixture
def tracker() -> Tracker:
    return Tracker(OBSERVER, SETTINGS)


@pytest.mark.parametrize(
    ("age_s", "state"),
    [
        (-1.0, "live"), (0.0, "live"), (2.0, "live"), (2.001, "coasting"), (14.999, "coasting"),
        (15.001, "stale"), (59.999, "stale"), (60.001, "lost"), (1e6, "lost"),
    ],
)  # fmt: skip
def test_track_state_follows_its_age(
    tracker: Tracker, fix: MakeFix, age_s: float, state: str
) -> None:
    tracker.accept(fix(100 * S, [0, 0, 0]))
    now_ns = 100 * S + round(age_s * 1e9)
    track = tracker.track("1:1", now_ns, same_time(now_ns + S))
    assert track is not None
    assert track.state == state
    assert tracker.state("1:1", same_time(now_ns)) is TrackState(state)
    assert tracker.state("2:1", same_time(now_ns)) is None
    # The prediction time may differ.
    assert track.age_s == pytest.approx(age_s + 1.0)


def test_first_report_of_a_track_is_its_estimate(tracker: Tracker, fix: MakeFix) -> None:
    first = tracker.accept(fix(100 * S, [1, 2, 3], late_ns=S // 4))[0]
    assert isinstance(first, Estimate)
    assert first.position_ned_m == (1, 2, 3)
    assert (first.innovation_m, first.dt_s) == (None, None)
    assert first.bound_m == pytest.approx(1.5)
    track = tracker.track("1:1", 100 * S, same_time(100 * S))
    assert track is not None
    assert (track.reports, track.dt_s, track.gamma, track.innovation_m) == (1, None, None, None)
    assert track.unknown_input_mps is None
    assert track.velocity_ned_mps is None
    assert track.latency_s == pytest.approx(0.25)


def test_second_report_is_gated_by_its_prediction(tracker: Tracker, fix: MakeFix) -> None:
    first, second = fix(100 * S, [0, 0, 0], [10, 0, 0]), fix(101 * S, [13, 4, 0], [10, 0, 0])
    tracker.accept(first)
    found = tracker.accept(second)[0]
    assert isinstance(found, Estimate)
    expected = OBSERVER.predict(OBSERVER.begin(first), 101 * S)
    assert found.position_ned_m == pytest.approx([10, 0, 0])
    assert found.bound_m == expected.bound_m
    assert found.innovation_m == pytest.approx(5.0)
    assert found.dt_s == pytest.approx(1.0)
    track = tracker.track("1:1", 101 * S, same_time(102 * S))
    assert track is not None
    assert track.reports == 2
    assert track.dt_s == pytest.approx(1.0)
    assert track.innovation_m == pytest.approx(5.0)
    assert track.velocity_ned_mps == pytest.approx(np.array([10.0, 0, 0]))
    assert track.unknown_input_mps == pytest.approx([10, 0, 0])
    assert not found.reacquired
    assert tracker.newest("1:1") is second


def test_gamma_is_that_of_the_longest_interval(tracker: Tracker, fix: MakeFix) -> None:
    """Without feedthrough and velocity mu* = b^2 / alpha: the longest interval counts."""
    for t_s in (100, 101, 104, 105):
        tracker.accept(fix(t_s * S, [0, 0, 0]))
    track = tracker.track("1:1", 105 * S, same_time(105 * S))
    assert track is not None
    # (b^2 - (1 - a) 0) / a at b = 3, a = .5
    assert track.gamma == pytest.approx(np.sqrt(9 / 0.5))
    assert track.dt_s == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("older_ns", "reason"),
    [(0, Reason.DUPLICATE), (5 * S + 1, Reason.OUT_OF_ORDER), (50 * S, Reason.OUT_OF_ORDER)],
)
def test_too_old_or_duplicate_report_is_rejected_without_effect(
    tracker: Tracker, fix: MakeFix, older_ns: int, reason: Reason
) -> None:
    tracker.accept(fix(100 * S, [0, 0, 0]))
    newest = fix(101 * S, [1, 0, 0])
    tracker.accept(newest)
    before = tracker.track("1:1", 102 * S, same_time(102 * S))
    late = tracker.accept(fix(101 * S - older_ns, [3, 0, 0], late_ns=3 * S))[0]
    assert isinstance(late, Rejection)
    assert (late.reason, late.source) == (reason, "1:1")
    assert late.t_ns == 104 * S - older_ns
    after = tracker.track("1:1", 102 * S, same_time(102 * S))
    assert before is not None
    assert after is not None
    assert after.position_ned_m.tolist() == before.position_ned_m.tolist()
    assert (after.reports, after.latency_s) == (2, before.latency_s)
    assert tracker.newest("1:1") is newest


def test_late_report_is_inserted_in_order(fix: MakeFix) -> None:
    """The resulting state equals that of a timely report."""
    made = [fix(n * S, [10 * n, n * n, 0], [10, 2 * n, 0], late_ns=S // 8) for n in range(100, 106)]
    one, other = Tracker(OBSERVER, SETTINGS), Tracker(OBSERVER, SETTINGS)
    for n in range(6):
        assert isinstance(one.accept(made[n])[0], Estimate)
    for n in (0, 1, 3, 2, 5):
        assert isinstance(other.accept(made[n])[0], Estimate)
    late, _ = other.accept(made[4])
    assert isinstance(late, Estimate)
    assert late.fix is made[4]
    assert (late.dt_s, late.reacquired) == (1.0, False)
    a, b = (
        one.track("1:1", 106 * S, same_time(107 * S)),
        other.track("1:1", 106 * S, same_time(107 * S)),
    )
    assert a is not None
    assert b is not None
    for name in ("position_ned_m", "velocity_ned_mps", "unknown_input_mps"):
        assert getattr(a, name).tolist() == getattr(b, name).tolist()
    assert (a.bound_m, a.dt_s, a.innovation_m, a.reports, a.age_s, a.latency_s) == (
        b.bound_m, b.dt_s, b.innovation_m, b.reports, b.age_s, b.latency_s
    )  # fmt: skip


def test_restart_removes_the_track(tracker: Tracker, fix: MakeFix) -> None:
    tracker.accept(fix(100 * S, [0, 0, 0]))
    tracker.accept(fix(100 * S, [0, 0, 0], uav="2:1"))
    assert tracker.uavs == ["1:1", "2:1"]
    tracker.forget("1:1")
    tracker.forget("9:1")  # unknown
    assert tracker.uavs == ["2:1"]
    assert tracker.track("1:1", 0, same_time(0)) is None
    assert tracker.newest("1:1") is None
    assert tracker.state("1:1", same_time(0)) is None
    found = tracker.accept(fix(50 * S, [7, 0, 0]))[0]
    assert isinstance(found, Estimate)
    assert found.dt_s is None


def test_tracks_are_independent(fix: MakeFix) -> None:
    both, alone = Tracker(OBSERVER, SETTINGS), Tracker(OBSERVER, SETTINGS)
    for t_s in range(100, 110):
        made = fix(t_s * S, [t_s, 0, 0])
        both.accept(made)
        alone.accept(made)
        both.accept(fix(t_s * S + 7, [0, -t_s, 5], uav="2:1"))
    a, b = (
        both.track("1:1", 110 * S, same_time(110 * S)),
        alone.track("1:1", 110 * S, same_time(110 * S)),
    )
    assert a is not None
    assert b is not None
    assert a.position_ned_m.tolist() == b.position_ned_m.tolist()
    assert a.bound_m == b.bound_m


# --- impossible reports -------------------------------------------------------------------------

KINEMATIC = KinematicObserver(KinematicModel(30.0, 5.0))
NOISE = ReportNoise(
    horizontal_m=2.0, vertical_m=2.0, position_m=math.hypot(2.0, 2.0), velocity_mps=0.4
)
CRUISE_MPS = 12.0


def tracking(feed_mps2: float | None = None, ages: Ages = AGES, **gate: float) -> Tracker:
    limits = Limits(30.0, feed_mps2 or 5.0)
    given = TrackerSettings(
        limits=limits, ages=ages, gate=GateSettings(**gate), feed_forward=feed_mps2 is not None
    )
    return Tracker(KINEMATIC, given)


def circling(t_s: float, radius_m: float = 60.0) -> tuple[FloatArray, FloatArray]:
    """Return position and velocity of level flight in a circle at 12 m/s: 2.4 m/s^2."""
    turned = CRUISE_MPS / radius_m * t_s
    ahead = np.array([-math.sin(turned), math.cos(turned), 0.0])
    side = np.array([math.cos(turned), math.sin(turned), 0.0])
    return radius_m * side - np.array([0, 0, 100.0]), CRUISE_MPS * ahead


Shift = Callable[[float], tuple[float, float, float]]


def flight(
    fix: MakeFix, times_s: Iterable[float], shift: Shift = lambda _: (0, 0, 0), seed: int = 0
) -> list[Fix]:
    """Return reports of the circle, with noise within its bounds, displaced by ``shift``."""
    rng, made = np.random.default_rng(seed), []
    for t_s in times_s:
        position, velocity = circling(t_s)
        angle, height = rng.uniform(0, 2 * math.pi), rng.uniform(-2, 2)
        wrong = np.array([2 * math.cos(angle), 2 * math.sin(angle), height]) * 0.99
        told = velocity + 0.2 * rng.uniform(-1, 1, 3)
        place = position + wrong + np.array(shift(t_s))
        made.append(fix(round(t_s * S), place, told, noise=NOISE))
    return made


def seen(tracker: Tracker, t_s: float, doubt_s: float = 0.0) -> Track:
    found = tracker.track("1:1", round(t_s * S), same_time(round(t_s * S), doubt_s))
    assert found is not None
    return found


def holds(track: Track, truth: FloatArray) -> float:
    """Check that the truth is in the cylinder, and return the position error."""
    off = track.position_ned_m - truth
    assert math.hypot(off[0], off[1]) <= track.horizontal_bound_m + 1e-6
    assert abs(off[2]) <= track.vertical_bound_m + 1e-6
    assert math.sqrt(off @ off) <= track.bound_m + 1e-6
    return math.sqrt(off @ off)


def reasons(outcomes: Iterable[Estimate | Rejection]) -> Counter[Reason | None]:
    return Counter(one.reason if isinstance(one, Rejection) else None for one in outcomes)


def every(interval_s: float, start_s: float, end_s: float) -> list[float]:
    return [start_s + interval_s * n for n in range(round((end_s - start_s) / interval_s))]


def test_single_outlier_is_rejected_and_does_not_affect_the_gate(fix: MakeFix) -> None:
    """The following good reports are far from the outlier and near the last accepted report."""
    tracker = tracking()
    made = flight(
        fix, every(0.2, 0, 30), lambda t_s: (500, 0, 0) if abs(t_s - 10) < 0.05 else (0, 0, 0)
    )
    outcomes = [tracker.accept(one)[0] for one in made]
    assert reasons(outcomes) == {None: 149, Reason.UNREACHABLE: 1}
    refused = outcomes[50]
    assert isinstance(refused, Rejection)
    assert (refused.t_ns, refused.source) == (10 * S, "1:1")
    assert "m from the prediction, at most" in refused.detail


def test_short_glitch_is_rejected_throughout(fix: MakeFix) -> None:
    """25 m to the north for 0.8 s: none of it is used, and the bounds hold."""
    tracker = tracking()
    for one in flight(
        fix, every(0.2, 0, 40), lambda t_s: (25, 0, 0) if 9.9 < t_s < 10.7 else (0, 0, 0)
    ):
        t_s = one.sender_ns * 1e-9
        outcome = tracker.accept(one)[0]
        glitch = 9.9 < t_s < 10.7
        assert isinstance(outcome, Rejection if glitch else Estimate)
        if isinstance(outcome, Estimate):
            assert not outcome.reacquired
        for later_s in (0.0, 0.1):
            holds(seen(tracker, t_s + later_s), circling(t_s + later_s)[0])
    assert seen(tracker, 40).reports == 196


def test_lasting_jump_reacquires_the_track_once(fix: MakeFix) -> None:
    """Rejected until it is confirmed; then the track restarts from it."""
    tracker = tracking()
    jumped = flight(fix, every(0.2, 0, 40), lambda t_s: (25, 0, 0) if t_s > 9.9 else (0, 0, 0))
    outcomes = [tracker.accept(one)[0] for one in jumped]
    again = [n for n, one in enumerate(outcomes) if isinstance(one, Estimate) and one.reacquired]
    refused = [n for n, one in enumerate(outcomes) if isinstance(one, Rejection)]
    assert len(again) == 1
    assert 10.99 <= jumped[again[0]].sender_ns * 1e-9 <= 11.3
    assert refused == list(range(50, again[0]))
    assert {outcomes[n].reason for n in refused} == {Reason.UNREACHABLE}
    assert isinstance(outcomes[again[0]], Estimate)
    assert outcomes[again[0]].fix is jumped[again[0]]
    assert tracker.newest("1:1") is jumped[-1]
    track = seen(tracker, 40)
    assert track.reports == 200  # the rejected reports count: the track starts with them
    holds(track, circling(40)[0] + np.array([25, 0, 0]))


@pytest.mark.parametrize("rate_hz", [5, 10, 25, 50])
def test_jump_is_reacquired_at_any_report_rate(fix: MakeFix, rate_hz: int) -> None:
    tracker = tracking()
    times_s = every(1 / rate_hz, 0, 10)
    jumped = flight(fix, times_s, lambda t_s: (400, 0, 0) if t_s > 4.99 else (0, 0, 0))
    outcomes = [tracker.accept(one)[0] for one in jumped]
    assert sum(isinstance(one, Estimate) and one.reacquired for one in outcomes) == 1


def test_height_datum_change_is_rejected_as_altitude_jump(fix: MakeFix) -> None:
    tracker = tracking()
    made = flight(fix, every(0.2, 0, 20), lambda t_s: (0, 0, -40) if t_s > 9.9 else (0, 0, 0))
    found = reasons(tracker.accept(one)[0] for one in made)
    assert set(found) == {None, Reason.ALTITUDE_JUMP}
    assert 4 <= found[Reason.ALTITUDE_JUMP] <= 6
    holds(seen(tracker, 20), circling(20)[0] - np.array([0, 0, 40.0]))


def test_repeated_positions_are_rejected_as_frozen(fix: MakeFix) -> None:
    """Fresh stamps and velocities with old positions for three seconds, then normal flight."""
    tracker, outcomes = tracking(), []
    made = flight(fix, every(0.2, 0, 20))
    for number, one in enumerate(made):
        frozen = 50 <= number < 65
        place = made[49] if frozen else one
        told = one._replace(position_ned_m=place.position_ned_m, report=place.report)
        outcomes.append(tracker.accept(told)[0])
        holds(seen(tracker, number / 5 + 0.1), circling(number / 5 + 0.1)[0])
    assert reasons(outcomes) == {None: 85, Reason.FROZEN: 15}
    assert all(isinstance(one, Rejection) for one in outcomes[50:65])


def test_repeated_position_after_reacquisition_is_rejected_as_frozen(fix: MakeFix) -> None:
    tracker = tracking()
    for one in flight(fix, every(0.2, 0, 20), lambda t_s: (400, 0, 0) if t_s > 9.9 else (0, 0, 0)):
        outcome = tracker.accept(one)[0]
        if isinstance(outcome, Estimate) and outcome.reacquired:
            break
    again = tracker.accept(one._replace(sender_ns=one.sender_ns + S // 5))[0]
    assert isinstance(again, Rejection)
    assert again.reason is Reason.FROZEN


def two_under_one_id(fix: MakeFix, end_s: float) -> list[Fix]:
    """Return five reports per second of each of two vehicles, 2 km apart: too far to be forgotten
    soon."""
    here = flight(fix, every(0.2, 0, end_s))
    there = flight(fix, every(0.2, 0.1, end_s + 0.1), lambda _: (0, 2000, 0), seed=1)
    return sorted(here + there, key=lambda one: one.sender_ns)


def test_duplicate_id_is_reported(fix: MakeFix) -> None:
    """First the second vehicle's reports are rejected, then, while both continue, those of both."""
    tracker = tracking()
    outcomes = [tracker.accept(one)[0] for one in two_under_one_id(fix, 5.9)]
    early = reasons(outcomes[:30])
    assert early == {None: 15, Reason.UNREACHABLE: 15}
    late = reasons(outcomes[34:])
    assert set(late) == {Reason.SHARED_ID, Reason.UNREACHABLE}
    assert late[Reason.SHARED_ID] >= 10


def test_track_does_not_jump_between_vehicles_of_one_id(fix: MakeFix) -> None:
    """While both continue, the track does not jump from one to the other."""
    tracker = tracking()
    outcomes = [tracker.accept(one)[0] for one in two_under_one_id(fix, 20)]
    assert not any(isinstance(one, Estimate) and one.reacquired for one in outcomes)


def test_track_coasts_over_a_gap(fix: MakeFix) -> None:
    """12 s without a report: the bound grows and holds; the first report after it is accepted."""
    tracker = tracking()
    for one in flight(fix, every(0.2, 0, 10)):
        assert isinstance(tracker.accept(one)[0], Estimate)
    bounds = []
    for t_s in every(0.5, 10, 22):
        track = seen(tracker, t_s)
        holds(track, circling(t_s)[0])
        bounds.append(track.horizontal_bound_m)
        assert track.state is (TrackState.LIVE if t_s < 11.9 else TrackState.COASTING)
    assert bounds == sorted(bounds)
    assert bounds[-1] > 20 * bounds[0]
    after = flight(fix, every(0.2, 22, 25))
    assert reasons(tracker.accept(one)[0] for one in after) == {None: 15}
    track = seen(tracker, 25)
    assert track.state is TrackState.LIVE
    holds(track, circling(25)[0])
    assert track.horizontal_bound_m < 5.0


@pytest.mark.parametrize(("gap_s", "anew"), [(59.9, False), (60.1, True)])
def test_lost_track_restarts_at_the_next_report(fix: MakeFix, gap_s: float, anew: bool) -> None:
    """Wherever it reappears: the old track is no longer compared."""
    tracker = tracking()
    tracker.accept(fix(0, [0, 0, 0], [0, 0, 0]))
    found = tracker.accept(fix(round(gap_s * S), [20_000, 0, 0], [0, 0, 0]))[0]
    assert isinstance(found, Estimate if anew else Rejection)
    if isinstance(found, Estimate):
        assert (found.dt_s, found.reacquired) == (None, False)
        assert seen(tracker, gap_s).reports == 1


# --- additions to the observer ------------------------------------------------------------------


def errors_m(fix: MakeFix, feed_mps2: float | None, ahead_s: float) -> float:
    """Return the mean error over a circle, ``ahead_s`` past the newest report."""
    tracker, off = tracking(feed_mps2), []
    for one in flight(fix, every(0.2, 0, 60)):
        assert isinstance(tracker.accept(one)[0], Estimate)
        t_s = one.sender_ns * 1e-9 + ahead_s
        if one.sender_ns > 5 * S:
            off.append(holds(seen(tracker, t_s), circling(t_s)[0]))
    return float(np.mean(off))


def test_acceleration_feedforward_reduces_error_in_a_turn(fix: MakeFix) -> None:
    """Two seconds ahead, 2.4 m/s^2 are 4.8 m. Noise is smoothed as well."""
    assert errors_m(fix, 5.0, 2.0) < 0.6 * errors_m(fix, None, 2.0)
    assert errors_m(fix, 5.0, 0.0) < 0.6 * errors_m(fix, None, 0.0)


def test_feedforward_displacement_is_included_in_the_bound(fix: MakeFix) -> None:
    """It moves the estimate, and the bound grows by the full displacement in that direction."""
    plain, fed = tracking(), tracking(5.0)
    for n in range(31):
        t_s = n / 5
        one = fix(n * S // 5, [t_s * t_s, 0, 0], [2 * t_s, 0, 0], noise=NOISE)  # 2 m/s^2
        plain.accept(one)
        fed.accept(one)
    for ahead_s in (0.0, 0.1, 1.0, 3.0):
        a, b = seen(plain, 6 + ahead_s), seen(fed, 6 + ahead_s)
        assert a.acceleration_ned_mps2 is None
        assert b.acceleration_ned_mps2 == pytest.approx([2, 0, 0])
        way_m = (b.position_ned_m - a.position_ned_m)[0]
        assert 0.8 * ahead_s**2 <= way_m <= ahead_s**2
        assert b.horizontal_bound_m - a.horizontal_bound_m == pytest.approx(way_m)
        assert b.vertical_bound_m == a.vertical_bound_m
        assert b.bound_m > a.bound_m or ahead_s == 0.0
    earlier = seen(fed, 5.5)
    assert earlier.position_ned_m.tolist() == seen(plain, 5.5).position_ned_m.tolist()


def test_feedforward_acceleration_is_limited(fix: MakeFix) -> None:
    """Such noisy velocities refute nothing and raise no limit."""
    tracker, noise = tracking(3.0), NOISE._replace(velocity_mps=20.0)
    for n in range(31):  # 5 m/s^2
        t_s = n / 5
        place = [0, 1.5 * t_s * t_s, 2.0 * t_s * t_s]
        tracker.accept(fix(n * S // 5, place, [0, 3.0 * t_s, 4.0 * t_s], noise=noise))
    assert seen(tracker, 6).acceleration_ned_mps2 == pytest.approx([0, 1.8, 2.4])


@pytest.mark.parametrize("doubt_s", [0.0, 0.4])
def test_adversaries_stay_within_the_published_track_bounds(fix: MakeFix, doubt_s: float) -> None:
    """Alternating accelerations, full noise, a clock error: no report is rejected, and the truth
    stays within the bounds."""
    for seed in range(rounds(40, 150)):
        rng = np.random.default_rng(seed)
        tracker = tracking(5.0)
        position, velocity, t_s = np.zeros(3), rng.normal(0, 5, 3), 0.0
        for _ in range(25):
            plane, fast = rng.normal(0, 1, 2), rng.normal(0, 1, 3)
            plane, fast = plane * 2 / math.hypot(*plane), fast * 0.4 / math.hypot(*fast)
            wrong = np.array([*plane, 2 * rng.choice([-1, 1])]) * (1 - 1e-9)
            made = fix(round(t_s * S), position + wrong, velocity + fast, noise=NOISE)
            assert isinstance(tracker.accept(made)[0], Estimate)
            step_s = round(float(10 ** rng.uniform(-1.5, 0.5)), 9)
            push = (
                rng.normal(0, 1, 3) if seed % 2 else rng.choice([-1, 1]) * np.array([0, 0.6, 0.8])
            )
            if float((velocity + push) @ velocity) > 20**2:
                push = -velocity
            push = push * 5.0 / math.hypot(*push)
            for ahead_s in (0.0, rng.uniform(0, step_s), step_s):
                off_s = rng.choice([-1, 1]) * min(doubt_s, ahead_s, step_s - ahead_s)
                true_s = ahead_s + off_s
                truth = position + velocity * true_s + push * true_s**2 / 2
                holds(seen(tracker, t_s + ahead_s, doubt_s), truth)
            position = position + velocity * step_s + push * step_s**2 / 2
            velocity, t_s = velocity + push * step_s, round(t_s + step_s, 9)


def test_clock_uncertainty_adds_distance_flown(fix: MakeFix) -> None:
    tracker = tracking()
    tracker.accept(fix(0, [0, 0, 0], [10, 0, 0], noise=NOISE))
    a, b = seen(tracker, 1), seen(tracker, 1, doubt_s=0.5)
    assert (a.clock_bound_s, b.clock_bound_s) == (0.0, 0.5)
    # At the later end: 10 m/s reported, 0.4 m/s of noise, and the acceleration since.
    widened_m = 0.5 * (10 + 0.4) + 5.0 * (1.5**2 - 1) / 2
    assert b.bound_m - a.bound_m == pytest.approx(widened_m)
    assert b.horizontal_bound_m - a.horizontal_bound_m == pytest.approx(widened_m)
    # The path is level: only its unknown part may be vertical.
    assert b.vertical_bound_m - a.vertical_bound_m == pytest.approx(widened_m - 0.5 * 10)
    a, b = seen(tracker, 40), seen(tracker, 40, doubt_s=0.5)
    assert b.horizontal_bound_m - a.horizontal_bound_m == pytest.approx(0.5 * 30.0)


def test_clock_uncertainty_covers_acceleration(fix: MakeFix) -> None:
    """At full acceleration and a clock one second early: 2.5 m beyond the path at constant
    speed.
    """
    tracker = tracking()
    tracker.accept(
        fix(0, [0, 0, 0], [0, 0, 0], noise=NOISE._replace(horizontal_m=1e-6, velocity_mps=1e-6))
    )[0]
    for ahead_s in (0.0, 0.5, 2.0):
        true_s = ahead_s + 1.0
        holds(seen(tracker, ahead_s, doubt_s=1.0), np.array([5.0 * true_s**2 / 2, 0, 0]))


def test_clock_uncertainty_covers_a_change_of_acceleration(fix: MakeFix) -> None:
    """It brakes at 4 m/s^2, which is fed forward, and accelerates at 5 m/s^2 after the last report.
    The prediction for 3.0 s must still hold at 3.4 s."""
    tracker, exact = tracking(5.0), NOISE._replace(horizontal_m=1e-6, velocity_mps=1e-6)
    for n in range(11):
        t_s = 0.2 * n
        place = [20 * t_s - 2 * t_s**2, 0, 0]
        tracker.accept(fix(n * S // 5, place, [20 - 4 * t_s, 0, 0], noise=exact))
    for ahead_s in (0.0, 1.0, 3.0):
        true_s = ahead_s + 0.4
        truth = np.array([32 + 12 * true_s + 5.0 * true_s**2 / 2, 0, 0])
        holds(seen(tracker, 2 + ahead_s, doubt_s=0.4), truth)


def test_nearby_uavs_are_found_by_their_newest_reports(fix: MakeFix) -> None:
    """Distance in three dimensions: 60 m east and 80 m up are 100 m."""
    tracker = tracking()
    tracker.accept(fix(0, [900, 0, 0], uav="1:1"))
    tracker.accept(fix(0, [1000, 60, -80], uav="2:1"))
    tracker.accept(fix(0, [4000, 0, 0], uav="3:1"))
    place = np.array([1000.0, 0, 0])
    assert tracker.near(place, 99.9, better_than="cot:A") == []
    assert tracker.near(place, 100.1, better_than="cot:A") == ["1:1", "2:1"]
    assert tracker.near(place, 3001.0, better_than="cot:A") == ["1:1", "2:1", "3:1"]
    tracker.accept(fix(10 * S, [700, 0, 0], uav="1:1"))
    assert tracker.near(place, 150.0, better_than="cot:A") == ["2:1"]
    tracker.forget("2:1")
    assert tracker.near(place, 150.0, better_than="cot:A") == []
    tracker.accept(fix(0, [1000, 0, 0], uav="4:1"))
    assert tracker.near(place, 150.0, better_than="cot:A") == ["4:1"]


def test_late_report_does_not_move_a_nearby_uav(fix: MakeFix) -> None:
    tracker = tracking()
    tracker.accept(fix(2 * S, [1000, 0, 0]))
    tracker.accept(fix(S, [990, 0, 0]))
    assert tracker.near(np.array([1000.0, 0, 0]), 5.0, better_than="cot:A") == ["1:1"]


def test_nearby_uavs_are_limited_to_kinds_with_a_better_identification(fix: MakeFix) -> None:
    tracker, place = tracking(), np.array([0.0, 0, 0])
    ids = ["cot:A", "icao:4CA7B3", "rid:X", "1:1"]
    for uav in ids + [f"icao:{number:06X}" for number in range(200)]:
        tracker.accept(fix(0, [5000 if uav.startswith("icao:0") else 1, 0, 0], uav=uav))
    assert sorted(tracker.near(place, 9.0, better_than="cot:B")) == sorted(ids[1:])
    assert sorted(tracker.near(place, 9.0, better_than="icao:0")) == ["1:1", "rid:X"]
    assert tracker.near(place, 9.0, better_than="rid:Y") == ["1:1"]
    assert tracker.near(place, 9.0, better_than="2:1") == []


def test_clock_uncertainty_without_velocity_uses_the_speed_limit(fix: MakeFix) -> None:
    tracker = Tracker(OBSERVER, SETTINGS)
    tracker.accept(fix(0, [0, 0, 0]))
    a, b = seen(tracker, 1), seen(tracker, 1, doubt_s=0.5)
    assert b.bound_m - a.bound_m == pytest.approx(0.5 * 30.0)


def test_error_p95_does_not_exceed_the_bound(fix: MakeFix) -> None:
    """The usual clock error was larger than its present bound."""
    tracker = Tracker(KinematicObserver(KinematicModel(30.0, 8.0)), SETTINGS)
    for t_s in range(100, 130):
        tracker.accept(fix(t_s * S, [20 * t_s, 0, 0], [20, 0, 0]))
    for usual_s, is_less in ((0.01, True), (5.0, False)):
        at = replace(same_time(129 * S + S // 10, 0.02), usual_s=usual_s)
        track = tracker.track("1:1", at.node_ns, at)
        assert track is not None
        assert track.error_p95_m is not None
        assert (track.error_p95_m < track.bound_m) is is_less
        assert track.error_p95_m <= track.bound_m
