"""Shared frames: used for vehicles that are silent here, and checked against own reception."""

from pymavlink.dialects.v20 import common

from companion.mavlink.trust.dedupe import content
from companion.mavlink.wire.positions import GLOBAL_POSITION_INT
from companion.pipeline.fleet.neighbours import NeighbourClock
from companion.pipeline.fleet.reception import Reception
from companion.pipeline.fleet.trust import OWN_NODE
from companion.settings.fleet import is_node_name
from companion.values import Frame, SharedFrame, Source

MS = 1_000_000
S = 1000 * MS
UAV = Source(1, 1)


def raw(boot_ms: int, north_m: float = 0.0, msg: str = "position") -> bytes:
    mav = common.MAVLink(None, srcSystem=1, srcComponent=1)
    if msg == "heartbeat":
        packed: bytes = common.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(mav)
        return packed
    lat = 473977000 + round(north_m / 0.0111195)
    message = common.MAVLink_global_position_int_message(boot_ms, lat, 85456000, 0, 0, 0, 0, 0, 0)
    return bytes(message.pack(mav))


def clock(behind_ns: int = 3 * S, width_ns: int = 2 * MS) -> NeighbourClock:
    """Return the clock of a node that lags by that much, known within ``width_ns``."""
    made = NeighbourClock()
    made.note_answer(10 * S, 10 * S + width_ns, 10 * S + width_ns // 2 - behind_ns)
    return made


def tell(
    hearing: Reception, now_ns: int, data: bytes, heard_ns: int, node: str = "b"
) -> list[Frame]:
    """Return the frames for the pipeline when a node 3 s behind shares a received one."""
    frame = hearing.to_own_timeline(now_ns, node, clock(), SharedFrame(heard_ns - 3 * S, data))
    return [] if frame is None else hearing.take_shared(now_ns, node, frame, content(frame.raw))


def test_shared_frame_keeps_its_sender_in_both_mavlink_versions() -> None:
    message = common.MAVLink_global_position_int_message(
        5000, 473977000, 85456000, 0, 0, 0, 0, 0, 0
    )
    for in_version_1, magic in ((True, 0xFE), (False, 0xFD)):
        mav = common.MAVLink(None, srcSystem=7, srcComponent=9)
        data = bytes(message.pack(mav, force_mavlink1=in_version_1))
        assert data[0] == magic
        heard = SharedFrame(8 * S - 5 * MS, data)
        frame = Reception().to_own_timeline(11 * S, "b", clock(), heard)
        assert frame is not None
        assert (frame.source, frame.msgid) == (Source(7, 9), GLOBAL_POSITION_INT)


def hear(hearing: Reception, now_ns: int, boot_ms: int, north_m: float = 0.0) -> None:
    data = raw(boot_ms, north_m)
    hearing.take_received(
        Frame(t_ns=now_ns, link="udp", source=UAV, msgid=GLOBAL_POSITION_INT, raw=data)
    )


def test_shared_frames_of_a_received_vehicle_are_discarded() -> None:
    hearing = Reception()
    for number in range(20):
        hear(hearing, 11 * S + number * 100 * MS, 1000 + 100 * number)
    now_ns = 11 * S + 1910 * MS
    assert tell(hearing, now_ns, raw(2900), now_ns - 5 * MS) == []  # received here too
    assert tell(hearing, now_ns, raw(2850, 1.0), now_ns - 5 * MS) == []
    assert tell(hearing, now_ns, raw(0, msg="heartbeat"), now_ns - 5 * MS) == []


def test_missed_frames_of_a_silent_vehicle_are_used() -> None:
    hearing = Reception()
    for number in range(20):
        hear(hearing, 11 * S + number * 100 * MS, 1000 + 100 * number)
    taken = []
    for number in range(20, 30):
        at_ns = 11 * S + number * 100 * MS
        taken.append(tell(hearing, at_ns + 5 * MS, raw(1000 + 100 * number), at_ns))
    assert [len(one) for one in taken[:4]] == [0, 0, 3, 1]
    first = taken[2][0]
    assert first.link == "fleet:b"
    assert first.source == UAV
    # Received 3 s behind, within the clock's width: late by at most that, and never early.
    at_ns = 11 * S + 2000 * MS
    assert at_ns <= first.t_ns <= at_ns + 3 * MS
    assert first.t_ns - first.doubt_ns <= at_ns
    assert tell(hearing, 15 * S, raw(0, msg="heartbeat"), 15 * S - 5 * MS)
    # Received here again, own reception counts.
    hear(hearing, 16 * S, 6000)
    assert tell(hearing, 16 * S + 50 * MS, raw(6040), 16 * S + 40 * MS) == []


def test_vehicle_with_queued_reports_is_not_silent() -> None:
    """An overloaded node would otherwise process every report twice."""
    hearing = Reception()
    for number in range(20):
        hear(hearing, 11 * S + number * 100 * MS, 1000 + 100 * number)
    now_ns = 11 * S + 1900 * MS + 900 * MS
    hearing.behind_ns = 850 * MS
    assert tell(hearing, now_ns, raw(3700), now_ns - 5 * MS) == []
    assert tell(hearing, now_ns, raw(0, msg="heartbeat"), now_ns - 5 * MS) == []
    later_ns = now_ns + 300 * MS
    assert tell(hearing, later_ns, raw(0, msg="heartbeat"), later_ns - 5 * MS)
    assert len(tell(hearing, later_ns, raw(3900), later_ns - 5 * MS)) == 2


def test_frames_of_an_unreceived_vehicle_are_used_once() -> None:
    hearing = Reception()
    assert len(tell(hearing, 12 * S, raw(1000), 12 * S - 5 * MS, "b")) == 1
    assert tell(hearing, 12 * S, raw(1000), 12 * S - 5 * MS, "c") == []
    assert len(tell(hearing, 12 * S, raw(1100), 12 * S - 5 * MS, "c")) == 1


def test_shared_frame_from_the_future_is_a_contradiction() -> None:
    hearing = Reception()
    assert tell(hearing, 12 * S, raw(1000), 12 * S + 50 * MS) == []
    assert hearing.early == ["b"]
    # Without a clock no frame is placed, and none contradicts.
    shared = SharedFrame(12 * S, raw(1000))
    assert hearing.to_own_timeline(12 * S, "c", NeighbourClock(), shared) is None
    assert hearing.early == ["b"]


def test_false_frames_of_a_received_vehicle_are_detected() -> None:
    hearing = Reception()
    for number in range(80):
        now_ns = 11 * S + number * 100 * MS
        hear(hearing, now_ns, 1000 + 100 * number)
        false = raw(1000 + 100 * number + 40, 300.0)
        assert tell(hearing, now_ns + 50 * MS, false, now_ns + 40 * MS) == []
    assert set(hearing.contradicted) == {("1:1", "b", OWN_NODE)}
    assert len(hearing.contradicted) >= 3


def test_nodes_that_contradict_each_other_are_both_kept() -> None:
    """The one that shared the vehicle first is believed: neither is known to be true."""
    hearing, used = Reception(), list[int]()
    for number in range(80):
        now_ns = 11 * S + number * 100 * MS
        used.append(len(tell(hearing, now_ns, raw(1000 + 100 * number), now_ns - 5 * MS, "b")))
        false = raw(1000 + 100 * number + 40, 300.0)
        tell(hearing, now_ns + 50 * MS, false, now_ns + 40 * MS, "c")
    assert used == [1] * 80
    assert hearing.contradicted == []
    assert set(hearing.disputed) == {("1:1", "c", "b")}


def test_node_that_shared_a_vehicle_first_is_not_contradicted_by_a_stranger_here() -> None:
    """Whoever sends in a vehicle's name here is believed, but it proves nothing against others."""
    hearing = Reception()
    for number in range(80):
        now_ns = 11 * S + number * 100 * MS
        tell(hearing, now_ns, raw(1000 + 100 * number), now_ns - 5 * MS, "b")
        if number > 10:
            hear(hearing, now_ns + 40 * MS, 1040 + 100 * number, 300.0)
    assert hearing.contradicted == []
    assert set(hearing.disputed) == {("1:1", "b", OWN_NODE)}


def test_node_with_the_name_of_a_place_is_not_this_node() -> None:
    assert not is_node_name(OWN_NODE)


def test_damaged_shared_frames_are_discarded() -> None:
    hearing = Reception()
    whole = raw(1000)
    for broken in (b"", whole[:-1], whole[:20] + b"\x55" + whole[21:], whole + b"\0", b"\xfd" * 40):
        assert hearing.to_own_timeline(12 * S, "b", clock(), SharedFrame(9 * S, broken)) is None
    attitude = common.MAVLink_attitude_message(1, 0, 0, 0, 0, 0, 0)
    packed = attitude.pack(common.MAVLink(None, srcSystem=1, srcComponent=1))
    assert hearing.to_own_timeline(12 * S, "b", clock(), SharedFrame(9 * S, bytes(packed))) is None


def test_frames_missed_between_received_reports_are_not_used() -> None:
    hearing = Reception()
    for number in range(20):
        hear(hearing, 11 * S + number * 100 * MS, 1000 + 100 * number)
        missed_ns = 11 * S + number * 100 * MS + 50 * MS
        assert tell(hearing, missed_ns + 5 * MS, raw(1050 + 100 * number), missed_ns) == []
    at_ns = 14 * S
    taken = tell(hearing, at_ns + 5 * MS, raw(4000), at_ns)
    assert [one.raw for one in taken] == [raw(2950), raw(4000)]


def test_shared_frames_that_cannot_be_recorded_are_counted() -> None:
    """Received long ago, before 1970, or damaged."""
    hearing, now_ns = Reception(), 1000 * S
    good = raw(1)
    for heard_ns, data in ((now_ns - 700 * S, good), (0, good), (now_ns, good[:-1]), (now_ns, b"")):
        assert tell(hearing, now_ns, data, heard_ns) == []
    assert hearing.unusable == 4
    early = NeighbourClock()
    early.note_answer(S, S + MS, 1000 * S)
    assert hearing.to_own_timeline(2 * S, "b", early, SharedFrame(900 * S, good)) is None
    assert hearing.unusable == 5
    assert len(tell(hearing, now_ns, good, now_ns - 500 * S)) == 1
    assert hearing.unusable == 5
