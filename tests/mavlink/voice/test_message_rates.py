"""Message rates: requested, monitored and not fought over, against autopilots simulated with
pymavlink."""

import math
import random
from collections import Counter
from collections.abc import Callable, Iterable
from itertools import pairwise
from operator import itemgetter
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect
from support import examples

from companion.mavlink.voice.component import ComponentSpec, ServiceComponent
from companion.mavlink.voice.message_rates import MessageRates
from companion.mavlink.voice.rate_watch import MessageRate, RateState, Request
from companion.mavlink.wire.encode import Outgoing, pack
from companion.mavlink.wire.framing import Splitter
from companion.values import Frame, Notice, Source

MS = 1_000_000
S = 1_000_000_000
EPOCH_NS = 1_790_000_000 * S
OURS, CARRIER, UAV, GCS = Source(5, 191), Source(5, 1), Source(3, 1), Source(255, 190)
POSITION, ATTITUDE = 33, 30
STREAMS = {POSITION: 6, ATTITUDE: 10}
STEP_MS = 50


class Autopilot:
    """A vehicle in pymavlink's generated dialect: it sends, obeys and acknowledges.

    ``results``: acknowledgements of SET_MESSAGE_INTERVAL in order, the last one repeating; None
    loses the request. ``streams``: whether it supports REQUEST_DATA_STREAM.
    """

    def __init__(
        self,
        *,
        source: Source = UAV,
        hz: float = 1.0,
        results: tuple[int | None, ...] = (dialect.MAV_RESULT_ACCEPTED,),
        streams: bool = True,
        obeys: bool = True,
        answers: bool = True,
    ) -> None:
        self.source, self.streams, self.obeys, self.answers = source, streams, obeys, answers
        self.hz = {POSITION: hz, ATTITUDE: hz}
        self.boot_ns = EPOCH_NS - 1000 * S
        self.mav = dialect.MAVLink(None, *source)
        self.received: list[Any] = []
        self._results = list(results)
        self._next_ns = {POSITION: 0, ATTITUDE: 0, 0: 0}

    def send(self, now_ns: int) -> list[bytes]:
        """Return due messages: a heartbeat per second, and the messages at their rates."""
        boot_ms = (now_ns - self.boot_ns) // MS
        made = {
            0: dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3),
            POSITION: dialect.MAVLink_global_position_int_message(
                boot_ms, 473977419, 85455938, 488_000, 25_000, 0, 0, 0, 0
            ),
            ATTITUDE: dialect.MAVLink_attitude_message(boot_ms, 0, 0, 0, 0, 0, 0),
        }
        out = []
        for msgid, message in made.items():
            hz = self.hz.get(msgid, 1.0)
            if hz and now_ns >= self._next_ns[msgid]:
                planned_ns = self._next_ns[msgid] or now_ns
                self._next_ns[msgid] = max(planned_ns + round(S / hz), now_ns)
                out.append(bytes(message.pack(self.mav)))
        return out

    def obey(self, raw: bytes) -> list[bytes]:
        """Handle a request addressed to this vehicle, and return the acknowledgement."""
        (message,) = dialect.MAVLink(None).parse_buffer(raw)
        kind = message.get_type()
        if kind not in ("COMMAND_LONG", "REQUEST_DATA_STREAM"):
            return []
        if message.target_system not in (0, self.source.sysid):
            return []
        ours = (message.get_srcSystem(), message.get_srcComponent()) == OURS
        if ours:
            self.received.append(message)
        if kind == "REQUEST_DATA_STREAM":
            for msgid, stream in STREAMS.items():
                if self.streams and message.req_stream_id in (0, stream):
                    self._set(msgid, message.req_message_rate * message.start_stop)
            return []
        result = dialect.MAV_RESULT_ACCEPTED
        if ours:
            result = self._results.pop(0) if len(self._results) > 1 else self._results[0]
        if result is None:
            return []
        if result == dialect.MAV_RESULT_ACCEPTED and self.obeys:
            self._set(int(message.param1), 1e6 / message.param2 if message.param2 > 0 else 0.0)
        ack = dialect.MAVLink_command_ack_message(
            message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
        )
        return [bytes(ack.pack(self.mav))] if self.answers else []

    def _set(self, msgid: int, hz: float) -> None:
        self.hz[msgid] = hz
        self._next_ns[msgid] = 0


