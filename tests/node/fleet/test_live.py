"""Settings that a fleet node rejects in one line, and messages that it accepts from others."""

import asyncio
import math
import socket
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from link_support import LOOPS, runner
from pymavlink.dialects.v20 import common
from support import HANG_S, examples, free_port, run_async

from companion.mavlink.links.to_loop import ToLoop
from companion.mavlink.links.zenoh_bus import open_peer
from companion.mavlink.links.zenoh_config import BusConfig
from companion.node.fleet import live, messages
from companion.node.fleet.budgets import BYTES_SAVED, NodeBudgets
from companion.node.fleet.config import bus_config
from companion.node.fleet.live import LiveFleetNode
from companion.node.fleet.traffic import Rate
from companion.pipeline.fleet.member import NODES_MAX
from companion.pipeline.fold import Pipeline
from companion.recording import codec, schemas
from companion.settings.fleet import FleetSettings
from companion.settings.model import Settings
from companion.settings.section import ConfigError
from companion.values import (
    Duty,
    Event,
    Frame,
    Notice,
    Offer,
    RoundTrip,
    Severity,
    Shared,
    SharedFrame,
    Source,
    Standing,
    UserError,
)

pytest.importorskip("zenoh")
MS = 1_000_000
S = 1000 * MS


def node(
    notify: Callable[[Notice], Any] = lambda notice: None,
    now: Callable[[], int] = lambda: 0,
    **settings: object,
) -> LiveFleetNode:
    pipeline = Pipeline(Settings().override(center={"source": "47,8,400"}))
    given = FleetSettings.model_validate({"node": "north", **settings})
    return LiveFleetNode(
        settings=given, pipeline=pipeline, step=lambda event: None, notify=notify, now_ns=now
    )


