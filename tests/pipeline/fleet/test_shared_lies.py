"""What another node says of a vehicle counts only while this node does not receive it itself."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pymavlink.dialects.v20.all as dialect
import pytest
from sent_frames import START_NS, position, sent

from companion import Frame, Pipeline, RoundTrip, Settings, Source
from companion.mavlink.clock.estimates import ClockEstimate
from companion.pipeline.fleet.reception import TRIPS_NS, Reception
from companion.pipeline.senders import KEPT_NS
from companion.tracking.noise import STATED_NS
from companion.values import Estimate, Event, Notice, Output, Reason, Rejection

S = 1_000_000_000
UAV = "1:1"
BEHIND_S = 600.0  # boot of the vehicle before the start, s


def own(t_s: float, ahead_s: float = 0.0) -> Frame:
    """Return a report of a vehicle that flies north at 10 m/s, stamped ``ahead_s`` ahead."""
    made: Frame = position(
        t_s, UAV, (10 * t_s, 0, -50), (10, 0, 0), boot_s=BEHIND_S + t_s + ahead_s
    )
    return made


def shared(frame: Frame) -> Frame:
    return frame._replace(link="fleet:b", doubt_ns=1_000_000)


def trip(t_s: float, ahead_s: float) -> RoundTrip:
    """Return a round trip of 4 ms that another node measured, on a clock ``ahead_s`` ahead."""
    at_ns = START_NS + round(t_s * S)
    return RoundTrip(
        t_ns=at_ns,
        source=Source(1, 1),
        sent_ns=at_ns - 4_000_000,
        remote_ns=round((BEHIND_S + t_s + ahead_s) * S) - 2_000_000,
        is_shared=True,
    )


def accuracy(t_s: float, stated_mm: int = 1) -> Frame:
    """Return the status of a receiver that states an accuracy."""
    message = dialect.MAVLink_gps_raw_int_message(
        round(t_s * 1e6), 6, 0, 0, 550_000, 50, 50, 0, 0, 20, 0, *[stated_mm] * 3
    )
    return sent(t_s, UAV, message)


def flown(*lies: Event, gap_s: tuple[float, float] = (10.0, 11.0), end_s: float = 20.0) -> Any:
    """Return the pipeline and its outputs after a flight with a gap in which lies are shared."""
    frames = [own(n / 10) for n in range(round(end_s * 10))]
    here = [one for one in frames if not gap_s[0] * S <= one.t_ns - START_NS < gap_s[1] * S]
    into = Pipeline(Settings().override(center={"source": "9:1"}))
    events: Sequence[Any] = sorted([*here, *lies], key=lambda one: one.t_ns)
    outputs: list[Output] = [out for event in events for out in into.step(event)]
    return into, outputs


def clock(into: Pipeline) -> ClockEstimate:
    found = into.clock_estimate(UAV)
    assert found is not None
    return found


@pytest.mark.parametrize("reports", [False, True], ids=["alone", "with reports"])
@pytest.mark.parametrize("ahead_s", [0.7, -0.7])
def test_round_trips_of_others_do_not_outlast_a_gap(ahead_s: float, reports: bool) -> None:
    """One of them moved the vehicle's clock for good: 9 m off at a bound of 5 m."""
    lies: list[Event] = [trip(10.2 + n / 10, ahead_s) for n in range(7)]
    if reports:
        lies += [shared(own(10.15 + n / 10)) for n in range(7)]
    assert clock(flown(*lies)[0]) == clock(flown()[0])


def test_round_trips_of_others_do_not_count_in_a_short_gap() -> None:
    reports = [shared(own(10 + n / 10)) for n in range(20)]
    trips = [trip(10.35 + n / 10, 0.03) for n in range(15)]
    found = [flown(*reports, *some, gap_s=(10, 12), end_s=12)[0] for some in (trips, [])]
    assert clock(found[0]) == clock(found[1])


def test_round_trips_of_others_count_while_their_reports_are_used() -> None:
    """Several, since frames agree with each only up to their own latency."""
    lies = [each for n in range(150) for each in (shared(own(5 + n / 10)), trip(5.05 + n / 10, 0))]
    with_them, without = (flown(*some, gap_s=(5, 20), end_s=20)[0] for some in (lies, lies[::2]))
    widths = [clock(one).before_s + clock(one).after_s for one in (with_them, without)]
    assert widths[0] < 0.01 < widths[1]


@pytest.mark.parametrize("reports", [False, True], ids=["alone", "with reports"])
def test_accuracies_of_others_lower_no_bound_in_a_gap_or_after_it(reports: bool) -> None:
    """They lowered it for ten seconds: 2.6 m off at a bound of 0.3 m."""
    lies = [shared(accuracy(10.2 + n / 10)) for n in range(7)]
    if reports:
        lies += [shared(own(10.15 + n / 10)) for n in range(7)]
    _, outputs = flown(*lies)
    fixes = [one.fix for one in outputs if isinstance(one, Estimate)]
    assert min(fix.noise.position_m for fix in fixes) > 1.0


def test_accuracies_of_a_node_that_shares_no_reports_lower_no_bound() -> None:
    """Beside another node's reports: 2.2 times beyond the bound, and then no link."""
    honest = [shared(own(5 + n / 10)) for n in range(350)]
    lies = [shared(accuracy(5 + n / 10))._replace(link="fleet:c") for n in range(350)]
    _, outputs = flown(*honest, *lies, gap_s=(5, 40), end_s=40.0)
    fixes = [one.fix for one in outputs if isinstance(one, Estimate)]
    assert len(fixes) > 350
    assert min(fix.noise.position_m for fix in fixes) > 1.0