Link = Callable[[int, bytes], list[tuple[int, bytes]]]
"""Maps a frame sent at a time to the arrivals of its copies."""


class World:
    """A component and autopilots on one network, in simulated time."""

    def __init__(
        self,
        *autopilots: Autopilot,
        position_hz: float | None = 5.0,
        attitude_hz: float | None = None,
        carrier: Source | None = None,
        link: Link = lambda t_ns, raw: [(t_ns, raw)],
    ) -> None:
        self.component = ServiceComponent(
            ComponentSpec(
                source=OURS, carrier=carrier, position_hz=position_hz, attitude_hz=attitude_hz
            )
        )
        self.autopilots = autopilots
        self.now_ns = EPOCH_NS
        self.requests: list[tuple[int, Outgoing, Source]] = []
        self.notices: list[Notice] = []
        self._link = link
        self._under_way: list[tuple[int, bytes]] = []
        self._splitter = Splitter("link")

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 1000 / STEP_MS)):
            self.now_ns += STEP_MS * MS
            for autopilot in self.autopilots:
                self._to_us(autopilot.send(self.now_ns))
            arrived = [x for x in self._under_way if x[0] <= self.now_ns]
            self._under_way = [x for x in self._under_way if x[0] > self.now_ns]
            for _, raw in sorted(arrived, key=itemgetter(0)):
                self._hear(raw)
            uavs = [a.source for a in self.autopilots]
            for message, to in self.component.due(self.now_ns, True, uavs):
                if to is not None:
                    self.requests.append((self.now_ns, message, to))
                    self._to_all(pack(message, 0))

    def say(self, message: Any, by: Source = GCS) -> None:
        """Another component sends, and all receive it."""
        raw = bytes(message.pack(dialect.MAVLink(None, *by)))
        self._to_us([raw])
        self._to_all(raw)

    def rate(self, uav: Source = UAV, msgid: int = POSITION) -> MessageRate:
        (found,) = (r for r in self.component.rates() if (r.uav, r.msgid) == (uav, msgid))
        return found

    def gaps_s(self) -> list[float]:
        """Return the times between requests, in seconds."""
        return [(b - a) / S for (a, *_), (b, *_) in pairwise(self.requests)]

    def _to_all(self, raw: bytes) -> None:
        for autopilot in self.autopilots:
            self._to_us(autopilot.obey(raw))

    def _to_us(self, frames: Iterable[bytes]) -> None:
        for raw in frames:
            self._under_way += self._link(self.now_ns, raw)

    def _hear(self, raw: bytes) -> None:
        for frame in self._splitter.feed(self.now_ns, raw):
            assert isinstance(frame, Frame)
            said = self.component.hear(frame)
            self.notices += [x for x in said if isinstance(x, Notice)]


def set_interval(hz: float, msgid: int = POSITION, target: Source = UAV) -> Any:
    interval_us = 1e6 / hz if hz else -1
    command = dialect.MAV_CMD_SET_MESSAGE_INTERVAL
    return dialect.MAVLink_command_long_message(
        *target, command, 0, msgid, interval_us, 0, 0, 0, 0, 0
    )


# --- requests -----------------------------------------------------------------------------------


def test_slow_uav_receives_one_rate_request() -> None:
    uav = Autopilot(hz=1.0)
    world = World(uav)
    world.run(60)
    (request,) = uav.received
    assert (request.get_type(), request.command) == ("COMMAND_LONG", 511)
    assert (request.target_system, request.target_component) == UAV
    assert (request.get_srcSystem(), request.get_srcComponent()) == OURS
    assert (request.param1, request.param2, request.confirmation) == (33, 200_000, 0)
    rate = world.rate()
    assert (rate.state, rate.asked, rate.changed_by) == (RateState.ACCEPTED, 1, None)
    assert (rate.wanted_hz, rate.observed_hz) == (5.0, pytest.approx(5.0))
    assert not world.notices


@pytest.mark.parametrize("hz", [4.1, 5.0, 10.0])
def test_sufficient_rate_is_not_requested(hz: float) -> None:
    world = World(Autopilot(hz=hz))
    world.run(60)
    assert not world.requests
    assert world.rate().state is RateState.WATCHING
    assert world.rate().observed_hz == pytest.approx(hz, rel=0.2)


def test_request_threshold_is_four_fifths_of_the_wanted_rate() -> None:
    world = World(Autopilot(hz=3.6))
    world.run(30)
    assert len(world.requests) == 1


