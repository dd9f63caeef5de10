"""Jumps of reported attitudes: both sides stay in the bound until one of them is refuted."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.tracking.attitude_jumps import DOUBT_S, SETTLED_S, AttitudeJumps
from companion.tracking.carrier import AttitudeBounds
from companion.values import Attitude, Source

S = 1_000_000_000
BOUNDS = AttitudeBounds(math.radians(3.0), math.radians(100.0))


def facing(t_s: float, yaw_deg: float) -> tuple[int, Attitude]:
    level = Attitude(
        source=Source(5, 1),
        t_ns=round(t_s * S),
        boot_ms=round(t_s * 1000),
        roll_rad=0.0,
        pitch_rad=0.0,
        yaw_rad=math.radians(yaw_deg),
        rollspeed_radps=0.0,
        pitchspeed_radps=0.0,
        yawspeed_radps=0.0,
    )
    return round(t_s * S), level


def followed(yaws_deg: list[float], hz: float = 10.0) -> list[tuple[float, float, float | None]]:
    """Return time, what stands against each attitude (degrees), and an announced jump."""
    jumps, before, found = AttitudeJumps(), None, []
    for number, yaw_deg in enumerate(yaws_deg):
        after = facing(number / hz, yaw_deg)
        told_rad = jumps.look(before, after, BOUNDS)
        against = jumps.against
        found.append(
            (
                number / hz,
                0.0 if against is None else math.degrees(against.at(0.0)),
                None if told_rad is None else math.degrees(told_rad),
            )
        )
        before = after
    return found


@pytest.mark.parametrize("hz", [2.0, 10.0, 50.0])
def test_attitude_before_a_lasting_jump_stays_possible_for_ten_seconds(hz: float) -> None:
    """An estimator's reset may be right or wrong: reports do not tell."""
    found = followed([10.0] * round(hz) + [67.0] * round(15 * hz), hz)
    at_s = 1.0
    assert all(against == 0.0 for t_s, against, _ in found if t_s < at_s)
    doubted = [against for t_s, against, _ in found if at_s <= t_s <= at_s + DOUBT_S]
    assert doubted == pytest.approx([57.0] * len(doubted))
    assert found[-1][1] == 0.0
    told = [(t_s, told_deg) for t_s, _, told_deg in found if told_deg is not None]
    assert told == [(pytest.approx(at_s + SETTLED_S, abs=1.1 / hz), pytest.approx(57.0))]


@pytest.mark.parametrize("wrong", [1, 3])
def test_attitudes_that_return_refute_what_was_between(wrong: int) -> None:
    found = followed([10.0] * 10 + [67.0] * wrong + [10.0] * 30)
    assert [against for _, against, _ in found[10 + wrong + 1 :]] == [0.0] * 29
    assert all(told_deg is None for *_, told_deg in found)


def test_later_jumps_add_up() -> None:
    """Of three opinions the first may be the right one."""
    found = followed([0.0] * 5 + [40.0] * 20 + [80.0] * 20)
    assert found[-1][1] == pytest.approx(80.0)


def test_two_components_that_alternate_do_not_add_up() -> None:
    found = followed([0.0, 40.0] * 40)
    assert max(against for _, against, _ in found) == pytest.approx(40.0)


@given(st.lists(st.sampled_from([0.0, 0.0, 0.0, 25.0, 120.0]), min_size=2, max_size=60))
def test_every_opinion_of_the_last_seconds_is_in_the_bound(yaws_deg: list[float]) -> None:
    """Unless it lasted less than a second, and the one before it returned."""
    found = followed(yaws_deg)
    for number, (_, against, _) in enumerate(found):
        lasted = {
            yaws_deg[first]
            for first in range(number)
            if len(set(yaws_deg[first : first + 11])) == 1 and first + 11 <= number + 1
        }
        for yaw_deg in lasted:
            apart_deg = abs(math.degrees(math.remainder(
                math.radians(yaw_deg - yaws_deg[number]), math.tau)))  # fmt: skip
            assert apart_deg <= against + 1e-6
