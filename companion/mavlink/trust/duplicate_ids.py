"""Detection of two senders under one id, from peers that contradict each other.

A vehicle may be received over any number of peers. A router forwards the same reports, a second
telemetry port has its own stamps, and a restarted radio has another address: all of their reports
lie on one path (``paths.py``). An autopilot that resets its position causes one or two
contradictions; ``CONTRADICTIONS`` within ``KEPT_NS`` prove two senders. Which of them is true is
not known: the peer that came later is rejected until both have agreed for that long. Unlike boot
clocks (``clock/epochs.py``) and flight limits (``tracking/gate.py``), the path also exposes a
sender that copies the clock and stays near.

The peers of links are judged by ``known_peers.py``; here they are nodes of a fleet.
"""

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from companion.mavlink.trust.paths import SLACK_M, Path
from companion.mavlink.wire.positions import OWN, read
from companion.values import Frame

CONTRADICTIONS: Final = 5
SPACED_NS: Final = 500_000_000
"""Time within which contradictions count once: a position reset causes several."""
KEPT_NS: Final = 30_000_000_000  # how long a peer and a contradiction are remembered
SENDERS_MAX: Final = 4096  # senders followed; new ones beyond it are not followed
PEERS_MAX: Final = 4  # peers followed per sender, the first; others are rejected


class Contradicted(NamedTuple):
    """Peer that a rejected peer contradicts, and whether it was the first of both."""

    peer: str
    is_first: bool


NO_PLACE: Final = Contradicted("", is_first=False)  # of a peer beyond ``PEERS_MAX``


@dataclass(slots=True, kw_only=True)
class _PeerPath:
    """Path of a sender over one peer, and the times at which it contradicted an earlier peer.

    rank  order among the peers of the sender: trusted ones come first
    """

    peer: str
    rank: tuple[bool, int]
    heard_ns: int
    path: Path = field(default_factory=Path)
    contradicted_ns: deque[int] = field(default_factory=lambda: deque(maxlen=CONTRADICTIONS))
    contradicts: Contradicted | None = None  # the first of the peers that it contradicted last
    is_duplicate: bool = False


@dataclass(slots=True, kw_only=True)
class _SenderPaths:
    """Paths of a sender by peer; ``peers`` counts all that there were."""

    heard_ns: int
    peers: int = 0
    paths: dict[str, _PeerPath] = field(default_factory=dict)


class DuplicateIds:
    """Detector of two senders under one id, by the peers that deliver their frames.

    ``trusted`` names peers whose frames are never rejected.
    """

    def __init__(self, trusted: Collection[str] = ()) -> None:
        self._trusted = frozenset(trusted)
        self._senders: dict[tuple[int, int], _SenderPaths] = {}

    def rejects(self, peer: str, frame: Frame) -> Contradicted | None:
        """Process a frame of ``decode.POSE``. Return why it must be rejected; None to use it."""
        sender = self._senders.get(frame.source)
        if sender is None:
            sender = self._follow(frame)
            if sender is None:
                return None
        sender.heard_ns = frame.t_ns
        path = sender.paths.get(peer) or self._add_peer(sender, peer, frame.t_ns)
        if path is None:
            return NO_PLACE
        path.heard_ns = frame.t_ns
        if len(sender.paths) == 1:
            return None
        if frame.msgid in OWN:
            self._compare(sender, path, frame)
        return path.contradicts if self._is_duplicate(frame.t_ns, path) else None

    def _follow(self, frame: Frame) -> _SenderPaths | None:
        """Start to follow a sender; None if ``SENDERS_MAX`` is reached."""
        if len(self._senders) >= SENDERS_MAX:
            before_ns = frame.t_ns - KEPT_NS
            self._senders = {k: v for k, v in self._senders.items() if v.heard_ns >= before_ns}
            if len(self._senders) >= SENDERS_MAX:
                return None
        return self._senders.setdefault(frame.source, _SenderPaths(heard_ns=frame.t_ns))

    def _add_peer(self, sender: _SenderPaths, peer: str, t_ns: int) -> _PeerPath | None:
        """Start to follow a peer of a sender; forget silent peers. None if there is no place."""
        paths = sender.paths
        for name in [name for name, path in paths.items() if t_ns - path.heard_ns > KEPT_NS]:
            del paths[name]
        if len(paths) >= PEERS_MAX:
            if peer not in self._trusted:  # in place of another one it could never be contradicted
                return None
            del paths[max(paths, key=lambda name: paths[name].rank)]
        rank = peer not in self._trusted, sender.peers
        sender.peers += 1
        return paths.setdefault(peer, _PeerPath(peer=peer, rank=rank, heard_ns=t_ns))

    def _compare(self, sender: _SenderPaths, path: _PeerPath, frame: Frame) -> None:
        """Add a report to its path; note with which other paths it is in contradiction."""
        before, said = path.path.newest, read(frame)
        if not path.path.add(said):
            return
        for other in sorted(sender.paths.values(), key=lambda one: one.rank, reverse=True):
            excess_m = None if other is path else path.path.excess_m(other.path, before, said)
            if excess_m is None or excess_m <= SLACK_M:
                continue
            first, later = sorted((path, other), key=lambda one: one.rank)
            if not later.rank[0]:  # both are trusted
                continue
            later.contradicts = Contradicted(first.peer, first.rank[1] < later.rank[1])
            when = later.contradicted_ns
            if not when or frame.t_ns - when[-1] >= SPACED_NS:
                when.append(frame.t_ns)

    def _is_duplicate(self, now_ns: int, path: _PeerPath) -> bool:
        """Return whether a peer contradicts an earlier one, and has not agreed with it since."""
        when = path.contradicted_ns
        while when and now_ns - when[0] > KEPT_NS:
            when.popleft()
        enough = 1 if path.is_duplicate else CONTRADICTIONS
        path.is_duplicate = len(when) >= enough
        return path.is_duplicate
