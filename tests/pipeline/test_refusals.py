"""What was refused is counted, by whom, and a flood of names is bounded."""

from companion.pipeline.refusals import RECENT, SENDERS_MAX, Refusals
from companion.values import Reason, Rejection


def test_counts_by_sender_and_reason() -> None:
    refusals = Refusals()
    for n in range(20):
        refusals.add(Rejection(n, "1:1", Reason.DUPLICATE))
    refusals.add(Rejection(20, "udp", Reason.GARBAGE, 7))
    assert refusals.total == {Reason.DUPLICATE: 20, Reason.GARBAGE: 7}
    assert refusals.of("udp").counts == {Reason.GARBAGE: 7}
    assert [one.t_ns for one in refusals.of("1:1").recent] == list(range(20 - RECENT, 20))
    assert not refusals.of("2:1").counts
    assert refusals.senders() == ["1:1", "udp"]


def test_a_flood_of_senders_forgets_the_one_heard_of_longest_ago() -> None:
    refusals = Refusals()
    for n in range(2 * SENDERS_MAX):
        refusals.add(Rejection(n, f"icao:{n:06X}", Reason.NO_POSITION))
        refusals.add(Rejection(n, "1:1", Reason.DUPLICATE))
    assert len(refusals.senders()) == SENDERS_MAX
    assert refusals.total == {
        Reason.NO_POSITION: 2 * SENDERS_MAX,
        Reason.DUPLICATE: 2 * SENDERS_MAX,
    }
    assert refusals.of("1:1").counts == {Reason.DUPLICATE: 2 * SENDERS_MAX}
