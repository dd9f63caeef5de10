"""One id from two peers: one vehicle or two. The adversary copies clock and path."""

import random
from collections import deque
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from peer_streams import HOME, OTHER, Place, S, Stream, beside, circle, heard, report

from companion.mavlink.trust import duplicate_ids, paths
from companion.mavlink.trust.duplicate_ids import KEPT_NS, DuplicateIds
from companion.mavlink.wire.positions import OwnPosition


def refused(judge: DuplicateIds, *streams: Stream) -> dict[str, list[float]]:
    """Return the times of rejections per peer, for interleaved streams."""
    found: dict[str, list[float]] = {HOME: [], OTHER: []}
    for arrives_s, boot_s, peer, place in sorted(one for stream in streams for one in stream):
        if judge.rejects(peer, report(round(arrives_s * S), boot_s, place)):
            found[peer].append(arrives_s)
    return found


# --- one vehicle ----------------------------------------------------------------------------------


def test_same_reports_over_two_routes_are_one_vehicle(delays: random.Random) -> None:
    judge = DuplicateIds()
    slow = heard(OTHER, 10, delay_s=lambda: 0.3 + 2 * delays.random())
    assert refused(judge, heard(HOME, 10), slow) == {HOME: [], OTHER: []}


@pytest.fixture
def delays() -> random.Random:
    return random.Random(5)


@pytest.mark.parametrize("hz", [1, 2.5, 10, 50])
def test_second_port_with_own_stamps_is_one_vehicle(hz: float) -> None:
    judge = DuplicateIds()
    found = refused(judge, heard(HOME, 4, begins_s=0.01), heard(OTHER, hz, begins_s=0.137))
    assert found == {HOME: [], OTHER: []}


def test_restarted_radio_with_new_address_is_one_vehicle() -> None:
    judge = DuplicateIds()
    found = refused(judge, heard(HOME, 10, lasts_s=20), heard(OTHER, 10, lasts_s=60, begins_s=20.1))
    assert found == {HOME: [], OTHER: []}


def test_position_resets_are_not_a_duplicate_id() -> None:
    def glitches(t_s: float) -> Place:
        return beside(30.0 if t_s % 20 > 10 else 0.0)(t_s)

    judge = DuplicateIds()
    both = heard(HOME, 4, told=glitches), heard(OTHER, 5, told=glitches)
    assert refused(judge, *both) == {HOME: [], OTHER: []}


def test_restart_is_not_a_duplicate_id() -> None:
    def again(stream: Stream) -> Stream:
        return ((at + 61, boot - 99, peer, beside(500)(at)) for at, boot, peer, _ in stream)

    judge = DuplicateIds()
    slow = heard(OTHER, 5, delay_s=lambda: 2.0)
    both = heard(HOME, 4), slow, again(heard(HOME, 4)), again(heard(OTHER, 5))
    assert refused(judge, *both) == {HOME: [], OTHER: []}


# --- two senders ----------------------------------------------------------------------------------


@pytest.mark.parametrize("forged_hz", [1, 4, 20])
@pytest.mark.parametrize("metres", [8.0, -8.0, 30.0])
def test_duplicate_with_copied_clock_and_nearby_path_is_detected(
    forged_hz: float, metres: float
) -> None:
    judge = DuplicateIds()
    forged = heard(OTHER, forged_hz, begins_s=10.03, told=beside(metres))
    found = refused(judge, heard(HOME, 4), forged)
    assert found[HOME] == []
    assert 12 < found[OTHER][0] < 17, "from then on the one that came later is not believed"
    assert found[OTHER][-1] > 58


def test_duplicate_with_inconsistent_velocity_is_detected() -> None:
    def drifts(t_s: float) -> Place:
        return circle(t_s)._replace(east_mps=circle(t_s).east_mps + 10)

    judge = DuplicateIds()
    assert refused(judge, heard(HOME, 4), heard(OTHER, 4, begins_s=10.1, told=drifts))[OTHER]


def test_early_and_late_stamps_are_compared_with_the_path() -> None:
    for delay_s in (0.0, 1.5):
        judge = DuplicateIds()
        late = heard(OTHER, 5, told=beside(10), delay_s=lambda by_s=delay_s: by_s)
        found = refused(judge, heard(HOME, 5, delay_s=lambda: 0.7), late)
        later = OTHER if delay_s > 0.7 else HOME
        assert [peer for peer, times in found.items() if times] == [later]


