"""Stamps of positions in microseconds, as Betaflight sends them, are found by their steps."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from companion.mavlink.clock.stamp_unit import CONFIRMED, StampUnit

S = 1_000_000_000
WRAP = 1 << 32


def unexplained(
    steps_s: list[float], per_s: int, unit: StampUnit, explained_each: int = 0
) -> list[bool]:
    """Note stamps without a time, so far apart; return at which of them the unit changed."""
    found, t_s, begun = list[bool](), 0.0, WRAP - 12_345  # it wraps around soon
    for number, step_s in enumerate(steps_s):
        t_s += step_s
        if explained_each and number % explained_each == 0:
            unit.milliseconds(round(t_s * 1000))
        unit.milliseconds((begun + round(t_s * per_s)) % WRAP)
        found.append(unit.note_unexplained(round(t_s * S)))
    return found


@given(steps_s=st.lists(st.floats(0.03, 5.0), min_size=20, max_size=20))
def test_steps_in_microseconds_change_the_unit_once(steps_s: list[float]) -> None:
    assert sum(unexplained(steps_s, 1_000_000, StampUnit(0))) == 1


@given(
    steps_s=st.lists(st.floats(0.03, 5.0), min_size=20, max_size=20),
    per_s=st.sampled_from([0, 1, 1000, 10_000, 100_000, 10_000_000]),
)
def test_other_steps_do_not(steps_s: list[float], per_s: int) -> None:
    """Milliseconds that jumped, a clock that stands still, and units that nobody sends."""
    assert not any(unexplained(steps_s, per_s, StampUnit(0)))


def test_steps_do_not_count_beside_stamps_in_the_present_unit() -> None:
    """Else anybody who knows an id could change the unit of its vehicle."""
    assert not any(unexplained([0.1] * 50, 1_000_000, StampUnit(0), CONFIRMED))
    assert any(unexplained([0.1] * 50, 1_000_000, StampUnit(0), CONFIRMED + 2))


def test_unit_changes_back() -> None:
    """As after a firmware that was updated, or a stranger in a gap of the radio."""
    unit = StampUnit(0)
    assert any(unexplained([0.1] * 10, 1_000_000, unit)) and unit.is_microseconds
    assert any(unexplained([0.1] * 10, 1_000, unit)) and not unit.is_microseconds
    assert unit.milliseconds(123) == 123


def test_milliseconds_go_on_where_microseconds_wrap_around() -> None:
    """They do after 71.6 min, milliseconds only after 49.7 days."""
    unit = StampUnit(0)
    unexplained([0.1] * (CONFIRMED + 1), 1_000_000, unit)
    assert unit.is_microseconds
    for stamp in (WRAP // 3, 2 * WRAP // 3):
        unit.milliseconds(stamp)
    first_us = WRAP - 1_000_000
    converted = [unit.milliseconds((first_us + 200_000 * n) % WRAP) for n in range(11)]
    assert converted[0] == first_us // 1000
    assert {after - before for before, after in pairwise(converted)} == {200}


def test_late_stamp_is_before_the_newest() -> None:
    unit = StampUnit(0)
    unexplained([0.1] * (CONFIRMED + 1), 1_000_000, unit)
    assert unit.milliseconds(900_000_000) == 900_000
    assert unit.milliseconds(899_500_000) == 899_500