def test_request_waits_until_the_rate_is_known_and_slow() -> None:
    world = World(Autopilot(hz=1.0))
    world.run(4)
    assert not world.requests
    assert world.rate().observed_hz is None
    world.run(16)
    assert 5.0 <= (world.requests[0][0] - EPOCH_NS) / S <= 12.0


def test_requests_cover_all_positions_and_the_carrier_attitude() -> None:
    world = World(Autopilot(), Autopilot(source=CARRIER), carrier=CARRIER, attitude_hz=10.0)
    world.run(60)
    asked = {
        (to, dialect.MAVLink(None).parse_buffer(pack(m, 0))[0].param1)
        for _, m, to in world.requests
    }
    assert asked == {(UAV, 33.0), (CARRIER, 33.0), (CARRIER, 30.0)}
    assert world.rate(CARRIER, ATTITUDE).observed_hz == pytest.approx(10.0)
    assert {(r.uav, r.msgid) for r in world.component.rates()} == asked


def test_no_rate_is_requested_when_none_is_configured() -> None:
    world = World(Autopilot(source=CARRIER, hz=0.3), carrier=CARRIER, position_hz=None)
    world.run(120)
    assert not world.requests
    assert not world.component.rates()


def test_message_never_received_is_requested() -> None:
    """The carrier is known by its heartbeat."""
    carrier = Autopilot(source=CARRIER, hz=0.0)
    world = World(carrier, carrier=CARRIER, position_hz=None, attitude_hz=10.0)
    world.run(5)
    assert world.rate(CARRIER, ATTITUDE).observed_hz is None
    world.run(25)
    assert carrier.hz[ATTITUDE] == 10.0
    assert carrier.hz[POSITION] == 0.0


# --- acknowledgements ---------------------------------------------------------------------------


def test_lost_request_is_resent_with_confirmation_count() -> None:
    uav = Autopilot(results=(None, None, dialect.MAV_RESULT_ACCEPTED))
    world = World(uav)
    world.run(60)
    assert [m.confirmation for m in uav.received] == [0, 1, 2]
    assert world.gaps_s() == pytest.approx([5.0, 5.0])
    assert world.rate().state is RateState.ACCEPTED


def test_lost_acknowledgement_is_inferred_from_the_rate() -> None:
    world = World(Autopilot(answers=False))
    world.run(60)
    assert world.rate().state is RateState.ACCEPTED
    assert len(world.requests) <= 2


@pytest.mark.parametrize(
    ("results", "tries"),
    [
        ((None,), 3),
        ((dialect.MAV_RESULT_TEMPORARILY_REJECTED,), 3),
        ((dialect.MAV_RESULT_DENIED,), 1),
        ((dialect.MAV_RESULT_UNSUPPORTED,), 1),
        ((dialect.MAV_RESULT_FAILED,), 1),
        ((dialect.MAV_RESULT_COMMAND_INT_ONLY,), 1),
        ((dialect.MAV_RESULT_TEMPORARILY_REJECTED, dialect.MAV_RESULT_DENIED), 2),
    ],
)
def test_old_autopilot_falls_back_to_request_data_stream(
    results: tuple[int | None, ...], tries: int
) -> None:
    uav = Autopilot(results=results)
    world = World(uav, position_hz=4.5)
    world.run(80)
    kinds = [m.get_type() for m in uav.received]
    assert kinds == ["COMMAND_LONG"] * tries + ["REQUEST_DATA_STREAM"]
    stream = uav.received[-1]
    assert (stream.req_stream_id, stream.req_message_rate, stream.start_stop) == (6, 5, 1)
    assert (stream.target_system, stream.target_component) == UAV
    assert world.gaps_s() == pytest.approx([5.0] * tries)
    assert world.rate().state is RateState.STREAMING
    assert world.rate().observed_hz == pytest.approx(5.0)
    assert not world.notices


def test_attitude_uses_its_data_stream() -> None:
    carrier = Autopilot(source=CARRIER, results=(dialect.MAV_RESULT_UNSUPPORTED,))
    World(carrier, carrier=CARRIER, position_hz=None, attitude_hz=10.0).run(60)
    assert [m.req_stream_id for m in carrier.received[1:]] == [10]


