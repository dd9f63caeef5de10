"""Asking for the rates that are wanted of the autopilots, and watching that they stay.

One small machine for each message of each UAV (``_Watch``):

    watching    nothing was asked, or the rate came without
    asked       SET_MESSAGE_INTERVAL was sent; up to three times, as COMMAND_ACK may be lost
    accepted    the autopilot said so, or its rate shows it
    streaming   REQUEST_DATA_STREAM was sent, after a refusal or no answer; nobody acknowledges it
    refused     neither helped

Asked is only where a rate is lower than wanted: a higher one is wanted by someone else. Between
two requests lies a back-off that doubles from round to round of asking, and begins anew after a
rate was in order for long: programs that want different rates of one UAV do not fight over it,
and a thin link is not filled with requests.

The rate is the sender's: intervals are those of its own stamps, so what the link loses (up to
half), repeats, delays or delivers in bursts changes nothing, for asking would not either. A
message counts as absent only while others of the same sender come.

Sources: https://mavlink.io/en/services/command.html, https://mavlink.io/en/messages/common.html.
ArduPilot answers FAILED for a message that it does not stream (``set_message_interval`` in its
GCS_Common.cpp); PX4 ignores REQUEST_DATA_STREAM (mavlink_receiver.cpp).
"""

import math
from bisect import insort
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import pairwise
from statistics import median_high
from typing import Final, NamedTuple

from companion.mavlink.decode import ATTITUDE, GLOBAL_POSITION_INT
from companion.mavlink.encode import Outgoing, request_data_stream, set_message_interval
from companion.values import Notice, Severity, Source

_NS: Final = 1_000_000_000
SLOW_BELOW: Final = 0.8
"""A rate below this part of the wanted one is slow."""
SETTLE_NS: Final = 5 * _NS
"""A rate is slow, or in order, once it was so for this long (or five of its messages)."""
TRIES: Final = 3
BACKOFF_NS: Final = (5 * _NS, 300 * _NS)
"""The shortest and the longest time between two requests for one message of one UAV."""
IN_ORDER_NS: Final = 600 * _NS
"""After so long in order, the back-off begins anew, and what was said may be said again."""
GONE_NS: Final = 5 * _NS
FORGET_NS: Final = 30 * _NS
"""A UAV that was not heard for so long is not asked anything; it is forgotten."""
BLAME_NS: Final = 30 * _NS
"""A request of someone else is taken for the cause of a change that follows within this."""
REQUESTS_PER_S: Final = 5
_ACK_WAIT_NS: Final = 5 * _NS
_PROGRESS_NS: Final = 60 * _NS
"""For so long after a request is "in progress" believed."""
_LATE_MS: Final = 30_000
"""A stamp that steps back by no more is that of a late frame; by more, of a restart."""
_STAMPS: Final = 12
_ENOUGH: Final = 5  # intervals
_WRAP_MS: Final = 1 << 32

_NAMES: Final = {GLOBAL_POSITION_INT: "GLOBAL_POSITION_INT", ATTITUDE: "ATTITUDE"}
STREAM: Final = {GLOBAL_POSITION_INT: 6, ATTITUDE: 10}
"""What carries a message: MAV_DATA_STREAM_POSITION, MAV_DATA_STREAM_EXTRA1."""
_ACCEPTED, _TEMPORARILY_REJECTED, _IN_PROGRESS = 0, 1, 5  # MAV_RESULT; all others are refusals
RESTART: Final = "a restart"
NOBODY: Final = "nobody was heard asking"


class RateState(StrEnum):
    """How far asking has come; see the head of this module."""

    WATCHING = "watching"
    ASKED = "asked"
    ACCEPTED = "accepted"
    STREAMING = "streaming"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True)
class MessageRate:
    """One message of one UAV. ``observed_hz`` is the sender's rate, None while too little was
    heard; ``asked`` counts requests; ``changed_by`` is who lowered the rate when it was in order:
    ``SYSID:COMPID``, a restart of the UAV, or that nobody was heard asking."""

    uav: Source
    msgid: int
    wanted_hz: float
    observed_hz: float | None
    state: RateState
    asked: int
    changed_by: str | None


