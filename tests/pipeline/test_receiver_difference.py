"""Difference between an autopilot's position and its receiver's: what is lateness, what is not."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.pipeline.receiver_difference import (
    ARRIVAL_LAG_S,
    GROWTH_MPS,
    HELD_NS,
    LAG_S,
    NEAR_M,
    NOTICE_M,
    RESOLUTION_M,
    ReceiverDifference,
)
from companion.values import AltitudeDatum, GnssStatus, Report, ReportNoise, Severity, Source

S = 1_000_000_000
METRES_PER_DEGREE = 111_195.0
LAT_DEG, LON_DEG = 47.4, 179.9999  # the antimeridian is 7.5 m to the east


def status(t_s: float, north_m: float = 0.0, east_m: float = 0.0, up_m: float = 0.0) -> GnssStatus:
    lat_deg, lon_deg = place(north_m, east_m)
    return GnssStatus(
        t_ns=round(t_s * S),
        source=Source(1, 1),
        fix_type=3,
        alt_m=500.0 + up_m,
        h_acc_m=None,
        v_acc_m=None,
        vel_acc_mps=None,
        position_deg=(lat_deg, lon_deg),
    )


def place(north_m: float, east_m: float) -> tuple[float, float]:
    across = METRES_PER_DEGREE * math.cos(math.radians(LAT_DEG))
    lon_deg = LON_DEG + east_m / across
    return LAT_DEG + north_m / METRES_PER_DEGREE, math.remainder(lon_deg, 360.0)


def report(
    t_s: float,
    place_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    velocity_mps: tuple[float, float, float] | None = (0.0, 0.0, 0.0),
) -> Report:
    lat_deg, lon_deg = place(*place_m[:2])
    return Report(
        t_ns=round(t_s * S),
        uav="1:1",
        source=Source(1, 1),
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        alt_m=500.0 + place_m[2],
        alt_datum=AltitudeDatum.MSL,
        relative_alt_m=None,
        velocity_ne_mps=None if velocity_mps is None else velocity_mps[:2],
        velocity_down_mps=None if velocity_mps is None else velocity_mps[2],
        heading_deg=None,
        boot_ms=0,
        tslc_s=None,
    )


RECEIVER_M, RECEIVER_UP_M = 0.9, 1.8


def compare(difference: ReceiverDifference, found: GnssStatus, made: Report, late_s: float) -> None:
    difference.compare(found, made, late_s, receiver(RECEIVER_M, RECEIVER_UP_M))


def receiver(horizontal_m: float, vertical_m: float) -> ReportNoise:
    return ReportNoise(
        horizontal_m=horizontal_m,
        vertical_m=vertical_m,
        position_m=math.hypot(horizontal_m, vertical_m),
        velocity_mps=0.3,
    )


@given(
    elapsed_s=st.floats(0.0, 1.0),
    late_s=st.floats(0.0, 1.0),
    shares=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
    velocity_mps=st.tuples(st.floats(-40.0, 40.0), st.floats(-40.0, 40.0)),
)
def test_lateness_of_status_and_report_is_no_difference(
    elapsed_s: float,
    late_s: float,
    shares: tuple[float, float, float],
    velocity_mps: tuple[float, float],
) -> None:
    """A vehicle flies straight on; both messages are late, and the status is older still."""
    north_mps, east_mps = velocity_mps
    true_s = elapsed_s - shares[0] * late_s, -shares[1] * late_s - shares[2] * ARRIVAL_LAG_S
    difference = ReceiverDifference()
    compare(difference,
        status(0.0, north_mps * true_s[1], east_mps * true_s[1]),
        report(elapsed_s, (north_mps * true_s[0], east_mps * true_s[0], 0.0),
               (north_mps, east_mps, 0.0)),
        late_s,
    )  # fmt: skip
    assert difference.horizontal.covered_m < 0.01


@pytest.mark.parametrize("off_m", [(0.0, 7.0), (-7.0, 0.0), (17.0 + 7.0, 0.0)])
def test_what_lateness_does_not_explain_is_covered(off_m: tuple[float, float]) -> None:
    """At 10 m/s northward: 7 m aside, behind, and ahead of where it may be in 1.7 s.

    Then nothing shows how late the status was.
    """
    difference = ReceiverDifference()
    compare(difference, status(0.0), report(0.2, (*off_m, 0.0), (10.0, 0.0, 0.0)), 0.5)
    behind_m = 3.0 if off_m[0] < 0.0 else 0.0  # the report may be from before the status
    assert difference.horizontal.apart_m == pytest.approx(7.0 - behind_m, abs=0.06)
    paths_m = ((10.0 * t_s, 0.0) for t_s in (0.2 - 0.5, 0.2 + 0.5 + ARRIVAL_LAG_S))
    farthest_m = max(math.dist(off_m, end_m) for end_m in paths_m)
    assert difference.horizontal.covered_m == pytest.approx(farthest_m, abs=0.06)


@pytest.mark.parametrize("lag_s", [0.0, LAG_S])
@pytest.mark.parametrize("status_late_s", [-1.0, 0.0, 1.5, 9.0])
def test_stamps_of_one_clock_show_how_late_each_is(status_late_s: float, lag_s: float) -> None:
    """A status that was overtaken is older than its arrival says."""
    difference = ReceiverDifference()
    climb_mps, north_mps, off_m = 8.0, 15.0, 20.0
    late = status(status_late_s)._replace(time_us=100_000_000)
    made_s = 0.3
    moved = (north_mps * (made_s + lag_s), 0.0, climb_mps * made_s + off_m)
    compare(
        difference,
        late,
        report(status_late_s + 0.1, moved, (north_mps, 0.0, -climb_mps))._replace(boot_ms=100_300),
        3.0,
    )
    lagged_m = climb_mps * LAG_S
    assert difference.height.apart_m == pytest.approx(off_m - lagged_m, abs=0.06)
    assert difference.height.covered_m == pytest.approx(off_m, abs=0.06)
    assert difference.horizontal.covered_m == pytest.approx(0.0, abs=0.06)


@pytest.mark.parametrize("time_us", [0, 1_790_000_000_000_000, 111_000_000])
def test_stamps_of_another_clock_are_not_compared(time_us: int) -> None:
    difference = ReceiverDifference()
    placed = report(0.4, (6.0, 0.0, 0.0), (15.0, 0.0, 0.0))._replace(boot_ms=100_000)
    compare(difference, status(0.0)._replace(time_us=time_us), placed, 0.0)
    assert difference.horizontal.apart_m == pytest.approx(0.0, abs=0.06)


def test_standing_vehicle_may_be_nowhere_else() -> None:
    difference = ReceiverDifference()
    compare(difference, status(0.0), report(0.2, (3.0, 4.0, 0.0)), 0.9)
    assert difference.horizontal.covered_m == pytest.approx(5.0, abs=0.06)
    assert difference.height.covered_m == 0.0


@pytest.mark.parametrize("climb_mps", [-6.0, 0.0, 6.0])
def test_climb_since_the_status_is_no_difference(climb_mps: float) -> None:
    difference = ReceiverDifference()
    climbed = report(0.5, (0.0, 0.0, climb_mps * 0.5), (0.0, 0.0, -climb_mps))
    compare(difference, status(0.0), climbed, 0.0)
    assert difference.height.covered_m == pytest.approx(0.0, abs=1e-9)


def test_report_without_velocity_is_not_compared() -> None:
    """Some messages state none: where the vehicle was at the time of the status is unknown."""
    difference = ReceiverDifference()
    compare(difference, status(0.0), report(0.1, (20.0, 0.0, 20.0), None), 0.0)
    assert difference.horizontal.covered_m == difference.height.covered_m == 0.0


@pytest.mark.parametrize("boot_ms", [None, 4000, 106_000])
def test_report_long_after_the_status_is_not_compared(boot_ms: int | None) -> None:
    """It may have turned within a gap of its radio."""
    difference = ReceiverDifference()
    later = report(6.0, (20.0, 0.0, 20.0), (-15.0, 0.0, 5.0))._replace(boot_ms=boot_ms)
    compare(difference, status(0.0)._replace(time_us=100_000_000), later, 0.0)
    assert difference.horizontal.covered_m == difference.height.covered_m == 0.0


@pytest.mark.parametrize("off_m", [0.5 * RECEIVER_M, 2.0 * RECEIVER_M])
def test_noise_of_the_receiver_is_no_reason_to_doubt_its_lag(off_m: float) -> None:
    difference = ReceiverDifference()
    aside = report(0.1, (2.0, off_m, 0.0), (20.0, 0.0, 0.0))._replace(boot_ms=100_100)
    compare(difference, status(0.0)._replace(time_us=100_000_000), aside, 0.0)
    is_noise = off_m < RECEIVER_M
    assert (difference.horizontal.covered_m < off_m) is is_noise
    assert (difference.horizontal.covered_m > 0.5 * 20.0 * LAG_S) is not is_noise


@pytest.mark.parametrize("off_m", [0.5 * RECEIVER_UP_M, 2.0 * RECEIVER_UP_M])
def test_noise_of_the_receivers_height_is_no_reason_to_doubt_its_lag(off_m: float) -> None:
    """A receiver's height is less accurate than its position."""
    difference = ReceiverDifference()
    below = report(0.1, (0.0, 0.0, -off_m), (0.0, 0.0, -8.0))._replace(boot_ms=100_100)
    compare(difference, status(0.0)._replace(time_us=100_000_000), below, 0.0)
    least_m, most_m = off_m + 0.1 * 8.0, off_m + (0.1 + LAG_S) * 8.0
    expected_m = least_m if least_m < RECEIVER_UP_M + RESOLUTION_M else most_m
    assert difference.height.covered_m == pytest.approx(expected_m, abs=0.06)