@pytest.mark.parametrize(("result", "tries"), [(dialect.MAV_RESULT_UNSUPPORTED, 1), (None, 3)])
def test_known_stream_autopilot_is_sent_stream_requests(result: int | None, tries: int) -> None:
    uav = Autopilot(results=(result,))
    world = World(uav)
    world.run(60)
    world.say(dialect.MAVLink_request_data_stream_message(*UAV, 0, 1, 1))
    world.run(60)
    kinds = [m.get_type() for m in uav.received]
    assert kinds == ["COMMAND_LONG"] * tries + ["REQUEST_DATA_STREAM"] * 2
    assert world.rate().observed_hz == pytest.approx(5.0)


def test_in_progress_answer_has_a_timeout() -> None:
    results = (dialect.MAV_RESULT_IN_PROGRESS, dialect.MAV_RESULT_ACCEPTED)
    world = World(Autopilot(results=results))
    world.run(60)
    assert [r[1].msgid for r in world.requests] == [76, 76]
    forever = World(Autopilot(obeys=False, results=(dialect.MAV_RESULT_TEMPORARILY_REJECTED,)))
    forever.run(12)
    for _ in range(400):
        forever.say(dialect.MAVLink_command_ack_message(511, dialect.MAV_RESULT_IN_PROGRESS), UAV)
        forever.run(0.5)
    assert 60.0 <= max(forever.gaps_s()) <= 70.0


