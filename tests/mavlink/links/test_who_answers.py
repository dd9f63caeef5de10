"""TIMESYNC answers are accepted only from the peer that delivers the sender's positions."""

import pytest
from link_support import frame

from companion.mavlink.links.peers import STAMPS_KEPT_NS
from companion.mavlink.links.transport import Link
from companion.mavlink.links.urls import parse_link
from companion.mavlink.trust.known_peers import KnownPeers
from companion.mavlink.wire.encode import TIMESYNC, pack, timesync
from companion.mavlink.wire.framing import Splitter
from companion.values import Frame, Reason, Rejection, Source

VEHICLE = Source(1, 1)
HOME, ELSEWHERE = ("10.0.0.1", 14550), ("10.0.0.66", 4000)


class Taken:
    """A link fed by hand, and its last output."""

    def __init__(self, known_peers: KnownPeers | None = None) -> None:
        self.found: list[Frame | Rejection] = []
        self.now_ns = 1_000_000_000
        link = parse_link("udpin:127.0.0.1:0")
        self.link = Link(
            url=link, receive=self.found.extend, now_ns=lambda: self.now_ns, known_peers=known_peers
        )

    def take(self, peer: object, raw: bytes) -> Frame | Rejection:
        """Return the result for a frame."""
        self.found.clear()
        self.link.take(peer, raw)
        (one,) = self.found
        return one


def answer(remote_ns: int = 77_000_000_000) -> bytes:
    """Return an answer of the vehicle, with the id of its packer."""
    message = timesync(VEHICLE, 5_000_191)
    payload = remote_ns.to_bytes(8, "little") + message.payload[8:]
    return pack(message._replace(payload=payload), 0, 2)


@pytest.fixture
def taken() -> Taken:
    return Taken()


def test_timesync_answer_must_come_from_the_position_peer(taken: Taken) -> None:
    assert isinstance(taken.take(HOME, frame(1)), Frame)
    assert isinstance(taken.take(HOME, answer()), Frame)
    forged = taken.take(ELSEWHERE, answer())
    assert isinstance(forged, Rejection)
    assert (forged.source, forged.reason, forged.msgid) == (
        "1:1", Reason.STRANGER, TIMESYNC,
    )  # fmt: skip


def test_answer_without_positions_from_anywhere_is_rejected(taken: Taken) -> None:
    forged = taken.take(ELSEWHERE, answer())
    assert isinstance(forged, Rejection)
    assert forged.reason is Reason.UNPLACED_STAMP


def test_answers_are_accepted_from_the_peer_that_was_first(taken: Taken) -> None:
    """A stranger whose positions agree for some seconds must not move the clock."""
    for number in range(80):
        taken.now_ns += 100_000_000
        for way in (HOME, ELSEWHERE):
            taken.take(way, frame(100 * number))
    assert isinstance(taken.take(HOME, answer()), Frame)
    forged = taken.take(ELSEWHERE, answer())
    assert isinstance(forged, Rejection)
    assert forged.reason is Reason.UNPLACED_STAMP
    asked = taken.link._peers.route_to(VEHICLE)
    assert asked is not None and asked.key == HOME
    for number in range(80, 110):  # the first falls silent
        taken.now_ns += 100_000_000
        taken.take(ELSEWHERE, frame(100 * number))
    assert isinstance(taken.take(ELSEWHERE, answer()), Frame)
    asked = taken.link._peers.route_to(VEHICLE)
    assert asked is not None and asked.key == ELSEWHERE


def test_answers_are_accepted_from_every_router() -> None:
    taken = Taken(KnownPeers(("10.0.0.1", "10.0.0.66")))
    for number in range(3):
        taken.now_ns += 100_000_000
        for way in (HOME, ELSEWHERE):
            taken.take(way, frame(100 * number))
    assert all(isinstance(taken.take(way, answer()), Frame) for way in (HOME, ELSEWHERE))


def test_positions_of_another_sender_do_not_authorise_answers(taken: Taken) -> None:
    taken.take(ELSEWHERE, frame(1, sysid=66))
    assert isinstance(taken.take(ELSEWHERE, answer()), Rejection)


def test_answer_from_a_long_silent_peer_is_rejected(taken: Taken) -> None:
    taken.take(HOME, frame(1))
    taken.now_ns += STAMPS_KEPT_NS + 1
    assert isinstance(taken.take(HOME, answer()), Rejection)


def test_timesync_request_is_not_treated_as_an_answer(taken: Taken) -> None:
    assert isinstance(taken.take(ELSEWHERE, answer(0)), Frame)
    assert Splitter("x").feed(0, answer(0))


def test_sequence_numbers_of_strangers_count_for_no_vehicle(taken: Taken) -> None:
    """They would show a vehicle as lossy that loses nothing."""
    for number in range(50):
        taken.now_ns += 100_000_000
        taken.take(HOME, frame(100 * number, seq=number))
        taken.take(ELSEWHERE, frame(100 * number + 7, sysid=1, seq=50 * number % 256))
    status = taken.link.status.components[VEHICLE]
    assert status.gaps == 0
    taken.take(HOME, frame(6000, seq=59))
    assert status.gaps == 9