class Request(NamedTuple):
    """A request of someone else: for which messages of whom, at what rate. None stops them or is
    the sender's default; a target with an id of 0 is everybody."""

    t_ns: int
    by: Source
    target: Source
    msgids: tuple[int, ...]
    hz: float | None

    def explains(self, uav: Source, msgid: int, wanted_hz: float) -> bool:
        """Whether it may have made this message slower than wanted."""
        addressed = all(mine in (0, its) for mine, its in zip(self.target, uav, strict=True))
        return addressed and msgid in self.msgids and (self.hz is None or self.hz < wanted_hz)


class _Observed:
    """The rate of a message by its sender's own stamps, and when it came last."""

    __slots__ = ("_newest_ms", "last_ns", "restarted_ns", "stamps_ms")

    def __init__(self, now_ns: int) -> None:
        self.last_ns = now_ns
        self.restarted_ns: int | None = None
        self._newest_ms: int | None = None
        self.stamps_ms: list[int] = []  # the newest, in order, past the wrap

    def add(self, t_ns: int, boot_ms: int) -> None:
        """One more came; a late one falls into its place, a repetition tells nothing."""
        newest_ms = boot_ms if self._newest_ms is None else self._newest_ms
        step_ms = (boot_ms - newest_ms + _WRAP_MS // 2) % _WRAP_MS - _WRAP_MS // 2
        if step_ms <= -_LATE_MS:
            self.restarted_ns = t_ns
            self.stamps_ms.clear()
        elif step_ms <= 0 and newest_ms + step_ms in self.stamps_ms:
            return
        if step_ms > 0 or not self.stamps_ms:
            self._newest_ms = newest_ms + step_ms
            self.last_ns = t_ns
        insort(self.stamps_ms, newest_ms + step_ms)
        del self.stamps_ms[:-_STAMPS]

    def median_ns(self) -> int | None:
        """The median interval; None before there are enough."""
        if len(self.stamps_ms) <= _ENOUGH:
            return None
        return median_high(b - a for a, b in pairwise(self.stamps_ms)) * 1_000_000


@dataclass(slots=True)
class _Watch:
    """The machine for one message of one UAV."""

    uav: Source
    msgid: int
    wanted_hz: float
    observed: _Observed
    state: RateState = RateState.WATCHING
    asked: int = 0
    changed_by: str | None = None
    next_ns: int = 0  # no request before this
    asked_ns: int = 0  # when the newest request was sent
    _backoff_ns: int = 0  # of this round; 0: none was begun since the last long order
    _tries: int = 0  # of SET_MESSAGE_INTERVAL in this round
    _by_stream: bool = False  # SET_MESSAGE_INTERVAL was refused, or not answered
    _slow_since_ns: int | None = None
    _order_since_ns: int | None = None
    _was_in_order: bool = False  # settled, since the newest request
    _told: set[str] = field(default_factory=set)

    def observed_hz(self, heard_ns: int) -> float | None:
        """The rate as of when the UAV was last heard; None while too little is known."""
        median_ns = self.observed.median_ns()
        if median_ns is None:
            return None
        return _NS / max(median_ns, heard_ns - self.observed.last_ns)

    def view(self, heard_ns: int) -> MessageRate:
        """What is known, as of when the UAV was last heard."""
        hz = self.wanted_hz, self.observed_hz(heard_ns)
        return MessageRate(self.uav, self.msgid, *hz, self.state, self.asked, self.changed_by)

    def review(self, now_ns: int, heard_ns: int, others: Iterable[Request]) -> list[Notice]:
        """Judge the rate, and see what there is to say about it."""
        observed_hz = self.observed_hz(heard_ns)
        silence_ns = heard_ns - self.observed.last_ns
        slow_hz = self.wanted_hz * SLOW_BELOW
        if silence_ns * slow_hz > _NS or (observed_hz is not None and observed_hz < slow_hz):
            if self._slow_since_ns is None:
                self._slow_since_ns = now_ns
            if self._is_settled(self._slow_since_ns, now_ns):
                self._order_since_ns = None
                return self._slow(now_ns, self._slow_since_ns, observed_hz, others)
        else:
            self._slow_since_ns = None
            if observed_hz is not None:
                self._in_order(now_ns)
        return []

    def ready(self, now_ns: int) -> bool:
        """Whether a request is due: the rate is slow for a while, and the back-off over."""
        since_ns = self._slow_since_ns
        slow = since_ns is not None and self._is_settled(since_ns, now_ns)
        return slow and now_ns >= self.next_ns

    def awaits_ack(self, now_ns: int) -> bool:
        """Whether an answer may be on its way; there is only one command under way to a UAV, for
        an answer does not say which message it is about."""
        unanswered = self.state is RateState.ASKED and not self._by_stream
        return unanswered and now_ns < self.asked_ns + _ACK_WAIT_NS

    def ask(self, now_ns: int, source: Source) -> Outgoing:
        """The request that is due, and what follows from having sent it."""
        if self.state is not RateState.ASKED:  # a new round
            self._backoff_ns = min(max(2 * self._backoff_ns, BACKOFF_NS[0]), BACKOFF_NS[1])
            self._tries = 0
        self.asked += 1
        self.asked_ns = now_ns
        self.next_ns = now_ns + self._backoff_ns
        if self._by_stream or self._tries == TRIES:
            self.state = RateState.STREAMING
            self._by_stream = True
            self._expect_change()
            rate_hz = math.ceil(self.wanted_hz)
            return request_data_stream(source, self.uav, STREAM[self.msgid], rate_hz)
        self.state = RateState.ASKED
        self._tries += 1
        interval_us = round(1e6 / self.wanted_hz)
        return set_message_interval(
            source, self.uav, self.msgid, interval_us, confirmation=self._tries - 1
        )

    def acknowledged(self, t_ns: int, result: int) -> None:
        """COMMAND_ACK to the newest request; after a refusal it is another's."""
        if self._by_stream:
            return
        if result == _ACCEPTED:
            self.state = RateState.ACCEPTED
            self._expect_change()
        elif result == _IN_PROGRESS:
            until_ns = min(t_ns, self.asked_ns + _PROGRESS_NS) + self._backoff_ns
            self.next_ns = max(self.next_ns, until_ns)
        elif result != _TEMPORARILY_REJECTED:  # the next try is for that
            self._by_stream = True

    def _is_settled(self, since_ns: int, now_ns: int) -> bool:
        return now_ns - since_ns >= max(SETTLE_NS, round(_ENOUGH / self.wanted_hz * _NS))

    def _expect_change(self) -> None:
        """What was observed so far no longer counts."""
        self.observed.stamps_ms.clear()
        self._slow_since_ns = self._order_since_ns = None

    def _in_order(self, now_ns: int) -> None:
        if self.state is RateState.ASKED and not self._by_stream:
            self.state = RateState.ACCEPTED  # it was done, though nobody was heard to say so
        elif self.state in (RateState.ASKED, RateState.REFUSED):
            self.state = RateState.WATCHING
        if self._order_since_ns is None:
            self._order_since_ns = now_ns
        self._was_in_order |= self._is_settled(self._order_since_ns, now_ns)
        if now_ns - self._order_since_ns >= IN_ORDER_NS:
            self._backoff_ns = 0
            self._told.clear()
            self.changed_by = None

    def _slow(
        self, now_ns: int, since_ns: int, observed_hz: float | None, others: Iterable[Request]
    ) -> list[Notice]:
        """Slow for a while: somebody changed it, or what was asked last did not help."""
        comes = "does not come" if observed_hz is None else f"comes at {observed_hz:.2g} Hz"
        text = f"{self.uav}: {_NAMES[self.msgid]} {comes}, wanted is {self.wanted_hz:g} Hz: "
        if self._was_in_order:
            self._was_in_order = False
            self.changed_by = self._who_changed(since_ns, others)
            by = "" if self.changed_by == NOBODY else "changed by "
            return self._tell(now_ns, self.changed_by, text + by + self.changed_by)
        if self.state is RateState.STREAMING and now_ns >= self.next_ns:
            self.state = RateState.REFUSED
            self.next_ns = now_ns + self._backoff_ns
            self._by_stream = False
            return self._tell(now_ns, self.state, text + "asking does not help")
        return []

    def _who_changed(self, since_ns: int, others: Iterable[Request]) -> str:
        """The latest cause known, between our own newest request and the change."""
        after_ns = max(since_ns - BLAME_NS, self.asked_ns)
        causes = [
            (request.t_ns, str(request.by))
            for request in others
            if request.explains(self.uav, self.msgid, self.wanted_hz)
        ]
        if self.observed.restarted_ns is not None:
            causes.append((self.observed.restarted_ns, RESTART))
        return max((c for c in causes if after_ns <= c[0] <= since_ns), default=(0, NOBODY))[1]

    def _tell(self, now_ns: int, what: str, text: str) -> list[Notice]:
        if what in self._told:
            return []
        self._told.add(what)
        return [Notice(now_ns, Severity.WARNING, str(self.uav), text)]


@dataclass(slots=True)
class _Uav:
    heard_ns: int
    watches: dict[int, _Watch]


class Rates:
    """All messages of all UAVs: ``position_hz`` of everyone, ``attitude_hz`` of the carrier;
    None where any rate will do. ``source`` is who asks.

    ``notices`` collects what there is to say; whoever reads it takes it out.
    """

    def __init__(
        self,
        source: Source,
        carrier: Source | None,
        position_hz: float | None,
        attitude_hz: float | None,
    ) -> None:
        self.notices: list[Notice] = []
        self._source = source
        self._carrier = carrier
        self._always: frozenset[Source] = frozenset(() if carrier is None else (carrier,))
        self._wanted_hz = {GLOBAL_POSITION_INT: position_hz, ATTITUDE: attitude_hz}
        self._wanted = self._always
        self._uavs: dict[Source, _Uav] = {}
        self._others: deque[Request] = deque(maxlen=256)
        self._sent: deque[int] = deque(maxlen=REQUESTS_PER_S)

    def heard(self, t_ns: int, source: Source) -> None:
        """Any message of a sender: it is there."""
        uav = self._uavs.get(source)
        if uav is not None:
            uav.heard_ns = t_ns
        elif source in self._wanted:
            self._uavs[source] = _Uav(t_ns, self._watches(t_ns, source))

    def stamped(self, t_ns: int, source: Source, msgid: int, boot_ms: int) -> None:
        """A position or an attitude, with its sender's stamp."""
        self.heard(t_ns, source)
        uav = self._uavs.get(source)
        watch = uav.watches.get(msgid) if uav is not None else None
        if watch is not None:
            watch.observed.add(t_ns, boot_ms)

    def requested(self, request: Request) -> None:
        """Someone else asked for a rate."""
        self._others.append(request)

    def acknowledged(self, t_ns: int, source: Source, result: int) -> None:
        """COMMAND_ACK of a SET_MESSAGE_INTERVAL, to us or to nobody in particular."""
        uav = self._uavs.get(source)
        asked = [w for w in uav.watches.values() if w.state is RateState.ASKED] if uav else []
        if asked:
            max(asked, key=lambda watch: watch.asked_ns).acknowledged(t_ns, result)

    def due(self, now_ns: int, uavs: Iterable[Source]) -> list[tuple[Outgoing, Source]]:
        """The requests to be sent now, and to whom. ``uavs``: those whose positions matter.

        At most ``REQUESTS_PER_S`` in any second; whoever waits longest comes first.
        """
        self._wanted = self._always.union(uavs)
        for source in [s for s, u in self._uavs.items() if now_ns - u.heard_ns > FORGET_NS]:
            del self._uavs[source]
        ready = []
        for uav in self._watched():
            for watch in uav.watches.values():
                self.notices += watch.review(now_ns, uav.heard_ns, self._others)
                if watch.ready(now_ns) and now_ns - uav.heard_ns < GONE_NS:
                    ready.append(watch)
        out = []
        for watch in sorted(ready, key=lambda watch: watch.next_ns):
            if len(self._sent) == REQUESTS_PER_S and now_ns - self._sent[0] < _NS:
                break
            if any(w.awaits_ack(now_ns) for w in self._uavs[watch.uav].watches.values()):
                continue
            out.append((watch.ask(now_ns, self._source), watch.uav))
            self._sent.append(now_ns)
        return out

    def state(self) -> list[MessageRate]:
        """Every message that is watched, in the order in which the UAVs were first heard."""
        return [w.view(uav.heard_ns) for uav in self._watched() for w in uav.watches.values()]

    def _watched(self) -> list[_Uav]:
        return [uav for source, uav in self._uavs.items() if source in self._wanted]

    def _watches(self, now_ns: int, source: Source) -> dict[int, _Watch]:
        return {
            msgid: _Watch(source, msgid, wanted_hz, _Observed(now_ns))
            for msgid, wanted_hz in self._wanted_hz.items()
            if wanted_hz is not None and (msgid != ATTITUDE or source == self._carrier)
        }
