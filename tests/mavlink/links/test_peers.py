"""Sequence numbers by peer and source: gaps, late frames, repeats and restarts."""

import gc
import random
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from link_support import frame
from support import rounds

from companion.mavlink.links import peers as peers_module
from companion.mavlink.links.peers import (
    COMPONENTS_MAX,
    PEERS_MAX,
    RESTART_RUN,
    SENDERS_MAX,
    Peer,
    Peers,
)
from companion.mavlink.links.status import LinkStatus
from companion.mavlink.wire.framing import Splitter
from companion.settings.model import Settings
from companion.values import Frame, Reason, Rejection, Source

UAV = Source(1, 1)
LINK = "udpin:127.0.0.1:14550"
(MADE,) = Splitter(LINK).feed(0, frame(1))
assert isinstance(MADE, Frame)


def numbered(number: int, source: Source = UAV, t_ns: int = 0) -> Frame:
    """Return a frame for counting: its checksum is assumed valid."""
    raw = bytearray(MADE.raw)
    raw[4:7] = number & 0xFF, *source
    return Frame(t_ns=t_ns, link=LINK, source=source, msgid=MADE.msgid, raw=bytes(raw))


class Heard:
    """Peers of a link, and the evicted ones."""

    def __init__(self) -> None:
        self.status = LinkStatus(url=LINK)
        self.farewells: list[Peer] = []
        self.peers = Peers(status=self.status, on_evict=self.farewells.append)

    def hear(
        self, numbers: Iterable[int], key: str = "a", source: Source = UAV, t_ns: int = 0
    ) -> "Heard":
        self.peers.count(self.peers.at(key), [numbered(n, source, t_ns) for n in numbers])
        return self

    @property
    def counts(self) -> tuple[int, int, int]:
        return self.status.gaps, self.status.late, self.status.repeats


@given(st.integers(0, 255), st.lists(st.integers(1, 127), max_size=200))
def test_sequence_gaps_below_half_the_range_are_counted(first: int, steps: list[int]) -> None:
    """Consecutive frames, of which some are lost."""
    number, numbers = first, [first]
    for step in steps:
        numbers.append(number := number + step)
    heard = Heard().hear(numbers)
    assert heard.counts == (numbers[-1] - first + 1 - len(numbers), 0, 0)
    assert heard.status.components[UAV].gaps == heard.status.gaps
    assert heard.status.frames == len(numbers)


@given(st.integers(0, 255), st.lists(st.integers(1, 5), max_size=200))
def test_repeated_frames_are_counted(first: int, times: list[int]) -> None:
    numbers = [first + n for n, copies in enumerate(times) for _ in range(copies)]
    assert Heard().hear(numbers).counts == (0, 0, sum(times) - len(times))


@given(st.integers(0, 255), st.lists(st.booleans(), max_size=200))
def test_swapped_frames_count_as_one_gap_and_one_late(first: int, swaps: list[bool]) -> None:
    numbers = list(range(first, first + 1 + 2 * len(swaps)))
    for n, swapped in enumerate(swaps):
        if swapped:
            at = 1 + 2 * n
            numbers[at], numbers[at + 1] = numbers[at + 1], numbers[at]
    assert Heard().hear(numbers).counts == (sum(swaps), sum(swaps), 0)


@pytest.mark.parametrize("behind", [2, 10, 126])
def test_stragglers_do_not_count_as_restart(behind: int) -> None:
    """Two routes, one of them slower: nothing is missing, each frame arrives twice."""
    numbers = [n for at in range(1000) for n in ((at, at - behind) if at > behind else (at,))]
    assert Heard().hear(numbers).counts == (0, 999 - behind, 0)


def test_reversed_frames_do_not_count_as_restart() -> None:
    """A restart counts upwards."""
    assert Heard().hear([1, 10, 9, 8, 7, 6, 5, 11]).counts == (8, 5, 0)


