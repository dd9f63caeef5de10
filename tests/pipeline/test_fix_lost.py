"""A vehicle whose GNSS receiver loses its fix in flight: its autopilot continues its position."""

import math
import re
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import pymavlink.dialects.v20.all as dialect
import pytest

from companion import Frame, Pipeline, Settings, Tick
from companion.values import Notice, Output, Reason, Rejection, Severity, Update
from tests.pipeline.test_assumptions import LAT, LON, M_PER_DEG, START_NS, S, position, sent

UAV = "1:1"
HERE = (47.4, 8.55, 500.0)
LOST_S, AGAIN_S, ENDS_S = 20.0, 28.0, 50.0
SPEED_MPS, RADIUS_M = 8.0, 60.0
KNOWS_ALL, KNOWS_NO_POSITION = 0b1100111111, 0b100101  # as ArduPilot sends them


def receiver(
    t_s: float, has_fix: bool, place_m: tuple[float, float] | None = None, *, accuracy_mm: int = 300
) -> Frame:
    """Return a status; of a receiver that states no position, if none is given."""
    lat_1e7 = lon_1e7 = 0
    if place_m is not None:
        lat_1e7 = round((LAT + place_m[0] / M_PER_DEG) * 1e7)
        lon_1e7 = round((LON + place_m[1] / M_PER_DEG / math.cos(math.radians(LAT))) * 1e7)
    message = dialect.MAVLink_gps_raw_int_message(
        round((100 + t_s) * 1e6), 6 if has_fix else 1, lat_1e7, lon_1e7, 560_000,
        100, 100, 0, 0, 12, 0, accuracy_mm, accuracy_mm, 300, 0, 0,
    )  # fmt: skip
    return sent(t_s, UAV, message)


def second_receiver(t_s: float, has_fix: bool = True) -> Frame:
    fix_type = 3 if has_fix else 1
    message = dialect.MAVLink_gps2_raw_message(
        round(t_s * 1e6), fix_type, 474_000_000, 85_500_000, 560_000, 100, 100, 0, 0, 12, 0, 0
    )
    return sent(t_s, UAV, message)


def estimator(t_s: float, flags: int) -> Frame:
    return sent(t_s, UAV, dialect.MAVLink_ekf_status_report_message(flags, 0.1, 0.1, 0.1, 0.1, 0.1))


def true_m(t_s: float) -> tuple[float, float]:
    angle = SPEED_MPS / RADIUS_M * t_s
    return 200 + RADIUS_M * math.cos(angle), RADIUS_M * math.sin(angle)


def flight(drift_mps2: float, *, second: bool = False, told: bool = True) -> Iterator[Frame | Tick]:
    """Return a circle at 10 Hz. From the loss of the fix on the position drifts to the north."""
    for n in range(round(ENDS_S * 10)):
        t_s = n / 10
        dead_reckoning_s = min(max(0.0, t_s - LOST_S), AGAIN_S - LOST_S)
        # The estimator returns within two seconds.
        off_m = drift_mps2 / 2 * dead_reckoning_s**2 * min(1.0, max(0.0, 1 - (t_s - AGAIN_S) / 2))
        (north_m, east_m), angle = true_m(t_s), SPEED_MPS / RADIUS_M * t_s
        off_mps = drift_mps2 * dead_reckoning_s if t_s < AGAIN_S else 0.0
        speed = -SPEED_MPS * math.sin(angle) + off_mps, SPEED_MPS * math.cos(angle), 0.0
        yield position(t_s, UAV, (north_m + off_m, east_m, -60.0), speed, late_s=0.02)
        if n % 5 == 0:
            yield receiver(t_s + 0.03, not LOST_S <= t_s < AGAIN_S if told else True)
            if second:
                yield second_receiver(t_s + 0.03)
        yield Tick(START_NS + round((t_s + 0.05) * S))


