"""Monitor of one message of one UAV: its rate, and the requests that maintain it.

A small state machine (``Watch``):

    watching    nothing was requested, or the rate is sufficient without a request
    asked       SET_MESSAGE_INTERVAL was sent; up to three times, as COMMAND_ACK may be lost
    accepted    the autopilot acknowledged it, or the rate shows that it complied
    streaming   REQUEST_DATA_STREAM was sent, after a refusal or no answer; it is not acknowledged
    refused     neither helped

A request is sent only if a rate is lower than wanted: another component wants a higher one. The
time between two requests doubles from round to round, and is reset after the rate was sufficient
for long. So programs that want different rates of one UAV do not fight over it, and requests do
not fill a slow link.

The rate is the sender's, measured between its own stamps. Frames that the link loses (up to half),
repeats, delays or delivers in bursts therefore change nothing; a request would not help either. A
message counts as absent only while others of the same sender arrive.

Sources: https://mavlink.io/en/services/command.html, https://mavlink.io/en/messages/common.html.
ArduPilot answers FAILED for a message that it does not stream (``set_message_interval`` in its
GCS_Common.cpp); PX4 ignores REQUEST_DATA_STREAM (mavlink_receiver.cpp).

Over 300 lines: one state machine, with its observations and its reports.
"""

import math
from bisect import insort
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median_high
from typing import Annotated, Final, NamedTuple

from companion.mavlink.wire.decode import ATTITUDE
from companion.mavlink.wire.encode import Outgoing, request_data_stream, set_message_interval
from companion.mavlink.wire.positions import GLOBAL_POSITION_INT
from companion.mavlink.wire.stamps import stamp_step
from companion.values import Notice, Severity, Source
from companion.values.described import DescribedEnum, Meaning

_NS: Final = 1_000_000_000
SLOW_BELOW: Final = 0.8  # fraction of the wanted rate below which a rate is slow
SETTLE_NS: Final = 5 * _NS
"""Least time for which a rate must be slow, or sufficient, to count; five messages too."""
TRIES: Final = 3  # SET_MESSAGE_INTERVAL requests in one round before REQUEST_DATA_STREAM is tried
BACKOFF_NS: Final = (5 * _NS, 300 * _NS)
"""Shortest and longest time between two rate requests for one message of one UAV."""
IN_ORDER_NS: Final = 600 * _NS
"""Time of a sufficient rate after which the back-off is reset and notices may repeat."""
ATTRIBUTION_NS: Final = 30 * _NS
"""Longest time between another component's request and a rate change it may explain."""
_ACK_WAIT_NS: Final = 5 * _NS
"""How long the answer to a command blocks the next command to that UAV."""
_PROGRESS_NS: Final = 60 * _NS
"""How long after a request IN_PROGRESS answers still postpone the next one."""
_LATE_MS: Final = 30_000
"""Largest step back of a stamp that counts as a late frame; a larger one is a restart."""
_STAMPS: Final = 12  # newest stamps kept per message
_ENOUGH: Final = 5  # intervals needed to measure a rate or to settle

_NAMES: Final = {GLOBAL_POSITION_INT: "GLOBAL_POSITION_INT", ATTITUDE: "ATTITUDE"}
STREAM: Final = {GLOBAL_POSITION_INT: 6, ATTITUDE: 10}
"""Data stream of each message: MAV_DATA_STREAM_POSITION, MAV_DATA_STREAM_EXTRA1."""
_ACCEPTED, _TEMPORARILY_REJECTED, _IN_PROGRESS = 0, 1, 5  # MAV_RESULT; all others are refusals
RESTART: Final = "a restart"
NO_REQUEST_SEEN: Final = "no request of another component was received"


class RateState(DescribedEnum):
    """State of the request for the rate of one message."""

    WATCHING = "watching", "nothing requested"
    ASKED = "asked", "requested"
    ACCEPTED = "accepted", "the autopilot accepted the request"
    STREAMING = "streaming", "requested as a data stream"
    REFUSED = "refused", "the autopilot refused"


@dataclass(frozen=True, slots=True, kw_only=True)
class MessageRate:
    """Message whose rate is requested of a UAV."""

    uav: Annotated[Source, Meaning("UAV that sends the message", example="3:1")]
    msgid: Annotated[int, Meaning("MAVLink message id")]
    wanted_hz: Annotated[float, Meaning("requested rate")]
    observed_hz: Annotated[float | None, Meaning("observed rate, by the sender's clock")]
    state: Annotated[RateState, Meaning("state of the request")]
    asked: Annotated[int, Meaning("requests sent")]
    changed_by: Annotated[
        str | None, Meaning("what lowered the rate: another component, or a restart of the UAV")
    ]


