"""Known peers and strangers: who was first stays believed, a second route of one vehicle counts."""

import math
import struct
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from peer_streams import HOME, LINK, OTHER, Place, S, Stream, beside, circle, heard, report
from pymavlink.dialects.v20 import all as dialect

from companion.mavlink.trust import known_peers, paths
from companion.mavlink.trust.duplicate_ids import KEPT_NS
from companion.mavlink.trust.known_peers import (
    BROUGHT,
    PROBATION_NS,
    REBOOT_NS,
    STRANGER,
    KnownPeers,
    PeerRank,
)
from companion.mavlink.trust.peer_notices import Disagreement
from companion.mavlink.wire.attitudes import ATTITUDE_QUATERNION_COV, GPS2_RAW, ODOMETRY
from companion.mavlink.wire.decode import (
    ATTITUDE,
    EKF_STATUS_REPORT,
    GPS_RAW_INT,
    HEARTBEAT,
    SYSTEM_TIME,
)
from companion.mavlink.wire.encode import TIMESYNC, Outgoing, heartbeat, pack
from companion.mavlink.wire.framing import Splitter
from companion.mavlink.wire.positions import GLOBAL_POSITION_INT, HIGH_LATENCY2
from companion.mavlink.wire.transponder import ADSB_VEHICLE
from companion.values import Frame, Source

PROBATION_S = PROBATION_NS / S
LOCAL_POSITION_NED = 32


def rejected(peers: KnownPeers, *streams: Stream) -> dict[str, list[float]]:
    """Return the times of rejections per peer, for interleaved streams."""
    found: dict[str, list[float]] = {}
    for arrives_s, boot_s, peer, place in sorted(one for stream in streams for one in stream):
        found.setdefault(peer, [])
        if peers.refusal(LINK, peer, report(round(arrives_s * S), boot_s, place)) is not None:
            found[peer].append(arrives_s)
    return found


def notices(peers: KnownPeers, what: Disagreement) -> list[tuple[str, str, tuple[str, ...]]]:
    return [(who, peer, known) for kind, who, peer, known in peers.notices if kind is what]


def message(t_s: float, out: Outgoing) -> Frame:
    (frame,) = Splitter("x").feed(round(t_s * S), pack(out, 0, 2))
    assert isinstance(frame, Frame)
    return frame


def drifting(rate_mps: float, from_s: float) -> Callable[[float], Place]:
    return lambda t_s: beside(rate_mps * max(0.0, t_s - from_s))(t_s)


# --- one vehicle ----------------------------------------------------------------------------------


@pytest.mark.parametrize("hz", [1, 2.5, 10, 50])
@pytest.mark.parametrize("delay_s", [0.05, 0.7, 10.0])
def test_second_route_is_used_once_it_has_agreed(hz: float, delay_s: float) -> None:
    """Also with stamps of its own, and if it is slower than the first.

    The path of the first is followed from the arrival of the second, and reached that much later.
    """
    peers, second = KnownPeers(), heard(OTHER, hz, begins_s=10.137, delay_s=lambda: delay_s)
    found = rejected(peers, heard(HOME, 4), second)
    assert notices(peers, Disagreement.CONTRADICTS) == []
    assert found[HOME] == []
    assert found[OTHER]
    assert max(found[OTHER]) <= 10.137 + PROBATION_S + 2 * delay_s + max(2.0, 2 / hz)


def test_second_route_agrees_on_the_antimeridian() -> None:
    peers, refused = KnownPeers(), list[float]()
    for number in range(600):
        t_s = number / 10
        for peer, late_s in ((HOME, 0.0), (OTHER, 0.04)):
            frame = report(
                round((t_s + 0.05) * S), 100 + t_s - late_s, circle(t_s - late_s), 1, 180e7
            )
            if peers.refusal(LINK, peer, frame) is not None:
                refused.append(t_s)
                assert peer == OTHER
    assert notices(peers, Disagreement.CONTRADICTS) == [] and max(refused) <= PROBATION_S + 1.0


def test_restarted_radio_with_new_address_is_used_after_a_second() -> None:
    peers = KnownPeers()
    found = rejected(peers, heard(HOME, 10, lasts_s=20), heard(OTHER, 10, begins_s=20.1))
    assert found[HOME] == []
    assert all(t_s < 21.1 for t_s in found[OTHER])
    assert notices(peers, Disagreement.CONTRADICTS) == []


def test_peer_whose_connection_ended_keeps_nobody_out() -> None:
    """A vehicle reconnects over TCP: its new connection is used from its first frame."""
    peers, source = KnownPeers(), Source(1, 1)
    rejected(peers, heard(HOME, 10, lasts_s=20))
    assert peers.rank(LINK, OTHER, source, 20 * S) is PeerRank.STRANGER
    peers.connection_ended(HOME, [source, Source(9, 1)])
    assert peers.rank(LINK, OTHER, source, 20 * S) is PeerRank.FIRST
    assert rejected(peers, heard(OTHER, 10, begins_s=20.1)) == {OTHER: []}


def test_stranger_that_contradicted_is_none_when_the_connection_ends() -> None:
    peers, source = KnownPeers(), Source(1, 1)
    rejected(peers, heard(HOME, 10, lasts_s=20), heard("x", 10, lasts_s=20, told=beside(80.0)))
    peers.connection_ended(HOME, [source])
    found = rejected(
        peers,
        heard("x", 10, begins_s=20.0, lasts_s=20.5, told=beside(80.0)),
        heard(OTHER, 10, begins_s=20.5),
    )
    assert len(found["x"]) == 5 and found[OTHER] == []


def test_serial_line_that_is_plugged_in_again_keeps_strangers_out() -> None:
    peers = KnownPeers()
    rejected(peers, heard(HOME, 10, lasts_s=20))
    peers.connection_ended(HOME, [Source(1, 1)])
    rejected(peers, heard(HOME, 10, begins_s=20.1, lasts_s=21))
    assert peers.rank(LINK, OTHER, Source(1, 1), 21 * S) is PeerRank.STRANGER