@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_restart_causes_at_most_one_wrong_gap(lost: float) -> None:
    """From any number to any other; also over a lossy link, whose own gaps count."""
    chance = random.Random(1)
    for last in range(0, 256, rounds(25, 5)):
        for first in range(256):
            heard = Heard().hear([last])
            arrived = [first + n for n in range(40) if n == 0 or chance.random() >= lost]
            heard.hear(arrived)
            holes = arrived[-1] - first + 1 - len(arrived)
            gaps, late, repeats = heard.counts
            step = (first - last) & 0xFF
            if 0 < step < 128:  # forwards: indistinguishable from a gap
                assert (gaps, late, repeats) == (step - 1 + holes, 0, 0)
            elif step == 0:  # the same number: not noticeable
                assert (gaps, late, repeats) == (holes, 0, 1)
            else:  # backwards: followed once certain, or once caught up
                assert gaps <= holes and late + repeats <= RESTART_RUN and repeats <= 1


def test_gaps_are_counted_after_a_restart() -> None:
    heard = Heard().hear(range(50, 100)).hear(range(20))
    assert heard.counts == (0, RESTART_RUN, 0)
    heard.hear(range(25, 30))
    assert heard.counts == (5, RESTART_RUN, 0)


def test_gap_of_256_frames_is_not_detectable() -> None:
    """An 8-bit number cannot show it."""
    assert Heard().hear([0, 1, 256 + 2]).counts == (0, 0, 0)
    assert Heard().hear([0, 1, 256 + 5]).counts == (3, 0, 0)


def test_sequence_numbers_are_tracked_per_peer_and_source() -> None:
    heard = Heard()
    for n in range(300):
        heard.hear([n], "a", UAV, t_ns=n)
        heard.hear([n + 100], "a", Source(1, 2), t_ns=n)
        heard.hear([7 * n], "b", Source(2, 1), t_ns=n)
        heard.hear([n + 50], "b", UAV, t_ns=1000 + n)
    status = heard.status
    assert heard.counts == (6 * 299, 0, 0)
    assert {source: c.gaps for source, c in status.components.items()} == {
        UAV: 0,
        Source(1, 2): 0,
        Source(2, 1): 6 * 299,
    }
    assert status.components[UAV].frames == 600
    assert status.components[UAV].heard_ns == status.heard_ns == 1299
    assert status.components[Source(1, 2)].heard_ns == 299
    assert (status.frames, status.peers) == (1200, 2)


def test_mavlink_version_of_each_peer_is_recorded() -> None:
    heard = Heard()
    peer = heard.peers.at("a")
    assert not peer.speaks_v1_only
    for version in (1, 1, 2, 1):
        (item,) = Splitter(LINK).feed(0, frame(1, version=version))
        heard.peers.count(peer, [item])
        assert heard.status.components[UAV].mavlink == version
    assert not peer.speaks_v1_only
    other = heard.peers.at("b")
    heard.peers.count(other, Splitter(LINK).feed(0, frame(1, version=1)))
    assert other.speaks_v1_only


def test_rejections_are_counted_by_reason_without_other_effect() -> None:
    heard = Heard()
    peer = heard.peers.at("a")
    lost = [
        Rejection(t_ns=5, source=LINK, reason=Reason.GARBAGE, count=7),
        Rejection(t_ns=5, source="1:1", reason=Reason.UNSIGNED),
    ]
    heard.peers.count(peer, [*lost, *lost])
    assert heard.status == LinkStatus(url=LINK, peers=1, lost={"garbage": 14, "unsigned": 2})
    assert peer.heard_ns is None and heard.peers.active_since(0) == []


def test_peer_of_replayed_frames_gets_messages_by_which_its_sender_learns_the_time() -> None:
    heard = Heard()
    replayed = Rejection(t_ns=5, source="1:1", reason=Reason.REPLAYED)
    heard.peers.count(heard.peers.at("a"), [replayed])
    assert [peer.key for peer in heard.peers.active_since(5)] == ["a"]
    assert heard.peers.route_to(UAV) is None and heard.status.frames == 0