def flown(events: Iterator[Frame | Tick]) -> tuple[list[Output], dict[float, tuple[float, float]]]:
    """Return the outputs; and error and bound of the horizontal position by time."""
    pipeline = Pipeline(Settings().override(center={"source": ",".join(map(str, HERE))}))
    outputs: list[Output] = []
    found = {}
    for event in events:
        for output in pipeline.step(event):
            outputs.append(output)
            if isinstance(output, Update) and output.tracks:
                track = output.tracks[0]
                t_s = (track.valid_at_ns - START_NS) * 1e-9
                (north_m, east_m), at = true_m(t_s), track.position_ned_m
                error_m = math.hypot(at[0] - north_m, at[1] - east_m)
                found[t_s] = error_m, track.bound_m
    return outputs, found


def largest_m(found: dict[float, tuple[float, float]], from_s: float, to_s: float) -> float:
    return max(bound_m for t_s, (_, bound_m) in found.items() if from_s < t_s < to_s)


def notices(outputs: list[Output]) -> list[Notice]:
    return about(outputs, "fix lost")


def about(outputs: list[Output], text: str) -> list[Notice]:
    return [one for one in outputs if isinstance(one, Notice) and text in one.text]


@pytest.mark.parametrize("drift_mps2", [0.0, 0.15, 0.4, 0.5])
def test_bound_holds_while_the_position_drifts_without_a_fix(drift_mps2: float) -> None:
    outputs, found = flown(flight(drift_mps2))
    assert [t_s for t_s, (error_m, bound_m) in found.items() if error_m > bound_m] == []
    assert largest_m(found, LOST_S - 5.0, LOST_S) < 4.0
    assert 16.0 < largest_m(found, LOST_S, AGAIN_S) < 25.0
    assert largest_m(found, AGAIN_S + 8.0, ENDS_S) < 4.0
    (told,) = notices(outputs)
    assert told.text == "1:1: GNSS fix lost; its position bound grows until the fix returns"
    assert told.severity is Severity.WARNING
    assert 0.0 <= (told.t_ns - START_NS) / S - LOST_S < 0.6


def test_unnoticed_drift_would_exceed_the_bound() -> None:
    """So the test above can fail."""
    outputs, found = flown(flight(0.5, told=False))
    assert any(error_m > bound_m for error_m, bound_m in found.values())
    assert notices(outputs) == []


def test_link_that_suffers_names_the_lost_fix() -> None:
    outputs, _ = flown(flight(0.15))
    told = [one.text for one in outputs if isinstance(one, Notice) and one.text.startswith("link")]
    why = r"weak . its position is uncertain by \d+ m, after \d\.\d s without a GNSS fix; check its"
    assert [bool(re.search(why, text)) for text in told] == [False, True, False]


def test_second_receiver_with_a_fix_replaces_the_first() -> None:
    outputs, found = flown(flight(0.0, second=True))
    assert largest_m(found, LOST_S - 5.0, ENDS_S) < 4.0
    assert notices(outputs) == []
    (told,) = about(outputs, "second one")  # it is assumed that the autopilot uses it
    assert 0.0 <= (told.t_ns - START_NS) / S - LOST_S < 0.6


def with_statuses(drift_mps2: float, *has_fix: Callable[[float], bool | None]) -> Iterator[Any]:
    """Return the flight with other statuses of its receivers; None: none is sent."""
    for event in flight(drift_mps2):
        if not (isinstance(event, Frame) and event.msgid == 24):
            yield event
            continue
        t_s = (event.t_ns - START_NS) / S
        for one, fixed in zip((receiver, second_receiver), has_fix, strict=False):
            if (said := fixed(t_s)) is not None:
                yield one(t_s, said)


def is_fixed(t_s: float) -> bool:
    return not LOST_S <= t_s < AGAIN_S


def test_bound_holds_if_both_receivers_lose_the_fix() -> None:
    outputs, found = flown(with_statuses(0.45, is_fixed, is_fixed))
    assert [t_s for t_s, (error_m, bound_m) in found.items() if error_m > bound_m] == []
    (told,) = notices(outputs)
    assert (told.t_ns - START_NS) / S - LOST_S < 0.6