def test_position_resets_of_one_vehicle_cost_the_first_route_nothing() -> None:
    def glitches(t_s: float) -> Place:
        return beside(30.0 if t_s % 20 > 10 else 0.0)(t_s)

    peers = KnownPeers()
    found = rejected(peers, heard(HOME, 4, told=glitches), heard(OTHER, 5, told=glitches))
    assert found[HOME] == []
    assert notices(peers, Disagreement.CONTRADICTS) == []


def test_messages_about_other_aircraft_are_accepted_if_the_known_peer_brings_none() -> None:
    peers = KnownPeers()
    rejected(peers, heard(HOME, 4, lasts_s=10))
    aircraft = Outgoing(Source(1, 1), ADSB_VEHICLE, bytes(range(38)))
    assert peers.refusal(LINK, OTHER, message(10.0, aircraft)) is None
    assert peers.refusal(LINK, HOME, message(10.0, aircraft)) is None
    assert peers.refusal(LINK, OTHER, message(10.0, aircraft)) == STRANGER
    other_id = message(10.0, heartbeat(Source(2, 1)))
    assert peers.refusal(LINK, OTHER, other_id) is None


@pytest.mark.parametrize(
    ("msgid", "payload"),
    [
        (TIMESYNC, struct.pack("<qq", 7, 8)),
        (SYSTEM_TIME, struct.pack("<QI", 7, 8)),
        (116, struct.pack("<Ihhhhhhhhh", 7, *range(1, 10))),  # SCALED_IMU2
        (HEARTBEAT, struct.pack("<IBBBBB", 4, 7, 3, 217, 4, 3)),
        (GPS_RAW_INT, bytes(29) + b"\1"),
        (HIGH_LATENCY2, bytes(41) + b"\1"),
        (EKF_STATUS_REPORT, bytes(20) + b"\1\4"),
        (GPS2_RAW, bytes(34) + b"\1"),
        (ATTITUDE_QUATERNION_COV, bytes(71) + b"\1"),
        (ODOMETRY, bytes(230) + b"\1"),
    ],
)
def test_clocks_and_bounds_are_not_moved_by_strangers(msgid: int, payload: bytes) -> None:
    """By messages too that the known peer does not bring."""
    peers = KnownPeers()
    rejected(peers, heard(HOME, 4, lasts_s=10))
    answer = message(10.0, Outgoing(Source(1, 1), msgid, payload))
    assert peers.refusal(LINK, OTHER, answer) == STRANGER
    assert peers.refusal(LINK, HOME, answer) is None


def attitude(t_s: float, yaw_rad: float) -> Frame:
    payload = struct.pack("<I6f", round((100 + t_s) * 1000), 0.0, 0.0, yaw_rad, 0.0, 0.0, 0.0)
    return message(t_s, Outgoing(Source(1, 1), ATTITUDE, payload))


def with_two_known_peers(routers: frozenset[str] = frozenset()) -> KnownPeers:
    """Peers after twenty seconds in which a second peer agreed about the position."""
    peers = KnownPeers(routers)
    found = rejected(peers, heard(HOME, 10, lasts_s=20), heard(OTHER, 10, begins_s=5, lasts_s=15))
    assert max(found[OTHER]) < 15
    return peers


def test_attitude_of_a_peer_whose_positions_agreed_is_not_used_beside_that_of_the_first() -> None:
    """A stranger that repeats a parked carrier's position must not turn its array."""
    peers = with_two_known_peers()
    for number in range(100):
        t_s = 20 + number / 100
        if number % 10 == 0:
            assert peers.refusal(LINK, HOME, attitude(t_s, 0.5)) is None
        assert peers.refusal(LINK, OTHER, attitude(t_s + 0.09, 0.5 + t_s - 20)) == BROUGHT
    copy = attitude(21.0, 0.5)
    assert peers.refusal(LINK, HOME, copy) is None
    assert peers.refusal(LINK, OTHER, copy) is None  # a duplicate, which is found as such


@pytest.mark.parametrize("is_stranger", [False, True])
@pytest.mark.parametrize(("off_rad", "contradicts"), [(0.0, False), (0.05, False), (0.5, True)])
def test_attitudes_of_two_peers_that_differ_are_announced(
    is_stranger: bool, off_rad: float, contradicts: bool
) -> None:
    """The first may be the stranger that took the vehicle's place while its radio was silent."""
    peers = with_two_known_peers()
    other = "10.0.0.77:5" if is_stranger else OTHER
    for number in range(60):
        t_s, yaw_rad = 20 + number / 10, 3.0 * math.sin(number / 10)
        assert peers.refusal(LINK, HOME, turning(t_s, yaw_rad, 3.0 * math.cos(number / 10))) is None
        t_s, yaw_rad = t_s + 0.06, 3.0 * math.sin(number / 10 + 0.06)
        beside = turning(t_s, yaw_rad + off_rad, 3.0 * math.cos(number / 10 + 0.06))
        assert peers.refusal(LINK, other, beside) == (STRANGER if is_stranger else BROUGHT)
    known = (HOME, OTHER) if is_stranger else (HOME,)
    assert notices(peers, Disagreement.CONTRADICTS) == [("1:1", other, known)] * contradicts


def turning(t_s: float, yaw_rad: float, yawspeed_radps: float) -> Frame:
    stamp_ms = round((100 + t_s) * 1000)
    payload = struct.pack("<I6f", stamp_ms, 0.1, -0.2, yaw_rad, 0.0, 0.0, yawspeed_radps)
    return message(t_s, Outgoing(Source(1, 1), ATTITUDE, payload))


