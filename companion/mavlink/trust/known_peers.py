"""Known peers of each sender, and strangers, whose frames are not used beside those of known ones.

A sender may be received over any number of peers (routers, second radios), and anybody that
reaches a link's port may send in its name. The first peer that brings a position of a sender is
known. While a known peer is current, the messages that it brings are not accepted from a stranger,
except positions that agree with its path to ``AGREEMENT_M``. A stranger becomes known

* when its positions have agreed with those of the current known peers for ``PROBATION_NS`` and in
  ``AGREEMENTS`` comparisons; each contradiction doubles that time,
* at once if no known peer is current, since they are silent or their connections have ended: a
  vehicle whose radio restarted has another address (with another clock, or stamps more than a
  second ahead, ``REBOOT_NS`` later; not if it contradicted them shortly before their connections
  ended),
* with its positions if no current known peer has brought any for ``NO_POSITION_NS``: a vehicle may
  send positions over one radio, attitudes over another. Known peers whose stamps are of another
  clock become strangers then,
* at once if the settings name it as a router.

If two known peers contradict each other (``paths.py``), the one that was known later is a stranger
again; its positions are used only as far as they agree with those of the other. Its attitudes are
used only where the other has not brought any shortly before: positions that agree prove nothing
about these. Attitudes that contradict those of the other are announced, and so are attitudes of a
stranger while no known peer brings any. If the other has become late, by its own stamps, newer
attitudes are used, but none newer than it could ever deliver. Messages that state accuracies,
fixes, a type or the time of day (``_OF_FIRST``) are not used at all while the other is current,
nor, except the type, from a peer that has brought no position yet.

Stamps are used only if they are of the other's clock: another clock would look like a restart, or
like a second vehicle. A peer that becomes more than ten seconds late is a stranger from then on, if
its positions agree with where another peer had the vehicle by these stamps. Stamps that are more
than a second ahead of the fastest that the other has delivered are rejected: anybody can predict
the positions of a standing vehicle. Those that are less ahead set the clock, as those of a faster
second radio must, and are announced. So the vehicle that was here first stays believed, and a
stranger costs it at most a metre; whoever sends first in a vehicle's name is believed until it
falls silent.

What a known peer does not bring about other aircraft is accepted from any peer: a receiver may send
in a vehicle's name. Messages that move the sender itself, its clock or its bounds are not: any
position or attitude, any message with a time stamp, TIMESYNC, HEARTBEAT, GPS_RAW_INT, GPS2_RAW
and EKF_STATUS_REPORT.

Over 300 lines: who is known, and what is used of each peer, depend on each other.
"""

import math
from collections import deque
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Final

from companion.mavlink.trust.attitude_difference import contradict
from companion.mavlink.trust.duplicate_ids import CONTRADICTIONS, KEPT_NS, SPACED_NS
from companion.mavlink.trust.paths import RESTARTED_MS, SLACK_M, Path
from companion.mavlink.trust.peer_clock import AHEAD_MS, PeerClock, has_stamp, stamp_ms
from companion.mavlink.trust.peer_notices import NOTICE_NS, Disagreement, PeerNotice
from companion.mavlink.wire.attitudes import ABOUT_ATTITUDE, first_has_fix
from companion.mavlink.wire.decode import (
    ATTITUDE,
    DECODED,
    EKF_STATUS_REPORT,
    GPS_RAW_INT,
    HEARTBEAT,
    POSE,
    SYSTEM_TIME,
)
from companion.mavlink.wire.encode import TIMESYNC
from companion.mavlink.wire.positions import OWN, OwnPosition, read
from companion.mavlink.wire.stamps import STAMPED, boot_ms, stamp_step
from companion.values import Frame, Source
from companion.values.budget import Budget