class Request(NamedTuple):
    """Another component's request for the rate of some messages."""

    t_ns: int
    by: Source
    target: Source
    msgids: tuple[int, ...]
    hz: float | None

    def explains(self, uav: Source, msgid: int, wanted_hz: float) -> bool:
        """Return whether this request may have made a message slower than wanted by the service."""
        addressed = all(mine in (0, its) for mine, its in zip(self.target, uav, strict=True))
        return addressed and msgid in self.msgids and (self.hz is None or self.hz < wanted_hz)


class ObservedRate:
    """Rate of a message by its sender's own stamps, and its last arrival."""

    __slots__ = ("_newest_ms", "last_ns", "restarted_ns", "stamps_ms")

    def __init__(self, now_ns: int) -> None:
        self.last_ns = now_ns
        self.restarted_ns: int | None = None
        self._newest_ms: int | None = None
        self.stamps_ms: list[int] = []  # the newest, sorted and unwrapped

    def add(self, t_ns: int, boot_ms: int) -> None:
        """Add one message. A late stamp is sorted in; a repeated stamp is ignored."""
        newest_ms = boot_ms if self._newest_ms is None else self._newest_ms
        ahead_ms = stamp_step(boot_ms, newest_ms)
        if ahead_ms <= -_LATE_MS:
            self.restarted_ns = t_ns
            self.stamps_ms.clear()
        elif ahead_ms <= 0 and newest_ms + ahead_ms in self.stamps_ms:
            return
        if ahead_ms > 0 or not self.stamps_ms:
            self._newest_ms = newest_ms + ahead_ms
            self.last_ns = t_ns
        insort(self.stamps_ms, newest_ms + ahead_ms)
        del self.stamps_ms[:-_STAMPS]

    def median_ns(self) -> int | None:
        """Return the median interval between stamps; None while there are too few."""
        if len(self.stamps_ms) <= _ENOUGH:
            return None
        return median_high(b - a for a, b in pairwise(self.stamps_ms)) * 1_000_000