def test_bound_holds_if_the_second_receiver_falls_silent_when_the_first_loses_the_fix() -> None:
    outputs, found = flown(with_statuses(0.45, is_fixed, lambda t: True if t < LOST_S else None))
    assert [t_s for t_s, (error_m, bound_m) in found.items() if error_m > bound_m] == []
    (told,) = notices(outputs)
    assert (told.t_ns - START_NS) / S - LOST_S < 5.6


def test_receiver_that_falls_silent_with_a_fix_is_announced_once() -> None:
    outputs, found = flown(with_statuses(0.0, lambda t_s: True if t_s < LOST_S else None))
    assert largest_m(found, LOST_S, ENDS_S) < 4.0
    (told,) = about(outputs, "GPS_RAW_INT")
    assert 9.5 <= (told.t_ns - START_NS) / S - LOST_S < 10.0  # 10 s after the last one


def test_gap_of_a_whole_link_is_no_silent_receiver() -> None:
    events = (
        event
        for event in with_statuses(0.0, lambda _: True)
        if isinstance(event, Tick) or not 0.0 < (event.t_ns - START_NS) / S - LOST_S < 11.0
    )
    outputs, _ = flown(events)
    assert about(outputs, "GPS_RAW_INT") == []


def test_rare_statuses_of_a_first_receiver_are_no_silence() -> None:
    outputs, _ = flown(with_statuses(0.0, lambda t_s: True if round(t_s * 10) % 120 == 0 else None))
    assert about(outputs, "GPS_RAW_INT") == []


def test_rare_statuses_of_a_second_receiver_with_a_fix_are_no_losses() -> None:
    """Every other one is lost on the way."""
    outputs, found = flown(
        with_statuses(0.0, lambda t: t < LOST_S, lambda t: True if t % 2 < 0.4 else None)
    )
    assert largest_m(found, LOST_S, ENDS_S) < 8.0
    assert notices(outputs) == []


def test_bound_grows_without_a_fix_if_the_receiver_falls_silent() -> None:
    pause_s = 60.0 + ENDS_S

    def silent() -> Iterator[Any]:
        yield from with_statuses(0.0, lambda t: t < LOST_S if t < AGAIN_S else None)
        yield position(pause_s, UAV, (200.0, 0.0, -60.0), (0.0, 0.0, 0.0), late_s=0.02)
        yield position(pause_s + 0.1, UAV, (200.0, 0.0, -60.0), (0.0, 0.0, 0.0), late_s=0.02)
        yield Tick(START_NS + round((pause_s + 0.15) * S))

    _, found = flown(silent())
    t_s, (_, bound_m) = max(found.items())
    assert bound_m > 0.25 * (t_s - LOST_S) ** 2


def test_loss_of_a_fix_that_was_stated_once_is_forgotten() -> None:
    """A stranger in a gap of the vehicle's radio may have stated both."""

    def once() -> Iterator[Any]:
        yield from with_statuses(0.0, lambda t: {10.0: True, 10.5: False}.get(t - 0.03))
        for n in range(round(ENDS_S * 10), round((ENDS_S + 30.0) * 10)):
            north_m, east_m = true_m(n / 10)
            angle = SPEED_MPS / RADIUS_M * n / 10
            speed = -SPEED_MPS * math.sin(angle), SPEED_MPS * math.cos(angle), 0.0
            yield position(n / 10, UAV, (north_m, east_m, -60.0), speed, late_s=0.02)
            yield Tick(START_NS + round((n / 10 + 0.05) * S))

    _, found = flown(once())
    assert largest_m(found, 30.0, ENDS_S) > 100.0
    assert largest_m(found, 75.0, ENDS_S + 30.0) < 7.0


@pytest.mark.parametrize(("every_s", "lasts_s"), [(1.0, 0.5), (4.0, 0.5), (6.0, 0.6)])
def test_losses_of_a_moment_do_not_add_up(every_s: float, lasts_s: float) -> None:
    """The receiver has no fix in one or two of its statuses, every few seconds."""
    fixed = lambda t_s: t_s < 10.0 or t_s % every_s > lasts_s  # noqa: E731
    outputs, found = flown(with_statuses(0.0, fixed))
    assert largest_m(found, 10.0, ENDS_S) < 6.0
    assert len(notices(outputs)) == 1