PROBATION_NS: Final = 5_000_000_000
PROBATION_MOST_NS: Final = 300_000_000_000
AGREEMENTS: Final = 5
AGREEMENT_M: Final = 1.0
"""Largest deviation, beyond what flight explains, of a stranger's position that is used."""
CURRENT_NS: Final = (1_000_000_000, 2_000_000_000)
"""Least and largest time after a message for which a peer is current."""
NO_POSITION_NS: Final = 5_000_000_000
"""Time without a position after which a known peer counts as one that brings none."""
INCOMPARABLE_NS: Final = 5_000_000_000
"""Time after which a stranger of another clock contradicts the known peers."""
LATE_LINK_MS: Final = 30_000  # stamps that are further off are not those of a late second link
REBOOT_NS: Final = 10_000_000_000
"""Time for which a silent known peer keeps out strangers of another clock.

A vehicle whose radio restarted has its clock; one that was restarted itself takes as long.
"""
CURRENT_INTERVALS: Final = 3.0  # that time in intervals between its messages
SENDERS_MAX: Final = 4096  # senders followed; those of known peers are forgotten last
PEERS_MAX: Final = 4  # known peers of a sender, and strangers compared with them
COMPARED_PER_S: Final = 30.0  # positions of strangers compared per sender and second

STRANGER: Final = "another peer than the known one of this sender; not used until both agree"
BROUGHT: Final = "the same message of this sender comes from the peer that was known first"
_OF_FIRST: Final = ABOUT_ATTITUDE | {GPS_RAW_INT, EKF_STATUS_REPORT, SYSTEM_TIME, HEARTBEAT}
"""Messages that count only from the peer believed first: nothing else confirms them."""
_UNPROVEN: Final = _OF_FIRST - {HEARTBEAT}
"""Those that count only once their peer has brought a position.

A heartbeat that comes alone shows over which radio positions can be requested.
"""
BROUGHT_NS: Final = {ATTITUDE: 300_000_000, **dict.fromkeys(_OF_FIRST, 5_000_000_000)}
"""Messages that move bounds, and the time for which one excludes those of peers known later."""
OVERTAKEN_MS: Final = 300
"""How late a peer that was known first must have become, and how much newer other attitudes are."""
LATE_MS: Final = 1000  # largest delay of a stranger's position that is used
EARLY_MS: Final = 100  # stamps that are further ahead of a peer's fastest ones are from the future
LEAD_NS: Final = 10_000_000_000  # time after which leads over a peer's fastest stamps are announced
LATE_PEER_MS: Final = 1000  # how much newer attitudes are whose rejection is announced
_ABOUT_SENDER: Final = frozenset({*STAMPED, *POSE, *_OF_FIRST, TIMESYNC})
JUDGED: Final = DECODED | _ABOUT_SENDER
"""Messages that ``refusal`` judges; it accepts all others."""


class PeerRank(Enum):
    """Rank of a peer for one sender: the one believed first, one known later, or a stranger.

    Without another current peer, any peer is the first.
    """

    FIRST = auto()
    LATER = auto()
    STRANGER = auto()