@dataclass(slots=True, kw_only=True)
class Watch:
    """State machine for one message of one UAV."""

    uav: Source
    msgid: int
    wanted_hz: float
    observed: ObservedRate
    state: RateState = RateState.WATCHING
    asked: int = 0
    changed_by: str | None = None
    next_ns: int = 0  # no request before this time
    asked_ns: int = 0  # when the newest request was sent
    _backoff_ns: int = 0  # of this round; 0: no round since the last reset
    _tries: int = 0  # SET_MESSAGE_INTERVAL requests in this round
    _by_stream: bool = False  # SET_MESSAGE_INTERVAL was refused, or not answered
    _slow_since_ns: int | None = None
    _order_since_ns: int | None = None
    _was_in_order: bool = False  # whether the rate settled as sufficient since the newest request
    _notified: set[str] = field(default_factory=set)

    def observed_hz(self, heard_ns: int) -> float | None:
        """Return the rate at the UAV's last message; None while there are too few stamps."""
        median_ns = self.observed.median_ns()
        if median_ns is None:
            return None
        return _NS / max(median_ns, heard_ns - self.observed.last_ns)

    def view(self, heard_ns: int) -> MessageRate:
        """Return the state of the watch at the UAV's last message."""
        observed_hz = self.observed_hz(heard_ns)
        return MessageRate(
            uav=self.uav,
            msgid=self.msgid,
            wanted_hz=self.wanted_hz,
            observed_hz=observed_hz,
            state=self.state,
            asked=self.asked,
            changed_by=self.changed_by,
        )

    def review(self, now_ns: int, heard_ns: int, others: Iterable[Request]) -> list[Notice]:
        """Check the rate of the message. Return the resulting notices."""
        observed_hz = self.observed_hz(heard_ns)
        silence_ns = heard_ns - self.observed.last_ns
        slow_hz = self.wanted_hz * SLOW_BELOW
        if silence_ns * slow_hz > _NS or (observed_hz is not None and observed_hz < slow_hz):
            if self._slow_since_ns is None:
                self._slow_since_ns = now_ns
            if self._is_settled(self._slow_since_ns, now_ns):
                self._order_since_ns = None
                return self._handle_slow(now_ns, self._slow_since_ns, observed_hz, others)
        else:
            self._slow_since_ns = None
            if observed_hz is not None:
                self._in_order(now_ns)
        return []

    def ready(self, now_ns: int) -> bool:
        """Return whether a request is due: the rate stays slow, and the back-off is over."""
        since_ns = self._slow_since_ns
        slow = since_ns is not None and self._is_settled(since_ns, now_ns)
        return slow and now_ns >= self.next_ns

    def awaits_ack(self, now_ns: int) -> bool:
        """Return whether the answer to the pending command to the UAV may still arrive.

        Only one is pending at a time, since an answer does not name its message.
        """
        unanswered = self.state is RateState.ASKED and not self._by_stream
        return unanswered and now_ns < self.asked_ns + _ACK_WAIT_NS

    def ask(self, now_ns: int, source: Source) -> Outgoing:
        """Build the rate request that is due, and record that it was sent."""
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
        """Process a COMMAND_ACK to the newest request; on refusal, a data stream is next."""
        if self._by_stream:
            return
        if result == _ACCEPTED:
            self.state = RateState.ACCEPTED
            self._expect_change()
        elif result == _IN_PROGRESS:
            until_ns = min(t_ns, self.asked_ns + _PROGRESS_NS) + self._backoff_ns
            self.next_ns = max(self.next_ns, until_ns)
        elif result != _TEMPORARILY_REJECTED:  # after a temporary rejection, try again
            self._by_stream = True

    def _is_settled(self, since_ns: int, now_ns: int) -> bool:
        return now_ns - since_ns >= max(SETTLE_NS, round(_ENOUGH / self.wanted_hz * _NS))

    def _expect_change(self) -> None:
        self.observed.stamps_ms.clear()
        self._slow_since_ns = self._order_since_ns = None

    def _in_order(self, now_ns: int) -> None:
        if self.state is RateState.ASKED and not self._by_stream:
            self.state = RateState.ACCEPTED  # it complied, but the acknowledgement was lost
        elif self.state in (RateState.ASKED, RateState.REFUSED):
            self.state = RateState.WATCHING
        if self._order_since_ns is None:
            self._order_since_ns = now_ns
        self._was_in_order |= self._is_settled(self._order_since_ns, now_ns)
        if now_ns - self._order_since_ns >= IN_ORDER_NS:
            self._backoff_ns = 0
            self._notified.clear()
            self.changed_by = None

    def _handle_slow(
        self, now_ns: int, since_ns: int, observed_hz: float | None, others: Iterable[Request]
    ) -> list[Notice]:
        """Handle a rate that stays slow: it changed, or the last request did not help."""
        comes = "is not sent" if observed_hz is None else f"is sent at {observed_hz:.2g} Hz"
        text = f"{self.uav}: {_NAMES[self.msgid]} {comes}, requested at {self.wanted_hz:g} Hz: "
        if self._was_in_order:
            self._was_in_order = False
            self.changed_by = self._cause_of_change(since_ns, others)
            by = "" if self.changed_by == NO_REQUEST_SEEN else "changed by "
            return self._notice_once(now_ns, self.changed_by, text + by + self.changed_by)
        if self.state is RateState.STREAMING and now_ns >= self.next_ns:
            self.state = RateState.REFUSED
            self.next_ns = now_ns + self._backoff_ns
            self._by_stream = False
            return self._notice_once(now_ns, self.state, text + "requests have no effect")
        return []

    def _cause_of_change(self, since_ns: int, others: Iterable[Request]) -> str:
        """Return the latest known cause of a rate change since the service's newest request."""
        after_ns = max(since_ns - ATTRIBUTION_NS, self.asked_ns)
        causes = [
            (request.t_ns, str(request.by))
            for request in others
            if request.explains(self.uav, self.msgid, self.wanted_hz)
        ]
        if self.observed.restarted_ns is not None:
            causes.append((self.observed.restarted_ns, RESTART))
        return max(
            (c for c in causes if after_ns <= c[0] <= since_ns), default=(0, NO_REQUEST_SEEN)
        )[1]

    def _notice_once(self, now_ns: int, what: str, text: str) -> list[Notice]:
        if what in self._notified:
            return []
        self._notified.add(what)
        return [Notice(t_ns=now_ns, severity=Severity.WARNING, subject=str(self.uav), text=text)]
