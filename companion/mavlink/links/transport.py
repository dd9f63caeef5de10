"""Links that carry MAVLink and related formats.

    udpin:HOST:PORT      listen for datagrams, from any number of peers
    udpout:HOST:PORT     send datagrams to one peer, and receive its answers
    tcp:HOST:PORT        connect, and reconnect when the peer goes away
    tcpin:HOST:PORT      listen for any number of connections
    serial:DEVICE:BAUD   a serial port, which may be unplugged and plugged in again
    sbs:HOST:PORT        connect to an ADS-B receiver; its lines become ADSB_VEHICLE
    readsb:HOST:PORT     connect to a receiver that speaks Beast; messages become ADSB_VEHICLE
    readsb:http://...    poll a receiver's aircraft.json
    rid:HOST:PORT        connect to a Remote ID receiver; its JSON becomes OPEN_DRONE_ID messages
    rid:udp:HOST:PORT    listen for datagrams of such receivers
    cot:tcp:HOST:PORT    connect to a Cursor on Target server; its events become frames
    cot:udp:HOST:PORT    listen for Cursor on Target datagrams
    zenoh:KEY            raw frames over Zenoh, in both directions

IPv6 hosts are written in brackets. Every peer has its own splitter: a frame truncated by one peer
cannot damage another's.

Over 300 lines: what a link receives, sends and reports is one class.
"""

import asyncio
import time
from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import replace
from typing import Final, Protocol

from companion.mavlink.links.endpoints import StalledError, Upcalls, reason
from companion.mavlink.links.kinds import endpoint, splitter
from companion.mavlink.links.lag import ArrivalLag
from companion.mavlink.links.peers import Peer, Peers
from companion.mavlink.links.status import LinkStatus
from companion.mavlink.links.urls import LinkError, LinkUrl
from companion.mavlink.trust.fair_share import Account
from companion.mavlink.trust.known_peers import JUDGED, KnownPeers, PeerRank
from companion.mavlink.trust.newcomers import LATE_NS, Admission, Newcomers
from companion.mavlink.wire import cot_link
from companion.mavlink.wire.aircraft_json import AircraftJson
from companion.mavlink.wire.decode import PREDICTION
from companion.mavlink.wire.encode import TIMESYNC, Outgoing, pack
from companion.mavlink.wire.foreign import ForeignSplitter
from companion.mavlink.wire.positions import OWN, is_passed_on
from companion.values import Frame, Notice, Reason, Rejection, Severity, Source
from companion.values.budget import Budget

__all__ = ["Link", "LinkStatus", "MessageSigning", "Notify", "Receive", "endpoint"]

RETRY_S: Final = (0.2, 0.5, 1.0, 2.0, 5.0)
"""Seconds between attempts to serve a lost link, in order; the last value is repeated."""
STEADY_S: Final = 1.0
"""Seconds for which a connection must last before it is reported as restored."""
REFUSED_EVERY_NS: Final = 500_000_000
"""Least time between rejections by admission, or of a receiver; each has a number of frames."""
REFUSED_KINDS: Final = 32  # senders and reasons that are counted apart in that time
REJECTED_PER_S: Final = 100.0
"""Rejections of damaged or badly signed frames that are passed on one by one; others are counted.

Each takes as much time as a valid frame, and its sender is unknown, so that it cannot be limited.
"""
UNUSABLE_MAX: Final = 64
"""Datagrams in a row without an acceptable frame after which late ones of their peer are dropped.

One in ``UNUSABLE_PARSED`` is parsed all the same, to notice when the peer sends acceptable frames.
"""
UNUSABLE_PARSED: Final = 16
RECEIVER_SHARE: Final = 0.3
"""Share of the time that messages of a receiver may take; further ones are skipped unparsed.

A receiver reports any number of aircraft under one sender id, so ``newcomers`` cannot limit them.
One aircraft's position takes 0.1 to 0.3 ms: a thousand a second fit, as in a dense sky.
"""
RECEIVER_SAVED_S: Final = 0.5  # time that a receiver may take at once, as for a large document
RECEIVERS_SHARE: Final = 0.5  # share of the time that all receivers together may take
RECEIVERS_SAVED_S: Final = 1.0
UNFINISHED_S: Final = 10
"""Seconds of received bytes without a complete message after which a connection is closed."""
PEER_ACTIVE_S: Final = 10.0
"""A listening UDP link sends to the peers from which a frame arrived within this many seconds."""

