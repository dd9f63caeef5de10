"""The service as a MAVLink component: heartbeat, rate requests, TIMESYNC, and id conflicts.

Pure: the caller passes in the received frames and the time, and sends the messages that are due.

Heartbeat (https://mavlink.io/en/services/heartbeat.html): once a second, and only while the
service works. Otherwise it would report a working service that is not.

TIMESYNC (https://mavlink.io/en/services/timesync.html): a request with the time of sending in
``ts1`` is broadcast. Each peer answers with that ``ts1`` and its own time in ``tc1``. Newer peers
also address the answer; older ones do not. An answer to another program is recognised by its
``ts1``: other programs send microseconds, or any nanosecond, of Unix time, while the last three
digits of ours are the system id, as in ArduPilot, which makes ``ts1`` up to 1 us earlier than the
sending. Once in a thousand million requests, another program's request to an autopilot that does
not address its answers has the same nanosecond. Its round trip is then mistaken for ours, and is
false only if that program's clock is ahead of ours.

``tc1`` is nanoseconds since boot of ArduPilot (``GCS_MAVLINK::handle_timesync``: ``micros64()``
times 1000) and of PX4 (mavlink_timesync.cpp: ``hrt_absolute_time()`` times 1000), the clock of the
milliseconds in their positions. Ground stations and other programs answer with Unix time, which is
unrelated to any boot clock. Answers of senders without a position or attitude are therefore
ignored, and answers far off the sender's boot clock are rejected. An answer is used ``HELD_NS``
after it arrived: if a second answer to the same request contradicts it, neither is used. See
docs/field-notes.md 1.

Over 300 lines: everything that the service receives and sends as a component is here.
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from companion.mavlink.clock.epochs import WRAP_NS
from companion.mavlink.voice.message_rates import MessageRates
from companion.mavlink.voice.rate_watch import STREAM, MessageRate, Request
from companion.mavlink.wire import positions, stamps
from companion.mavlink.wire.decode import POSE
from companion.mavlink.wire.encode import (
    COMMAND_LONG,
    HEARTBEAT,
    MAV_CMD_SET_MESSAGE_INTERVAL,
    REQUEST_DATA_STREAM,
    TIMESYNC,
    Outgoing,
    heartbeat,
    timesync,
)
from companion.mavlink.wire.payload import unpack
from companion.values import (
    Frame,
    Notice,
    Reason,
    Rejection,
    RoundTrip,
    Severity,
    Source,
    UserError,
)

_NS: Final = 1_000_000_000
COMMAND_ACK: Final = 77
ACCEPTED_IDS: Final = POSE | {HEARTBEAT, REQUEST_DATA_STREAM, COMMAND_LONG, COMMAND_ACK, TIMESYNC}
"""Ids of the messages that ``ServiceComponent.hear`` processes."""

HEARTBEAT_NS: Final = _NS  # time between two heartbeats
TIMESYNC_NS: Final = (1 * _NS, 5 * _NS)
"""Time between TIMESYNC requests: of the first ``TIMESYNC_FIRST``, and of later ones."""
TIMESYNC_FIRST: Final = 10  # requests sent at the shorter interval
LONGEST_TRIP_NS: Final = 10 * _NS  # longest round trip that is used
KEPT_NS: Final = 30 * _NS  # how long sent messages and senders' newest stamps are remembered
HELD_NS: Final = 2 * _NS
"""How long an answer is held until a contradicting one could have arrived over a slow radio."""
CLOCKS_APART_NS: Final = 60 * _NS
"""Largest difference between an answer and the sender's boot clock.