def test_accuracies_of_others_without_their_reports_count_for_nothing() -> None:
    """Not even once the vehicle has been silent for so long that its clock is not known here."""
    lies = [shared(accuracy(21 + n / 10)) for n in range(9)]
    _, outputs = flown(*lies, gap_s=(10, 22), end_s=25)
    fixes = [one.fix for one in outputs if isinstance(one, Estimate)]
    assert min(fix.noise.position_m for fix in fixes) > 1.0


def test_receivers_own_accuracies_are_not_overtaken_by_shared_ones() -> None:
    """A receiver's time 20 s ahead: the vehicle's own 20 m no longer counted, 7 m off at 3 m."""
    ahead = dialect.MAVLink_gps_raw_int_message(
        35_000_000, 6, 474000000, 85500000, 550_000, 50, 50, 0, 0, 20, 0, 1, 1, 1
    )
    lies = [shared(own(10.15 + n / 10)) for n in range(7)] + [shared(sent(10.3, UAV, ahead))]
    stated = [accuracy(float(n), 20_000) for n in range(40)]
    _, outputs = flown(*lies, *stated, end_s=40.0)
    after = [
        one.fix for one in outputs if isinstance(one, Estimate) and one.fix.t_ns > START_NS + 11 * S
    ]
    assert min(fix.noise.horizontal_m for fix in after) > 20


def test_accuracy_that_is_received_in_a_gap_counts_after_it() -> None:
    """The vehicle's own statement arrives while its positions do not."""
    lies = [shared(own(10.15 + n / 10)) for n in range(15)]
    _, outputs = flown(*lies, accuracy(10.9, 20_000), gap_s=(10, 12))
    fixes = [one.fix for one in outputs if isinstance(one, Estimate)]
    after = [fix.noise.horizontal_m for fix in fixes if fix.t_ns > START_NS + 12 * S]
    assert min(after) > 20


@pytest.mark.parametrize("ahead_s", [0.5, 0.9])
def test_reports_of_others_ahead_of_the_clock_known_here_are_rejected(ahead_s: float) -> None:
    lies = [shared(own(10.05 + n / 10, ahead_s)) for n in range(9)]
    _, outputs = flown(*lies)
    assert len([one for one in outputs if isinstance(one, Rejection)]) == len(lies)


def test_accuracies_of_others_count_after_own_ones_have_ended() -> None:
    lies = [
        each for n in range(150) for each in (shared(own(5 + n / 10)), shared(accuracy(5 + n / 10)))
    ]
    _, outputs = flown(*lies, accuracy(4.95), gap_s=(5, 20))
    fixes = [one.fix for one in outputs if isinstance(one, Estimate)]
    late = [fix.noise.position_m for fix in fixes if fix.t_ns > START_NS + 5 * S + STATED_NS]
    assert late and max(late) < 1.0


def test_reports_of_others_with_another_clock_are_rejected_for_ten_seconds() -> None:
    """The carrier had "two clocks" then, and no beam for ten seconds at a time."""
    lies = [shared(own(10.05 + n / 10, 3600.0)) for n in range(9)]
    into, outputs = flown(*lies)
    refused = [one for one in outputs if isinstance(one, Rejection)]
    assert {one.reason for one in refused} == {Reason.UNPLACED_STAMP}
    assert len(refused) == len(lies)
    assert not [one for one in outputs if isinstance(one, Notice) and "clock" in one.text]
    assert clock(into) == clock(flown()[0])


def test_track_restarts_if_others_shared_another_clock_meanwhile() -> None:
    """After ten seconds it may have been restarted where only others receive it."""
    lies = [shared(own(21 + n / 10, 3600.0)) for n in range(80)]
    _, outputs = flown(*lies, gap_s=(10, 30), end_s=33)
    told = [one for one in outputs if isinstance(one, Notice) and "another clock" in one.text]
    assert len(told) == 1
    newest = [one for one in outputs if isinstance(one, Estimate)][-1]
    assert newest.fix.t_ns > START_NS + 32.5 * S


def test_vehicle_that_others_shared_is_forgotten_once_nobody_shares_it() -> None:
    into = flown(*(shared(own(n / 10)) for n in range(20)), gap_s=(0, 20), end_s=2)[0]
    senders = into.senders
    senders._tracked = ()
    senders.forget_silent(START_NS + KEPT_NS)
    assert UAV in senders._senders
    senders.forget_silent(START_NS + KEPT_NS + 3 * S)
    assert UAV not in senders._senders


def test_round_trips_of_unknown_senders_use_no_memory() -> None:
    into = Pipeline(Settings())
    for number in range(250):
        into.step(replace(trip(1.0, 0), source=Source(number + 1, 7)))
    assert len(into.senders._senders) == 0


def test_round_trips_are_used_of_vehicles_whose_reports_are_shared_and_not_too_often() -> None:
    hearing, now_ns = Reception(), START_NS
    assert not hearing.uses_trip(now_ns, Source(1, 1))
    frame = shared(own(1.0))
    assert hearing.take_shared(now_ns, "b", frame, b"key")
    used = [hearing.uses_trip(now_ns + n * TRIPS_NS // 4, Source(1, 1)) for n in range(9)]
    assert used == [n % 4 == 0 for n in range(9)]
    hearing.take_received(own(1.1))
    assert not hearing.uses_trip(now_ns + 9 * TRIPS_NS, Source(1, 1))