@dataclass(slots=True, kw_only=True)
class _Peer:
    """Peer of one sender. ``since_ns`` is when it became known, or a stranger."""

    is_router: bool
    since_ns: int
    heard_ns: int
    messages: int = 1  # positions and attitudes since then
    newest: dict[int, Frame] = field(default_factory=dict)  # of each message since then
    stamped: Frame | None = None  # newest with a stamp, while other peers are known too
    clock: PeerClock = field(default_factory=PeerClock)
    path: Path = field(default_factory=Path)
    agreements: int = 0
    agrees_since_ns: int = 0
    probation_ns: int = PROBATION_NS
    contradicted_ns: int = -SPACED_NS
    has_left: bool = False  # its connection ended
    has_led: bool = False  # whether its stamps were ahead of those of peers known earlier

    def is_current(self, now_ns: int) -> bool:
        """Return whether the peer's newest message is so new that more are to be expected."""
        return not self.has_left and self.is_recent(now_ns)

    def is_recent(self, now_ns: int) -> bool:
        """Return whether the newest message is so new, even if the connection has ended since."""
        least_ns, most_ns = CURRENT_NS
        interval_ns = (self.heard_ns - self.since_ns) / self.messages
        return now_ns - self.heard_ns <= min(
            max(CURRENT_INTERVALS * interval_ns, least_ns), most_ns
        )

    def brings_positions(self, now_ns: int) -> bool:
        """Return whether the peer may still bring positions."""
        return self.brings(OWN, now_ns)

    def brings(self, msgids: Collection[int], now_ns: int) -> bool:
        """Return whether the peer may still bring one of these messages."""
        arrivals = (self.newest[msgid].t_ns for msgid in msgids if msgid in self.newest)
        return now_ns - max(self.since_ns, *arrivals, 0) <= NO_POSITION_NS

    def hear(self, now_ns: int) -> None:
        """Note the arrival of a position or attitude."""
        if now_ns - self.heard_ns > KEPT_NS:
            self.since_ns, self.messages = now_ns, 0
        self.heard_ns, self.has_left = now_ns, False
        self.messages += 1


@dataclass(slots=True, kw_only=True)
class _Sender:
    """Peers of one sender, and the times of contradictions between them."""

    known: dict[str, _Peer] = field(default_factory=dict)
    strangers: dict[str, _Peer] = field(default_factory=dict)
    contradicted_ns: deque[int] = field(default_factory=lambda: deque(maxlen=CONTRADICTIONS))
    notified_ns: dict[Disagreement, int] = field(default_factory=dict)
    comparisons: Budget = field(
        default_factory=lambda: Budget(per_s=COMPARED_PER_S, most=COMPARED_PER_S)
    )

    def has_contradicted(self, name: str, now_ns: int) -> bool:
        """Return whether a stranger contradicted the known peers that have just left."""
        stranger = self.strangers.get(name)
        return (
            stranger is not None
            and now_ns - stranger.contradicted_ns <= KEPT_NS
            and any(one.is_recent(now_ns) for one in self.known.values())
        )

    @property
    def heard_ns(self) -> int:
        """Arrival of the newest position or attitude from a known peer."""
        return max((one.heard_ns for one in self.known.values()), default=0)