def test_refusing_autopilot_is_asked_with_backoff_and_announced_once() -> None:
    world = World(Autopilot(results=(dialect.MAV_RESULT_DENIED,), streams=False))
    world.run(1500)
    gaps = world.gaps_s()
    backoffs = [min(5.0 * 2 ** (n // 2), 300.0) for n in range(len(gaps))]
    assert all(gap >= backoff for gap, backoff in zip(gaps, backoffs, strict=True))
    assert all(gap <= 2 * backoff + 10 for gap, backoff in zip(gaps, backoffs, strict=True))
    assert backoffs[-1] == 300.0
    assert {m.msgid for _, m, _ in world.requests} == {76, 66}
    (notice,) = world.notices
    assert notice.subject == "3:1"
    assert "GLOBAL_POSITION_INT" in notice.text
    assert "requests have no effect" in notice.text
    assert world.rate().asked == len(world.requests)


def test_refused_state_is_entered_and_left() -> None:
    uav = Autopilot(results=(dialect.MAV_RESULT_DENIED,), streams=False)
    world = World(uav)
    states = set()
    for _ in range(60):
        world.run(0.5)
        states |= {r.state for r in world.component.rates()}
    assert {RateState.REFUSED, RateState.ASKED, RateState.STREAMING} <= states
    uav.hz[POSITION] = 10.0
    world.run(30)
    assert world.rate().state in (RateState.WATCHING, RateState.STREAMING)


def test_accepting_but_inactive_autopilot_is_asked_with_backoff() -> None:
    world = World(Autopilot(obeys=False))
    world.run(1800)
    assert len(world.requests) < 20
    assert max(world.gaps_s()) >= 300.0
    assert world.rate().state in (RateState.ACCEPTED, RateState.ASKED)
    assert world.rate().observed_hz == pytest.approx(1.0)


def test_acknowledgements_to_others_are_ignored() -> None:
    """An acknowledgement to another component, of another command or from another sender is
    ignored."""
    uav = Autopilot(results=(None,))
    world = World(uav)
    while not world.requests:
        world.run(0.5)
    denied = dialect.MAV_RESULT_DENIED
    world.say(dialect.MAVLink_command_ack_message(511, denied, 0, 0, *GCS), UAV)
    world.say(dialect.MAVLink_command_ack_message(511, denied, 0, 0, OURS.sysid, 9), UAV)
    world.say(dialect.MAVLink_command_ack_message(512, denied, 0, 0, *OURS), UAV)
    world.say(dialect.MAVLink_command_ack_message(511, denied, 0, 0, *OURS), Source(3, 154))
    world.run(12)
    assert [m.get_type() for m in uav.received] == ["COMMAND_LONG"] * 3
    world.say(dialect.MAVLink_command_ack_message(511, denied), UAV)  # in version 1 form
    world.run(0.5)
    world.say(dialect.MAVLink_command_ack_message(511, dialect.MAV_RESULT_ACCEPTED), UAV)
    world.run(6)
    assert uav.received[-1].get_type() == "REQUEST_DATA_STREAM"


def test_commands_to_one_uav_are_sequential() -> None:
    """An acknowledgement does not name the message that it concerns."""
    carrier = Autopilot(source=CARRIER, results=(None,))
    world = World(carrier, carrier=CARRIER, attitude_hz=5.0)
    world.run(40)
    commands = [t_ns for t_ns, m, _ in world.requests if m.msgid == 76]
    assert len(commands) == 6
    assert min(b - a for a, b in pairwise(commands)) >= 5 * S
    other = Autopilot(source=CARRIER, results=(dialect.MAV_RESULT_UNSUPPORTED, 0))
    world = World(other, carrier=CARRIER, attitude_hz=5.0)
    world.run(40)
    states = {r.msgid: r.state for r in world.component.rates()}
    assert sorted(states.values()) == [RateState.ACCEPTED, RateState.STREAMING]
    assert other.hz == {POSITION: 5.0, ATTITUDE: 5.0}


def test_acknowledgement_applies_to_the_last_command() -> None:
    carrier = Autopilot(source=CARRIER, results=(None, dialect.MAV_RESULT_ACCEPTED))
    world = World(carrier, carrier=CARRIER, attitude_hz=5.0)
    while len(world.requests) < 2:
        world.run(0.05)
    world.run(0.05)
    lost, answered = (int(m.param1) for m in carrier.received[:2])
    assert (lost, answered) == (POSITION, ATTITUDE)
    assert world.rate(CARRIER, lost).state is RateState.ASKED
    assert world.rate(CARRIER, answered).state is RateState.ACCEPTED


def test_uav_no_longer_wanted_receives_no_requests() -> None:
    rates, uav = MessageRates(source=OURS, carrier=None, position_hz=5.0, attitude_hz=None), UAV
    for n in range(600):
        t_ns = EPOCH_NS + n * S // 10
        if n % 10 == 0:
            rates.stamped(t_ns, uav, POSITION, n * 100)
        sent = rates.due(t_ns, [uav] if n < 50 else [])
        assert not sent
        assert bool(rates.state()) == (10 <= n < 50)


# --- changes ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        set_interval(1.0),
        set_interval(0.0),
        set_interval(1.0, target=Source(0, 0)),
        dialect.MAVLink_request_data_stream_message(*UAV, 6, 1, 1),
        dialect.MAVLink_request_data_stream_message(0, 0, 0, 2, 1),
        dialect.MAVLink_request_data_stream_message(*UAV, 6, 10, 0),
    ],
)
def test_component_that_changed_the_rate_is_named(change: Any) -> None:
    world = World(Autopilot())
    world.run(40)
    world.say(change)
    world.run(40)
    (notice,) = world.notices
    assert notice.text.endswith("changed by 255:190")
    assert world.rate().changed_by == "255:190"
    assert world.rate().observed_hz == pytest.approx(5.0)
    assert len(world.requests) == 2


@pytest.mark.parametrize(
    "innocent",
    [
        set_interval(10.0),
        set_interval(1.0, msgid=ATTITUDE),
        set_interval(1.0, msgid=24),
        set_interval(1.0, target=Source(4, 1)),
        set_interval(1.0, target=Source(3, 154)),
        dialect.MAVLink_request_data_stream_message(4, 1, 6, 1, 1),
        dialect.MAVLink_request_data_stream_message(*UAV, 10, 1, 1),
        dialect.MAVLink_command_long_message(*UAV, 512, 0, 33, 1e6, 0, 0, 0, 0, 0),
    ],
)
def test_unrelated_components_are_not_named(innocent: Any) -> None:
    uav = Autopilot()
    world = World(uav)
    world.run(40)
    world.say(innocent)
    world.run(1)
    uav.hz[POSITION] = 1.0
    world.run(40)
    assert [n.text.split(": ")[-1] for n in world.notices] == [
        "no request of another component was received"
    ]
    assert world.rate().changed_by == "no request of another component was received"


def test_old_request_is_not_named_as_cause() -> None:
    uav = Autopilot(hz=5.0)
    world = World(uav)
    world.run(30)
    uav_hz = uav.hz.copy()
    world.say(set_interval(1.0))
    uav.hz = uav_hz
    world.run(40)
    uav.hz[POSITION] = 1.0
    world.run(40)
    assert world.rate().changed_by == "no request of another component was received"


def test_overridden_request_is_not_named_for_the_next_change() -> None:
    uav = Autopilot()
    world = World(uav)
    world.run(40)
    world.say(set_interval(1.0))
    while len(world.requests) < 2:
        world.run(0.5)
    world.run(7)
    assert world.rate().changed_by == "255:190"
    uav.hz[POSITION] = 1.0
    world.run(12)
    assert world.rate().changed_by == "no request of another component was received"


def test_fluctuating_rate_does_not_reset_the_backoff() -> None:
    """A rate that fluctuates by itself does not cause more requests."""
    uav = Autopilot(results=(None,), streams=False)
    world = World(uav)
    for _ in range(12):
        uav.hz[POSITION] = 5.0
        world.run(100)
        uav.hz[POSITION] = 1.0
        world.run(20)
    assert len(world.requests) < 20


def test_stopped_message_is_requested() -> None:
    uav = Autopilot(hz=5.0, results=(None,), streams=False)
    world = World(uav)
    world.run(20)
    uav.hz[POSITION] = 0.0
    world.run(20)
    observed_hz = world.rate().observed_hz
    assert observed_hz is not None
    assert observed_hz < 0.1
    assert world.requests


def test_ineffective_request_is_announced() -> None:
    uav = Autopilot(hz=5.0, results=(dialect.MAV_RESULT_DENIED,), streams=False)
    world = World(uav)
    world.run(20)
    uav.hz[POSITION] = 1.0
    world.run(60)
    texts = [n.text.split(": ")[-1] for n in world.notices]
    assert texts == ["no request of another component was received", "requests have no effect"]


def test_restart_is_named_as_cause() -> None:
    uav = Autopilot()
    world = World(uav)
    world.run(40)
    uav.hz[POSITION], uav.boot_ns = 1.0, world.now_ns
    world.run(40)
    assert world.rate().changed_by == "a restart"
    assert [n.text.split(": ")[-1] for n in world.notices] == ["changed by a restart"]
    assert world.rate().observed_hz == pytest.approx(5.0)


def test_competing_ground_station_is_announced_once_with_backoff() -> None:
    world = World(Autopilot())
    for _ in range(150):
        world.run(10)
        world.say(set_interval(1.0))
    assert len(world.requests) < 20
    assert max(world.gaps_s()) >= 300.0
    assert len(world.notices) == 1
    assert world.rate().changed_by == "255:190"


def test_backoff_and_notice_reset_after_a_long_stable_period() -> None:
    world = World(Autopilot())
    for _ in range(40):
        world.run(15)
        world.say(set_interval(1.0))
    assert max(world.gaps_s()) > 60.0
    world.run(1300)
    assert world.rate().changed_by is None
    before = len(world.requests)
    for _ in range(2):
        world.say(set_interval(1.0))
        world.run(22)
    assert len(world.requests) == before + 2
    assert len(world.notices) == 2


# --- links --------------------------------------------------------------------------------------


def radio(seed: int, loss: float, burst_s: float, jitter_s: float, copies: int = 1) -> Link:
    """Return a link that loses, bursts, reorders and repeats frames."""
    rng = random.Random(seed)

    def carry(t_ns: int, raw: bytes) -> list[tuple[int, bytes]]:
        if rng.random() < loss:
            return []
        every_ns = round(burst_s * S)
        burst_ns = -(-t_ns // every_ns) * every_ns
        return [(burst_ns + round(rng.random() * jitter_s * S), raw) for _ in range(copies)]

    return carry


@pytest.mark.parametrize("loss", [0.0, 0.3])
@pytest.mark.parametrize("burst_s", [0.001, 1.5, 4.8])
@pytest.mark.parametrize("jitter_s", [0.0, 0.5])
def test_link_impairments_cause_no_requests(loss: float, burst_s: float, jitter_s: float) -> None:
    world = World(Autopilot(hz=5.0), link=radio(1, loss, burst_s, jitter_s, copies=2))
    world.run(120)
    assert len(world.requests) <= (2 if loss else 0)  # occasionally most of a dozen are lost
    assert world.rate().observed_hz is not None


def test_bursts_and_duplicates_do_not_hide_a_slow_rate() -> None:
    uav = Autopilot(hz=1.0)
    World(uav, link=radio(2, 0.0, 2.5, 0.3, copies=3)).run(60)
    assert uav.hz[POSITION] == 5.0


def test_silent_uav_receives_no_requests_and_is_forgotten() -> None:
    uav = Autopilot(obeys=False)
    world = World(uav)
    world.run(30)
    assert world.requests
    uav.send = lambda now_ns: []  # type: ignore[method-assign]
    uav.obey = lambda raw: []  # type: ignore[method-assign]
    world.run(6)
    before = len(world.requests)
    world.run(22.9)
    assert world.component.rates()
    world.run(1.5)
    assert not world.component.rates()
    assert len(world.requests) == before


def test_fleet_requests_are_rate_limited_and_fair() -> None:
    """The longest waiting UAV comes first, with at most five requests per second."""
    fleet = [
        Autopilot(source=Source(n, 1), results=(None,), streams=False) for n in range(100, 160)
    ]
    world = World(*fleet)
    world.run(40)
    times = [t_ns for t_ns, *_ in world.requests]
    assert all(b - a >= S for a, b in zip(times, times[5:], strict=False))
    assert len(times) > 100
    assert len({to for *_, to in world.requests[:60]}) == 60
    assert len({to for *_, to in world.requests[60:120]}) == 60


# --- arbitrary input ----------------------------------------------------------------------------

NUMBERS = st.integers(0, 3)
EVENTS = st.one_of(
    st.tuples(st.just("wait"), st.sampled_from([0, 1, 90, 700, 5_000, 31_000, 700_000])),
    st.tuples(st.just("quiet"), st.sampled_from([100, 3_000, 20_000])),
    st.tuples(st.just("ack"), NUMBERS, st.integers(0, 8)),
    st.tuples(st.just("stamp"), NUMBERS, st.integers(0, 2**32 - 1)),
    st.tuples(st.just("rate"), NUMBERS, st.sampled_from([0.2, 0.5, 0.9, 2.0])),
    st.tuples(st.just("other"), NUMBERS, st.sampled_from([None, 0.0, 1.0, 50.0])),
)


@settings(max_examples=examples(25), deadline=None)
@given(st.lists(EVENTS, max_size=40))
def test_request_limits_hold_for_any_input(events: list[Any]) -> None:
    """Per message at least 5 s apart, in total at most 5 per second; hundreds of seconds of slow
    rates cause no more than the back-off allows."""
    uavs = [CARRIER, UAV, Source(4, 1), Source(6, 1)]
    rates, now_ns = (
        MessageRates(source=OURS, carrier=CARRIER, position_hz=1.0, attitude_hz=20.0),
        EPOCH_NS,
    )
    hz = dict.fromkeys(uavs, 0.5)
    sent: list[tuple[int, Source, int]] = []

    def step(t_ns: int) -> None:
        for message, to in rates.due(t_ns, uavs):
            (decoded,) = dialect.MAVLink(None).parse_buffer(pack(message, 0))
            assert message.source == OURS
            stream = decoded.get_type() == "REQUEST_DATA_STREAM"
            msgid = {6: 33, 10: 30}[decoded.req_stream_id] if stream else int(decoded.param1)
            assert msgid == 33 or to == CARRIER
            sent.append((t_ns, to, msgid))

    for kind, which, *value in [*events, ("wait", 700_000)]:
        if kind in ("wait", "quiet"):
            step_ms = 100 if which <= 5_000 else 500
            for n in range(which // step_ms + 1):
                now_ns += min(which, step_ms) * MS
                for uav in uavs if kind == "wait" else ():
                    if n % max(1, round(1000 / step_ms / hz[uav])) == 0:
                        rates.stamped(now_ns, uav, POSITION, now_ns // MS % 2**32)
                    rates.message_received(now_ns, uav)
                step(now_ns)
            continue
        uav = uavs[which]
        if kind == "ack":
            rates.acknowledged(now_ns, uav, value[0])
        elif kind == "stamp":
            rates.stamped(now_ns, uav, ATTITUDE, value[0])
        elif kind == "rate":
            hz[uav] = value[0]
        else:
            rates.requested(Request(t_ns=now_ns, by=GCS, target=uav, msgids=(33,), hz=value[0]))
    times = [t_ns for t_ns, *_ in sent]
    assert all(b - a >= S for a, b in zip(times, times[5:], strict=False))
    for key in {(uav, msgid) for _, uav, msgid in sent}:
        own = [t_ns for t_ns, uav, msgid in sent if (uav, msgid) == key]
        assert all(b - a >= 5 * S for a, b in pairwise(own))
    last = Counter((uav, msgid) for t_ns, uav, msgid in sent if t_ns > now_ns - 700 * S)
    rounds = math.ceil(math.log2(700 / 5))  # at most four requests in each
    assert all(count <= 4 * rounds for count in last.values())
