"""Rejections: counted by sender, with bounded memory under a flood of ids."""

from companion.pipeline.records import Records, UavRecord
from companion.pipeline.refusals import RECENT, SENDERS_MAX, Refusals
from companion.values import Reason, Rejection


def made_refusals() -> Refusals:
    return Refusals(Records(UavRecord, set[str]().__contains__))


def test_counts_by_sender_and_reason() -> None:
    refusals = made_refusals()
    for n in range(20):
        refusals.add(Rejection(t_ns=n, source="1:1", reason=Reason.DUPLICATE))
    refusals.add(Rejection(t_ns=20, source="udp", reason=Reason.GARBAGE, count=7))
    assert refusals.total == {Reason.DUPLICATE: 20, Reason.GARBAGE: 7}
    assert refusals.of("udp").counts == {Reason.GARBAGE: 7}
    assert [one.t_ns for one in refusals.of("1:1").recent] == list(range(20 - RECENT, 20))
    assert not refusals.of("2:1").counts


def test_a_flood_of_senders_forgets_the_one_heard_of_longest_ago() -> None:
    refusals = made_refusals()
    for n in range(2 * SENDERS_MAX):
        refusals.add(Rejection(t_ns=n, source=f"icao:{n:06X}", reason=Reason.NO_POSITION))
        refusals.add(Rejection(t_ns=n, source="1:1", reason=Reason.DUPLICATE))
    assert len(refusals._senders) == SENDERS_MAX
    assert refusals.total == {
        Reason.NO_POSITION: 2 * SENDERS_MAX,
        Reason.DUPLICATE: 2 * SENDERS_MAX,
    }
    assert refusals.of("1:1").counts == {Reason.DUPLICATE: 2 * SENDERS_MAX}


def refused(t_s: float, uav: str = "3:1", reason: Reason = Reason.UNREACHABLE) -> Rejection:
    return Rejection(
        t_ns=round(t_s * 1e9),
        source=uav,
        reason=reason,
        detail="45.0 m off, at most 4.0 m possible",
    )


def told_at(refusals: Refusals, rejections: list[Rejection]) -> list[float]:
    return [one.t_ns * 1e-9 for one in rejections if refusals.add(one) is not None]


def test_a_second_without_a_report_that_is_used_is_told_once() -> None:
    refusals = made_refusals()
    assert told_at(refusals, [refused(t / 4) for t in range(20)]) == [1.0]
    said = refusals.add(refused(7, "4:1"))
    assert said is None
    said = refusals.add(refused(8.5, "4:1"))
    assert said is not None
    assert said.text == (
        "no report of 4:1 was used in the last 1.5 s: unreachable,"
        " 45.0 m off, at most 4.0 m possible"
    )


def test_a_report_that_is_used_ends_the_run() -> None:
    refusals = made_refusals()
    for t in range(40):
        assert refusals.add(refused(t / 4)) is None
        if t % 3 == 0:
            refusals.used("3:1")


def test_runs_that_follow_one_another_are_told_every_ten_seconds_at_most() -> None:
    refusals = made_refusals()
    told = []
    for t in range(30):
        told += told_at(refusals, [refused(t), refused(t + 0.5, reason=Reason.FROZEN)])
        told += told_at(refusals, [refused(t + 0.9)] if t % 2 else [])
        if t % 2:
            refusals.used("3:1")
    assert told == [1.0, 11.0, 21.0]


def test_what_is_no_report_about_its_sender_is_told_of_nobody() -> None:
    refusals = made_refusals()
    for reason in (Reason.DUPLICATE, Reason.BAD_CRC, Reason.NOT_ALLOWED, Reason.UNSIGNED):
        assert told_at(refusals, [refused(t, reason=reason) for t in range(9)]) == []
    assert told_at(refusals, [refused(t, "icao:4CA7B3") for t in range(9)]) == []


def test_reports_under_a_shared_id_are_why_a_uav_is_silent_and_are_told_elsewhere() -> None:
    refusals = made_refusals()
    shared = [refused(t / 4, reason=Reason.SHARED_ID) for t in range(20)]
    assert told_at(refusals, shared) == []
    assert refusals.unheard("3:1") is Reason.SHARED_ID