class KnownPeers:
    """Known peers and strangers of all senders.

    ``routers`` names trusted peers: a link as in the settings, HOST or HOST:PORT. ``notices``
    holds the disagreements since it was last emptied.
    """

    def __init__(self, routers: Collection[str] = ()) -> None:
        self.notices: list[PeerNotice] = []
        self._routers = frozenset(routers)
        self._senders: dict[Source, _Sender] = {}

    def refusal(self, link: str, peer: str, frame: Frame) -> str | None:
        """Process a frame; return why it must be rejected, None to accept it.

        ``link`` is the link as in the settings, ``peer`` the peer's HOST:PORT, or the link again if
        it has only one peer.
        """
        msgid = frame.msgid
        if msgid not in JUDGED:
            return None
        sender = self._senders.get(frame.source)
        if sender is None:
            if msgid not in OWN or not _is_usable(frame):
                return None
            sender = self._follow(frame)
        known = sender.known.get(peer)
        if known is not None:
            return self._refusal_of_known(sender, peer, known, frame)
        current = [one for one in sender.known.values() if one.is_current(frame.t_ns)]
        is_router = self._is_router(link, peer)
        if not current and not is_router and sender.has_contradicted(peer, frame.t_ns):
            return STRANGER
        if not current or is_router:
            if msgid in OWN and _is_usable(frame):  # others can be neither agreed with nor refuted
                if not is_router and _is_another_clock_too_soon(sender, frame):
                    return STRANGER
                self._make_known(sender, peer, self._new(frame, is_router), frame)
            return STRANGER if msgid in _UNPROVEN and not is_router else None
        if msgid not in _ABOUT_SENDER and not any(msgid in one.newest for one in current):
            return None
        if msgid in OWN and self._replaces(sender, peer, current, frame):
            return None
        if msgid in OWN and sender.comparisons.spend(1, frame.t_ns * 1e-9):
            agrees = self._agrees(sender, peer, frame)
            return None if agrees and read(frame).accuracy is None else STRANGER
        if msgid == ATTITUDE:
            self._compare_attitudes(sender, peer, frame, current)
        self._note_attitudes(sender, peer, frame, current)
        self._note_no_fix(sender, peer, frame, current)
        return STRANGER

    def rank(self, link: str, peer: str, source: Source, now_ns: int) -> PeerRank:
        """Return the rank of a peer for a sender. Routers are first."""
        sender = self._senders.get(source)
        if sender is None or self._is_router(link, peer):
            return PeerRank.FIRST
        known = sender.known.get(peer)
        if known is not None:
            return PeerRank.LATER if _current_earlier(sender, known, now_ns) else PeerRank.FIRST
        is_believed = any(one.is_current(now_ns) for one in sender.known.values())
        return PeerRank.STRANGER if is_believed else PeerRank.FIRST

    def connection_ended(self, peer: str, sources: Iterable[Source]) -> None:
        """Note that a peer's connection ended, over which it sent frames of these sources."""
        for source in sources:
            sender = self._senders.get(source)
            if sender is not None and (known := sender.known.get(peer)) is not None:
                known.has_left = True

    # --- known peers --------------------------------------------------------------------------

    def _refusal_of_known(
        self, sender: _Sender, peer: str, known: _Peer, frame: Frame
    ) -> str | None:
        msgid, is_only = frame.msgid, len(sender.known) == 1
        if msgid not in OWN or _is_usable(frame):
            known.newest[msgid] = frame
        if msgid in POSE:
            known.hear(frame.t_ns)
            if frame.t_ns >= known.clock.due_ns:
                known.clock.observe(frame)
        if not is_only and has_stamp(frame):
            earlier = _earlier(sender, known, frame.t_ns)
            if any(_is_off_clock(one, frame) for one in earlier):
                return STRANGER
            if any(_is_ahead(one, frame) for one in earlier):
                self._notify(sender, Disagreement.IS_NEWER, peer, frame)
                return STRANGER
            self._note_lead(sender, peer, known, frame, earlier)
            known.stamped = frame
        if msgid in BROUGHT_NS and not is_only:
            return self._refusal_of_brought(sender, peer, known, frame)
        if msgid not in OWN or (is_only and not sender.strangers):
            return None
        if not is_only and self._falls_behind(sender, peer, known, frame):
            return STRANGER
        refused = self._compare_known(sender, peer, known, frame)
        if refused is None and not is_only and read(frame).accuracy is not None:  # moves bounds
            earlier = _current_earlier(sender, known, frame.t_ns)
            if any(one.brings_positions(frame.t_ns) for one in earlier):
                return BROUGHT
        return refused

    def _refusal_of_brought(
        self, sender: _Sender, peer: str, known: _Peer, frame: Frame
    ) -> str | None:
        """Return why a message that moves a bound must be rejected.

        That is if peers that were known earlier brought it shortly before. Copies of their messages
        count as not brought: they are found as duplicates.
        """
        if known.is_router:
            return None
        earlier = [
            (one, one.newest[frame.msgid])
            for one in sender.known.values()
            if _standing(one) > _standing(known) and frame.msgid in one.newest
        ]
        now_ns, kept_ns = frame.t_ns, BROUGHT_NS[frame.msgid]
        recent = [(one, same) for one, same in earlier if now_ns - same.t_ns <= kept_ns]
        if any(same.payload == frame.payload for _, same in recent):
            return None
        if frame.msgid in _OF_FIRST and (before := _current_earlier(sender, known, now_ns)):
            self._note_no_fix(sender, peer, frame, before)
            return BROUGHT  # positions that agree do not justify it
        if not recent:
            return None
        if frame.msgid not in STAMPED:
            return BROUGHT
        if frame.msgid == ATTITUDE:
            self._compare_attitudes(sender, peer, frame, [one for one, _ in recent])
        if all(_is_overtaken(one, same, frame) for one, same in recent):
            return None
        if all(_ahead_ms(frame, same) > LATE_PEER_MS for _, same in recent):
            self._notify(sender, Disagreement.IS_NEWER, peer, frame)
        return BROUGHT

    def _compare_attitudes(
        self, sender: _Sender, peer: str, frame: Frame, believed: list[_Peer]
    ) -> None:
        """Publish that the attitudes of a peer, which are not used, contradict those that are."""
        if sender.comparisons.spend(1, frame.t_ns * 1e-9) and any(
            contradict(frame, one.newest[ATTITUDE]) for one in believed if ATTITUDE in one.newest
        ):
            self._note_contradiction(sender, peer, frame)

    def _note_attitudes(
        self, sender: _Sender, name: str, frame: Frame, believed: list[_Peer]
    ) -> None:
        """Publish that a stranger brings attitudes, but the known peers bring none.

        They are not used: nothing confirms them, and they could turn the carrier's array.
        """
        if frame.msgid == ATTITUDE and not any(
            one.brings((ATTITUDE,), frame.t_ns) for one in believed
        ):
            self._notify(sender, Disagreement.HAS_ATTITUDES, name, frame)

    def _note_no_fix(self, sender: _Sender, name: str, frame: Frame, believed: list[_Peer]) -> None:
        """Publish that a peer states a lost fix, of which those that are believed bring nothing."""
        if (
            frame.msgid == GPS_RAW_INT
            and not first_has_fix(frame)
            and not any(
                GPS_RAW_INT in one.newest
                and frame.t_ns - one.newest[GPS_RAW_INT].t_ns <= BROUGHT_NS[GPS_RAW_INT]
                for one in believed
            )
        ):
            self._notify(sender, Disagreement.HAS_NO_FIX, name, frame)

    def _note_lead(
        self, sender: _Sender, name: str, peer: _Peer, frame: Frame, earlier: list[_Peer]
    ) -> None:
        """Publish once that the stamps of a peer are ahead of those of peers known earlier.

        Its link is faster, or somebody predicts the path: stamps do not tell which.
        """
        if peer.has_led or not any(
            frame.t_ns - one.since_ns >= LEAD_NS and _is_ahead(one, frame, EARLY_MS)
            for one in earlier
        ):
            return
        peer.has_led = True
        self._notify(sender, Disagreement.LEADS, name, frame)

    def _compare_known(self, sender: _Sender, peer: str, known: _Peer, frame: Frame) -> str | None:
        """Compare a known peer's position with those of all other peers of its sender."""
        said = read(frame)
        before = known.path.newest
        if not known.path.add(said):
            earlier = _current_earlier(sender, known, frame.t_ns)
            excesses = [known.path.excess_m(one.path, None, said) for one in earlier]
            return None if all(_agrees(excess) for excess in excesses) else STRANGER
        for name, stranger in list(sender.strangers.items()):
            if frame.t_ns - stranger.heard_ns > KEPT_NS:
                del sender.strangers[name]
            else:
                excess_m = known.path.excess_m(stranger.path, before, said)
                self._judge(sender, name, stranger, excess_m, frame)
        worst_m = -math.inf  # against peers that were known earlier
        for name, other in _by_standing(sender, known):
            excess_m = _excess_m(known, other, before, said)
            is_later = _standing(known) < _standing(other)
            if is_later and not known.is_router:
                worst_m = max(worst_m, excess_m)
            if excess_m > SLACK_M:
                later = peer if is_later else name
                if not sender.known[later].is_router:
                    self._demote(sender, later, frame)
                    if is_later:  # it is a stranger now, and must not demote others
                        return STRANGER
        return None if worst_m <= AGREEMENT_M else STRANGER

    def _falls_behind(self, sender: _Sender, peer: str, known: _Peer, frame: Frame) -> bool:
        """Make a peer a stranger that became so late that its stamps look like another clock.

        They are of the same clock if its position agrees with where another peer had the vehicle by
        these stamps, and that peer's stamps are of the clock that the late one had before.
        """
        if known.is_router:
            return False
        said = read(frame)
        for other in sender.known.values():
            if other is known or other.is_router or not other.is_recent(frame.t_ns):
                continue
            newest = other.path.newest
            if newest is None or stamp_step(newest.boot_ms, said.boot_ms) <= RESTARTED_MS:
                continue
            if other.stamped is None or not known.clock.had(other.stamped):
                continue
            if _agrees(known.path.excess_m(other.path, None, said)):
                self._notify(sender, Disagreement.FALLS_BEHIND, peer, frame)
                self._add(sender.strangers, peer, sender.known.pop(peer), frame.t_ns)
                return True
        return False

    def _demote(self, sender: _Sender, name: str, frame: Frame) -> None:
        """Make a known peer a stranger, since it contradicts one that was known earlier."""
        peer = sender.known.pop(name)
        self._add(sender.strangers, name, peer, frame.t_ns)
        self._judge(sender, name, peer, math.inf, frame)

    def _make_known(self, sender: _Sender, name: str, peer: _Peer, frame: Frame) -> None:
        for old in [k for k, v in sender.known.items() if frame.t_ns - v.heard_ns > KEPT_NS]:
            del sender.known[old]
        sender.strangers.pop(name, None)
        peer.since_ns = frame.t_ns
        peer.newest[frame.msgid] = frame
        peer.messages, peer.heard_ns = 1, frame.t_ns
        self._add(sender.known, name, peer, frame.t_ns)

    def _replaces(self, sender: _Sender, name: str, current: list[_Peer], frame: Frame) -> bool:
        """Make a stranger known whose positions no other peer brings; return whether it is.

        Peers of another clock are strangers then: one position and attitudes, forged before the
        vehicle began, would keep it out.
        """
        if any(one.brings_positions(frame.t_ns) for one in current) or not _is_usable(frame):
            return False
        self._notify(sender, Disagreement.REPLACES, name, frame)
        for other in [one for one, peer in sender.known.items() if _is_off_clock(peer, frame)]:
            self._add(sender.strangers, other, sender.known.pop(other), frame.t_ns)
        self._make_known(sender, name, self._new(frame, False), frame)
        return True

    # --- strangers ----------------------------------------------------------------------------

    def _agrees(self, sender: _Sender, name: str, frame: Frame) -> bool:
        """Compare a stranger's position with the known peers; return whether it agrees with one."""
        believed = [one for one in sender.known.values() if one.is_current(frame.t_ns)]
        if any(_is_ahead(one, frame) for one in believed):
            self._notify(sender, Disagreement.IS_NEWER, name, frame)
            return False
        is_late = any(_is_off_clock(one, frame) or _is_late(one, frame) for one in believed)
        stranger = sender.strangers.get(name)
        if stranger is None:
            stranger = self._new(frame, False)
            self._add(sender.strangers, name, stranger, frame.t_ns)
        stranger.hear(frame.t_ns)
        said = read(frame)
        before = stranger.path.newest
        if not stranger.path.add(said):
            return False
        behind = [stranger.path.excess_m(one.path, before, said) for one in believed]
        ahead = [one.path.excess_ahead_m(said) for one in believed]
        excess_m = max((one for one in behind if one is not None), default=None)
        if frame.t_ns - stranger.since_ns > INCOMPARABLE_NS and any(
            _clock_off_ms(one, frame) > LATE_LINK_MS for one in sender.known.values()
        ):
            self._note_contradiction(sender, name, frame)
        self._judge(sender, name, stranger, excess_m, frame)
        found = [one for one in (*behind, *ahead) if one is not None]
        agrees = bool(found) and max(found) <= AGREEMENT_M
        if agrees and not is_late:
            self._note_lead(sender, name, stranger, frame, believed)
        return (agrees or name in sender.known) and not is_late

    def _judge(
        self, sender: _Sender, name: str, stranger: _Peer, excess_m: float | None, frame: Frame
    ) -> None:
        """Count a comparison of a stranger with a known peer."""
        if excess_m is None:
            return
        if excess_m > SLACK_M:
            stranger.agreements = 0
            if frame.t_ns - stranger.contradicted_ns >= SPACED_NS:
                stranger.probation_ns = min(2 * stranger.probation_ns, PROBATION_MOST_NS)
                stranger.contradicted_ns = frame.t_ns
            self._note_contradiction(sender, name, frame)
            return
        if stranger.agreements == 0:
            stranger.agrees_since_ns = frame.t_ns
        stranger.agreements += 1
        proven_ns = frame.t_ns - stranger.agrees_since_ns
        if stranger.agreements >= AGREEMENTS and proven_ns >= stranger.probation_ns:
            self._make_known(sender, name, stranger, frame)

    def _note_contradiction(self, sender: _Sender, name: str, frame: Frame) -> None:
        """Publish contradictions that are more than the resets of an autopilot's position."""
        when = sender.contradicted_ns
        while when and frame.t_ns - when[0] > KEPT_NS:
            when.popleft()
        if not when or frame.t_ns - when[-1] >= SPACED_NS:
            when.append(frame.t_ns)
        if len(when) >= CONTRADICTIONS:
            self._notify(sender, Disagreement.CONTRADICTS, name, frame)

    def _notify(self, sender: _Sender, what: Disagreement, name: str, frame: Frame) -> None:
        """Publish a disagreement of a peer with the known ones."""
        if frame.t_ns - sender.notified_ns.get(what, -NOTICE_NS) < NOTICE_NS:
            return
        sender.notified_ns[what] = frame.t_ns
        known = tuple(one for one in sender.known if one != name)
        self.notices.append(PeerNotice(what=what, who=str(frame.source), peer=name, known=known))

    # --- tables -------------------------------------------------------------------------------

    def _is_router(self, link: str, peer: str) -> bool:
        return not {link, peer, peer.rpartition(":")[0].strip("[]")}.isdisjoint(self._routers)

    @staticmethod
    def _new(frame: Frame, is_router: bool) -> _Peer:
        return _Peer(is_router=is_router, since_ns=frame.t_ns, heard_ns=frame.t_ns)

    @staticmethod
    def _add(peers: dict[str, _Peer], name: str, peer: _Peer, now_ns: int) -> None:
        """Add a peer. Beyond ``PEERS_MAX`` silent ones go, then the last to become what it is."""
        peers[name] = peer
        if len(peers) > PEERS_MAX:
            silent = [one for one in peers if not peers[one].is_current(now_ns)]
            del peers[min(silent or peers, key=lambda one: _standing(peers[one]))]

    def _follow(self, frame: Frame) -> _Sender:
        """Start to follow a sender; beyond ``SENDERS_MAX`` the one silent for longest goes."""
        if len(self._senders) >= SENDERS_MAX:
            del self._senders[min(self._senders, key=lambda one: self._senders[one].heard_ns)]
        return self._senders.setdefault(frame.source, _Sender())