def standing(node: str, serves: tuple[tuple[str, float], ...] = ()) -> bytes:
    """Return a node's standing, encoded."""
    said = Standing(node=node, place=None, reach_m=None, most=16, serves=serves)
    return messages.standing(said)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"ca": "ca.pem"}, "set fleet.certificate and fleet.key as well"),
        ({"certificate": "me.pem"}, "set fleet.ca as well"),
        ({"mode": "client"}, "a client needs the address of a router"),
    ],
)
def test_inconsistent_fleet_settings_are_rejected(settings: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        node(**settings)


@pytest.mark.parametrize("endpoint", ["foo", "tcp/192.0.2.1:7447"])
def test_invalid_zenoh_endpoint_is_rejected(endpoint: str) -> None:
    with pytest.raises(UserError, match="Zenoh"):
        node(listen=[endpoint]).open()


def test_port_in_use_is_reported_before_start() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(UserError, match="Zenoh"):
            node(listen=[f"tcp/127.0.0.1:{taken.getsockname()[1]}"]).open()


@pytest.mark.parametrize("name", ["", "a/b", "a*", "-a", "x" * 33, "a b"])
def test_invalid_node_name_is_rejected(name: str) -> None:
    with pytest.raises(ValueError, match="node"):
        FleetSettings(node=name)


def test_node_listens_on_loopback_by_default() -> None:
    config = bus_config(FleetSettings(node="north"))
    assert config.listen == ("tcp/127.0.0.1:0",)
    assert not config.scouting


def test_status_separates_sent_from_received_rates() -> None:
    one = node(site="harbour")
    one._sent.bps, one._heard.bps, one.damaged = 1000.0, 2000.0, 3
    found = one.status()
    assert (found.sent_bps, found.heard_bps) == (1000.0, 2000.0)
    assert (found.site, found.damaged, found.member) == ("harbour", 3, one.member)


class Wire:
    """Stand-in bus that records messages and queries; ``takes`` holds the subscriptions."""

    def __init__(self, *_: object) -> None:
        self.takes: dict[str, Callable[..., None]] = {}
        self.asked: list[Callable[[bytes, int], None]] = []
        self.is_asked = asyncio.Event()
        self.said: list[tuple[str, bytes]] = []

    def open(self) -> None:
        pass

    def close(self) -> None:
        pass

    async def run(self) -> None:
        await asyncio.Event().wait()

    def subscribe(self, key: str, take: Callable[..., None]) -> None:
        self.takes[key.rsplit("/", 1)[-1]] = take

    def watch(self, key: str, take: Callable[[str, bool], None]) -> None:
        take(key.replace("*", "south"), True)

    def ask(self, key: str, payload: bytes, timeout_s: float, take: Callable[..., None]) -> None:
        assert key.endswith("/south/time")
        self.asked.append(take)
        self.is_asked.set()

    def serve(self, *_: object) -> None:
        pass

    def alive(self, key: str) -> None:
        pass

    def put(self, key: str, payload: bytes, **__: object) -> bool:
        self.said.append((key.rsplit("/", 1)[-1], payload))
        return True

    def is_wanted(self, *_: object) -> bool:
        return False


@pytest.fixture
def wire(monkeypatch: pytest.MonkeyPatch) -> Wire:
    made = Wire()
    monkeypatch.setattr(live, "Bus", lambda *_: made)
    return made


def test_answer_time_is_when_zenoh_received_it(wire: Wire) -> None:
    """However long the event loop was busy afterwards."""
    now_ns = [1000 * S]

    async def test() -> None:
        member = node(mode="client", connect=["tcp/127.0.0.1:1"], now=lambda: now_ns[0])
        task = asyncio.create_task(member.run())
        await wire.is_asked.wait()
        now_ns[0] = 1090 * S
        remote_ns = 1005 * S
        wire.asked[0](messages.CLOCK.pack(1, remote_ns), time.monotonic_ns() - 20 * S)
        ahead = member.member.neighbours["south"].clock.newest_offset()
        assert ahead is not None
        assert ahead.low_ns == 1000 * S - remote_ns
        assert ahead.high_ns <= 1070 * S - remote_ns
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    run_async(test())


def test_node_with_the_same_name_is_announced_once_and_ignored(wire: Wire) -> None:
    notices: list[Notice] = []

    async def test() -> None:
        member = node(mode="client", connect=["tcp/127.0.0.1:1"], notify=notices.append)
        task = asyncio.create_task(member.run())
        await wire.is_asked.wait()
        said = messages.standing(
            Standing(node="north", place=None, reach_m=None, most=4, serves=(("1:1", 9.0),))
        )
        for _ in range(2):
            wire.takes["standing"]("companion/site/north/standing", said)
        assert list(member.member.neighbours) == ["south"]
        assert [one.text for one in notices if "another" in one.text] == [
            "another node is also named north; set a unique `[fleet] node` on each"
        ]
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    run_async(test())


@pytest.mark.parametrize("loop", LOOPS)
def test_received_reports_are_shared_at_once_with_a_rate_limit(wire: Wire, loop: str) -> None:
    """The second report is held back until it is due, independent of ticks and of the pipeline."""
    now_ns = [1000 * S]

    async def test() -> None:
        member = node(
            mode="client", connect=["tcp/127.0.0.1:1"], now=lambda: now_ns[0], share_hz=0.1
        )
        task = asyncio.create_task(member.run())
        await wire.is_asked.wait()
        counts = []
        for number, wait_ms in enumerate((0, 100, 100, 9_899, 1, 9_999, 1)):
            now_ns[0] += wait_ms * MS
            member.on_event(report(now_ns[0] - 70 * MS, number))
            counts.append([len(said.frames) for said in told(wire)])
        assert member.member.reception.behind_ns == 70 * MS
        # The first is held for 60 ms, in which another node may share it. After two, this node
        # shares.
        assert counts == [[], [1], [1], [1], [1, 4], [1, 4], [1, 4, 2]]
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    runner(loop)(test())


def report(t_ns: int, number: int) -> Frame:
    mav = common.MAVLink(None, srcSystem=1, srcComponent=1)
    message = common.MAVLink_global_position_int_message(
        5000 + 100 * number, 473977000, 85456000, 0, 0, 0, 0, 0, 0
    )
    raw = bytes(message.pack(mav))
    return Frame(t_ns=t_ns, link="udp", source=Source(1, 1), msgid=message.get_msgId(), raw=raw)


def told(wire: Wire) -> list[Shared]:
    """Return the shared frames of the received ones."""
    return [messages.to_shared(payload) for what, payload in wire.said if what == "heard"]


def test_duty_change_is_published_at_once(wire: Wire) -> None:
    """Two nodes serve a UAV only for one message delay, not until the next periodic message."""
    now_ns, steps = [1000 * S], list[Event]()

    async def test() -> None:
        member = node(mode="client", connect=["tcp/127.0.0.1:1"], now=lambda: now_ns[0])
        member._step = steps.append
        task = asyncio.create_task(member.run())
        await wire.is_asked.wait()
        member.member.set_offers(
            {"1:1": Offer(uav="1:1", sure_db=10.0, likely_db=10.0, sinr_db=20.0, heard_s=0.1)}
        )
        member.ticked(now_ns[0])
        now_ns[0] += 3 * S
        wire.said.clear()
        member.ticked(now_ns[0])
        (duty,) = [one for one in steps if isinstance(one, Duty) and one.serves]
        assert duty.serves == ("1:1",)
        ((what, payload),) = wire.said
        assert what == "standing"
        assert messages.to_standing(payload, "north").serves[0][0] == "1:1"
        better = Offer(uav="1:1", sure_db=10.0, likely_db=10.0, sinr_db=25.0, heard_s=0.1)
        wire.takes["offers"]("companion/site/south/offers", messages.offers({"1:1": better}))
        rival = Standing(node="south", place=None, reach_m=None, most=4, serves=(("1:1", 25.0),))
        wire.takes["standing"]("companion/site/south/standing", messages.standing(rival))
        last = steps[-1]
        assert isinstance(last, Duty)
        assert last.serves == ()  # without waiting for a tick
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    run_async(test())


def test_unresponsive_neighbour_triggers_reconnection() -> None:
    """A real neighbour that is alive but receives no query."""
    import zenoh

    notices: list[str] = []
    lives: list[bool] = []

    async def test() -> None:
        loop, again = asyncio.get_running_loop(), asyncio.Event()

        def seen(sample: zenoh.Sample) -> None:
            lives.append(sample.kind == zenoh.SampleKind.PUT)
            if lives == [True, False, True]:
                loop.call_soon_threadsafe(again.set)

        member = node(
            notify=lambda notice: notices.append(notice.text),
            now=time.monotonic_ns,
            connect=[f"tcp/127.0.0.1:{port}"],
        )
        member.open()
        kept = [
            south.liveliness().declare_token("companion/site/south/alive"),
            south.liveliness().declare_subscriber("companion/site/north/alive", seen, history=True),
        ]
        task = asyncio.create_task(member.run())
        await asyncio.wait_for(again.wait(), HANG_S)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert len(kept) == 2

    port = free_port()
    config = BusConfig(listen=(f"tcp/127.0.0.1:{port}",))
    with open_peer(config) as south:
        run_async(test())
    assert "no answer from south; reconnecting to all nodes" in notices


def test_node_leaves_the_fleet_while_descriptors_are_scarce(
    wire: Wire, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Zenoh limits no connections that never become a session."""
    notices: list[str] = []
    answers = iter([True])
    monkeypatch.setattr(live, "are_scarce", lambda: next(answers, False))
    monkeypatch.setattr(live, "AWAY_S", 0.05)
    ends: list[float] = []
    wire.close = lambda: ends.append(time.monotonic())  # type: ignore[method-assign]

    async def test() -> None:
        member = node(
            mode="client",
            connect=["tcp/127.0.0.1:1"],
            notify=lambda notice: notices.append(notice.text),
            now=time.monotonic_ns,
        )
        task = asyncio.create_task(member.run())
        while not ends:
            await asyncio.sleep(0)
        wire.is_asked.clear()
        await asyncio.wait_for(wire.is_asked.wait(), HANG_S)
        assert time.monotonic() - ends[0] >= 0.05
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    run_async(test())
    assert "nearly all file descriptors are in use; this node leaves the fleet for 0 s" in notices


def test_rates_are_in_bits_per_second() -> None:
    rate = Rate()
    rate.look(0)
    rate.bytes += 250
    rate.look(2 * S)
    assert rate.bps == 1000.0


# --- malformed samples ----------------------------------------------------------------------------


SAMPLES = {"standing": b"\x0a\x03abc", "heard": b"\xff", "offers": b"\x0a\xff"}


def test_malformed_samples_are_counted_and_reported_once_for_each_node() -> None:
    notices: list[Notice] = []
    member = node(mode="client", connect=["tcp/127.0.0.1:1"], notify=notices.append)
    member._valid_only(member._offered)("companion/site/east/offers", SAMPLES["offers"])
    for _ in range(3):
        for what, take in (
            ("standing", member._stands),
            ("heard", member._shared),
            ("offers", member._offered),
        ):
            member._valid_only(take)(f"companion/site/south/{what}", SAMPLES[what])
    assert member.status().damaged == 10
    assert [one.text for one in notices] == [
        "node east: message discarded: malformed message of offers; further ones are only counted",
        "node south: message discarded: name in the message differs: 'abc'; further ones are only"
        " counted",
    ]
    assert {one.severity for one in notices} == {Severity.WARNING}


TRIP = RoundTrip(t_ns=S, source=Source(1, 1), sent_ns=S, remote_ns=1)


@pytest.mark.parametrize(
    "many",
    [
        Shared(S, (SharedFrame(S, bytes(20)),) * messages.FRAMES_MAX),
        Shared(S, (), (TRIP,) * messages.FRAMES_MAX),
    ],
    ids=["frames", "round trips"],
)
def test_message_of_many_items_is_processed_in_slices(many: Shared) -> None:
    """While many items wait, further messages are discarded and counted."""
    taken: list[int] = []

    async def receive() -> None:
        member = node(mode="client", connect=["tcp/127.0.0.1:1"])
        member._slices = ToLoop(asyncio.get_running_loop())
        member._take_piece = lambda _, piece: taken.append(len(piece.frames + piece.trips))  # type: ignore[method-assign]
        payload = messages.shared(many)
        member._shared("south", payload)
        assert taken == [live.PIECE]
        member._shared("south", payload)
        member._shared("south", payload)
        assert member.member.reception.unusable == messages.FRAMES_MAX
        while member._waiting:
            await asyncio.sleep(0)

    run_async(receive())
    assert sum(taken) == 2 * messages.FRAMES_MAX
    assert max(taken) == live.PIECE


def test_frames_of_a_node_take_a_limited_share_of_the_time() -> None:
    """One node has 20 % of the time, all nodes together 30 %; time saved is half a second."""
    budgets, seconds = NodeBudgets(), Counter[str]()
    for number in range(20_000):
        now_s = number / 1000
        for name in ("north", "south"):
            if budgets.has_time(name, now_s):
                budgets.charge_time(name, 0.001)
                seconds[name] += 1
    assert sum(seconds.values()) == pytest.approx(1000 * (0.3 * 20 + 0.5), rel=0.01)
    alone = NodeBudgets()
    used = 0
    for number in range(20_000):
        if alone.has_time("north", number / 1000):
            alone.charge_time("north", 0.001)
            used += 1
    assert used == pytest.approx(1000 * (0.2 * 20 + 0.5), rel=0.01)


def test_frames_beyond_the_time_of_their_node_are_counted() -> None:
    member = node(mode="client", connect=["tcp/127.0.0.1:1"])
    assert member._budgets.has_time("south", S * 1e-9)
    member._budgets.charge_time("south", 10.0)
    member._shared("south", messages.shared(Shared(S, (SharedFrame(S, bytes(20)),) * 7)))
    assert member.member.reception.unusable == 7


def test_messages_of_a_node_beyond_its_budget_are_not_parsed() -> None:
    """Other nodes do not notice."""
    notices: list[Notice] = []
    taken: list[str] = []
    member = node(mode="client", connect=["tcp/127.0.0.1:1"], notify=notices.append)
    take = member._valid_only(lambda who, _: taken.append(who))
    for _ in range(10):
        take("companion/site/south/offers", bytes(BYTES_SAVED // 4))
    take("companion/site/west/offers", b"")
    assert taken == ["south"] * 4 + ["west"]
    assert member.damaged == 6
    assert ["more than 500 kB/s of messages" in one.text for one in notices] == [True]


def test_nodes_that_come_and_go_cost_a_bounded_number_of_notices() -> None:
    """Each is a line on stderr, an event and a message to every page."""
    notices: list[Notice] = []
    member = node(mode="client", connect=["tcp/127.0.0.1:1"], notify=notices.append)
    for n in range(3000):
        member._seen(f"companion/site/n{n}/alive", True)
        member._seen(f"companion/site/n{n}/alive", False)
    assert len(notices) < 600
    member._stands("west", standing("west"))
    assert "west" in member.member.neighbours  # by its messages, without a token


def test_claims_cause_decisions_at_a_limited_rate() -> None:
    """A claim to a UAV that this node serves is decided at once, but not again and again."""
    decided: list[int] = []
    now_ns = S
    member = node(mode="client", connect=["tcp/127.0.0.1:1"], now=lambda: now_ns)
    now_ns += live.DECIDED_NS
    member.ticked = decided.append  # type: ignore[method-assign]
    member.member.duties.serves["1:1"] = 5.0
    claim = standing("west", (("1:1", 9.0),))
    for _ in range(100):
        member._stands("west", claim)
    assert len(decided) == 1
    now_ns += live.DECIDED_NS
    member._stands("west", claim)
    assert len(decided) == 2


def test_malformed_clock_answer_is_counted_and_reported() -> None:
    notices: list[Notice] = []
    member = node(mode="client", connect=["tcp/127.0.0.1:1"], notify=notices.append)
    for answer in (b"", bytes(15), bytes(1000)):
        member._clock_answer("south", 0)(answer, 0)
    assert member.damaged == 3
    assert ["malformed clock answer" in one.text for one in notices] == [True]


def test_names_of_absent_nodes_are_bounded_and_reported_once() -> None:
    """A stranger may declare any number of liveliness tokens."""
    notices: list[Notice] = []
    member = node(mode="client", connect=["tcp/127.0.0.1:1"], notify=notices.append)

    for n in range(3 * NODES_MAX):
        member._seen(f"companion/site/n{n}/alive", True)
    assert len(member.member.neighbours) == len(member._unanswered.alive) == NODES_MAX
    texts = [one.text for one in notices]
    assert texts[NODES_MAX:] == [
        "more than 256 nodes; further ones are ignored",
        "nodes come and go too often; their messages show which are present",
    ]
    for n in range(10 * NODES_MAX):
        member._valid_only(member._offered)(f"companion/site/n{n}/offers", b"\xff")
    assert len(member._warned) <= NODES_MAX + 1


CLOCKS_NS = st.sampled_from([0, 1, -1, 1 << 62, -(1 << 63), (1 << 63) - 1, 1000 * S, 10**18])


@given(data=st.data())
@settings(max_examples=examples(400))
def test_whatever_a_node_sends_can_be_recorded_and_replayed(data: st.DataObject) -> None:
    """Its frames, round trips, positions and duties, by any clock."""
    now_ns = data.draw(st.sampled_from([S, 10**18, 1_800_000_000 * S]))
    events: list[Event] = []
    member = node(now=lambda: now_ns)
    member._step = events.append
    member._bus = Wire()  # type: ignore[assignment]
    remote_ns = data.draw(CLOCKS_NS)
    member.member.node_joined(now_ns, "south")
    answer = messages.CLOCK.pack(data.draw(CLOCKS_NS), remote_ns)
    for _ in range(3):
        member._clock_answer("south", now_ns - MS)(answer, time.monotonic_ns())
    mav = common.MAVLink(None, srcSystem=1, srcComponent=1)
    report = common.MAVLink_global_position_int_message(5, 473977000, 85456000, 0, 0, 0, 0, 0, 0)
    raw = bytes(report.pack(mav))
    times = st.sampled_from([0, max(remote_ns, 0), max(remote_ns - S, 0)])
    uavs = st.sampled_from(["1:1", "9:9", "foo", "x" * 64, "\u0663:1", "1:1:1"])
    numbers = st.sampled_from([0.0, 1e9, -1e9, math.inf, math.nan, 90.0, 1e300])
    trip = {"t_ns": times, "sent_ns": times, "remote_ns": CLOCKS_NS}
    trip |= {"sysid": st.just(1), "compid": st.just(1)}
    served = {"uav": uavs, "worth_db": numbers}
    samples = {
        "heard": schemas.message_class("Shared")(
            first_ns=data.draw(times),
            told_ns=data.draw(times),
            frame=[{"after_ns": data.draw(st.sampled_from([0, 1])), "raw": raw}],
            trip=[data.draw(st.fixed_dictionaries(trip))],
        ),
        "standing": schemas.message_class("Standing")(
            node="south",
            place=[data.draw(numbers) for _ in range(data.draw(st.sampled_from([0, 3])))],
            reach_m=data.draw(numbers),
            serves=[data.draw(st.fixed_dictionaries(served))],
            handing=[{"uav": data.draw(uavs), "to": data.draw(uavs)}],
        ),
        "offers": schemas.message_class("Offers")(
            offer=[{"uav": data.draw(uavs), "sure_db": data.draw(numbers), "heard_s": 1.0}]
        ),
    }
    takes = {"heard": member._shared, "standing": member._stands, "offers": member._offered}
    for what, sample in samples.items():
        key = f"companion/site/south/{what}"
        member._valid_only(takes[what])(key, sample.SerializeToString())
    member.ticked(now_ns)
    for event in events:
        member._pipeline.step(event)
        match event:
            case Frame():
                codec.to_frame(schemas.FrameEncoder().encode(event), {})
                assert event.doubt_ns < 3600 * S  # more is read back as damage
            case RoundTrip():
                codec.to_event(schemas.ROUND_TRIPS_TOPIC, schemas.encode("RoundTrip", event))
            case Duty():
                codec.to_event(schemas.DUTIES_TOPIC, schemas.encode("Duty", event))