def test_position_of_a_vehicle_that_never_had_a_fix_is_used() -> None:
    """It navigates by other means."""

    def indoors() -> Iterator[Frame | Tick]:
        yield receiver(0.0, True)  # before its first position: it may be anybody's
        for event in flight(0.0, told=False):
            is_status = isinstance(event, Frame) and event.msgid == 24
            yield receiver((event.t_ns - START_NS) / S, False) if is_status else event

    outputs, found = flown(indoors())
    assert largest_m(found, 20.0, ENDS_S) < 7.0
    assert notices(outputs) == []


def test_positions_are_rejected_while_the_estimator_knows_none() -> None:
    """ArduPilot then repeats the last position, or any other one. With a fix, it is on the ground,
    and not ready."""

    def blind() -> Iterator[Frame | Tick]:
        for event in flight(0.0):
            yield event
            t_s = (event.t_ns - START_NS) / S
            if isinstance(event, Frame) and event.msgid == 24:
                blind = 26.0 <= t_s < 30.0
                yield estimator(t_s, KNOWS_NO_POSITION if blind else KNOWS_ALL)
                yield sent(t_s, UAV, dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3))

    outputs, found = flown(blind())
    refused = [one for one in outputs if isinstance(one, Rejection)]
    assert 18 <= len(refused) <= 21  # until it has a fix again
    assert {one.reason for one in refused} == {Reason.NO_FIX}
    assert {one.detail for one in refused} == {"its estimator reports no valid position"}
    assert [t_s for t_s, (error_m, bound_m) in found.items() if error_m > bound_m] == []
    texts = [one.text for one in outputs if isinstance(one, Notice)]
    assert any(text.startswith("no report of 1:1 was used in the last") for text in texts)


@pytest.mark.parametrize("is_armed", [False, True])
def test_positions_in_flight_are_rejected_while_the_estimator_knows_none(is_armed: bool) -> None:
    """Its receiver has a fix, which the estimator does not believe."""

    def blind() -> Iterator[Any]:
        for event in flight(0.0, told=False):
            yield event
            t_s = (event.t_ns - START_NS) / S
            if isinstance(event, Frame) and event.msgid == 24:
                yield estimator(t_s, KNOWS_NO_POSITION if 26.0 <= t_s < 30.0 else KNOWS_ALL)
                mode = 128 if is_armed else 0
                yield sent(t_s, UAV, dialect.MAVLink_heartbeat_message(2, 3, mode, 0, 4, 3))

    outputs, _ = flown(blind())
    refused = [one for one in outputs if isinstance(one, Rejection)]
    assert len(refused) == (40 if is_armed else 0)
    assert {one.reason for one in refused} <= {Reason.NO_FIX}


def test_stranger_in_a_gap_is_no_estimator_of_a_vehicle_that_has_a_fix() -> None:
    """As of PX4, which sends no such statuses."""

    def forged() -> Iterator[Any]:
        for event in flight(0.0, told=False):
            yield event
            t_s = (event.t_ns - START_NS) / S
            if isinstance(event, Frame) and event.msgid == 24:
                yield sent(t_s, UAV, dialect.MAVLink_heartbeat_message(2, 12, 128, 0, 4, 3))
                if round(t_s % 10) == 1:
                    yield estimator(t_s, KNOWS_ALL)
                    yield estimator(t_s, KNOWS_NO_POSITION)

    outputs, _ = flown(forged())
    assert not [one for one in outputs if isinstance(one, Rejection)]


def test_statement_of_an_estimator_that_is_not_repeated_counts_for_ten_seconds() -> None:
    def once() -> Iterator[Frame | Tick]:
        for event in flight(0.0, told=False):
            is_status = isinstance(event, Frame) and event.msgid == 24
            yield receiver((event.t_ns - START_NS) / S, False) if is_status else event
            if isinstance(event, Frame) and event.t_ns == START_NS + round(20.02 * S):
                yield estimator(20.03, KNOWS_NO_POSITION)

    outputs, _ = flown(once())
    refused = [one.t_ns for one in outputs if isinstance(one, Rejection)]
    assert len(refused) == 100
    assert max(refused) <= START_NS + 30.1 * S