def _ahead_ms(frame: Frame, other: Frame) -> int:
    """Return how far the stamp of a message is ahead of another one of its kind."""
    return stamp_step(boot_ms(frame), boot_ms(other))


def _is_overtaken(earlier: _Peer, same: Frame, frame: Frame) -> bool:
    """Return whether a peer has become late, so that another one brings newer messages.

    That peer's own fastest message shows that the newer stamp is not from the future.
    """
    delay_ms, late_ms = earlier.clock.late_ms(same), earlier.clock.late_ms(frame)
    if delay_ms is None or late_ms is None:
        return False
    is_newer = _ahead_ms(frame, same) > OVERTAKEN_MS
    return is_newer and delay_ms > OVERTAKEN_MS and late_ms > -EARLY_MS


def _earlier(sender: _Sender, known: _Peer, now_ns: int) -> list[_Peer]:
    """Return the peers that were known earlier and are not silent for long; none for a router."""
    if known.is_router:
        return []
    standing = _standing(known)
    return [
        one
        for one in sender.known.values()
        if _standing(one) > standing and now_ns - one.heard_ns <= REBOOT_NS
    ]


def _by_standing(sender: _Sender, known: _Peer) -> list[tuple[str, _Peer]]:
    """Return the other known peers by name, in descending order of standing."""
    others = [(name, one) for name, one in sender.known.items() if one is not known]
    return sorted(others, key=lambda named: _standing(named[1]), reverse=True)