@pytest.mark.parametrize("begins_s", [(0.0, 10.1), (10.1, 0.0)])
def test_trusted_peer_is_believed_over_the_other_one(begins_s: tuple[float, float]) -> None:
    judge = DuplicateIds([HOME])
    trusted = heard(HOME, 4, begins_s=begins_s[0])
    found = refused(judge, trusted, heard(OTHER, 4, begins_s=begins_s[1], told=beside(20)))
    assert found[HOME] == []
    assert len(found[OTHER]) > 150


def test_agreeing_peers_are_trusted_again_until_a_new_conflict() -> None:
    def two_visits(t_s: float) -> bool:
        return 10 < t_s < 20 or 60 < t_s < 70

    judge = DuplicateIds()
    visits = (one for one in heard(OTHER, 4, lasts_s=110, told=beside(20)) if two_visits(one[0]))
    found = refused(judge, heard(HOME, 4, lasts_s=120), visits)
    assert found[HOME] == []
    assert [t_s for t_s in found[OTHER] if t_s < 20]
    assert [t_s for t_s in found[OTHER] if 60 < t_s < 70]


def test_peers_beyond_the_limit_are_rejected_until_an_earlier_one_is_silent() -> None:
    """One peer under five names was never followed long enough to be contradicted."""
    judge = DuplicateIds()
    names = [f"10.0.0.{n}:9" for n in range(duplicate_ids.PEERS_MAX + 2)]
    first = [judge.rejects(name, report(S, 1, circle(1))) for name in names]
    assert first == [None] * duplicate_ids.PEERS_MAX + [duplicate_ids.NO_PLACE] * 2
    assert judge.rejects(names[-1], report(2 * S + KEPT_NS, 60, circle(60))) is None


def test_first_peer_stays_believed_however_many_contradict_it() -> None:
    judge, found = DuplicateIds(), set[str]()
    streams = [
        heard(HOME, 4),
        *(heard(f"10.0.0.{n}:9", 4, begins_s=5.0 + n / 50, told=beside(20 + n)) for n in range(8)),
    ]
    for arrives_s, boot_s, peer, place in sorted(one for stream in streams for one in stream):
        contradicts = judge.rejects(peer, report(round(arrives_s * S), boot_s, place))
        assert contradicts is None or peer != HOME
        found |= {peer} if contradicts == (HOME, True) else set()
    assert found


# --- bounds ---------------------------------------------------------------------------------------


def test_invented_ids_and_addresses_use_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(duplicate_ids, "SENDERS_MAX", 8)
    judge = DuplicateIds()
    for number in range(200):
        peer, sysid = f"10.0.0.9:{number}", number % 100 + 1
        judge.rejects(peer, report(number, number, circle(0), sysid))
        judge.rejects(peer, report(number, number, circle(0)))
    assert len(judge._senders) == 8
    assert max(len(sender.paths) for sender in judge._senders.values()) <= duplicate_ids.PEERS_MAX
    assert judge._senders.keys() == {(number, 1) for number in range(1, 9)}
    later_ns = 200 + KEPT_NS
    judge.rejects(HOME, report(later_ns, 1, circle(0), 99))
    assert (99, 1) in judge._senders


@given(
    stamps=st.sets(st.integers(0, 40), max_size=20),
    boot_ms=st.integers(-1, 41),
    later_ms=st.integers(0, 20),
)
def test_path_search_from_the_newest_matches_a_full_search(
    stamps: set[int], boot_ms: int, later_ms: int
) -> None:
    """A report lies near the end of a path; searching backwards from there gives the same
    result.
    """

    def said(stamp_ms: int) -> OwnPosition:
        return OwnPosition(
            boot_ms=stamp_ms,
            lat_1e7=0,
            lon_1e7=0,
            alt_m=0.0,
            relative_alt_m=None,
            velocity_ned_mps=None,
            heading_deg=None,
        )

    reports = deque(map(said, sorted(stamps)))
    first, last = said(boot_ms), said(boot_ms + later_ms)
    around = [one for one in pairwise(reports) if one[0].boot_ms <= boot_ms <= one[1].boot_ms]
    within = [one for one in reports if first.boot_ms <= one.boot_ms <= last.boot_ms]
    assert list(paths.around(reversed(reports), boot_ms)) == around[::-1]
    assert list(paths.within(reversed(reports), first, last)) == within[::-1]