def test_bound_of_a_restarted_vehicle_on_the_ground_does_not_grow() -> None:
    """It waits for its first fix."""

    def restarted() -> Iterator[Frame | Tick]:
        yield from flight(0.0, told=False)
        yield sent(ENDS_S, UAV, dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3))
        for n in range(300):
            t_s = ENDS_S + 15.0 + n / 10
            yield booted(t_s, n)
            if n % 5 == 0:
                yield sent(t_s, UAV, dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3))
                yield receiver(t_s + 0.03, False)
            yield Tick(START_NS + round((t_s + 0.05) * S))

    _, found = flown(restarted())
    assert max(found) > ENDS_S + 40.0
    assert [
        bound_m for t_s, (_, bound_m) in found.items() if t_s > ENDS_S + 40 and bound_m > 7
    ] == []


def booted(t_s: float, n: int) -> Frame:
    """Return a report of the standing vehicle, from a boot clock that started with n = 0."""
    message = dialect.MAVLink_global_position_int_message(
        1000 + 100 * n, 474_000_000, 85_526_500, 500_000, 0, 0, 0, 0, 65535
    )
    return sent(t_s + 0.02, UAV, message)


@pytest.mark.parametrize("first_status_s", [0.1, 1.2, 3.0])
def test_bound_grows_if_the_vehicle_restarts_in_flight_and_states_no_fix_later(
    first_status_s: float,
) -> None:
    """A redundant autopilot takes over; nothing was lost before that."""
    restarts_s = 24.0

    def restarted() -> Iterator[Any]:
        for event in flight(0.45):
            t_s = (event.t_ns - START_NS) / S if isinstance(event, Frame) else 0.0
            if isinstance(event, Frame) and event.msgid == 24:
                yield sent(t_s, UAV, dialect.MAVLink_heartbeat_message(2, 3, 128, 0, 4, 3))
                if t_s > restarts_s + first_status_s:
                    yield receiver(t_s, False)
                elif t_s < restarts_s:
                    yield receiver(t_s, True)
                continue
            if isinstance(event, Frame) and event.msgid == 33 and t_s > restarts_s:
                message = dialect.MAVLink(None).decode(bytearray(event.raw))
                message.time_boot_ms -= 90_000
                event = sent(t_s, UAV, message)  # noqa: PLW2901
            yield event

    outputs, found = flown(restarted())
    assert about(outputs, "restarted")
    (told,) = notices(outputs)
    assert told.t_ns - START_NS < (restarts_s + first_status_s + 0.6) * S
    assert largest_m(found, ENDS_S - 5.0, ENDS_S) > 100.0


@pytest.mark.parametrize("back_s", [3.0, 18.0])
def test_loss_is_noticed_after_the_clock_of_the_receiver_was_set_back(back_s: float) -> None:
    """It learned the leap seconds, or another receiver is used."""

    def set_back() -> Iterator[Any]:
        for event in flight(0.45):
            t_s = (event.t_ns - START_NS) / S if isinstance(event, Frame) else 0.0
            if isinstance(event, Frame) and event.msgid == 24 and t_s > LOST_S - 1.0:
                message = dialect.MAVLink(None).decode(bytearray(event.raw))
                message.time_usec -= round(back_s * 1e6)
                event = sent(t_s, UAV, message)  # noqa: PLW2901
            yield event

    outputs, _ = flown(set_back())
    (told,) = notices(outputs)
    assert 0.0 <= (told.t_ns - START_NS) / S - LOST_S < 1.6


# --- what the estimator states in flight ----------------------------------------------------------

BY_FLOW, REJECTS_GNSS = 0b0000101111, 0b1100111111 | 1 << 15