def _current_earlier(sender: _Sender, known: _Peer, now_ns: int) -> list[_Peer]:
    """Return the current peers that were known earlier; none for a router."""
    return [one for one in _earlier(sender, known, now_ns) if one.is_current(now_ns)]


def _is_ahead(one: _Peer, frame: Frame, by_ms: int = AHEAD_MS) -> bool:
    """Return whether a stamp is so much ahead of the fastest that a peer has delivered."""
    late_ms = one.clock.late_ms(frame)
    return late_ms is not None and late_ms < -by_ms


def _is_late(one: _Peer, frame: Frame) -> bool:
    """Return whether a stamp is so late beside the fastest of a peer that it adds nothing."""
    late_ms = one.clock.late_ms(frame)
    return late_ms is not None and late_ms > LATE_MS


def _is_off_clock(one: _Peer, frame: Frame) -> bool:
    """Return whether a stamp is too far off the newest one of a peer to be of its clock."""
    return _clock_off_ms(one, frame) > RESTARTED_MS


def _clock_off_ms(one: _Peer, frame: Frame) -> int:
    """Return how far a stamp is off the newest one of a peer; 0 if that peer has sent none."""
    stamped = one.stamped
    if stamped is None:
        timed = [m for m in one.newest.values() if has_stamp(m)]
        if not timed:
            return 0
        stamped = max(timed, key=lambda m: m.t_ns)
    expected_ms = stamp_ms(stamped) + (frame.t_ns - stamped.t_ns) // 1_000_000
    return abs(stamp_step(stamp_ms(frame), expected_ms))


