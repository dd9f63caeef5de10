"""Peers of a link, each with its own splitter and sequence numbers in both directions.

The 8-bit sequence number (https://mavlink.io/en/guide/serialization.html) is counted by sender and
path, so it is followed for each peer and source. With d the step from the last frame to this one,
modulo 256:

    d = 1            in order
    d = 0            a repeat
    1 < d < 128      d - 1 frames are missing
    d >= 128         late by 256 - d; the expected number does not change

A sender that restarts jumps anywhere. A jump forwards looks like a gap: one wrong gap is counted.
After a jump backwards every frame would look late until the sender has caught up. Therefore
``RESTART_RUN`` late frames in a row, in increasing order, count as a restart, which adds no gap.
Stragglers between frames in order never form such a run.

Over 300 lines: the peers, and what is followed and counted of each.
"""

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from typing import Final, Protocol

from companion.mavlink.links.endpoints import address_text
from companion.mavlink.links.status import ComponentStatus, LinkStatus
from companion.mavlink.trust.fair_share import Account
from companion.mavlink.wire.decode import POSE
from companion.mavlink.wire.foreign import ForeignSplitter
from companion.mavlink.wire.framing import MAGIC_V2, Splitter
from companion.values import Frame, Reason, Rejection, Source

PEERS_MAX: Final = 4096  # most recent peers kept: a port scan must not fill the memory
SENDERS_MAX: Final = 16_384
"""Most sequences followed over all peers, so that forged senders do not fill the memory either.

Beyond the limit all are reset, which loses only the gaps of that moment.
"""
COMPONENTS_MAX: Final = 4096
"""Most sources whose frames are counted; beyond it an eighth is forgotten, the silent ones first.

A source of its own in each frame would otherwise fill the memory within the hour.
"""
RESTART_RUN: Final = 3  # late frames in a row, in increasing order, that prove a restart

STAMPS_KEPT_NS: Final = 30_000_000_000
_HALF_ROUND: Final = 128
_UNKNOWN: Final = -1  # in place of the sequence number that is due


class Splits(Protocol):
    """Parser of a peer's bytes: MAVLink's splitter, or one of another format.

    While ``has_more``, a call of ``feed`` without bytes returns more of what was received.
    """

    @property
    def has_more(self) -> bool: ...

    def feed(self, t_ns: int, data: bytes) -> list[Frame | Rejection]:
        """Parse bytes that arrived at ``t_ns``; return the complete frames and the rejections."""

    def finish(self, t_ns: int) -> list[Frame | Rejection]:
        """End the stream; return the frames and rejections in its unfinished end."""


class _Component:
    """One source over the whole link: its counts, and the peer over which it was last received.

    The peer is None after it was forgotten, until the source is received again.
    """

    __slots__ = ("peer", "status")

    def __init__(self, status: ComponentStatus, peer: "Peer") -> None:
        self.status = status
        self.peer: Peer | None = peer


class _PeerSender:
    """One source over one peer: the expected sequence number, and the run of late frames."""

    __slots__ = ("component", "due", "late", "run", "stamped_ns")

    def __init__(self, component: _Component, due: int) -> None:
        self.component = component
        self.due = due
        self.late = 0
        self.run = 0
        self.stamped_ns: int | None = None  # when the peer last delivered a stamp of its clock


