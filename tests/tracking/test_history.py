"""Report history: reports within the window give the same state in any order of arrival."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.tracking.history import REPORTS_MAX, ReportHistory
from companion.tracking.observers.kinematic import KinematicModel, KinematicObserver, KinematicState
from companion.tracking.observers.position import PositionModel, PositionObserver
from companion.values import Fix

MakeFix = Callable[..., Fix]
S = 1_000_000_000
WINDOW_NS = 5 * S
OBSERVERS = {
    "position": PositionObserver(PositionModel(speed_max_mps=30.0, acceleration_max_mps2=8.0)),
    "kinematic": KinematicObserver(
        KinematicModel(30.0, 8.0, gain=lambda t: (0.7, 0.6 * t, 0.1, 0.8))
    ),
}
KINEMATIC = OBSERVERS["kinematic"]


def reports(fix: MakeFix, seed: int, gaps_ms: list[int], told: float = 0.8) -> list[Fix]:
    """Return ordered reports at random positions; some have a velocity."""
    rng, t_ns, made = np.random.default_rng(seed), 17 * S, []
    for gap_ms in gaps_ms:
        t_ns += gap_ms * 1_000_000
        velocity = rng.normal(0, 10, 3) if rng.uniform() < told else None
        made.append(fix(t_ns, rng.normal(0, 50, 3), velocity))
    return made


def told(observer: object, arriving: list[Fix], window_ns: int = WINDOW_NS) -> ReportHistory:
    history = ReportHistory(observer, arriving[0], window_ns)
    for fix in arriving[1:]:
        index = history.index(fix.sender_ns)
        assert index is not None
        history.insert(index, fix)
    return history


def same_state(one: object, other: object) -> bool:
    return type(one) is type(other) and all(
        np.array_equal(getattr(one, name), getattr(other, name))
        if isinstance(getattr(one, name), np.ndarray)
        else getattr(one, name) is getattr(other, name)
        or getattr(one, name) == getattr(other, name)
        for name in type(one).__annotations__
    )


@settings(max_examples=examples(150))
@given(
    seed=st.integers(0, 2**32 - 1),
    gaps_ms=st.lists(st.integers(1, 900), min_size=2, max_size=40),
    late=st.lists(st.integers(0, 4), min_size=40, max_size=40),
    name=st.sampled_from(list(OBSERVERS)),
)
def test_any_arrival_order_gives_the_same_state(
    fix: MakeFix, seed: int, gaps_ms: list[int], late: list[int], name: str
) -> None:
    """Each report may be overtaken by up to four others, always within the window."""
    in_order = reports(fix, seed, gaps_ms)
    by_arrival = sorted(range(len(in_order)), key=lambda n: n + late[n])
    shuffled = [in_order[n] for n in by_arrival]
    right, found = told(OBSERVERS[name], in_order), told(OBSERVERS[name], shuffled)
    assert [e.fix for e in found.entries] == [e.fix for e in right.entries]
    for one, other in zip(found.entries, right.entries, strict=True):
        assert same_state(one.state, other.state)
        assert (one.predicted is None) == (other.predicted is None)
        if one.predicted is not None:
            assert same_state(one.predicted, other.predicted)
    assert np.array_equal(found.accelerations([(5.0, 5)])[0], right.accelerations([(5.0, 5)])[0])
    end_ns = in_order[-1].sender_ns + S
    assert same_state(
        OBSERVERS[name].predict(found.newest.state, end_ns),
        OBSERVERS[name].predict(right.newest.state, end_ns),
    )


def test_late_report_is_estimated_from_its_predecessor(fix: MakeFix) -> None:
    """Later reports are then estimated from it."""
    first, late, last = (
        fix(0, [0, 0, 0], [1, 0, 0]),
        fix(S, [9, 0, 0], [2, 0, 0]),
        fix(2 * S, [0] * 3),
    )
    history = told(KINEMATIC, [first, last, late])
    assert [entry.fix for entry in history.entries] == [first, late, last]
    assert history.newest.fix is last
    state = KINEMATIC.begin(first)
    assert history.entries[0].predicted is None
    for entry in history.entries[1:]:
        expected = KINEMATIC.predict(state, entry.fix.sender_ns)
        assert entry.predicted is not None
        assert same_state(entry.predicted, expected)
        state = KINEMATIC.after(state, expected, entry.fix)
        assert isinstance(entry.state, KinematicState)
        assert same_state(entry.state, state)


def test_report_older_than_the_first_becomes_the_first(fix: MakeFix) -> None:
    first, earlier = fix(10 * S, [5, 0, 0]), fix(9 * S, [4, 0, 0])
    history = told(KINEMATIC, [first, earlier])
    assert [entry.fix for entry in history.entries] == [earlier, first]
    assert history.entries[0].predicted is None
    assert history.entries[1].predicted is not None


@pytest.mark.parametrize(
    ("sender_ns", "index"),
    [
        (20 * S + 1, 11), (20 * S, 10), (20 * S - 1, 10), (19 * S + S // 2, 9), (15 * S, 0),
        (15 * S - 1, None), (0, None),
    ],
)  # fmt: skip
def test_history_index_of_a_report(fix: MakeFix, sender_ns: int, index: int | None) -> None:
    """A report with the time of a stored one would replace it: its index shows that."""
    history = told(KINEMATIC, [fix(n * S // 2, [n, 0, 0]) for n in range(30, 41)])
    assert history.index(sender_ns) == index


def test_history_is_bounded_by_its_window(fix: MakeFix) -> None:
    """In order or not, the history never exceeds the window, however long the flight."""
    rng = np.random.default_rng(1)
    history = ReportHistory(KINEMATIC, fix(0, [0, 0, 0]), WINDOW_NS)
    order = sorted(range(1, 1000), key=lambda n: n + rng.uniform(0, 8))
    for number in order:
        index = history.index(number * S // 10)
        assert index is not None
        history.insert(index, fix(number * S // 10, [0, 0, 0]))
        times = [entry.fix.sender_ns for entry in history.entries]
        assert all(a < b for a, b in pairwise(times))
        assert len(times) <= 52
        assert times[0] >= times[-1] - WINDOW_NS - S // 10
    assert len(history.entries) >= 51


def test_history_of_a_fast_sender_is_bounded_by_the_number_of_reports(fix: MakeFix) -> None:
    """Reports older than all that are kept would be dropped again: they are too old."""
    step = S // 1000
    history = told(KINEMATIC, [fix(n * step, [0, 0, 0]) for n in range(0, 1200, 2)])
    assert len(history.entries) == REPORTS_MAX
    first_ns = history.entries[0].fix.sender_ns
    assert first_ns == (1198 - 2 * (REPORTS_MAX - 1)) * step
    assert history.index(first_ns - step) is None
    late = first_ns + step
    assert history.index(late) == 1
    history.insert(1, fix(late, [0, 0, 0]))
    assert [entry.fix.sender_ns for entry in history.entries[:2]] == [late, first_ns + 2 * step]
    assert len(history.entries) == REPORTS_MAX


def test_late_report_is_used_after_a_gap_longer_than_the_window(fix: MakeFix) -> None:
    """It is half a second late: the window is measured in time, not in reports."""
    before, after, late = fix(0, [0, 0, 0]), fix(7 * S, [7, 0, 0]), fix(6 * S + S // 2, [6, 0, 0])
    history = told(KINEMATIC, [before, after])
    index = history.index(late.sender_ns)
    assert index is not None
    history.insert(index, late)
    right = told(KINEMATIC, [before, late, after])
    assert same_state(history.newest.state, right.newest.state)


# --- acceleration -------------------------------------------------------------------------------


@given(
    seed=st.integers(0, 2**32 - 1), gaps_ms=st.lists(st.integers(10, 700), min_size=6, max_size=40)
)
def test_acceleration_is_the_slope_of_the_velocities(
    fix: MakeFix, seed: int, gaps_ms: list[int]
) -> None:
    """numpy.polyfit over the last five seconds, or over the last five velocities."""
    made = reports(fix, seed, gaps_ms, told=1.0)
    newest_ns = made[-1].sender_ns
    used = max(5, sum(newest_ns - one.sender_ns <= 5 * S for one in made))
    times = [(one.sender_ns - newest_ns) * 1e-9 for one in made[-used:]]
    expected = np.polyfit(times, [one.velocity_ned_mps for one in made[-used:]], 1)[0]
    found = told(KINEMATIC, made).accelerations([(5.0, 5)])[0]
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_acceleration_needs_five_consecutive_velocities(fix: MakeFix) -> None:
    made = [fix(n * S // 5, [0, 0, 0], [n, 0, -2 * n]) for n in range(6)]
    assert told(KINEMATIC, made[:4]).accelerations([(5.0, 5)])[0] is None
    assert told(KINEMATIC, made[:5]).accelerations([(5.0, 5)])[0] == pytest.approx([5, 0, -10])
    silent = fix(2 * S, [0, 0, 0])
    assert told(KINEMATIC, [*made, silent]).accelerations([(5.0, 5)])[0] is None
    hidden = [
        made[0],
        made[1],
        fix(2 * S // 5, [0, 0, 0]),
        made[3],
        *(fix(n * S // 5, [0] * 3, [1] * 3) for n in (4, 5, 6)),
    ]
    assert told(KINEMATIC, hidden).accelerations([(5.0, 5)])[0] is None