def _is_another_clock_too_soon(sender: _Sender, frame: Frame) -> bool:
    """Return whether a known peer that fell silent a moment ago had another clock.

    Stamps ahead of the fastest that it delivered are another clock's too: several would move it.
    """
    return any(
        frame.t_ns - one.heard_ns <= REBOOT_NS
        and (_is_off_clock(one, frame) or _is_ahead(one, frame))
        for one in sender.known.values()
    )


def _is_usable(frame: Frame) -> bool:
    """Return whether a frame has a position on Earth; 0, 0 is that of a receiver without a fix."""
    said = read(frame)
    has_place = (said.lat_1e7, said.lon_1e7) != (0, 0)
    return has_place and abs(said.lat_1e7) <= 900_000_000 and abs(said.lon_1e7) <= 1_800_000_000


def _agrees(excess_m: float | None) -> bool:
    return excess_m is not None and excess_m <= AGREEMENT_M


def _excess_m(known: _Peer, other: _Peer, before: OwnPosition | None, said: OwnPosition) -> float:
    """Return how far a new report is off another known peer's path; -inf: not comparable."""
    excesses = (known.path.excess_m(other.path, before, said), other.path.excess_ahead_m(said))
    return max((one for one in excesses if one is not None), default=-math.inf)


def _standing(peer: _Peer) -> tuple[bool, int]:
    """Return what decides which of two peers is believed, the higher one."""
    return peer.is_router, -peer.since_ns