class Peer:
    """Peer of a link; ``key`` is the endpoint's name for it.

    ``address`` is its HOST:PORT; empty if the endpoint has only one peer.
    """

    __slots__ = (
        "_sequence", "accounts", "address", "heard_ns", "key", "senders", "served",
        "served_generation", "splitter", "unusable", "versions",
    )  # fmt: skip

    def __init__(self, key: Hashable, splitter: Splits) -> None:
        self.key = key
        self.address = address_text(key) if isinstance(key, tuple) else str(key or "")
        self.splitter = splitter
        self.senders: dict[Source, _PeerSender] = {}
        self.served: set[Source] = set()
        """Senders whose frames from this peer are admitted without a further look."""
        self.accounts: dict[Source, Account] = {}  # what admitted frames are charged to
        self.served_generation = 0  # of ``Newcomers``, when ``served`` was emptied
        self.heard_ns: int | None = None
        self.unusable = 0  # pieces of data since the last one with an acceptable frame
        self.versions = 0  # bit 0: MAVLink 1 received, bit 1: MAVLink 2 received
        self._sequence = 0

    @property
    def speaks_v1_only(self) -> bool:
        """True if the peer sent at least one frame, and all of them were MAVLink 1."""
        return self.versions == 1

    def note_data(self, *, has_frame: bool) -> None:
        """Note whether a piece of data had an acceptable frame."""
        self.unusable = 0 if has_frame else self.unusable + 1

    def brings_stamps(self, source: Source, now_ns: int) -> bool:
        """Return whether this peer recently delivered a source's stamped position or attitude."""
        sender = self.senders.get(source)
        stamped_ns = None if sender is None else sender.stamped_ns
        return stamped_ns is not None and now_ns - stamped_ns <= STAMPS_KEPT_NS

    def next_sequence(self) -> int:
        """Return the sequence number of the next frame to this peer, and advance it."""
        number = self._sequence
        self._sequence = (number + 1) & 0xFF
        return number