def stamped_attitude(arrives_s: float, stamp_s: float, yaw_rad: float = 0.5) -> Frame:
    return replace_time(attitude(stamp_s, yaw_rad), arrives_s)


def replace_time(frame: Frame, t_s: float) -> Frame:
    return frame._replace(t_ns=round(t_s * S))


def test_newer_attitudes_are_used_once_the_first_peer_has_become_late() -> None:
    """Its radio begins to buffer: the second one brings all in time."""
    peers = with_two_known_peers()
    used = list[float]()
    for number in range(200):
        t_s = 20 + number / 10
        late_s = min(3.0, 0.5 * max(0.0, t_s - 22))
        assert peers.refusal(LINK, HOME, stamped_attitude(t_s + 0.05, t_s - late_s)) is None
        if peers.refusal(LINK, OTHER, stamped_attitude(t_s + 0.09, t_s, 0.6)) is None:
            used.append(t_s)
    assert used == [20 + number / 10 for number in range(27, 200)]
    assert notices(peers, Disagreement.IS_NEWER) == []


@pytest.mark.parametrize("late_s", [0.0, 0.5])
def test_attitudes_from_the_future_are_not_those_of_a_faster_peer(late_s: float) -> None:
    peers = with_two_known_peers()
    for number in range(100):
        t_s = 20 + number / 10
        assert peers.refusal(LINK, HOME, stamped_attitude(t_s, t_s - late_s)) is None
        for ahead_s in (0.2, 0.35, 0.9):
            assert peers.refusal(LINK, OTHER, stamped_attitude(t_s, t_s + ahead_s, 0.6)) == BROUGHT
    named = [(who, peer) for who, peer, _ in notices(peers, Disagreement.IS_NEWER)]
    assert named == ([("1:1", OTHER)] if late_s else [])


def test_attitudes_between_those_of_a_slow_first_peer_are_not_used() -> None:
    """Each is newer than the first peer's last one; that alone makes nobody late."""
    peers = with_two_known_peers()
    for number in range(100):
        t_s = 20 + number / 4
        assert peers.refusal(LINK, HOME, stamped_attitude(t_s + 0.05, t_s)) is None
        for later_s in (0.15, 0.2, 0.25):
            beside = stamped_attitude(t_s + 0.05 + later_s, t_s + later_s + 0.099, 0.6)
            assert peers.refusal(LINK, OTHER, beside) == BROUGHT


def test_first_peer_that_was_always_late_is_believed_and_named() -> None:
    """A second peer may be the faster one, or send stamps from the future: nothing tells which."""
    peers = KnownPeers()
    rejected(
        peers,
        heard(HOME, 10, lasts_s=20, delay_s=lambda: 2.5),
        heard(OTHER, 10, begins_s=5, lasts_s=22),
    )
    for number in range(900):
        t_s = 22 + number / 10
        assert peers.refusal(LINK, HOME, stamped_attitude(t_s, t_s - 2.5)) is None
        early = stamped_attitude(t_s, t_s, 0.6)
        assert peers.refusal(LINK, OTHER, early) in (BROUGHT, STRANGER)
    assert notices(peers, Disagreement.IS_NEWER) == [("1:1", OTHER, (HOME,))]


@pytest.mark.parametrize("off_s", [0.0, 600.0])
def test_positions_over_another_radio_than_attitudes_are_used(off_s: float) -> None:
    """The first radio's attitudes stay in force, unless their stamps are of another clock."""
    peers = KnownPeers()
    used, refused = list[float](), list[float]()
    for number in range(300):
        t_s = number / 10
        turned = peers.refusal(LINK, HOME, attitude(t_s, 0.5))
        if number < 100:
            place = report(round(t_s * S), 100 + t_s, circle(t_s))
            assert peers.refusal(LINK, HOME, place) is None
        else:
            said = report(round(t_s * S), 100 + t_s + off_s, circle(t_s))
            (refused if peers.refusal(LINK, OTHER, said) else used).append(t_s)
        if number > 200:
            assert turned == (STRANGER if off_s else None)
            turned = peers.refusal(LINK, OTHER, attitude(t_s + 0.01, 1.5))
            assert turned in ((None,) if off_s else (BROUGHT, STRANGER))
    assert refused[-1] < used[0] == pytest.approx(15.0, abs=0.3)
    assert notices(peers, Disagreement.REPLACES) == [("1:1", OTHER, (HOME,))]


def summary(t_s: float) -> Frame:
    """Return a HIGH_LATENCY2 at rest, with accuracies of 25 m."""
    fields: dict[str, Any] = dict.fromkeys(dialect.MAVLink_high_latency2_message.fieldnames, 0)
    fields |= {
        "timestamp": round((100 + t_s) * 1000), "latitude": 470_000_000,
        "longitude": 80_000_000, "altitude": 488, "eph": 250, "epv": 250,
    }  # fmt: skip
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    raw = bytes(dialect.MAVLink_high_latency2_message(**fields).pack(mav))
    (frame,) = Splitter("x").feed(round(t_s * S), raw)
    assert isinstance(frame, Frame)
    return frame


def test_accuracies_of_a_summary_from_another_peer_are_not_used() -> None:
    """Its position agrees, but 25 m of error made the links of a carrier at rest weak."""
    peers, at_rest = KnownPeers(), Place(0.0, 0.0, 0.0, 0.0)
    for number in range(200):
        t_s = number / 10
        place = report(round(t_s * S), 100 + t_s, at_rest)
        assert peers.refusal(LINK, HOME, place) is None
        if number > 50:
            assert peers.refusal(LINK, OTHER, summary(t_s + 0.03)) in (STRANGER, BROUGHT)
    used = [peers.refusal(LINK, OTHER, summary(t_s)) is None for t_s in (20.0, 23.0, 26.0, 29.0)]
    assert used[-1]  # the first is silent