def with_estimator(
    drift_mps2: float, flags: Callable[[float], int], *, mode: int | None = 128
) -> Iterator[Any]:
    """Return the flight with a fix all the time, and statuses of its estimator."""
    for event in flight(drift_mps2, told=False):
        yield event
        if isinstance(event, Frame) and event.msgid == 24:
            t_s = (event.t_ns - START_NS) / S
            yield estimator(t_s, flags(t_s))
            if mode is not None:
                yield sent(t_s, UAV, dialect.MAVLink_heartbeat_message(2, 3, mode, 0, 4, 3))


@pytest.mark.parametrize("flags", [BY_FLOW, REJECTS_GNSS])
def test_bound_holds_while_the_estimator_does_not_use_gnss(flags: int) -> None:
    """The receiver states a fix all the time."""
    outputs, found = flown(with_estimator(0.45, lambda t: KNOWS_ALL if is_fixed(t) else flags))
    assert [t_s for t_s, (error_m, bound_m) in found.items() if error_m > bound_m] == []
    assert largest_m(found, AGAIN_S + 8.0, ENDS_S) < 4.0
    (told,) = about(outputs, "navigates without GNSS")
    assert 0.0 <= (told.t_ns - START_NS) / S - LOST_S < 0.6


def test_vehicle_that_always_navigated_without_gnss_keeps_its_bound() -> None:
    events = with_statuses(0.0, lambda _: False)
    without = (
        (event, estimator((event.t_ns - START_NS) / S, BY_FLOW))
        if isinstance(event, Frame) and event.msgid == 24
        else (event,)
        for event in events
    )
    outputs, found = flown(one for pair in without for one in pair)
    assert largest_m(found, 5.0, ENDS_S) < 4.0
    assert about(outputs, "GNSS") == []


def test_estimator_without_gnss_on_the_ground_loses_no_fix() -> None:
    flags = with_estimator(0.0, lambda t: KNOWS_ALL if is_fixed(t) else BY_FLOW, mode=0)
    outputs, found = flown(flags)
    assert largest_m(found, LOST_S - 5.0, ENDS_S) < 4.0
    assert about(outputs, "navigates without GNSS") == []


@pytest.mark.parametrize("mode", [None, 128])
def test_estimator_counts_in_flight_after_gaps_of_its_statuses(mode: int | None) -> None:
    """Its router may forward no HEARTBEAT, and another component may send unarmed ones."""

    def events() -> Iterator[Any]:
        for event in with_estimator(
            0.0, lambda t: KNOWS_ALL if is_fixed(t) else 0b100101, mode=mode
        ):
            t_s = (event.t_ns - START_NS) / S if isinstance(event, Frame) else 0.0
            if not 12.0 < t_s < 18.0:  # a gap of the radio
                yield event
            if isinstance(event, Frame) and event.msgid == 0:
                yield sent(t_s, UAV, dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))

    outputs, _ = flown(events())
    refused = [one for one in outputs if isinstance(one, Rejection)]
    assert {one.reason for one in refused} == {Reason.NO_FIX}
    assert len(refused) == round(10 * (AGAIN_S - LOST_S))


def taken_over(drift_mps2: float, back_s: float) -> Iterator[Any]:
    """Return ``flight`` of an armed vehicle, whose boot clock is another one after 24 s."""
    for event in flight(drift_mps2):
        t_s = (event.t_ns - START_NS) / S if isinstance(event, Frame) else 0.0
        if isinstance(event, Frame) and event.msgid == 24:
            yield sent(t_s, UAV, dialect.MAVLink_heartbeat_message(2, 3, 128, 0, 4, 3))
        if isinstance(event, Frame) and event.msgid == 33 and t_s > 24.0:
            message = dialect.MAVLink(None).decode(bytearray(event.raw))
            message.time_boot_ms -= round(back_s * 1000)
            event = sent(t_s, UAV, message)  # noqa: PLW2901
        yield event


