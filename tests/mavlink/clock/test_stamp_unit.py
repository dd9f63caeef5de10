"""Stamps of positions in microseconds, as Betaflight sends them, are found by their steps."""

import math
from collections.abc import Callable
from itertools import accumulate, pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.mavlink.clock.stamp_unit import CONFIRMED, LASTS_NS, StampUnit

S = 1_000_000_000
WRAP = 1 << 32
BEGUN = WRAP - 12_345  # it wraps around soon
STEPS_S = st.lists(st.floats(0.05, 3.0), min_size=40, max_size=40)


def unexplained(
    times_s: list[float],
    per_s: int,
    unit: StampUnit,
    *,
    explained_each: int = 0,
    late_s: Callable[[float], float] = lambda _: 0.0,
) -> list[bool]:
    """Note stamps of these times that have no time; return whether the unit changed."""
    found = []
    for number, t_s in enumerate(times_s):
        arrival_ns = round((t_s + late_s(t_s)) * S)
        if explained_each and number % explained_each == 0:
            unit.milliseconds(arrival_ns, round(t_s * 1000), None)
        unit.milliseconds(arrival_ns, (BEGUN + round(t_s * per_s)) % WRAP, None)
        found.append(unit.note_unexplained(arrival_ns))
    return found


def regular(count: int, step_s: float = 0.1) -> list[float]:
    return [step_s * n for n in range(1, count + 1)]


def in_microseconds() -> StampUnit:
    """Return a unit that changed at the arrival 3 s, after a stamp near the wrap."""
    unit = StampUnit(0)
    unexplained(regular(30), 1_000_000, unit)
    assert unit.is_microseconds
    return unit


@given(steps_s=STEPS_S)
def test_steps_in_microseconds_change_the_unit(steps_s: list[float]) -> None:
    """It does not change back at the next ones."""
    unit = StampUnit(0)
    changes = unexplained(list(accumulate(steps_s)), 1_000_000, unit)
    assert changes.count(True) == 1
    assert unit.is_microseconds


@given(steps_s=STEPS_S, per_s=st.sampled_from([0, 1, 1000, 10_000, 100_000, 10_000_000]))
def test_other_steps_do_not(steps_s: list[float], per_s: int) -> None:
    """Milliseconds that jumped, a clock that stands still, and units that nobody sends."""
    assert not any(unexplained(list(accumulate(steps_s)), per_s, StampUnit(0)))


@pytest.mark.parametrize("bunch", [2, 3, 5, 8])
def test_radio_may_deliver_in_bunches(bunch: int) -> None:
    """All of a bunch arrive when its last one was made."""
    period_s = bunch / 10

    def late_s(t_s: float) -> float:
        return math.ceil(round(t_s / period_s, 6)) * period_s - t_s + (t_s % period_s) * 0.01

    found = unexplained(regular(60), 1_000_000, StampUnit(0), late_s=late_s)
    assert any(found[:30])


def test_steps_do_not_count_beside_stamps_in_the_present_unit() -> None:
    """Else anybody who knows an id could change the unit of its vehicle."""
    assert not any(unexplained(regular(50), 1_000_000, StampUnit(0), explained_each=CONFIRMED))
    lasts = LASTS_NS // (S // 10)
    assert any(unexplained(regular(50), 1_000_000, StampUnit(0), explained_each=lasts + 5))


def test_unit_changes_back() -> None:
    """As after a firmware that was updated, or a stranger in a gap of the radio."""
    unit = in_microseconds()
    assert any(unexplained([3.0 + t_s for t_s in regular(30)], 1_000, unit))
    assert not unit.is_microseconds
    assert unit.milliseconds(7 * S, 123, None) == 123


@pytest.mark.parametrize("gap_s", [0.2, 60.0, 1800.0, 2300.0, 3000.0, 9000.0])
def test_milliseconds_go_on_where_microseconds_wrap_around(gap_s: float) -> None:
    """They do after 71.6 min, milliseconds only after 49.7 days; also in a gap of the radio."""
    unit, made_us = in_microseconds(), BEGUN + 3_000_000
    before = unit.milliseconds(3 * S, made_us % WRAP, None)
    after_us = made_us + round(gap_s * 1e6)
    after = unit.milliseconds(round((3.0 + gap_s) * S), after_us % WRAP, None)
    assert after - before == pytest.approx(gap_s * 1000, abs=1)


def test_late_stamp_is_before_the_newest() -> None:
    unit = in_microseconds()
    made = [900_000_000, 900_200_000, 899_700_000, 900_400_000]
    arrivals = (900 * S, 900 * S + S // 5, 900 * S + S // 4, 900 * S + 2 * S // 5)
    found = [unit.milliseconds(at, us, None) for at, us in zip(arrivals, made, strict=True)]
    assert [after - before for before, after in pairwise(found)] == [200, -500, 700]


def test_other_stamps_show_how_often_microseconds_have_wrapped_around() -> None:
    """A service that starts hours after the vehicle; its attitudes count milliseconds."""
    unit, boot_s = in_microseconds(), 3 * WRAP / 1e6 + 500.0
    stamp = round(boot_s * 1e6) % WRAP
    assert unit.milliseconds(4 * S, stamp, (4 * S - S // 10, round((boot_s - 0.1) * 1e3))) == (
        pytest.approx(boot_s * 1000, abs=1)
    )
