"""Detection of two senders under one id, from peers that contradict each other.

A vehicle may be received over any number of peers. A router forwards the same reports, a second
telemetry port has its own stamps, and a restarted radio has another address: all of their reports
lie on one path (``paths.py``). An autopilot that resets its position causes one or two
contradictions; ``CONTRADICTIONS`` within ``KEPT_NS`` prove two senders, and both are rejected until
they have agreed for that long. Unlike boot clocks (``clock/epochs.py``) and flight limits
(``tracking/gate.py``), the path also exposes a sender that copies the clock and stays near.

The peers of links are judged by ``known_peers.py``; here no peer was first, as among nodes of a
fleet.
"""

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Final

from companion.mavlink.trust.paths import SLACK_M, Path
from companion.mavlink.wire.positions import OWN, OwnPosition, read
from companion.values import Frame

CONTRADICTIONS: Final = 5
SPACED_NS: Final = 500_000_000
"""Time within which contradictions count once: a position reset causes several."""
KEPT_NS: Final = 30_000_000_000  # how long a peer and a contradiction are remembered
SENDERS_MAX: Final = 4096  # senders followed; new ones beyond it are not followed
PEERS_MAX: Final = 4  # peers followed per sender, the most recent


@dataclass(slots=True)
class _PeerPath:
    """Path of a sender over one peer."""

    is_trusted: bool
    heard_ns: int
    path: Path = field(default_factory=Path)


@dataclass(slots=True, kw_only=True)
class _SenderPaths:
    """Paths of a sender by peer, and the times of their contradictions."""

    heard_ns: int
    paths: dict[str, _PeerPath] = field(default_factory=dict)
    contradicted_ns: deque[int] = field(default_factory=lambda: deque(maxlen=CONTRADICTIONS))
    is_duplicate: bool = False


class DuplicateIds:
    """Detector of two senders under one id, by the peers that deliver their frames.

    ``trusted`` names peers whose frames are never rejected.
    """

    def __init__(self, trusted: Collection[str] = ()) -> None:
        self._trusted = frozenset(trusted)
        self._senders: dict[tuple[int, int], _SenderPaths] = {}

    def rejects(self, peer: str, frame: Frame) -> bool:
        """Process a frame of ``decode.POSE``. Return whether it must be rejected."""
        sender = self._senders.get(frame.source)
        if sender is None:
            sender = self._follow(frame)
            if sender is None:
                return False
        sender.heard_ns = frame.t_ns
        path = sender.paths.get(peer)
        if path is None:
            path = self._add_peer(sender, peer, frame.t_ns)
        path.heard_ns = frame.t_ns
        if len(sender.paths) == 1:
            return False
        if frame.msgid in OWN and self._contradicts(sender, path, read(frame)):
            when = sender.contradicted_ns
            if not when or frame.t_ns - when[-1] >= SPACED_NS:
                when.append(frame.t_ns)
        return self._is_duplicate(frame, sender) and not path.is_trusted

    def _follow(self, frame: Frame) -> _SenderPaths | None:
        """Start to follow a sender; None if ``SENDERS_MAX`` is reached."""
        if len(self._senders) >= SENDERS_MAX:
            before_ns = frame.t_ns - KEPT_NS
            self._senders = {k: v for k, v in self._senders.items() if v.heard_ns >= before_ns}
            if len(self._senders) >= SENDERS_MAX:
                return None
        return self._senders.setdefault(frame.source, _SenderPaths(heard_ns=frame.t_ns))

    def _add_peer(self, sender: _SenderPaths, peer: str, t_ns: int) -> _PeerPath:
        """Start to follow a peer of a sender; forget silent peers."""
        paths = sender.paths
        for name in [name for name, path in paths.items() if t_ns - path.heard_ns > KEPT_NS]:
            del paths[name]
        if len(paths) >= PEERS_MAX:
            others = [name for name, path in paths.items() if not path.is_trusted]
            del paths[min(others or paths, key=lambda name: paths[name].heard_ns)]
        return paths.setdefault(peer, _PeerPath(peer in self._trusted, t_ns))

    def _contradicts(self, sender: _SenderPaths, path: _PeerPath, said: OwnPosition) -> bool:
        """Add a report to its path. Return whether it contradicts that of another peer."""
        before = path.path.newest
        if not path.path.add(said):
            return False
        others = [
            other.path
            for other in sender.paths.values()
            if other is not path and not (other.is_trusted and path.is_trusted)
        ]
        excesses = [path.path.excess_m(other, before, said) for other in others]
        return any(excess is not None and excess > SLACK_M for excess in excesses)

    def _is_duplicate(self, frame: Frame, sender: _SenderPaths) -> bool:
        """Return whether a sender's peers contradict each other, and have not agreed since."""
        when = sender.contradicted_ns
        while when and frame.t_ns - when[0] > KEPT_NS:
            when.popleft()
        enough = 1 if sender.is_duplicate else CONTRADICTIONS
        sender.is_duplicate = len(when) >= enough
        return sender.is_duplicate