@pytest.mark.parametrize("back_s", [15.0, 40.0])
def test_bound_grows_on_if_the_vehicle_restarts_without_a_fix(back_s: float) -> None:
    """A redundant autopilot takes over: its clock is another one."""

    outputs, found = flown(taken_over(0.45, back_s))
    assert about(outputs, "restarted")
    assert [t_s for t_s, (error_m, bound_m) in found.items() if error_m > bound_m] == []


def test_takeover_without_a_fix_in_flight_is_tracked_at_once() -> None:
    """Not as a vehicle that was switched on, whose positions may be invalid."""

    outputs, found = flown(taken_over(0.2, 90.0))
    assert about(outputs, "restarted")
    unused = [one for one in outputs if isinstance(one, Rejection) and one.reason is Reason.NO_FIX]
    assert unused == []
    assert max(after - before for before, after in pairwise(sorted(found))) < 1.5


# --- an estimator that does not follow its receiver ----------------------------------------------


def drifting_estimator(rate_mps: float, *, told: bool = True) -> Iterator[Frame | Tick]:
    """Return ``flight`` whose position drifts from ``LOST_S`` on while the receiver has a fix."""
    for n in range(round(ENDS_S * 10)):
        t_s = n / 10
        (north_m, east_m), angle = true_m(t_s), SPEED_MPS / RADIUS_M * t_s
        off_m = rate_mps * max(0.0, t_s - LOST_S)
        speed = -SPEED_MPS * math.sin(angle), SPEED_MPS * math.cos(angle), 0.0
        yield position(t_s, UAV, (north_m + off_m, east_m, -60.0), speed, late_s=0.02)
        if n % 5 == 0 and told:
            yield receiver(t_s + 0.03, True, true_m(t_s - 0.2))
        yield Tick(START_NS + round((t_s + 0.05) * S))


def turns(*, with_positions: bool) -> Iterator[Frame | Tick]:
    """Return a circle at 20 m/s and 10 m/s²; of an RTK receiver few statuses arrive."""
    for n in range(round(ENDS_S * 10)):
        t_s, angle = n / 10, n / 20
        place_m = 200.0 + 40.0 * math.cos(angle), 40.0 * math.sin(angle)
        speed = -20.0 * math.sin(angle), 20.0 * math.cos(angle), 0.0
        yield position(t_s, UAV, (*place_m, -60.0), speed, late_s=0.02)
        if n % 25 == 0:
            seen = angle - 0.1
            late_m = 200.0 + 40.0 * math.cos(seen), 40.0 * math.sin(seen)
            seen_m = late_m if with_positions else None
            yield receiver(t_s + 0.03, True, seen_m, accuracy_mm=20)
        yield Tick(START_NS + round((t_s + 0.05) * S))


def test_turns_cost_little_also_where_few_statuses_arrive() -> None:
    """The acceleration is that of the newest two reports."""
    bounds_m = []
    for with_positions in (False, True):
        _, found = flown(turns(with_positions=with_positions))
        bounds_m.append(largest_m(found, 10.0, ENDS_S))
    assert bounds_m[1] < bounds_m[0] + 1.0


@pytest.mark.parametrize("rate_mps", [0.05, 0.3, 2.0])
def test_bound_covers_an_estimator_that_drifts_from_its_receiver(rate_mps: float) -> None:
    outputs, found = flown(drifting_estimator(rate_mps))
    assert [t_s for t_s, (error_m, bound_m) in found.items() if error_m > bound_m] == []
    assert largest_m(found, 5.0, LOST_S) < 4.0
    texts = [one.text for one in about(outputs, "1:1: its position differs by")]
    assert bool(texts) is (rate_mps > 0.1)
    assert all("covers the difference" in text for text in texts)


def test_estimator_that_drifts_unseen_would_exceed_the_bound() -> None:
    """So the test above can fail."""
    outputs, found = flown(drifting_estimator(0.3, told=False))
    assert any(error_m > bound_m for error_m, bound_m in found.values())
    assert about(outputs, "its position differs by") == []


def test_link_that_suffers_names_the_position_that_differs() -> None:
    outputs, _ = flown(drifting_estimator(4.0))
    texts = [one.text for one in about(outputs, "link to")]
    assert any("its position differs by" in text for text in texts), texts