CHECKED: Final = JUDGED | {cot_link.TUNNEL}  # messages that are not accepted from every peer
RESERVED: Final = "TUNNEL: sender id 0:25 is reserved for the service's Cursor on Target links"

Received = Frame | Rejection
Receive = Callable[[list[Received]], None]
Notify = Callable[[Notice], None]


class MessageSigning(Protocol):
    """Interface of a link's message signing (https://mavlink.io/en/guide/message_signing.html)."""

    def refusal(self, frame: Frame) -> Reason | None:
        """Return why a frame must be rejected; None to accept. Called once per frame, in order."""

    def sign(self, raw: bytes, now_ns: int) -> bytes:
        """Return a packed MAVLink 2 frame with its signature appended."""


def receivers_budget() -> Budget:
    """Return a budget for all receivers together, in seconds of work."""
    return Budget(per_s=RECEIVERS_SHARE, most=RECEIVERS_SAVED_S)


class Link:
    """One link of the service, of any scheme.

    Call ``open`` for early errors, then ``run`` until cancelled.

        receive        called on the event loop with the frames and rejections of each datagram or
                       read
        now_ns         the node's timeline
        notify         called once when the link is lost, and once when it is back
        guard          rejects received frames and signs sent ones; None: no signing
        lag            records how late datagrams are processed
        known_peers    rejects frames of strangers in the name of others; shared by all links
        newcomers      limits new senders; shared by all links
        receivers_s    seconds that all receivers together may take; shared by all links

    All methods but ``open`` must be called on the event loop; ``open`` is called before it runs.
    """

    def __init__(
        self,
        *,
        url: LinkUrl,
        receive: Receive,
        now_ns: Callable[[], int],
        notify: Notify | None = None,
        guard: MessageSigning | None = None,
        lag: ArrivalLag | None = None,
        known_peers: KnownPeers | None = None,
        newcomers: Newcomers | None = None,
        receivers_s: Budget | None = None,
    ) -> None:
        self.url = url
        self.status = LinkStatus(url=str(url))
        self._name = str(url)
        self._receive = receive
        self._now_ns = now_ns
        self._notify = notify
        self._guard = guard
        self._lag = lag or ArrivalLag()
        self._known_peers = known_peers or KnownPeers()
        self._newcomers = newcomers or Newcomers()
        self._refused = Counter[tuple[str, Reason]]()  # by vehicle or link, not passed on yet
        self._rejections = Budget(per_s=REJECTED_PER_S, most=REJECTED_PER_S)
        self._refused_ns = 0
        self._receiver_s = Budget(per_s=RECEIVER_SHARE, most=RECEIVER_SAVED_S)
        self._receivers_s = receivers_s or receivers_budget()
        self._skipped = 0  # messages of receivers not reported yet
        self._skipped_ns = 0
        self._peers = Peers(
            status=self.status,
            on_evict=self._finish,
            splitter=splitter(url),
            is_first=self._is_first,
        )
        upcalls = Upcalls(
            up=self._up,
            take=self.take,
            stale=self._count_stale,
            on_peer_gone=self._peer_gone,
            overflow=self._overflow,
            request=self._requested,
            has_sent=self._has_sent,
        )
        self._endpoint = endpoint(url, self.status, upcalls)
        self._is_out = False
        self._steady: asyncio.TimerHandle | None = None

    def open(self) -> None:
        """Claim a listening link's address. Raises ``LinkError`` if it is not available.

        An absent peer or device is no error: ``run`` retries.
        """
        try:
            port = self._endpoint.open()
        except OSError as error:
            raise LinkError(f"{self.url}: {reason(error)}") from error
        if port is not None:
            self.status.url = str(replace(self.url, port=port))

    async def run(self) -> None:
        """Serve until cancelled. Retry a lost link, with growing delays until frames arrive.

        Raises the exceptions of ``receive``.
        """
        attempt = 0
        try:
            while True:
                self.status.state = "connecting"
                frames = self.status.frames
                try:
                    await self._endpoint.serve()
                except OSError as error:
                    self._notify_down(reason(error))
                if self.status.frames > frames:
                    attempt = 0
                self.status.state = "connecting"
                await asyncio.sleep(RETRY_S[min(attempt, len(RETRY_S) - 1)])
                attempt += 1
        finally:
            self._cancel_steady()
            self.status.state = "down"

    # --- receiving --------------------------------------------------------------------------

    def take(self, key: Hashable, data: bytes, age_ns: int | None = None) -> bool:
        """Split the bytes that a peer sent into frames, and pass them on.

        ``age_ns`` is the time since their arrival; None if unknown: they count as arrived now.
        Returns whether there is more: then a call without bytes continues. Raises ``StalledError``
        if a server of another format completes no message, or its messages are too late.
        """
        began_s = time.perf_counter()
        peer = self._peers.at(key)
        self.status.bytes += len(data)
        now_ns = t_ns = self._now_ns()
        if age_ns is not None:
            self._lag.observe(t_ns, age_ns)
            t_ns -= age_ns
            if peer.unusable >= UNUSABLE_MAX and age_ns > LATE_NS and self._drops_unparsed(peer):
                return False
        splitter = peer.splitter
        receiver = splitter if isinstance(splitter, ForeignSplitter) else None
        if receiver is not None:
            began_cpu_s = time.thread_time()
            found = self._receive_within_budget(receiver, t_ns, data)
        else:
            found = splitter.feed(t_ns, data)
        if found:
            used = self._pass_on(peer, found)
        else:
            used = []
            peer.note_data(has_frame=False)
        if age_ns is not None and age_ns > LATE_NS:
            self._newcomers.late(age_ns)
        spent_s = time.perf_counter() - began_s
        is_mixed = len(found) != 1 or isinstance(found[0], Rejection)
        if receiver is not None:
            took_s = time.thread_time() - began_cpu_s
            self._receiver_s.charge(took_s)
            self._receivers_s.charge(took_s)
        elif is_mixed and not splitter.has_more:
            spent_s *= _share_of_frames(found, len(data))
        self._charge(peer, used, spent_s / max(1, len(found)))
        self._newcomers.worked_s += spent_s
        if now_ns >= self._newcomers.adapts_ns:
            self._newcomers.adapt(now_ns, time.thread_time(), time.process_time())
        if receiver is not None and not self.url.listens:
            _require_progress(receiver, t_ns)
        return splitter.has_more

    def _drops_unparsed(self, peer: Peer) -> bool:
        """Drop and count a late datagram of a peer that sends no acceptable frames.

        Returns False for one in ``UNUSABLE_PARSED``, which is to be parsed.
        """
        peer.unusable += 1
        if peer.unusable % UNUSABLE_PARSED == 0:
            return False
        self.status.overflowed = (self.status.overflowed or 0) + 1
        self._note_refused(self.status.url, Reason.SOCKET_OVERFLOW, 1)
        return True

    def _charge(self, peer: Peer, used: list[Received], each_s: float) -> None:
        """Charge the time that each used frame took to its sender."""
        for item in used:
            if isinstance(item, Frame):
                self._newcomers.worked(peer.accounts[item.source], each_s)

    def _receive_within_budget(
        self, receiver: ForeignSplitter, t_ns: int, data: bytes
    ) -> list[Received]:
        """Parse bytes of a receiver; skip messages while its budget is used up, or it is dropped.

        Then a datagram is dropped whole, and counts as one message. Of a stream, the messages are
        passed over one by one: the place of the next one is known only then.
        """
        now_s = t_ns * 1e-9
        has_time = self._receiver_s.has(0.0, now_s) and self._receivers_s.has(0.0, now_s)
        receiver.skips = not has_time or self._newcomers.is_dropped(receiver.sender, t_ns)
        if receiver.skips and self.url.listens:
            receiver.drop()
            receiver.skipped += 1
            found = list[Received]()
        else:
            found = receiver.feed(t_ns, data)
        self._skipped, receiver.skipped = self._skipped + receiver.skipped, 0
        if self._skipped and t_ns - self._skipped_ns >= REFUSED_EVERY_NS:
            found.append(
                Rejection(
                    t_ns=t_ns,
                    source=self.status.url,
                    reason=Reason.TOO_FREQUENT,
                    count=self._skipped,
                )
            )
            self._skipped, self._skipped_ns = 0, t_ns
        return found

    def _count_stale(self, key: Hashable, data: bytes) -> None:
        """Count the frames in stale bytes, and keep the splitter synchronised with the stream."""
        self.status.bytes += len(data)
        splitter, now_ns = self._peers.at(key).splitter, self._now_ns()
        found = splitter.feed(now_ns, data)
        while splitter.has_more:
            found += splitter.feed(now_ns, b"")
        frames = sum(isinstance(item, Frame) for item in found)
        if frames:
            self.status.overflowed = (self.status.overflowed or 0) + frames
            self._overflow(frames)

    def _pass_on(self, peer: Peer, found: list[Received]) -> list[Received]:
        """Count what a peer sent, and pass on what is accepted from it.

        Returns what was admitted.

        Most frames are of senders that are served, and of messages that need no check.
        """
        if self._guard is not None:
            found = [_checked_by_guard(self._guard, item) for item in found]
        peer.note_data(has_frame=any(isinstance(item, Frame) for item in found))
        newcomers, has_timesync = self._newcomers, False
        if peer.served_generation != newcomers.generation:
            peer.served.clear()
            peer.accounts.clear()
            peer.served_generation = newcomers.generation
        counted, checked = list[Received](), list[Received]()
        for item in found:
            kept = item
            if isinstance(item, Frame):
                _, _, source, msgid, _, _ = item
                if source not in peer.served and not self._is_admitted(peer, item):
                    continue
                if msgid in CHECKED:
                    kept = self._checked(peer, item)
                    has_timesync |= msgid == TIMESYNC
            elif not self._rejections.spend(1, item.t_ns * 1e-9):
                self._note_refused(item.source, item.reason, item.count)
                continue
            counted.append(item)
            checked.append(kept)
        self._peers.count(peer, counted, checked)
        if has_timesync:
            checked = [self._checked_timesync(peer, item) for item in checked]
        if self._refused:
            self._report_refused(checked)
        self._receive(checked)
        return counted

    def _is_admitted(self, peer: Peer, frame: Frame) -> bool:
        """Return whether a frame may be used; remember its sender if all of its frames may be."""
        source, now_ns = frame.source, frame.t_ns
        rank = self._rank(peer, source, now_ns)
        matters = frame.msgid in CHECKED
        found = self._newcomers.admits(source, now_ns, rank, matters=matters)
        if found is not Admission.DROPPED:
            peer.accounts[source] = Account(source, rank is not PeerRank.FIRST)
            if found is Admission.ALL:
                peer.served.add(source)
            return True
        self._peers.pass_over(peer, source)
        is_apart = rank is PeerRank.FIRST and matters
        self._note_refused(str(source) if is_apart else self.status.url, Reason.NEWCOMER, 1)
        return False

    def _note_refused(self, source: str, reason: Reason, count: int) -> None:
        """Count frames that are dropped, or rejected beyond the budget.

        Beyond ``REFUSED_KINDS``, they are counted for the whole link.
        """
        self._peers.count_lost(reason, count)
        counts = self._refused
        has_place = (source, reason) in counts or len(counts) < REFUSED_KINDS
        counts[source if has_place else self.status.url, reason] += count

    def _rank(self, peer: Peer, source: Source, now_ns: int) -> PeerRank:
        return self._known_peers.rank(self._name, peer.address or self._name, source, now_ns)

    def _is_first(self, peer: Peer, source: Source, now_ns: int) -> bool:
        """Return whether a peer is the one that is believed about a sender."""
        return self._rank(peer, source, now_ns) is PeerRank.FIRST

    def _report_refused(self, items: list[Received]) -> None:
        """Add rejections with the numbers of frames that were not passed on, if they are due."""
        now_ns = self._now_ns()
        if now_ns - self._refused_ns < REFUSED_EVERY_NS:
            return
        items += [
            Rejection(t_ns=now_ns, source=source, reason=why, count=count)
            for (source, why), count in self._refused.items()
        ]
        self._refused.clear()
        self._refused_ns = now_ns

    def _checked(self, peer: Peer, frame: Frame) -> Received:
        """Return the frame, or a rejection if it is not accepted from this peer.

        Inner messages of Cursor on Target links come from such links only: any peer could otherwise
        make tracks of aircraft, as if a receiver had reported them.
        """
        reason = Reason.STRANGER
        if frame.msgid == cot_link.TUNNEL and frame.source == cot_link.SENDER:
            is_own = isinstance(peer.splitter, ForeignSplitter)
            reason, detail = Reason.NOT_ALLOWED, None if is_own else RESERVED
        elif frame.msgid in OWN and is_passed_on(frame):
            reason, detail = Reason.DUPLICATE, PREDICTION
        else:
            detail = self._known_peers.refusal(self._name, peer.address or self._name, frame)
        if detail is None:
            return frame
        return Rejection(
            t_ns=frame.t_ns,
            source=str(frame.source),
            reason=reason,
            msgid=frame.msgid,
            detail=detail,
        )

    def _checked_timesync(self, peer: Peer, item: Received) -> Received:
        """Return the item; a rejection for a TIMESYNC that may be another program's.

        Its peer must bring its sender's stamps, and be the first that did. Any program that reaches
        the socket could otherwise shift a clock. Routers deliver both.
        """
        if isinstance(item, Rejection) or item.msgid != TIMESYNC:
            return item
        if item.payload[:8].strip(b"\0") == b"":
            return item  # a request is no evidence
        is_first = self._is_first(peer, item.source, item.t_ns)
        if is_first and peer.brings_stamps(item.source, item.t_ns):
            return item
        detail = "TIMESYNC: answer came from another peer than this sender's positions"
        return Rejection(
            t_ns=item.t_ns,
            source=str(item.source),
            reason=Reason.UNPLACED_STAMP,
            msgid=TIMESYNC,
            detail=detail,
        )

    def _requested(self) -> None:
        splitter = self._peers.at(None).splitter
        assert isinstance(splitter, AircraftJson)
        splitter.requested(self._now_ns())

    def _has_sent(self, key: Hashable) -> bool:
        peer = self._peers.find(key)
        return peer is not None and bool(peer.senders)

    def _peer_gone(self, key: Hashable) -> None:
        peer = self._peers.find(key)
        if peer is not None:
            self._finish(peer)
            self._known_peers.connection_ended(peer.address or self._name, peer.senders)
            self._peers.forget(peer)

    def _finish(self, peer: Peer) -> None:
        """Search the unfinished frame of a departing peer for other frames."""
        found = peer.splitter.finish(self._now_ns())
        if found:
            self._pass_on(peer, found)

    def _overflow(self, count: int) -> None:
        """Count dropped datagrams or frames; their senders are unknown."""
        self._newcomers.late()
        self._peers.count_lost(Reason.SOCKET_OVERFLOW, count)
        reject = Rejection(
            t_ns=self._now_ns(), source=self.status.url, reason=Reason.SOCKET_OVERFLOW, count=count
        )
        self._receive([reject])

    # --- sending ----------------------------------------------------------------------------

    def send(self, message: Outgoing) -> int:
        """Send to every recent peer (udpin), every connection (tcpin), or the one peer.

        "Recent" is within ``PEER_ACTIVE_S``. Returns how many accepted the frame. Never waits and
        never raises.
        """
        keys = self._endpoint.peers()
        if keys is None:
            peers = self._peers.active_since(self._now_ns() - int(PEER_ACTIVE_S * 1e9))
        else:
            peers = [self._peers.at(key) for key in keys]
        return sum([self._send(peer, message) for peer in peers])

    def send_raw(self, raw: bytes) -> None:
        """Send raw bytes to every peer that would get a broadcast message."""
        for key in self._endpoint.peers() or ():
            if self._endpoint.write(key, raw):
                self.status.sent += 1
            else:
                self.status.send_dropped += 1

    def send_to(self, target: Source, message: Outgoing) -> bool:
        """Send to the peer over which ``target`` was last received on this link.

        Returns False if there is none, it has hung up, or it does not accept the frame.
        """
        peer = self._peers.route_to(target)
        return peer is not None and self._send(peer, message)

    def _send(self, peer: Peer, message: Outgoing) -> bool:
        """Send to one peer: as MAVLink 1 if the peer uses only that and the link has no guard.

        MAVLink 1 cannot be signed.
        """
        in_v1 = peer.speaks_v1_only and self._guard is None and message.msgid < 256
        raw = pack(message, peer.next_sequence(), 1 if in_v1 else 2)
        if self._guard is not None:
            raw = self._guard.sign(raw, self._now_ns())
        taken = self._endpoint.write(peer.key, raw)
        if taken:
            self.status.sent += 1
        else:
            self.status.send_dropped += 1
        return taken

    # --- state of the connection ------------------------------------------------------------

    def _up(self) -> None:
        self.status.state = "up"
        self._cancel_steady()
        if self._is_out:
            loop = asyncio.get_running_loop()
            self._steady = loop.call_later(STEADY_S, self._notify_up)

    def _notify_up(self) -> None:
        """Report a restored connection, but not one that has only sent part of a message."""
        if self._peers.has_incomplete():
            self._steady = asyncio.get_running_loop().call_later(STEADY_S, self._notify_up)
            return
        self._is_out = False
        self._say(Severity.INFO, "is back")

    def _notify_down(self, why: str) -> None:
        self._cancel_steady()
        if not self._is_out:
            self._is_out = True
            self._say(Severity.WARNING, f"is down: {why}; trying again")

    def _say(self, severity: Severity, what: str) -> None:
        if self._notify is not None:
            url = self.status.url
            self._notify(
                Notice(
                    t_ns=self._now_ns(), severity=severity, subject=url, text=f"link {url} {what}"
                )
            )

    def _cancel_steady(self) -> None:
        if self._steady is not None:
            self._steady.cancel()
            self._steady = None


def _require_progress(receiver: ForeignSplitter, t_ns: int) -> None:
    """Raise ``StalledError`` if a server completes no message, or its messages are too late."""
    if receiver.too_late is not None:
        raise StalledError(receiver.too_late)
    began_ns = receiver.unfinished_ns
    if began_ns is not None and t_ns - began_ns > UNFINISHED_S * 1_000_000_000:
        raise StalledError(f"no complete message in {UNFINISHED_S} s of data")


def _checked_by_guard(guard: MessageSigning, item: Frame | Rejection) -> Frame | Rejection:
    refusal = None if isinstance(item, Rejection) else guard.refusal(item)
    if refusal is None or isinstance(item, Rejection):
        return item
    return Rejection(t_ns=item.t_ns, source=str(item.source), reason=refusal, msgid=item.msgid)


def _share_of_frames(found: list[Frame | Rejection], size: int) -> float:
    """Return the share of the bytes that were frames: dropping senders saves no other work."""
    return min(1.0, sum(len(item.raw) for item in found if isinstance(item, Frame)) / max(1, size))
