"""A vehicle whose GNSS receiver loses its fix in flight: its autopilot continues its position."""

import math
import re
from collections.abc import Callable, Iterator
from typing import Any

import pymavlink.dialects.v20.all as dialect
import pytest

from companion import Frame, Pipeline, Settings, Tick
from companion.values import Notice, Output, Reason, Rejection, Severity, Update
from tests.pipeline.test_assumptions import START_NS, S, position, sent

UAV = "1:1"
HERE = (47.4, 8.55, 500.0)
LOST_S, AGAIN_S, ENDS_S = 20.0, 28.0, 50.0
SPEED_MPS, RADIUS_M = 8.0, 60.0
KNOWS_ALL, KNOWS_NO_POSITION = 0b1100111111, 0b100101  # as ArduPilot sends them


def receiver(t_s: float, has_fix: bool) -> Frame:
    message = dialect.MAVLink_gps_raw_int_message(
        round(t_s * 1e6), 6 if has_fix else 1, 474_000_000, 85_500_000, 560_000,
        100, 100, 0, 0, 12, 0, 300, 300, 300, 0, 0,
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
    return [one for one in outputs if isinstance(one, Notice) and "fix lost" in one.text]


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


def test_bound_of_a_restarted_vehicle_does_not_grow() -> None:
    """It waits for its first one, on the ground."""

    def restarted() -> Iterator[Frame | Tick]:
        yield from flight(0.0, told=False)
        for n in range(300):
            t_s = ENDS_S + 15.0 + n / 10
            yield booted(t_s, n)
            if n % 5 == 0:
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