class Peers:
    """Peers of one link, bounded in number. Their frames are counted in ``status``.

    ``on_evict`` is called with each peer that is evicted, before its removal; ``splitter`` builds a
    peer's splitter from the link's name. ``is_first`` says whether a peer is believed about a
    sender: gaps of others do not count, and messages do not go to them.
    """

    def __init__(
        self,
        *,
        status: LinkStatus,
        on_evict: Callable[[Peer], None],
        splitter: Callable[[str], Splits] = Splitter,
        is_first: Callable[[Peer, Source, int], bool] = lambda *_: True,
    ) -> None:
        self._status = status
        self._is_first = is_first
        self._splitter = splitter
        self._on_evict = on_evict
        self._peers: OrderedDict[Hashable, Peer] = OrderedDict()
        self._components: dict[Source, _Component] = {}
        self._senders = 0

    def __len__(self) -> int:
        return len(self._peers)

    def at(self, key: Hashable) -> Peer:
        """Return the peer of a key, created if new; it becomes the last candidate for eviction."""
        peer = self._peers.get(key)
        if peer is not None:
            self._peers.move_to_end(key)
            return peer
        if len(self._peers) >= PEERS_MAX:
            oldest = next(iter(self._peers.values()))
            self._on_evict(oldest)
            self.forget(oldest)
        peer = self._peers[key] = Peer(key, self._splitter(self._status.url))
        self._status.peers += 1
        return peer

    def has_incomplete(self) -> bool:
        """Return whether a peer of another format has sent bytes, but no complete message yet."""
        return any(
            isinstance(peer.splitter, ForeignSplitter) and peer.splitter.is_incomplete
            for peer in self._peers.values()
        )

    def find(self, key: Hashable) -> Peer | None:
        """Return the peer of a key; None if it is unknown or disconnected."""
        return self._peers.get(key)

    def forget(self, peer: Peer) -> None:
        """Remove a peer that disconnected or is evicted."""
        del self._peers[peer.key]
        self._senders -= len(peer.senders)
        for sender in peer.senders.values():
            if sender.component.peer is peer:
                sender.component.peer = None

    def active_since(self, t_ns: int) -> list[Peer]:
        """Return the peers from which a frame arrived at ``t_ns`` or later, even a replayed one."""
        return [p for p in self._peers.values() if p.heard_ns is not None and p.heard_ns >= t_ns]

    def route_to(self, source: Source) -> Peer | None:
        """Return the peer to which messages to a source go; None if it is disconnected.

        It is the first known peer of the source while that is current, and otherwise the one over
        which the source was last received.
        """
        component = self._components.get(source)
        return None if component is None else component.peer

    def count(
        self,
        peer: Peer,
        found: Sequence[Frame | Rejection],
        checked: Sequence[Frame | Rejection] | None = None,
    ) -> None:
        """Count the items that a peer sent, in order.

        ``checked`` has a rejection in place of each frame that was not accepted from this peer:
        messages to its sender do not go there.
        """
        status, senders = self._status, peer.senders
        for item, kept in zip(found, checked or found, strict=True):
            if isinstance(item, Rejection):
                self.count_lost(item.reason, item.count)
                if item.reason is Reason.REPLAYED:  # its sender learns the time from our frames
                    peer.heard_ns = item.t_ns
                continue
            t_ns, _, source, msgid, raw, _ = item
            if raw[0] == MAGIC_V2:
                version, number = 2, raw[4]
            else:
                version, number = 1, raw[2]
            sender = senders.get(source)
            if sender is None:
                sender = self._add_source(peer, item)
            component = sender.component
            is_accepted = kept is item
            if is_accepted and component.peer is not peer:
                self._prefer(component, peer, source, t_ns)
            counts = component.status
            counts.frames += 1
            counts.heard_ns = t_ns
            counts.mavlink = version
            if is_accepted and msgid in POSE:  # stamps of the clock that TIMESYNC measures
                sender.stamped_ns = t_ns
            peer.versions |= version
            peer.heard_ns = status.heard_ns = t_ns
            status.frames += 1
            if number == sender.due:
                sender.due = (number + 1) & 0xFF
                sender.run = 0
            else:
                missing = self._out_of_order(sender, number)
                if missing and self._is_first(peer, source, t_ns):
                    counts.gaps += missing

    def _prefer(self, component: _Component, peer: Peer, source: Source, t_ns: int) -> None:
        """Send messages to this peer from now on, unless the other is believed and connected."""
        if component.peer is None or self._is_first(peer, source, t_ns):
            component.peer = peer

    def pass_over(self, peer: Peer, source: Source) -> None:
        """Note that a frame of a source was dropped, uncounted: it is no gap."""
        sender = peer.senders.get(source)
        if sender is not None:
            sender.due = _UNKNOWN

    def count_lost(self, reason: Reason, count: int) -> None:
        """Count bytes or frames of this link that are not used."""
        lost = self._status.lost
        lost[reason] = lost.get(reason, 0) + count

    def _out_of_order(self, sender: _PeerSender, number: int) -> int:
        """Process an unexpected sequence number; return how many frames are missing before it."""
        step, missing = (number - sender.due + 1) & 0xFF, 0
        if sender.due == _UNKNOWN:
            step = 1
        if step == 0:
            self._status.repeats += 1
            return 0
        if step < _HALF_ROUND:
            missing = step - 1
            self._status.gaps += missing
        else:
            self._status.late += 1
            continues = sender.run > 0 and 0 < (number - sender.late) & 0xFF < _HALF_ROUND
            sender.run = sender.run + 1 if continues else 1
            sender.late = number
            if sender.run < RESTART_RUN:
                return 0
        sender.due = (number + 1) & 0xFF
        sender.run = 0
        return missing

    def _add_source(self, peer: Peer, frame: Frame) -> _PeerSender:
        """Start to follow a source of this peer; its first sequence number counts as expected."""
        component = self._components.get(frame.source)
        if component is None:
            if len(self._components) >= COMPONENTS_MAX:
                self._forget_silent()
            counts = ComponentStatus(frames=0, gaps=0, heard_ns=frame.t_ns, mavlink=frame.version)
            self._status.components[frame.source] = counts
            component = self._components[frame.source] = _Component(counts, peer)
        if self._senders >= SENDERS_MAX:
            self._reset_senders()
        sender = peer.senders[frame.source] = _PeerSender(component, frame.seq)
        self._senders += 1
        return sender

    def _reset_senders(self) -> None:
        """Follow no sequence any more; a component's frames go to the peer that is heard next."""
        for known in self._peers.values():
            known.senders.clear()
        for component in self._components.values():
            component.peer = None
        self._senders = 0

    def _forget_silent(self) -> None:
        """Forget the counts of the sources that have been silent for longest."""
        components = self._status.components
        silent = sorted(components, key=lambda source: components[source].heard_ns)
        for source in silent[: COMPONENTS_MAX // 8]:
            del components[source], self._components[source]
        self._reset_senders()
