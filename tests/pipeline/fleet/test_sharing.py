"""Sharing of frames: once for a vehicle that all receive, at once for one that a single node
receives."""

import struct
from dataclasses import dataclass, field

from pymavlink.dialects.v20 import common

from companion.mavlink.trust.dedupe import content
from companion.mavlink.wire.positions import GLOBAL_POSITION_INT
from companion.pipeline.fleet.reception import VEHICLES_MAX
from companion.pipeline.fleet.sharing import AT_ONCE, HELD_MAX, HOLD_NS, Sharing
from companion.values import Frame, RoundTrip, Source

MS = 1_000_000
S = 1000 * MS
UAV = Source(1, 1)


def report(at_ns: int, boot_ms: int, source: Source = UAV) -> Frame:
    mav = common.MAVLink(None, srcSystem=source.sysid, srcComponent=source.compid)
    message = common.MAVLink_global_position_int_message(boot_ms, 1, 2, 3, 4, 5, 6, 7, 8)
    return Frame(
        t_ns=at_ns, link="udp", source=source, msgid=GLOBAL_POSITION_INT, raw=message.pack(mav)
    )


@dataclass
class Nodes:
    """Nodes on one clock with a link between them; each report reaches all that receive it."""

    names: tuple[str, ...]
    way_ns: int = 2 * MS
    told: list[tuple[str, int, int]] = field(default_factory=list)
    """The sharing node, the report's number, and the delay since its reception."""

    def __post_init__(self) -> None:
        self.sharing = {name: Sharing(name) for name in self.names}
        self._on_the_way: list[tuple[int, str, Frame]] = []
        self.now_ns = 0

    def fly(self, reports: int, hearers: tuple[str, ...], first: int = 0) -> None:
        for number in range(first, first + reports):
            frame = report(self.now_ns, 1000 + 100 * number)
            for name in hearers:
                self.sharing[name].frame_received(frame.t_ns, frame, content(frame.raw))
            for _ in range(20):
                self._pass(5 * MS)

    def _pass(self, ns: int) -> None:
        self.now_ns += ns
        for at_ns, teller, frame in [one for one in self._on_the_way if one[0] <= self.now_ns]:
            self._on_the_way.remove((at_ns, teller, frame))
            for name in self.names:
                if name != teller:
                    key = content(frame.raw)
                    self.sharing[name].note_shared(self.now_ns, teller, UAV, key, self.way_ns)
        for name in self.names:
            said = self.sharing[name].next_message(self.now_ns)
            for one in said.frames if said else ():
                (boot_ms,) = struct.unpack_from("<I", one.raw, 10)
                late_ns = self.now_ns - one.heard_ns
                self.told.append((name, (boot_ms - 1000) // 100, late_ns))
                frame = Frame(
                    t_ns=one.heard_ns, link="", source=UAV, msgid=GLOBAL_POSITION_INT, raw=one.raw
                )
                self._on_the_way.append((self.now_ns + self.way_ns, name, frame))


def test_one_node_shares_a_vehicle_that_all_receive() -> None:
    nodes = Nodes(("a", "b", "c"))
    nodes.fly(50, ("a", "b", "c"))
    later = [one for one in nodes.told if one[1] >= 10]
    assert {name for name, _, _ in later} == {"a"}
    assert sorted(number for _, number, _ in later) == list(range(10, 50))
    assert max(late for _, _, late in later) <= 5 * MS


def test_only_receiving_node_shares_a_vehicle_at_once() -> None:
    nodes = Nodes(("a", "b", "c"))
    nodes.fly(20, ("a", "b", "c"))
    nodes.told.clear()
    nodes.fly(20, ("b",), first=20)  # hidden from the others by a building
    assert sorted(number for _, number, _ in nodes.told) == list(range(20, 40))
    first = [late for _, number, late in nodes.told if number < 22]
    assert max(first) <= HOLD_NS[0] + 5 * MS
    assert max(late for _, number, late in nodes.told if number >= 22) <= 5 * MS
    nodes.told.clear()
    nodes.fly(20, ("a", "b"), first=40)
    assert len({name for name, number, _ in nodes.told if number >= 50}) == 1
    assert sorted(number for _, number, _ in nodes.told if number >= 50) == list(range(50, 60))


def test_nodes_with_slow_links_agree_on_one_sharing_node() -> None:
    nodes = Nodes(("a", "b", "c"), way_ns=300 * MS)
    nodes.fly(120, ("a", "b", "c"))
    late = [one for one in nodes.told if one[1] >= 80]
    assert len(late) <= 1.1 * 40
    assert {number for _, number, _ in late} == set(range(80, 120))


def test_sharing_node_shares_round_trips() -> None:
    nodes = Nodes(("a", "b"))
    nodes.fly(20, ("a", "b"))
    trip = RoundTrip(t_ns=nodes.now_ns, source=UAV, sent_ns=nodes.now_ns - MS, remote_ns=5)
    nodes.sharing["a"].round_trip_measured(trip)
    nodes.sharing["b"].round_trip_measured(trip)
    assert nodes.sharing["b"].next_message(nodes.now_ns) is None
    said = nodes.sharing["a"].next_message(nodes.now_ns)
    assert said is not None
    assert said.trips == (trip,)


def node_sharing_a_vehicle() -> Sharing:
    """Return a node that shares a vehicle."""
    nodes = Nodes(("a",))
    nodes.fly(5, ("a",))
    return nodes.sharing["a"]


def test_burst_is_shared_completely_in_several_messages() -> None:
    sharing, now_ns = node_sharing_a_vehicle(), 60_000 * MS
    for number in range(1200):
        frame = report(now_ns, 60_000 + number)
        sharing.frame_received(frame.t_ns, frame, content(frame.raw))
    counts, boots = [], []
    while sharing.wait_ns(now_ns) is not None:
        said = sharing.next_message(now_ns)
        assert said is not None
        counts.append(len(said.frames))
        boots += [struct.unpack_from("<I", one.raw, 10)[0] for one in said.frames]
    assert boots == list(range(60_000, 61_200))
    assert max(counts) <= AT_ONCE
    assert len(counts) == 3


def test_overdue_frames_are_dropped_oldest_first_and_counted() -> None:
    sharing = Sharing("a")
    for number in range(HELD_MAX + 3):
        frame = report(number, number)
        sharing.frame_received(frame.t_ns, frame, content(frame.raw))
    assert sharing.dropped == 3
    said = sharing.next_message(10 * S)
    assert said is not None
    assert struct.unpack_from("<I", said.frames[0].raw, 10)[0] == 3
    told = len(said.frames)
    while (said := sharing.next_message(10 * S)) is not None:
        told += len(said.frames)
    assert told == HELD_MAX
    assert sharing.dropped == 3


def test_old_vehicles_make_room_for_new_ones() -> None:
    sharing = Sharing("a")
    for number in range(VEHICLES_MAX):
        frame = report(0, 1, Source(1 + number % 255, number // 255))
        sharing.frame_received(frame.t_ns, frame, content(frame.raw))
    while sharing.wait_ns(S) is not None:
        sharing.next_message(S)
    late = Source(200, 201)
    for number in range(2):
        frame = report(3600 * S + number * S, 1000 * number, late)
        sharing.frame_received(frame.t_ns, frame, content(frame.raw))
    assert sharing.next_message(3610 * S) is None  # no capacity left
    assert sharing.dropped == 2
    sharing.forget(3620 * S, 600 * S)
    frame = report(3620 * S, 9000, late)
    sharing.frame_received(frame.t_ns, frame, content(frame.raw))
    said = sharing.next_message(3630 * S)
    assert said is not None
    assert [one.raw for one in said.frames] == [frame.raw]


def test_held_frames_of_a_forgotten_vehicle_are_not_shared() -> None:
    sharing, frame = Sharing("a"), report(0, 1)
    sharing.frame_received(frame.t_ns, frame, content(frame.raw))
    sharing.forget(601 * S, 600 * S)
    assert sharing.next_message(602 * S) is None
    assert sharing.wait_ns(602 * S) is None


def test_wait_time_is_exact() -> None:
    """A node that does not share holds every frame briefly; it is not woken for each one."""
    sharing = Sharing("b", every_ns=2 * MS)
    assert sharing.wait_ns(S) is None
    frames = [report(S + number * MS, number) for number in range(3)]
    for frame in frames:
        sharing.frame_received(frame.t_ns, frame, content(frame.raw))
    assert sharing.wait_ns(S + 10 * MS) == 50 * MS
    sharing.note_shared(S + 11 * MS, "a", frames[0].source, content(frames[0].raw), MS)
    assert sharing.next_message(S + 12 * MS) is None
    assert sharing.wait_ns(S + 12 * MS) == 49 * MS  # of the next frame
    assert sharing.next_message(S + 60 * MS) is None
    assert sharing.next_message(S + 61 * MS) is not None
    assert sharing.next_message(S + 62 * MS) is None
    assert sharing.wait_ns(S + 62 * MS) == 1 * MS
    assert sharing.next_message(S + 63 * MS) is not None
    assert sharing.wait_ns(S + 63 * MS) is None


def test_shared_frames_wait_while_this_node_is_behind() -> None:
    """Frames that this node reads late are not late through the others' fault."""
    sharing = Sharing("b")
    frames = [report(S + number * 100 * MS, number) for number in range(3)]
    now_ns = S + 900 * MS
    for frame in frames:
        sharing.frame_received(now_ns, frame, content(frame.raw))
    assert sharing.next_message(now_ns) is None
    assert sharing.wait_ns(now_ns) == 60 * MS
    for frame in frames:
        sharing.note_shared(now_ns + MS, "a", frame.source, content(frame.raw), MS)
    assert sharing.next_message(now_ns + 2 * MS) is None
    assert sharing.wait_ns(now_ns + 2 * MS) is None
