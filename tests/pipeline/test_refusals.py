"""Rejections: counted by sender, with bounded memory under a flood of ids."""

import pytest

from companion.mavlink.wire.decode import HEARTBEAT
from companion.mavlink.wire.positions import GLOBAL_POSITION_INT
from companion.pipeline.records import Records, UavRecord
from companion.pipeline.refusals import ARRIVING_NS, RECENT, SENDERS_MAX, Refusals
from companion.values import Reason, Rejection


def new_refusals() -> Refusals:
    return Refusals(Records(UavRecord, set[str]().__contains__))


def test_rejections_are_counted_by_sender_and_reason() -> None:
    refusals = new_refusals()
    for n in range(20):
        refusals.add(Rejection(t_ns=n, source="1:1", reason=Reason.DUPLICATE))
    refusals.add(Rejection(t_ns=20, source="udp", reason=Reason.GARBAGE, count=7))
    assert refusals.total == {Reason.DUPLICATE: 20, Reason.GARBAGE: 7}
    assert refusals.of("udp").counts == {Reason.GARBAGE: 7}
    assert [one.t_ns for one in refusals.of("1:1").recent] == list(range(20 - RECENT, 20))
    assert not refusals.of("2:1").counts


def test_flood_of_senders_evicts_the_least_recent() -> None:
    refusals = new_refusals()
    for n in range(2 * SENDERS_MAX):
        refusals.add(Rejection(t_ns=n, source=f"icao:{n:06X}", reason=Reason.NO_POSITION))
        refusals.add(Rejection(t_ns=n, source="1:1", reason=Reason.DUPLICATE))
    assert len(refusals._senders) == SENDERS_MAX
    assert refusals.total == {
        Reason.NO_POSITION: 2 * SENDERS_MAX,
        Reason.DUPLICATE: 2 * SENDERS_MAX,
    }
    assert refusals.of("1:1").counts == {Reason.DUPLICATE: 2 * SENDERS_MAX}


def refused(
    t_s: float,
    uav: str = "3:1",
    reason: Reason = Reason.UNREACHABLE,
    msgid: int = GLOBAL_POSITION_INT,
) -> Rejection:
    return Rejection(
        t_ns=round(t_s * 1e9),
        source=uav,
        reason=reason,
        msgid=msgid,
        detail="45.0 m from the prediction, at most 4.0 m possible",
    )


def told_at(refusals: Refusals, rejections: list[Rejection]) -> list[float]:
    return [one.t_ns * 1e-9 for one in rejections if refusals.add(one) is not None]


def test_one_second_of_rejected_reports_is_announced_once() -> None:
    refusals = new_refusals()
    assert told_at(refusals, [refused(t / 4) for t in range(20)]) == [1.0]
    said = refusals.add(refused(7, "4:1"))
    assert said is None
    said = refusals.add(refused(8.5, "4:1"))
    assert said is not None
    assert said.text == (
        "no report of 4:1 was used in the last 1.5 s: unreachable,"
        " 45.0 m from the prediction, at most 4.0 m possible"
    )


def test_accepted_report_ends_the_run_of_rejections() -> None:
    refusals = new_refusals()
    for t in range(40):
        assert refusals.add(refused(t / 4)) is None
        if t % 3 == 0:
            refusals.used("3:1")


def test_consecutive_runs_are_announced_at_most_every_ten_seconds() -> None:
    refusals = new_refusals()
    told = []
    for t in range(30):
        told += told_at(refusals, [refused(t), refused(t + 0.5, reason=Reason.FROZEN)])
        told += told_at(refusals, [refused(t + 0.9)] if t % 2 else [])
        if t % 2:
            refusals.used("3:1")
    assert told == [1.0, 11.0, 21.0]


def test_rejections_unrelated_to_own_reports_are_not_announced() -> None:
    refusals = new_refusals()
    for reason in (Reason.DUPLICATE, Reason.BAD_CRC, Reason.NOT_ALLOWED):
        assert told_at(refusals, [refused(t, reason=reason) for t in range(9)]) == []
    for reason in (Reason.UNSIGNED, Reason.MALFORMED):
        others = [refused(t, reason=reason, msgid=HEARTBEAT) for t in range(9)]
        assert told_at(refusals, others) == []
    assert told_at(refusals, [refused(t, "icao:4CA7B3") for t in range(9)]) == []