A larger one means that the answer is from another clock.
"""
_UPTIME_MAX_NS: Final = 10 * 365 * 86_400 * _NS
"""Largest plausible time since boot. Unix time has exceeded it since 1980."""
CONFLICT_NOTICE_NS: Final = 300 * _NS  # time after which a conflict of ids is reported again

_BROADCAST: Final = 0
_NOT_OURS: Final = frozenset({0, 1, 190})  # broadcast, an autopilot, a ground station
_RATES_HZ: Final = (0.1, 100.0)
_ALL_STREAMS: Final = 0

_COMMAND_ACK = struct.Struct("<HBBiBB")
_COMMAND_LONG = struct.Struct("<7fHBBB")
_REQUEST_DATA_STREAM = struct.Struct("<HBBBB")
_TIMESYNC = struct.Struct("<qqBB")


@dataclass(frozen=True, slots=True, kw_only=True)
class ComponentSpec:
    """Identity of the service on the network, and the message rates that it requests.

    A rate of None requests nothing. Raises ``UserError`` for ids of ground stations, autopilots or
    broadcasts, for a source equal to the carrier, and for rates outside 0.1 to 100 Hz.
    """

    source: Source  # system and component id of the service
    carrier: Source | None  # the vehicle that carries the array; None for a fixed array
    position_hz: float | None  # rate of GLOBAL_POSITION_INT of every UAV and of the carrier
    attitude_hz: float | None  # rate of ATTITUDE of the carrier

    def __post_init__(self) -> None:
        if not 1 <= self.source.sysid <= 254:
            raise UserError(f"source is {self.source}, allowed system ids: 1 to 254")
        if self.source.compid in _NOT_OURS or not 0 <= self.source.compid <= 255:
            raise UserError(
                f"source is {self.source}, allowed component ids: 2 to 255, and not 190;"
                " an onboard computer is 191"
            )
        if self.carrier == self.source:
            raise UserError(f"carrier {self.carrier} has this service's own id; name another one")
        for name, rate_hz in (("position_hz", self.position_hz), ("attitude_hz", self.attitude_hz)):
            if rate_hz is not None and not _RATES_HZ[0] <= rate_hz <= _RATES_HZ[1]:
                raise UserError(f"{name} is {rate_hz}, allowed: 0.1 to 100")


class ServiceComponent:
    """The service as a MAVLink component. Times are node times and do not decrease.

    ``source`` is its system and component id.
    """

    def __init__(self, settings: ComponentSpec) -> None:
        self.source = settings.source
        self._rates = MessageRates(
            source=settings.source,
            carrier=settings.carrier,
            position_hz=settings.position_hz,
            attitude_hz=settings.attitude_hz,
        )
        self._heartbeat_ns = 0  # no heartbeat before this time
        self._timesync_ns = 0
        self._timesyncs = 0
        self._answered: dict[int, dict[Source, RoundTrip]] = {}  # by time of sending
        self._held: list[RoundTrip] = []  # answers that others may still contradict, in order
        self._doubted: dict[Source, int] = {}  # last notice on contradictions of a source
        self._sent: dict[tuple[int, bytes], int] = {}  # own messages by content: when last sent
        self._stamps: dict[Source, tuple[int, int]] = {}  # arrival ns and boot ms of the newest
        self._purge_ns = 0
        self._conflict_ns: int | None = None

    def hear(self, frame: Frame) -> list[RoundTrip | Rejection | Notice]:
        """Process a frame whose id is in ``ACCEPTED_IDS``.

        Returns the round trips, rejections and notices since the last call.
        """
        outputs: list[RoundTrip | Rejection | Notice] = []
        if frame.source == self.source:
            self._own_id_received(frame, outputs)
        elif frame.msgid in POSE:
            is_stamped = frame.msgid in stamps.STAMPED
            boot_ms = stamps.boot_ms(frame) if is_stamped else positions.read(frame).boot_ms
            self._stamps[frame.source] = (frame.t_ns, boot_ms)
            self._rates.stamped(frame.t_ns, frame.source, frame.msgid, boot_ms)
        else:
            self._rates.message_received(frame.t_ns, frame.source)
            if frame.msgid == TIMESYNC:
                self._timesync_answer(frame, outputs)
            elif frame.msgid == COMMAND_ACK:
                self._command_ack(frame)
            elif frame.msgid == COMMAND_LONG:
                self._command_long(frame)
            elif frame.msgid == REQUEST_DATA_STREAM:
                self._request_data_stream(frame)
        while self._held and frame.t_ns - self._held[0].t_ns >= HELD_NS:
            outputs.append(self._held.pop(0))
        if self._rates.notices:
            outputs += self._rates.notices
            self._rates.notices.clear()
        return outputs

    def due(
        self, now_ns: int, fit: bool, uavs: Iterable[Source]
    ) -> list[tuple[Outgoing, Source | None]]:
        """Return the messages to send now, each with its target; None: broadcast.

            fit   whether the service works
            uavs  UAVs whose positions are needed

        Call it about ten times a second. Messages missed between calls are not sent later.
        """
        out: list[tuple[Outgoing, Source | None]] = []
        if fit and now_ns >= self._heartbeat_ns:
            self._heartbeat_ns = now_ns + HEARTBEAT_NS
            out.append((heartbeat(self.source), None))
        if now_ns >= self._timesync_ns:
            self._timesyncs += 1
            self._timesync_ns = now_ns + TIMESYNC_NS[self._timesyncs >= TIMESYNC_FIRST]
            sent_ns = now_ns - (now_ns - self.source.sysid) % 1000
            self._answered[sent_ns] = {}
            out.append((timesync(self.source, sent_ns), None))
        out += self._rates.due(now_ns, uavs)
        for message, _ in out:
            self._sent[_content(message.msgid, message.payload)] = now_ns
        if now_ns >= self._purge_ns:
            self._purge_ns = now_ns + _NS
            self._purge(now_ns - KEPT_NS)
        return out

    def rates(self) -> list[MessageRate]:
        """Return the state of every message whose rate is monitored."""
        return self._rates.state()

    def _purge(self, oldest_ns: int) -> None:
        self._answered = {t_ns: who for t_ns, who in self._answered.items() if t_ns >= oldest_ns}
        self._sent = {content: t_ns for content, t_ns in self._sent.items() if t_ns >= oldest_ns}
        self._stamps = {who: at for who, at in self._stamps.items() if at[0] >= oldest_ns}
        told = {who: at for who, at in self._doubted.items() if oldest_ns - at < CONFLICT_NOTICE_NS}
        self._doubted = told

    def _own_id_received(self, frame: Frame, outputs: list[RoundTrip | Rejection | Notice]) -> None:
        """Handle a frame under this service's id: its own echo, or another sender's frame."""
        sent_ns = self._sent.get(_content(frame.msgid, frame.payload))
        if sent_ns is not None and frame.t_ns - sent_ns <= KEPT_NS:
            return
        if self._conflict_ns is None or frame.t_ns - self._conflict_ns >= CONFLICT_NOTICE_NS:
            self._conflict_ns = frame.t_ns
            text = f"{frame.link}: another sender uses {self.source}, this service's id"
            outputs.append(
                Notice(
                    t_ns=frame.t_ns, severity=Severity.WARNING, subject=str(self.source), text=text
                )
            )

    def _timesync_answer(self, frame: Frame, outputs: list[RoundTrip | Rejection | Notice]) -> None:
        remote_ns, sent_ns, *target = unpack(frame, _TIMESYNC)
        answered = self._answered.get(sent_ns)
        stamp = self._stamps.get(frame.source)
        if (
            remote_ns == 0
            or answered is None
            or stamp is None
            or not self._is_addressed_to_us(*target)
        ):
            return  # a request, an answer to others, or an answer of a sender without stamps
        if frame.t_ns - sent_ns > LONGEST_TRIP_NS:
            trip_s = (frame.t_ns - sent_ns) * 1e-9
            refused, detail = Reason.OUT_OF_ORDER, f"TIMESYNC: round trip took {trip_s:.1f} s"
        elif not _is_boot_time(remote_ns, frame.t_ns, *stamp):
            refused, detail = (
                Reason.UNPLACED_STAMP,
                "TIMESYNC: answer is from another clock than the positions",
            )
        else:
            trip = RoundTrip(
                t_ns=frame.t_ns, source=frame.source, sent_ns=sent_ns, remote_ns=remote_ns
            )
            first = answered.setdefault(frame.source, trip)
            if first is trip:
                self._held.append(trip)
                return
            if not _agree(first, trip):
                self._discard_contradicting(first, trip, outputs)
                return
            refused, detail = Reason.DUPLICATE, "TIMESYNC: request was already answered"
        outputs.append(_refused(frame.t_ns, frame.source, refused, detail))

    def _discard_contradicting(
        self, first: RoundTrip, second: RoundTrip, outputs: list[RoundTrip | Rejection | Notice]
    ) -> None:
        """Discard two answers that cannot be of one clock; the first only if still held."""
        discarded = [first, second] if first in self._held else [second]
        self._held = [trip for trip in self._held if trip is not first]
        detail = "TIMESYNC: two answers contradict each other"
        outputs += [_refused(one.t_ns, one.source, Reason.SHARED_ID, detail) for one in discarded]
        t_ns, source = second.t_ns, second.source
        if t_ns - self._doubted.get(source, -CONFLICT_NOTICE_NS) >= CONFLICT_NOTICE_NS:
            self._doubted[source] = t_ns
            text = f"two senders answer TIMESYNC as {source} with different clocks: neither is used"
            outputs.append(
                Notice(t_ns=t_ns, severity=Severity.WARNING, subject=str(source), text=text)
            )

    def _command_ack(self, frame: Frame) -> None:
        command, result, _, _, *target = unpack(frame, _COMMAND_ACK)
        if command == MAV_CMD_SET_MESSAGE_INTERVAL and self._is_addressed_to_us(*target):
            self._rates.acknowledged(frame.t_ns, frame.source, result)

    def _command_long(self, frame: Frame) -> None:
        msgid, interval_us, *_, command, sysid, compid, _ = unpack(frame, _COMMAND_LONG)
        if command == MAV_CMD_SET_MESSAGE_INTERVAL and msgid in STREAM:
            hz = 1e6 / interval_us if interval_us > 0 else None  # stopped, or default rate
            target = Source(sysid, compid)
            self._rates.requested(
                Request(
                    t_ns=frame.t_ns, by=frame.source, target=target, msgids=(int(msgid),), hz=hz
                )
            )

    def _request_data_stream(self, frame: Frame) -> None:
        rate_hz, sysid, compid, stream, start = unpack(frame, _REQUEST_DATA_STREAM)
        msgids = tuple(m for m, its in STREAM.items() if stream in (its, _ALL_STREAMS))
        if msgids:
            target, hz = Source(sysid, compid), float(rate_hz if start else 0)
            self._rates.requested(
                Request(t_ns=frame.t_ns, by=frame.source, target=target, msgids=msgids, hz=hz)
            )

    def _is_addressed_to_us(self, sysid: int, compid: int) -> bool:
        """Return whether an answer may be for this service: addressed to it, or broadcast."""
        return sysid in (_BROADCAST, self.source.sysid) and compid in (
            _BROADCAST,
            self.source.compid,
        )


def _refused(t_ns: int, source: Source, why: Reason, detail: str) -> Rejection:
    return Rejection(t_ns=t_ns, source=str(source), reason=why, msgid=TIMESYNC, detail=detail)


def _agree(one: RoundTrip, other: RoundTrip) -> bool:
    """Return whether two answers to one request can come from one clock, whatever their delays.

    A request that takes several routes is answered several times. Each answer bounds the offset;
    for one clock the intervals overlap, to a millisecond of rounding.
    """
    high_ns = min(one.t_ns - one.remote_ns, other.t_ns - other.remote_ns)
    low_ns = max(one.sent_ns - one.remote_ns, other.sent_ns - other.remote_ns)
    return low_ns <= high_ns + 1_000_000


def _content(msgid: int, payload: bytes) -> tuple[int, bytes]:
    """Return the part of a message that routers leave unchanged in both MAVLink versions."""
    return msgid, payload.rstrip(b"\0")


def _is_boot_time(remote_ns: int, t_ns: int, stamp_t_ns: int, boot_ms: int) -> bool:
    """Return whether ``remote_ns`` can be the clock of stamp ``boot_ms`` at ``stamp_t_ns``.

    The stamp wraps after 49.7 days; ``remote_ns`` does not.
    """
    if not 0 < remote_ns < _UPTIME_MAX_NS:
        return False
    expected_ns = boot_ms * 1_000_000 + t_ns - stamp_t_ns
    apart_ns = (remote_ns - expected_ns + WRAP_NS // 2) % WRAP_NS - WRAP_NS // 2
    return abs(apart_ns) <= CLOCKS_APART_NS