def test_source_is_located_at_the_peer_last_received_from() -> None:
    heard = Heard().hear([1], "a").hear([1], "b").hear([1], "c", Source(2, 1))
    peers = heard.peers
    assert peers.route_to(UAV) is peers.find("b")
    heard.hear([2], "a")
    assert peers.route_to(UAV) is peers.find("a")
    assert peers.route_to(Source(2, 1)) is peers.find("c")
    assert peers.route_to(Source(3, 1)) is None
    peers.forget(peers.at("a"))
    assert peers.route_to(UAV) is None
    peers.at("a")  # a new peer at the old address has not been received yet
    assert peers.route_to(UAV) is None


def test_recently_received_peers_are_active() -> None:
    heard = Heard().hear([1], "old", t_ns=99).hear([1], "new", t_ns=100)
    heard.peers.at("silent")
    assert [peer.key for peer in heard.peers.active_since(100)] == ["new"]


def test_each_peer_has_its_own_send_sequence() -> None:
    heard = Heard()
    a, b = heard.peers.at("a"), heard.peers.at("b")
    assert [a.next_sequence() for _ in range(258)] == [*range(256), 0, 1]
    assert b.next_sequence() == 0


def test_least_recent_peers_are_evicted() -> None:
    heard = Heard()
    for n in range(PEERS_MAX + 10):
        heard.peers.at(n)
        heard.peers.at(0)  # a peer that keeps sending is kept
    assert len(heard.peers) == PEERS_MAX
    assert [peer.key for peer in heard.farewells] == list(range(1, 11))
    assert heard.peers.find(0) is not None and heard.peers.find(1) is None


def test_invented_senders_use_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """A steady sender loses at most the gap count of that moment."""
    assert SENDERS_MAX <= 1 << 16
    monkeypatch.setattr(peers_module, "SENDERS_MAX", 100)
    heard = Heard()
    for n in range(1000):
        heard.hear([n], "steady")
        heard.hear([5], f"bad {n % 7}", Source(n % 250, n % 251))
        kept = [heard.peers.at(key) for key in ("steady", *(f"bad {k}" for k in range(7)))]
        assert sum(len(peer.senders) for peer in kept) <= 100
        if n == 500:
            for key in range(7):
                heard.peers.forget(heard.peers.at(f"bad {key}"))
    assert heard.counts == (0, 0, 0)


def test_sources_from_ever_new_peers_use_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Evicted peers were kept by the sources that they had sent: 421 MB after nine minutes."""
    monkeypatch.setattr(peers_module, "PEERS_MAX", 50)
    monkeypatch.setattr(peers_module, "COMPONENTS_MAX", 200)
    heard = Heard()
    for n in range(2000):
        source = Source(2 + n // 250, 1 + n % 250)
        heard.hear([n], "steady", t_ns=n).hear([5], f"ever new {n}", source, t_ns=n)
        heard.farewells.clear()
        assert len(heard.status.components) <= 200
        assert heard.peers.route_to(source) is heard.peers.find(f"ever new {n}")
    kept = [one for one in gc.get_objects() if type(one) is Peer and str(one.key)[:8] == "ever new"]
    assert len(kept) < 100
    assert heard.status.components[UAV].frames == 2000
    assert heard.hear([2000], "steady").peers.route_to(UAV) is heard.peers.find("steady")
    assert heard.counts == (0, 0, 0)


def test_default_limit_of_sources_exceeds_that_of_tracks() -> None:
    assert Settings().tracks.most < COMPONENTS_MAX


def test_evicted_peers_do_not_affect_active_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """However many there were: remaining peers are tracked, and every gap is counted."""
    monkeypatch.setattr(peers_module, "SENDERS_MAX", 10)
    heard = Heard()
    for n in range(100):
        heard.hear([2 * n], "steady")
        heard.hear([1], "passing", Source(2, 1))
        heard.peers.forget(heard.peers.at("passing"))
    assert heard.counts == (99, 0, 0)