def test_shared_id_explains_silence_without_its_own_notice() -> None:
    refusals = new_refusals()
    shared = [refused(t / 4, reason=Reason.SHARED_ID) for t in range(20)]
    assert told_at(refusals, shared) == []
    newest_ns = shared[-1].t_ns
    assert refusals.current_rejection("3:1", newest_ns + ARRIVING_NS) is Reason.SHARED_ID
    assert refusals.current_rejection("3:1", newest_ns + ARRIVING_NS + 1) is None  # silent now


def test_vehicles_whose_frames_are_dropped_are_remembered_only_if_they_are_tracked() -> None:
    """Ids can be forged in any number; and dropping them has a notice of its own."""
    refusals = Refusals(Records(UavRecord, {"3:1"}.__contains__))
    for number in range(5):
        for uav in ("3:1", "7:7"):
            assert refusals.add(refused(number, uav, Reason.NEWCOMER)) is None
    assert refusals.current_rejection("3:1", 4_000_000_000) is Reason.NEWCOMER
    assert refusals.current_rejection("7:7", 4_000_000_000) is None
    assert refusals.of("7:7").counts == {Reason.NEWCOMER: 5}


@pytest.mark.parametrize(
    ("reason", "told"),
    [
        (Reason.UNSIGNED, [1.0]),
        (Reason.BAD_SIGNATURE, [1.0]),
        (Reason.REPLAYED, [1.0]),
        (Reason.MALFORMED, [1.0]),
        (Reason.STRANGER, []),  # which has notices of its own
    ],
)
def test_tracked_vehicle_whose_positions_are_all_rejected_is_not_silent(
    reason: Reason, told: list[float]
) -> None:
    refusals = Refusals(Records(UavRecord, {"3:1"}.__contains__))
    assert told_at(refusals, [refused(t / 4, reason=reason) for t in range(20)]) == told
    assert refusals.current_rejection("3:1", 5_000_000_000) is reason


def test_forged_positions_between_accepted_ones_explain_nothing() -> None:
    """Anybody may send unsigned frames in a vehicle's name, and more often than the vehicle."""
    refusals = Refusals(Records(UavRecord, {"3:1"}.__contains__))
    for t in range(100):
        assert refusals.add(refused(t / 20, reason=Reason.UNSIGNED)) is None
        assert refusals.current_rejection("3:1", t * 50_000_000) is None
        if t % 15 == 0:
            refusals.used("3:1")


def test_vehicle_of_which_no_signed_frame_was_ever_accepted_is_named() -> None:
    """One of them in a minute: ids can be forged in any number."""
    refusals = Refusals(Records(UavRecord, set[str]().__contains__))
    several = [
        refused(t / 4 + k / 100, f"{k}:1", Reason.BAD_SIGNATURE)
        for t in range(400)
        for k in range(1, 9)
    ]
    assert told_at(refusals, several) == pytest.approx([1.01, 61.01])
    said = Refusals(Records(UavRecord, set[str]().__contains__))
    texts = {one.text for each in several if (one := said.add(each)) is not None}
    assert texts == {"reports of 1:1 are rejected: bad-signature; check its signing key and clock"}
    strangers = [refused(200 + t, "9:1", Reason.STRANGER) for t in range(99)]
    assert told_at(refusals, strangers) == []


def test_rejections_of_a_link_are_not_announced_as_those_of_a_vehicle() -> None:
    """A polled document of unknown age, for example."""
    refusals, link = new_refusals(), "readsb:http://127.0.0.1:80/data/aircraft.json"
    many = [refused(t / 4, link, Reason.UNPLACED_STAMP) for t in range(20)]
    assert told_at(refusals, many) == []
    assert refusals.of(link).counts == {Reason.UNPLACED_STAMP: 20}


def test_two_aircraft_with_one_address_are_announced_while_they_last() -> None:
    """Of tracked ones: addresses can be invented in any number."""
    tracked = Refusals(Records(UavRecord, {"icao:4CA7B3"}.__contains__))
    many = [refused(t / 4, "icao:4CA7B3", Reason.SHARED_ID) for t in range(120)]
    assert told_at(tracked, many) == [0.0]
    assert told_at(tracked, [refused(50, "icao:4CA7B3", Reason.SHARED_ID)]) == [50.0]
    assert told_at(tracked, [refused(51, "icao:4CA7B4", Reason.SHARED_ID)]) == []
