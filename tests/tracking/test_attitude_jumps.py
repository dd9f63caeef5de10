"""Jumps of reported attitudes: both sides stay in the bound until one of them is refuted."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from companion.tracking.attitude_jumps import (
    ANNOUNCED_EVERY_S,
    DOUBT_S,
    OPINIONS_MAX,
    SETTLED_S,
    AttitudeJumps,
)
from companion.tracking.carrier import AttitudeBounds, agreement_rad
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


@pytest.mark.parametrize("each_s", [1.1, 2.0, 8.0])
def test_estimator_that_goes_back_and_forth_has_two_opinions(each_s: float) -> None:
    """They do not add up, and are announced once a minute."""
    each = round(10 * each_s)
    found = followed(([0.0] * each + [20.0] * each) * (600 // each))
    assert max(against for _, against, _ in found) == pytest.approx(20.0)
    told_deg = [angle for *_, angle in found if angle is not None]
    assert told_deg == pytest.approx([20.0] * len(told_deg))
    assert len(told_deg) == found[-1][0] // ANNOUNCED_EVERY_S + 1


def test_what_is_between_returns_again_and_again_is_no_outlier() -> None:
    """Half a second each: either may be right."""
    found = followed(([0.0] * 5 + [20.0] * 5) * 10)
    assert [against for _, against, _ in found[15:]] == pytest.approx([20.0] * 85)


def test_three_opinions_in_turn_all_stay_possible() -> None:
    found = followed(([0.0] * 3 + [40.0] * 3 + [80.0] * 3) * 30)
    assert min(against for t_s, against, _ in found if t_s > 2.0) >= 39.9


@pytest.mark.parametrize("forged", [9, 10])
def test_rates_that_lead_back_do_not_hide_a_jump(forged: int) -> None:
    jumps, before = AttitudeJumps(), None
    for number in range(100):
        t_ns, attitude = facing(number / 10, 0.0 if number < 10 else 60.0)
        if number == forged:
            attitude = attitude._replace(yawspeed_radps=math.radians(600.0))
        jumps.look(before, (t_ns, attitude), BOUNDS)
        before = t_ns, attitude
        assert number < 10 or (jumps.against and jumps.against.at(0.0) >= math.radians(60.0))


@pytest.mark.parametrize("dwell", [2, 5, 12])
def test_opinions_that_drift_do_not_hide_the_first(dwell: int) -> None:
    """Each return is near the one before, but further and further from the truth."""
    steps = [0.0] * 20
    for number in range(1, 8):
        steps += [35.0 + 5.0 * number] * dwell + [5.0 * number] * dwell
    for t_s, against, _ in followed(steps)[20 + 4 * dwell :]:
        if t_s < 2.0 + DOUBT_S - 0.1:
            limit = math.degrees(agreement_rad(0.1, BOUNDS))
            assert steps[round(10 * t_s)] <= against + limit


def test_flapping_is_announced_by_its_angle() -> None:
    for dwell in (1, 3, 6, 9):
        found = followed([0.0] * 20 + ([40.0] * dwell + [0.0] * dwell) * (150 // dwell))
        told = [angle for *_, angle in found if angle is not None]
        assert told == [pytest.approx(40.0)], dwell


def test_estimator_of_many_opinions_knows_nothing() -> None:
    steps = [10.0 * number for number in range(OPINIONS_MAX + 3)]
    found = followed([*steps, *[steps[-1]] * 120])
    assert [against for t_s, against, _ in found if 1.5 <= t_s <= DOUBT_S] == [180.0] * 86
    assert found[-1][1] == 0.0


def test_larger_jump_soon_after_another_is_announced_too() -> None:
    found = followed([0.0] * 10 + [20.0] * 150 + [110.0] * 50)
    told = [(t_s, angle) for t_s, _, angle in found if angle is not None]
    assert told == [(2.0, pytest.approx(20.0)), (17.0, pytest.approx(90.0))]


def turned(t_s: float, offset: Rotation, rates: tuple[float, float, float]) -> Attitude:
    """Return an attitude of an estimator that is off by a rotation, on a steadily turning body."""
    body = offset * Rotation.from_euler("ZYX", [80.0, 25.0, -15.0], degrees=True)
    yaw, pitch, roll = (body * Rotation.from_rotvec(t_s * TURN_RADPS)).as_euler("ZYX")
    return facing(t_s, 0.0)[1]._replace(
        roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw,
        rollspeed_radps=rates[0], pitchspeed_radps=rates[1], yawspeed_radps=rates[2],
    )  # fmt: skip


TURN_RADPS = np.array([0.3, -0.2, 0.4])


def test_opinions_of_a_turning_carrier_turn_alike() -> None:
    """Rolled, pitched and turning: the error of the heading is about the vertical."""
    jumps, before = AttitudeJumps(), None
    against = list[float]()
    for number in range(80):
        t_s = number / 10
        offset = Rotation.from_euler("z", 30.0 * (20 <= number < 50), degrees=True)
        attitude = turned(t_s, offset, tuple(TURN_RADPS))
        after = round(t_s * S), attitude
        jumps.look(before, after, BOUNDS)
        against.append(0.0 if jumps.against is None else math.degrees(jumps.against.at(0.0)))
        before = after
    assert against[:20] == [0.0] * 20
    assert against[20:] == pytest.approx([30.0] * 60, abs=0.1)


OFFSETS = st.lists(st.tuples(*[st.floats(-3.0, 3.0)] * 3), min_size=3, max_size=3)
SEGMENTS = st.lists(
    st.tuples(st.integers(0, 2), st.sampled_from([0.1, 0.3, 0.9, 1.1, 1.5, 3.0])),
    min_size=2,
    max_size=25,
)


@given(
    offsets=OFFSETS,
    segments=SEGMENTS,
    hz=st.sampled_from([5.0, 10.0, 20.0]),
    forged=st.sets(st.integers(0, 200), max_size=10),
)
def test_opinion_that_lasted_stays_in_the_bound_for_ten_seconds(
    offsets: list[tuple[float, float, float]],
    segments: list[tuple[int, float]],
    hz: float,
    forged: set[int],
) -> None:
    """Whatever comes after it: brief returns, other opinions, forged rates.

    It lasted, if it was reported for more than a second.
    """
    jumps, number, before = AttitudeJumps(), 0, None
    seen: dict[int, float] = {}  # when an opinion that lasted was last reported
    for index, lasts_s in segments:
        count = max(1, round(lasts_s * hz))
        began_s = number / hz
        for _ in range(count):
            t_s = number / hz
            rates = (9.0, -9.0, 9.0) if number in forged else tuple(TURN_RADPS)
            attitude = turned(t_s, Rotation.from_rotvec(offsets[index]), rates)
            jumps.look(before, (round(t_s * S), attitude), BOUNDS)
            before, number = (round(t_s * S), attitude), number + 1
            if t_s - began_s > SETTLED_S:
                seen[index] = t_s
            allowed_rad = 0.0 if jumps.against is None else jumps.against.at(0.0)
            for other, seen_s in seen.items():
                if t_s - seen_s < DOUBT_S:
                    off = Rotation.from_rotvec(offsets[other]).inv() * Rotation.from_rotvec(
                        offsets[index]
                    )
                    assert off.magnitude() <= allowed_rad + agreement_rad(1 / hz, BOUNDS) + 1e-6


def test_wrong_rate_leaves_no_doubt_about_the_angle() -> None:
    jumps, before = AttitudeJumps(), None
    for number in range(30):
        t_ns, attitude = facing(number / 10, 10.0)
        if number == 10:
            attitude = attitude._replace(yawspeed_radps=3.0)
        jumps.look(before, (t_ns, attitude), BOUNDS)
        assert (jumps.against is not None) == (number in (10, 11))
        before = t_ns, attitude


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