def test_accuracies_in_a_gap_of_a_radio_are_those_of_peers_with_positions() -> None:
    peers, status = KnownPeers(), bytes(29) + b"\6"
    for number in range(50):
        place = report(number * S // 10, 100 + number / 10, circle(number / 10))
        assert peers.refusal(LINK, HOME, place) is None

    def refused(peer: str, t_s: float) -> str | None:
        said = message(t_s, Outgoing(Source(1, 1), GPS_RAW_INT, status))
        return peers.refusal(LINK, peer, said)

    assert refused(OTHER, 9.0) == STRANGER
    assert refused(HOME, 9.0) is None
    assert peers.refusal(LINK, OTHER, report(20 * S, 120.0, circle(20.0))) is None
    assert refused(OTHER, 20.1) is None  # the vehicle's radio has another address now


def unusable(t_s: float, lat_1e7: int) -> Frame:
    payload = struct.pack("<IiiiihhhH", round((100 + t_s) * 1000), lat_1e7, 0, 0, 0, 0, 0, 0, 0)
    return message(t_s, Outgoing(Source(1, 1), GLOBAL_POSITION_INT, payload))


@pytest.mark.parametrize("lat_1e7", [0, 1_000_000_000])
def test_peer_without_a_usable_position_does_not_keep_the_vehicle_out(lat_1e7: int) -> None:
    peers = KnownPeers()
    for number in range(200):
        t_s = number / 10
        peers.refusal(LINK, OTHER, unusable(t_s, lat_1e7))
        if number >= 50:
            place = report(round(t_s * S) + 1, 100 + t_s, circle(t_s))
            assert peers.refusal(LINK, HOME, place) is None


def test_peer_that_cannot_be_compared_is_announced() -> None:
    """It was first, and its stamps are of another clock."""
    peers, refused = KnownPeers(), 0
    for number in range(300):
        t_s = number / 10
        if number % 10 == 0:
            place = report(round(t_s * S), 77_000 + t_s, beside(500.0)(t_s))
            assert peers.refusal(LINK, OTHER, place) is None
        if number >= 50:
            place = report(round(t_s * S) + 1, 100 + t_s, circle(t_s))
            refused += peers.refusal(LINK, HOME, place) is not None
    assert refused > 200
    ((who, stranger, known),) = notices(peers, Disagreement.CONTRADICTS)
    assert (who, stranger, known) == ("1:1", HOME, (OTHER,))


def test_stranger_of_another_clock_does_not_replace_a_peer_that_is_silent_for_seconds() -> None:
    """Its radio restarts; after ten seconds the vehicle itself may have been restarted."""
    peers, used = KnownPeers(), list[float]()
    for number in range(500):
        t_s = number / 10
        if number < 100 or 130 <= number < 300:
            peer = HOME if number < 100 else "127.0.0.1:7"
            place = report(round(t_s * S), 100 + t_s, circle(t_s))
            assert peers.refusal(LINK, peer, place) is None, t_s
        place = report(round(t_s * S) + 1, 77_000 + t_s, beside(1.0)(t_s))
        if number > 50 and peers.refusal(LINK, OTHER, place) is None:
            used.append(t_s)
    assert used[0] == pytest.approx(40.0, abs=0.3)


@pytest.mark.parametrize("first_s", [5.5, 2.0, None])
def test_attitudes_over_a_radio_without_positions_are_announced(first_s: float | None) -> None:
    """Nor are they used: a carrier of which only a second radio brings them has no beams."""
    peers = KnownPeers()
    for number in range(200):
        t_s = number / 10
        place = report(round(t_s * S), 100 + t_s, circle(t_s))
        assert peers.refusal(LINK, HOME, place) is None
        if first_s is not None and t_s >= first_s:
            assert peers.refusal(LINK, HOME, attitude(t_s, 0.5)) is None
        assert peers.refusal(LINK, OTHER, attitude(t_s + 0.05, 0.5)) == STRANGER or number == 0
    has_gap = first_s != 2.0
    named = [("1:1", OTHER, (HOME,))] * has_gap
    assert notices(peers, Disagreement.HAS_ATTITUDES) == named


def test_stranger_that_sends_attitudes_alone_does_not_keep_the_vehicle_out() -> None:
    """Before its first position, and while it is silent for seconds. Nor are they used then."""
    peers = KnownPeers()
    for number in range(400):
        t_s = number / 10
        turned = peers.refusal(LINK, OTHER, attitude(t_s, 1.5))
        if number < 100 or 200 <= number < 230:
            assert turned is None or 200 <= number < 222  # nobody else tells anything
            continue
        peer = HOME if number < 230 else "127.0.0.1:7"  # a restarted radio has another port
        place = report(round(t_s * S), 100 + t_s, circle(t_s))
        assert peers.refusal(LINK, peer, place) is None
        assert peers.refusal(LINK, peer, attitude(t_s, 0.5)) is None
        assert number in (100, 230) or turned == STRANGER
    assert notices(peers, Disagreement.REPLACES) == []


def test_second_peer_brings_attitudes_while_the_first_brings_none_or_few() -> None:
    peers = with_two_known_peers()
    assert peers.refusal(LINK, OTHER, attitude(20.0, 0.5)) is None
    assert peers.refusal(LINK, HOME, attitude(20.1, 0.5)) is None
    taken = [peers.refusal(LINK, OTHER, attitude(20.1 + n / 50, 0.6)) is None for n in range(1, 50)]
    assert not any(taken[:14])  # up to 0.3 s later
    assert all(taken[16:])


def told(msgid: int, number: int) -> bytes:
    stamp_ms = (100 + 20) * 1000
    return struct.pack("<QI", number, stamp_ms) if msgid == SYSTEM_TIME else bytes([7]) * number


@pytest.mark.parametrize(
    "msgid", [GPS_RAW_INT, GPS2_RAW, ODOMETRY, EKF_STATUS_REPORT, SYSTEM_TIME, HEARTBEAT]
)
def test_bounds_follow_the_peer_that_was_known_first(msgid: int) -> None:
    peers = with_two_known_peers()
    true, lie = (Outgoing(Source(1, 1), msgid, told(msgid, n)) for n in (20, 21))
    assert peers.refusal(LINK, OTHER, message(20.0, lie)) == BROUGHT
    assert peers.refusal(LINK, HOME, message(20.1, true)) is None
    assert peers.refusal(LINK, OTHER, message(24.9, lie)) == BROUGHT
    assert peers.refusal(LINK, OTHER, message(25.2, lie)) is None
    assert peers.refusal(LINK, HOME, message(25.3, lie)) is None  # the first is always used


@pytest.mark.parametrize("is_stranger", [False, True])
@pytest.mark.parametrize("first_states_fix", [False, True])
@pytest.mark.parametrize("fix_type", [1, 3])
def test_lost_fix_that_the_first_peer_does_not_report_is_announced(
    is_stranger: bool, first_states_fix: bool, fix_type: int
) -> None:
    """It is not used: a stranger that repeats positions could widen all bounds."""
    peers, other = with_two_known_peers(), "10.0.0.77:5" if is_stranger else OTHER

    def stated(peer: str, t_s: float, fix: int) -> str | None:
        payload = struct.pack("<QiiiHHHHBB", round(t_s * 1e6), *[0] * 7, fix, 9)
        return peers.refusal(LINK, peer, message(t_s, Outgoing(Source(1, 1), GPS_RAW_INT, payload)))

    if first_states_fix:
        assert stated(HOME, 20.0, 3) is None
    for number in range(30):
        place = report(
            round((20.05 + number / 10) * S), 120.05 + number / 10, circle(20.05 + number / 10)
        )
        assert peers.refusal(LINK, HOME, place) is None
        assert stated(other, 20.1 + number / 10, fix_type) == (STRANGER if is_stranger else BROUGHT)
    known = (HOME, OTHER) if is_stranger else (HOME,)
    is_told = fix_type == 1 and not first_states_fix
    assert notices(peers, Disagreement.HAS_NO_FIX) == [("1:1", other, known)] * is_told


def test_stamps_ahead_of_time_are_never_used() -> None:
    """They would move the clock: here by 1.5 s, with the path predicted exactly."""
    early = heard(OTHER, 10, begins_s=10.0, lasts_s=30.0, delay_s=lambda: -1.5)
    found = rejected(KnownPeers(), heard(HOME, 10, lasts_s=30.0), early)
    assert found[HOME] == []
    assert len(found[OTHER]) == 200


@pytest.mark.parametrize("ahead_s", [1.4, 4.0, 9.5])
def test_known_peer_with_stamps_ahead_of_time_is_not_used(ahead_s: float) -> None:
    """Of a standing vehicle anybody knows the next positions."""
    peers = with_two_known_peers()
    for number in range(100):
        t_s = 20 + number / 10
        here, there_ns = report(round(t_s * S), 100 + t_s, circle(t_s)), round((t_s + 0.02) * S)
        early = report(there_ns, 100 + t_s + ahead_s, circle(t_s + ahead_s))
        assert peers.refusal(LINK, HOME, here) is None
        assert peers.refusal(LINK, OTHER, early) == STRANGER
        assert peers.refusal(LINK, OTHER, stamped_attitude(t_s + 0.03, t_s + ahead_s)) is not None
    assert [(who, peer) for who, peer, _ in notices(peers, Disagreement.IS_NEWER)] == [
        ("1:1", OTHER)
    ]


@pytest.mark.parametrize(("ahead_s", "is_told"), [(0.0, False), (0.2, True), (0.5, True)])
def test_peer_whose_stamps_set_the_clock_is_told_once(ahead_s: float, is_told: bool) -> None:
    """Its radio is faster, or it predicts the path: then the track is ahead of the vehicle."""
    peers = KnownPeers()
    early = heard(OTHER, 10, begins_s=12.0, lasts_s=60.0, delay_s=lambda: -ahead_s)
    found = rejected(peers, heard(HOME, 10, lasts_s=60.0), early)
    assert len(found[OTHER]) < 60  # used, once known
    assert notices(peers, Disagreement.LEADS) == [("1:1", OTHER, (HOME,))] * is_told


def test_leads_of_ever_new_peers_are_told_once_a_minute() -> None:
    peers = KnownPeers()
    early = [
        (at_s, boot_s, f"10.0.0.66:{number}", place)
        for number, (at_s, boot_s, _, place) in enumerate(
            heard(OTHER, 10, begins_s=12.0, lasts_s=60.0, delay_s=lambda: -0.1)
        )
    ]
    rejected(peers, heard(HOME, 10, lasts_s=60.0), early)
    assert len(notices(peers, Disagreement.LEADS)) == 1


def test_peer_is_ahead_only_of_one_whose_fastest_messages_are_known() -> None:
    """The first messages of a peer may all be late."""
    delays_s = iter([0.5] * 20)
    slow = heard(HOME, 10, lasts_s=20.0, delay_s=lambda: next(delays_s, 0.0))
    peers = KnownPeers()
    rejected(peers, slow, heard(OTHER, 10, begins_s=1.0, lasts_s=20.0))
    assert notices(peers, Disagreement.LEADS) == []


@pytest.mark.parametrize("late_s", [2.0, 9.0, 14.0])
def test_positions_of_strangers_that_are_late_are_not_used(late_s: float) -> None:
    """Anybody can repeat a vehicle's path; over ten seconds late it looks like a second vehicle."""
    peers = KnownPeers()
    late = [
        (at_s, boot_s, f"10.0.0.66:{number // 8}", place)
        for number, (at_s, boot_s, _, place) in enumerate(
            heard(OTHER, 2, begins_s=5.03, lasts_s=60.0, delay_s=lambda: late_s)
        )
    ]
    found = rejected(peers, heard(HOME, 10, lasts_s=80.0), late)
    assert found.pop(HOME) == []
    assert sum(map(len, found.values())) == len(late)


@pytest.mark.parametrize("late_s", [11.0, 15.0, 25.0])
def test_first_peer_that_falls_behind_gives_way_to_one_in_time(late_s: float) -> None:
    """Its stamps look like another clock's; its positions were the other's at these stamps."""
    peers = KnownPeers()
    late = [(at_s + (late_s if at_s > 30 else 0.0), *rest) for at_s, *rest in heard(HOME, 10)]
    found = rejected(peers, late, heard(OTHER, 10, begins_s=10.0, lasts_s=90.0))
    assert [t_s for t_s in found[OTHER] if t_s > 20.0] == []
    assert found[HOME] == [at_s for at_s, *_ in late if at_s > 30.2]
    assert notices(peers, Disagreement.FALLS_BEHIND) == [("1:1", HOME, (OTHER,))]


def test_first_peer_whose_vehicle_was_restarted_stays_believed() -> None:
    """A stranger continues the former clock and path."""
    peers = KnownPeers()
    first = [*heard(HOME, 10, lasts_s=30.0)]
    first += [
        (at_s, boot_s - 129.0, peer, place)
        for at_s, boot_s, peer, place in heard(HOME, 10, begins_s=31.0)
    ]
    found = rejected(peers, first, heard(OTHER, 10, begins_s=10.0))
    assert found[HOME] == []
    assert len([t_s for t_s in found[OTHER] if t_s > 33.0]) > 260


@pytest.mark.parametrize("ahead_s", [1.2, 4.0, 9.0])
def test_stamps_ahead_of_time_in_gaps_of_a_radio_are_not_used(ahead_s: float) -> None:
    """A datagram in each gap moved the clock of a standing carrier: anybody knows its place."""
    peers, at_rest, used = KnownPeers(), Place(0.0, 0.0, 0.0, 0.0), []
    for number in range(600):
        t_s = number / 10
        if t_s % 8 < 6.7:
            assert peers.refusal(LINK, HOME, report(round(t_s * S), 100 + t_s, at_rest)) is None
        elif t_s % 8 > 7.8:
            forged = report(round(t_s * S), 100 + t_s + ahead_s, at_rest)
            used.append(peers.refusal(LINK, f"10.0.0.66:{number}", forged) is None)
    assert len(used) > 5
    assert not any(used)


@pytest.mark.parametrize("gap_s", [1.1, 11.0])
def test_first_peer_is_believed_after_a_gap_in_which_another_ran_ahead(gap_s: float) -> None:
    """Beside stamps that run ahead within the gap, those of the first peer look late.

    After ``REBOOT_NS`` they are used, since the vehicle may have been restarted.
    """
    peers, at_rest = KnownPeers(), Place(0.0, 0.0, 0.0, 0.0)

    def refused(peer: str, t_s: float, ahead_s: float = 0.0) -> str | None:
        return peers.refusal(LINK, peer, report(round(t_s * S), 100 + t_s + ahead_s, at_rest))

    for number in range(120):
        assert refused(HOME, number / 10) is None
    ahead_s = [0.0, *(1.4 * number for number in range(10)), 13.0]
    to_s = 12.0 + gap_s
    in_gap = [refused(OTHER, to_s + number / 100, by_s) for number, by_s in enumerate(ahead_s)]
    assert in_gap[0] is None  # the vehicle's radio may have another address
    assert in_gap[2:] == [STRANGER if gap_s < REBOOT_NS / S else None] * 10
    for number in range(300):
        t_s = to_s + 0.2 + number / 10
        assert refused(HOME, t_s) is None
        if number % 5 == 0:
            assert refused(OTHER, t_s + 0.05, 13.0) == STRANGER
    assert notices(peers, Disagreement.FALLS_BEHIND) == []


def test_rank_of_a_peer_depends_on_the_others_that_are_current() -> None:
    peers, source = with_two_known_peers(frozenset({"10.0.0.9"})), Source(1, 1)
    now_ns = 20 * S
    ranks = {
        peer: peers.rank(LINK, peer, source, now_ns)
        for peer in (HOME, OTHER, "10.0.0.8:7", "10.0.0.9:7")
    }
    assert list(ranks.values()) == [
        PeerRank.FIRST,
        PeerRank.LATER,
        PeerRank.STRANGER,
        PeerRank.FIRST,
    ]
    assert peers.rank(LINK, "10.0.0.8:7", Source(2, 1), now_ns) is PeerRank.FIRST
    assert peers.rank(LINK, "10.0.0.8:7", source, now_ns + 3 * S) is PeerRank.FIRST
    assert peers.rank(LINK, OTHER, source, now_ns + 3 * S) is PeerRank.FIRST


# --- strangers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("forged_hz", [0.04, 1, 4, 20])
@pytest.mark.parametrize("metres", [8.0, -8.0, 50.0])
def test_vehicle_that_was_first_stays_believed(forged_hz: float, metres: float) -> None:
    """Also if the forged stamps are ahead of its own."""
    for ahead_s in (0.0, 0.2):
        path = beside(metres)
        forged = (
            (at_s, boot_s + ahead_s, peer, path(boot_s - 100 + ahead_s))
            for at_s, boot_s, peer, _ in heard(OTHER, forged_hz, begins_s=10.03)
        )
        peers = KnownPeers()
        found = rejected(peers, heard(HOME, 4), forged)
        assert found[HOME] == []
        assert len(found[OTHER]) == round((60 - 10.03) * forged_hz)
        if forged_hz >= 1:
            assert notices(peers, Disagreement.CONTRADICTS) == [("1:1", OTHER, (HOME,))]


def test_known_peer_that_contradicts_two_others_is_a_stranger() -> None:
    """It contradicts both at once, and judges neither, whichever was known first."""
    third = "10.0.0.77:5"
    peers = KnownPeers()
    found = rejected(
        peers,
        heard(HOME, 10),
        heard(OTHER, 10, begins_s=2.02),
        heard(third, 10, begins_s=2.04, lasts_s=30.0),
        heard(third, 10, begins_s=30.04, told=beside(60.0)),
    )
    assert found[HOME] == [] and max(found[OTHER]) < 20 < min(found[third][-200:])
    assert len([t_s for t_s in found[third] if t_s > 30]) == 300


@given(st.randoms(use_true_random=False), st.integers(2, 6))
def test_peers_that_agree_and_contradict_in_any_order_are_judged(random: Any, count: int) -> None:
    """Of a vehicle whose estimator resets its position, over radios of any latency and loss."""
    latencies_s = [random.choice((0.02, 0.1, 0.6, 1.0)) for _ in range(count)]
    off_m, streams = 0.0, list[Stream]()
    for number in range(200):
        if random.random() < 0.03:
            off_m = random.choice((0.0, 5.0, 20.0, 100.0))
        streams += [
            heard(
                f"10.0.0.{peer}:9",
                5,
                begins_s=number / 5,
                lasts_s=(number + 1) / 5,
                delay_s=lambda late_s=latencies_s[peer]: late_s + random.random() * 0.1,
                told=beside(off_m),
            )
            for peer in range(count)
            if random.random() < 0.8
        ]
    found = rejected(KnownPeers(), *streams)
    assert set(found) <= {f"10.0.0.{peer}:9" for peer in range(count)}


def test_fresh_ports_evict_no_known_peer_and_are_never_believed() -> None:
    """Each report comes from another port, near the true path and drifting away."""
    forged = (
        (at_s, boot_s + 0.05, f"10.0.0.66:{number}", place)
        for number, (at_s, boot_s, _, place) in enumerate(
            heard(OTHER, 40, begins_s=10.0, told=drifting(2.0, 10.0))
        )
    )
    peers = KnownPeers()
    found = rejected(peers, heard(HOME, 10), forged)
    assert found[HOME] == []
    within_slack_s = (known_peers.AGREEMENT_M + 0.1 * 20.0 + 0.7) / 2.0
    late = [t_s for times in found.values() for t_s in times if t_s > 10.1 + within_slack_s]
    assert len(late) >= 40 * (50 - within_slack_s) - 2
    assert [one[0] for one in notices(peers, Disagreement.CONTRADICTS)] == ["1:1"]


@pytest.mark.parametrize("off_s", [-3600.0, 3600.0, -30.0, 30.0, 2.0**31 / 1000])
def test_true_place_with_a_stamp_of_another_clock_is_never_used(off_s: float) -> None:
    """Half of the stamps are right, so that the stranger becomes known."""
    forged = (
        (at_s, (boot_s + off_s * (number % 2)) % (2**32 / 1000), peer, place)
        for number, (at_s, boot_s, peer, place) in enumerate(heard(OTHER, 10, begins_s=10.03))
    )
    found = rejected(KnownPeers(), heard(HOME, 10), forged)
    assert found[HOME] == []
    lies = {round(10.08 + number / 10, 3) for number in range(1, 500, 2)}
    assert lies <= {round(t_s, 3) for t_s in found[OTHER]}


@pytest.mark.parametrize("off_ms", [-3_600_000, 3_600_000])
def test_no_stamp_of_another_clock_is_used_of_a_peer_that_became_known(off_ms: int) -> None:
    peers = with_two_known_peers()
    for number in range(20):
        t_s = 20 + number / 10
        assert peers.refusal(LINK, HOME, report(round(t_s * S), 100 + t_s, circle(t_s))) is None
        for lie, verdict in ((off_ms, STRANGER), (0, None)):
            boot_ms = (round((100 + t_s) * 1000) + lie) % 2**32
            said = Outgoing(Source(1, 1), LOCAL_POSITION_NED, struct.pack("<I", boot_ms))
            assert peers.refusal(LINK, OTHER, message(t_s + 0.01, said)) == verdict


def test_late_reports_of_a_second_route_are_used_if_they_agree() -> None:
    """Also if they arrive after newer ones of the same route."""

    def swapped(told: Callable[[float], Place]) -> Stream:
        for number, (at_s, boot_s, peer, _) in enumerate(heard(OTHER, 10, begins_s=5)):
            earlier_s = 0.35 if number % 3 == 0 else 0.0
            place = told(boot_s - 100 - earlier_s) if earlier_s else circle(boot_s - 100)
            yield at_s, boot_s - earlier_s, peer, place

    found = rejected(KnownPeers(), heard(HOME, 10), swapped(circle))
    assert found[HOME] == [] and max(found[OTHER]) < 15
    false = rejected(KnownPeers(), heard(HOME, 10), swapped(beside(8.0)))
    assert false[HOME] == []
    assert len([t_s for t_s in false[OTHER] if t_s > 20]) >= 10 * 40 / 3 - 1


def test_vehicle_that_restarts_is_used_over_both_of_its_routes() -> None:
    def restarted(stream: Stream) -> Stream:
        return (
            (at, boot - 95 if at > 30 else boot, peer, place) for at, boot, peer, place in stream
        )

    streams = (heard(HOME, 10), heard(OTHER, 10, begins_s=5.03, delay_s=lambda: 0.02))
    found = rejected(KnownPeers(), *(restarted(one) for one in streams))
    assert found[HOME] == []
    assert len([t_s for t_s in found[OTHER] if t_s > 20]) <= 3


def test_right_place_ahead_of_time_with_a_wrong_velocity_is_not_used() -> None:
    forged = (
        (at_s, boot_s + 0.05, f"10.0.0.66:{number}", place._replace(north_mps=place.north_mps + 30))
        for number, (at_s, boot_s, _, _) in enumerate(heard(OTHER, 25, begins_s=10.0))
        for place in [circle(boot_s + 0.05 - 100)]
    )
    found = rejected(KnownPeers(), heard(HOME, 10), forged)
    assert found.pop(HOME) == []
    assert sum(map(len, found.values())) == 25 * 50


def test_stranger_that_agrees_first_and_drifts_is_rejected_within_the_slack() -> None:
    peers = KnownPeers()
    forged = heard(OTHER, 10, begins_s=10.03, told=drifting(2.0, 30.0))
    found = rejected(peers, heard(HOME, 10), forged)
    assert found[HOME] == []
    assert not [t_s for t_s in found[OTHER] if 17 < t_s < 30]
    slack_s = (paths.SLACK_M + 20.0 * paths.STALE_S) / 2.0  # drifts 2 m/s, flies 20 m/s
    refused_s = [t_s for t_s in found[OTHER] if t_s > 30]
    assert len(refused_s) > 10 * (60 - 30 - slack_s - 0.5)


def is_known_at(t_s: float, told: Callable[[float], Place]) -> bool:
    """Return whether a stranger that begins after 10 s is known by then."""
    peers = KnownPeers()
    both = heard(HOME, 10, lasts_s=t_s), heard(OTHER, 10, lasts_s=t_s, begins_s=10.03, told=told)
    assert rejected(peers, *both)[HOME] == []
    beat = message(t_s, heartbeat(Source(1, 1)))
    assert peers.refusal(LINK, HOME, beat) is None
    return peers.refusal(LINK, OTHER, beat) is None


def test_each_contradiction_doubles_the_probation() -> None:
    def told(t_s: float) -> Place:
        return beside(30.0 if 20 < t_s < 20.2 else 0.0)(t_s)

    first, again_s = 10.03 + PROBATION_S, 20.2 + 2 * PROBATION_S
    assert [is_known_at(first + by_s, told) for by_s in (-0.5, 0.5)] == [False, True]
    assert not is_known_at(20.5, told)
    assert not is_known_at(again_s - 0.5, told)
    assert is_known_at(60.0, told)


def test_stranger_is_used_when_the_known_peer_falls_silent() -> None:
    peers = KnownPeers()
    found = rejected(
        peers, heard(HOME, 10, lasts_s=20), heard(OTHER, 10, begins_s=10.03, told=beside(20))
    )
    assert all(t_s < 21.2 for t_s in found[OTHER])


def test_first_peer_is_believed_again_after_a_gap_used_by_a_stranger() -> None:
    def with_gap() -> Stream:
        return (one for one in heard(HOME, 10) if not 20 < one[0] < 24)

    peers = KnownPeers()
    found = rejected(peers, with_gap(), heard(OTHER, 10, begins_s=10.03, told=beside(20)))
    assert found[HOME] == []
    assert not [t_s for t_s in found[OTHER] if 21.2 < t_s < 24]
    assert len([t_s for t_s in found[OTHER] if t_s > 24.5]) > 10 * (60 - 25)


@pytest.mark.parametrize("named", [OTHER, "10.0.0.66"])
def test_router_is_believed_over_a_peer_that_was_first(named: str) -> None:
    peers = KnownPeers([named])
    found = rejected(peers, heard(HOME, 4), heard(OTHER, 4, begins_s=10.1, told=beside(20)))
    assert found[OTHER] == []
    assert len(found[HOME]) > 190


def test_all_peers_of_a_configured_link_are_trusted() -> None:
    peers = KnownPeers([LINK])
    found = rejected(peers, heard(HOME, 4), heard(OTHER, 4, begins_s=10.1, told=beside(20)))
    assert found == {HOME: [], OTHER: []}


@given(
    st.lists(
        st.tuples(
            st.floats(0, 60), st.sampled_from(["a", "b", "c"]), st.floats(-300, 300),
            st.floats(-3, 3),
        ),
        max_size=60,
    )
)  # fmt: skip
def test_no_stranger_costs_the_first_peer_a_report(
    forged: list[tuple[float, str, float, float]],
) -> None:
    """Whatever strangers send, at any time after the first report, with any clock and place."""
    stream = [
        (0.2 + at_s, 100 + at_s + ahead_s, f"10.0.0.66:{peer}", beside(off_m)(at_s))
        for at_s, peer, off_m, ahead_s in forged
    ]
    found = rejected(KnownPeers(), heard(HOME, 5), stream)
    assert found[HOME] == []


# --- bounds ---------------------------------------------------------------------------------------


def test_invented_ids_and_addresses_use_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(known_peers, "SENDERS_MAX", 8)
    peers = KnownPeers()
    for number in range(400):
        peer, sysid = f"10.0.0.9:{number}", number % 100 + 2
        t_ns = number * S // 10
        peers.refusal(LINK, HOME, report(t_ns, t_ns / S, circle(t_ns / S)))
        peers.refusal(LINK, peer, report(t_ns, number, circle(0), sysid))
        peers.refusal(LINK, peer, report(t_ns, t_ns / S, circle(0)))
    assert len(peers._senders) == 8
    assert Source(1, 1) in peers._senders
    for sender in peers._senders.values():
        assert len(sender.known) <= known_peers.PEERS_MAX
        assert len(sender.strangers) <= known_peers.PEERS_MAX


def test_silent_peers_are_forgotten() -> None:
    peers = KnownPeers()
    for number in range(20):
        t_ns = number * (KEPT_NS + S)
        peers.refusal(LINK, f"10.0.0.9:{number}", report(t_ns, t_ns / S, circle(0)))
    (sender,) = peers._senders.values()
    assert len(sender.known) == 1
    assert next(iter(sender.known.values())).messages == 1