@pytest.mark.parametrize("apart_s", [0.5, 2.5])
def test_turn_of_an_accurate_receiver_is_no_drift(apart_s: float) -> None:
    """A circle at 30 m/s and 15 m/s²; the receiver is 0.2 s late, and accurate to 0.1 m."""
    difference, covered_m = ReceiverDifference(), []
    for number in range(1, 60):
        stamped_s = number * apart_s
        made_s = stamped_s + 0.3
        (seen, _), (flown, (north_mps, east_mps)) = turning(stamped_s - 0.2), turning(made_s)
        made = status(stamped_s, *seen)._replace(time_us=round(stamped_s * 1e6))
        told = report(made_s, (*flown, 0.0), (north_mps, east_mps, 0.0))
        _, (north_mps, east_mps) = turning(made_s - 0.2)
        before = report(made_s - 0.2, velocity_mps=(north_mps, east_mps, 0.0))
        difference.before = before._replace(boot_ms=round((made_s - 0.2) * 1e3))
        difference.compare(
            made, told._replace(boot_ms=round(made_s * 1e3)), 0.1, receiver(0.1, 0.2)
        )
        covered_m.append(difference.horizontal.covered_m)
    assert max(covered_m[25:]) < 1.0


def turning(t_s: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return place and velocity on a circle."""
    angle = t_s / 2
    place_m = 60.0 * math.cos(angle), 60.0 * math.sin(angle)
    return place_m, (-30.0 * math.sin(angle), 30.0 * math.cos(angle))


def test_late_report_is_not_compared_by_arrival() -> None:
    difference = ReceiverDifference()
    compare(difference, status(0.0), report(0.1, (20.0, 0.0, 20.0)), 1.5)
    assert difference.horizontal.covered_m == difference.height.covered_m == 0.0


def test_position_0_0_is_none() -> None:
    difference = ReceiverDifference()
    nowhere = status(0.0)._replace(position_deg=None)
    compare(difference, nowhere, report(0.1, (20.0, 0.0, 0.0)), 0.0)
    assert not difference.is_news


def test_difference_stays_while_the_receiver_has_no_fix() -> None:
    difference = ReceiverDifference()
    compare(difference, status(0.0), report(0.1, (20.0, 0.0, 0.0)), 0.0)
    lost = status(1.0)._replace(fix_type=1)
    compare(difference, lost, report(1.1), 0.0)
    assert difference.compared is lost
    assert difference.horizontal.covered_m == pytest.approx(20.0, abs=0.06)


def test_drift_is_covered_beyond_the_largest_difference_of_valid_positions() -> None:
    drifts, jumps, away = ReceiverDifference(), ReceiverDifference(), ReceiverDifference()
    for t_s in range(14):
        compare(drifts, status(t_s), report(t_s + 0.1, (0.0, 0.0, 4.6 * t_s)), 0.0)
    compare(jumps, status(0.0), report(0.1, (0.0, 0.0, NEAR_M + 10.0)), 0.0)
    compare(away, status(0.0), report(0.1, (NEAR_M + 10.0, 0.0, 0.0)), 0.0)
    assert drifts.height.covered_m == pytest.approx(4.6 * 13, abs=0.1)
    assert jumps.height.covered_m == 0.0
    (told,) = jumps.announce(0)
    text = "its altitude differs by 60 m from its GNSS receiver's; one of the two is invalid"
    assert told == (Severity.WARNING, text)
    assert away.horizontal.covered_m == pytest.approx(
        NEAR_M + 10.0, abs=0.1
    )  # no datum explains it


def test_jump_of_a_report_is_not_covered_at_once() -> None:
    """The tracker must be able to reject it."""
    difference, covered_m = ReceiverDifference(), []
    for number in range(60):
        t_s = number / 5
        jumped_m = 30.0 if t_s > 2.0 else 0.0
        compare(difference, status(t_s), report(t_s + 0.05, (0.0, jumped_m, 0.0)), 0.0)
        covered_m.append(difference.horizontal.covered_m)
    grown_m = [after - before for before, after in pairwise(covered_m)]
    assert max(grown_m) == pytest.approx(0.2 * GROWTH_MPS)
    assert covered_m[-1] == pytest.approx(30.0 - RESOLUTION_M, abs=0.06)


def test_difference_is_announced_once_until_it_doubles() -> None:
    difference, told = ReceiverDifference(), list[str]()
    for metres in range(20):
        compare(difference, status(metres), report(metres + 0.1, (0.0, metres + 0.6, 0.0)), 0.0)
        if difference.is_news:
            told += [text for _, text in difference.announce(0)]
        assert not difference.is_news
    assert [text.split(" by ")[1].split()[0] for text in told] == ["4", "8", "16"]
    assert NOTICE_M < 4


def test_difference_is_held_for_a_while() -> None:
    """On another course less of it shows."""
    difference, held_s = ReceiverDifference(), HELD_NS / S
    compare(difference, status(0.0), report(0.1, (8.0, 0.0, 0.0)), 0.0)
    found = []
    for number in range(1, 30):
        t_s = number / 2
        compare(difference, status(t_s), report(t_s + 0.1, (1.0, 0.0, 0.0)), 0.0)
        found.append((t_s, round(difference.horizontal.covered_m)))
    assert {metres for t_s, metres in found if t_s <= held_s} == {8}
    assert {metres for t_s, metres in found if t_s > 2 * held_s + 1.0} == {1}


def test_difference_that_is_gone_for_a_while_is_announced_again() -> None:
    difference, told = ReceiverDifference(), []
    for number in range(200):
        t_s = number / 2
        off_m = 20.0 if 10.0 <= t_s < 12.0 or t_s >= 90.0 else 0.5
        compare(difference, status(t_s), report(t_s + 0.1, (0.0, off_m, 0.0)), 0.0)
        if difference.is_news:
            told += difference.announce(round(t_s * S))
    assert [text.split(" by ")[1].split()[0] for _, text in told] == ["20", "20"]


def test_larger_difference_is_named() -> None:
    difference = ReceiverDifference()
    compare(difference, status(0.0), report(0.1, (6.0, 0.0, 4.0)), 0.0)
    assert difference.larger.text("6") == "its position differs by 6 m from its GNSS receiver's"
    difference = ReceiverDifference()
    compare(difference, status(1.0), report(1.1, (0.0, 0.0, 4.0)), 0.0)
    assert difference.larger.text("4") == "its altitude differs by 4 m from its GNSS receiver's"


def test_climb_hides_nothing_that_was_seen_before() -> None:
    """RTK: a climb of 30 s, in which a lag of half a second would explain the error."""
    difference, off_m, covered_m = ReceiverDifference(), 1.0, []
    for number in range(100):
        t_s, climb_mps = number / 2, 4.0 if 20 <= number < 80 else 0.0
        climbed_m = 4.0 * (min(max(t_s, 10.0), 40.0) - 10.0)
        made = status(t_s, up_m=climbed_m)._replace(time_us=round((t_s + 100) * 1e6))
        placed = report(t_s, (0.0, 0.0, climbed_m + off_m), (0.0, 0.0, -climb_mps))
        placed = placed._replace(boot_ms=round((t_s + 100) * 1e3))
        difference.compare(made, placed, 0.1, receiver(0.05, 0.05))
        covered_m.append(difference.height.covered_m)
        if number == 79:
            assert difference.height.apart_m < 0.3  # the climb hides it
    assert min(covered_m) == pytest.approx(off_m, abs=0.06)


def drifted(path_m: list[float]) -> tuple[ReceiverDifference, list[tuple[int, Severity, float]]]:
    """Return the notices of differences in the plane, twice a second: when, severity, metres."""
    difference, told = ReceiverDifference(), []
    for number, off_m in enumerate(path_m):
        t_s = number / 2
        compare(difference, status(t_s), report(t_s + 0.1, (0.0, off_m, 0.0)), 0.0)
        if difference.is_news:
            at_ns = round(t_s * S)
            for severity, text in difference.announce(at_ns):
                told.append((number, severity, float(text.split(" by ")[1].split()[0])))
    return difference, told


def test_growth_that_the_bound_does_not_follow_is_announced() -> None:
    """Although the notice before said that the bound covers the difference."""
    path_m = [0.5 * n for n in range(60)] + [30.0 + 6.0 * n for n in range(8)]
    _, told = drifted(path_m)
    assert {severity for n, severity, _ in told if n < 60} == {Severity.INFO}
    fast = [(n, severity) for n, severity, _ in told if n >= 60]
    assert fast and fast[0][0] <= 62 and fast[0][1] is Severity.WARNING


def test_difference_that_is_not_covered_is_announced_again_after_a_minute() -> None:
    """A glitch of the receiver, a drift that the bound follows, and one that it does not."""
    glitch = [0.0] * 20 + [90.0] * 4
    path_m = [*glitch, *(0.3 * n for n in range(130)), *(39.0 + 6.0 * n for n in range(8))]
    _, told = drifted(path_m)
    late = [(n, severity) for n, severity, _ in told if n >= 154]
    assert late and late[0][0] <= 156 and late[0][1] is Severity.WARNING


def test_fast_drift_is_covered_once_it_ends() -> None:
    path_m = [0.0] * 10 + [min(80.0, 6.0 * n) for n in range(60)]
    difference, _ = drifted(path_m)
    assert difference.horizontal.covered_m == pytest.approx(80.0, abs=0.1)


def test_difference_after_a_loss_of_the_fix_is_covered_at_once() -> None:
    """By what it may have grown since the last status with a fix."""
    difference = ReceiverDifference()
    compare(difference, status(0.0), report(0.1), 0.0)
    compare(difference, status(20.0)._replace(fix_type=1), report(20.1, (0.0, 40.0, 0.0)), 0.0)
    compare(difference, status(30.0), report(30.1, (0.0, 90.0, 0.0)), 0.0)
    assert difference.horizontal.covered_m == pytest.approx(90.0, abs=0.1)