# --- heights --------------------------------------------------------------------------------------


def drifting_heights(rate_mps: float, climb_m: float = 0.0) -> Iterator[Any]:
    """Return a vehicle that climbs and descends; its barometer drifts from ``LOST_S`` on."""
    for n in range(round(ENDS_S * 10)):
        t_s = n / 10
        height_m = 60.0 + climb_m * math.sin(t_s / 3)
        off_m = rate_mps * max(0.0, t_s - LOST_S)
        down_mps = -climb_m / 3 * math.cos(t_s / 3)
        yield position(t_s, UAV, (200.0, 0.0, -height_m - off_m), (0, 0, down_mps), late_s=0.02)
        if n % 5 == 0:
            message = dialect.MAVLink_gps_raw_int_message(
                round(t_s * 1e6), 3, 0, 0, round((500.0 + height_m) * 1e3),
                100, 100, 0, 0, 12, 0, 500, 500, 200, 0, 0,
            )  # fmt: skip
            yield sent(t_s + 0.03, UAV, message)
        yield Tick(START_NS + round((t_s + 0.05) * S))


def heights_m(events: Iterator[Any], climb_m: float) -> list[tuple[float, float]]:
    """Return error and bound of the heights of the track."""
    pipeline = Pipeline(Settings().override(center={"source": ",".join(map(str, HERE))}))
    found = []
    for event in events:
        for output in pipeline.step(event):
            if isinstance(output, Update) and output.tracks:
                (track,) = output.tracks
                t_s = (track.valid_at_ns - START_NS) * 1e-9
                true_m = 60.0 + climb_m * math.sin(t_s / 3)
                found.append((abs(-track.position_ned_m[2] - true_m), track.vertical_bound_m))
    return found


@pytest.mark.parametrize("climb_m", [0.0, 9.0])
def test_bound_on_the_height_covers_a_barometer_that_drifts(climb_m: float) -> None:
    """The receiver's height shows it; the bound on the receiver's error is 1.5 m."""
    found = heights_m(drifting_heights(0.25, climb_m), climb_m)
    assert [one for one in found[10:] if one[0] > one[1]] == []
    assert found[-1][0] > 5.0
    outputs, _ = flown(drifting_heights(0.25, climb_m))
    texts = [one.text for one in about(outputs, "its altitude differs by")]
    assert len(texts) == 2
    assert texts[0].endswith("from its GNSS receiver's; the position bound covers the difference")


def test_bound_on_the_height_covers_a_drift_of_any_size() -> None:
    """A difference that begins with more than 50 m is that of an invalid height."""
    found = heights_m(drifting_heights(2.2), 0.0)
    assert [one for one in found[10:] if one[0] > one[1]] == []
    assert found[-1][0] > 60.0


def test_difference_of_heights_outlasts_the_statuses_of_the_receiver() -> None:
    def silent(events: Iterator[Any]) -> Iterator[Any]:
        for event in events:
            is_status = isinstance(event, Frame) and event.msgid == 24
            if not (is_status and event.t_ns - START_NS > 45 * S):
                yield event
        for n in range(800):  # more than a minute without a status
            t_s = ENDS_S + n / 10
            yield position(t_s, UAV, (200.0, 0.0, -68.0), late_s=0.02)
            yield Tick(START_NS + round((t_s + 0.05) * S))

    found = heights_m(silent(drifting_heights(0.3)), 0.0)
    assert len(found) > 1200
    assert all(bound_m > 8.0 for _, bound_m in found[-200:])


def test_link_that_suffers_names_the_heights_that_differ() -> None:
    outputs, _ = flown(drifting_heights(2.0))
    texts = [one.text for one in about(outputs, "link to")]
    assert any("its altitude differs by" in text for text in texts), texts


def test_heights_that_agree_cost_nothing_while_the_vehicle_climbs() -> None:
    found = heights_m(drifting_heights(0.0, 9.0), 9.0)
    assert max(bound_m for _, bound_m in found[20:]) < 3.0
