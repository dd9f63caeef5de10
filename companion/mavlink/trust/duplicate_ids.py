"""Detection of two senders under one id, from peers that contradict each other.

A vehicle may be received over any number of peers. A router forwards the same reports, a second
telemetry port has its own stamps, and a restarted radio has another address: all of their reports
lie on one path. Take two reports of one peer, dt apart, and a report of another peer whose stamp
lies between them. Its distance from the straight line between the two is at most

    a dt^2 / 8    in position, and    a dt / 2    in velocity,

where a is the largest acceleration, plus an allowance for differences between the reports of one
vehicle: ``SLACK_M``, the noise of any report, and the distance flown in ``STALE_S``. A report
further off contradicts the other peer. An autopilot that resets its position causes one or two
contradictions; ``CONTRADICTIONS`` within ``KEPT_NS`` prove two senders, and both are rejected until
they have agreed for that long. Unlike boot clocks (``clock/epochs.py``) and flight limits
(``tracking/gate.py``), the path also exposes a sender that copies the clock and stays near.

Peers that the settings name as routers are trusted, even if others contradict them.
"""

import math
from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

from companion.mavlink.wire.positions import OWN, OwnPosition, read
from companion.values import Frame, Vector

CONTRADICTIONS: Final = 5
SPACED_NS: Final = 500_000_000
"""Time within which contradictions count once: a position reset causes several."""
KEPT_NS: Final = 30_000_000_000  # how long a peer and a contradiction are remembered
SLACK_M: Final = 3.0
STALE_S: Final = 0.1
SLACK_MPS: Final = 1.0
ACCELERATION_MPS2: Final = 20.0
STRETCH_MS: Final = 2000
"""Longest time between two reports of a peer that a third report is compared with."""
RESTARTED_MS: Final = 10_000  # a stamp that steps back further is from another boot

SENDERS_MAX: Final = 4096  # senders followed; new ones beyond it are not followed
PEERS_MAX: Final = 4  # peers followed per sender, the most recent
REPORTS_KEPT: Final = 32  # newest reports kept of a peer

_METRES: Final = 111_195.0 * 1e-7  # metres in 1e-7 degrees of latitude


@dataclass(slots=True)
class _Path:
    """Path of a sender over one peer; ``is_router``: the settings trust the peer."""

    is_router: bool
    heard_ns: int
    reports: deque[OwnPosition] = field(default_factory=lambda: deque(maxlen=REPORTS_KEPT))


@dataclass(slots=True, kw_only=True)
class _SenderPaths:
    """Paths of a sender by peer, and the times of their contradictions."""

    heard_ns: int
    paths: dict[str, _Path] = field(default_factory=dict)
    contradicted_ns: deque[int] = field(default_factory=lambda: deque(maxlen=CONTRADICTIONS))
    is_reported: bool = False


class DuplicateIds:
    """Detector of two senders under one id, by the peers that deliver their frames.

    ``routers`` names trusted peers: a link as in the settings, HOST or HOST:PORT. ``found`` holds
    the duplicate ids since it was last emptied, with their peers.
    """

    def __init__(self, routers: Collection[str] = ()) -> None:
        self.found: list[tuple[str, tuple[str, ...]]] = []
        self._routers = frozenset(routers)
        self._senders: dict[tuple[int, int], _SenderPaths] = {}

    def rejects(self, link: str, peer: str, frame: Frame) -> bool:
        """Process a frame of ``decode.POSE``. Return whether it must be rejected.

        ``link`` is the link as in the settings, ``peer`` the peer's HOST:PORT, or the link again if
        it has only one peer.
        """
        sender = self._senders.get(frame.source)
        if sender is None:
            sender = self._follow(frame)
            if sender is None:
                return False
        sender.heard_ns = frame.t_ns
        path = sender.paths.get(peer)
        if path is None:
            path = self._add_peer(sender, link, peer, frame.t_ns)
        path.heard_ns = frame.t_ns
        if len(sender.paths) == 1:
            return False
        if frame.msgid in OWN and self._contradicts(sender, path, read(frame)):
            when = sender.contradicted_ns
            if not when or frame.t_ns - when[-1] >= SPACED_NS:
                when.append(frame.t_ns)
        return self._is_duplicate(frame, sender) and not path.is_router

    def _follow(self, frame: Frame) -> _SenderPaths | None:
        """Start to follow a sender; None if ``SENDERS_MAX`` is reached."""
        if len(self._senders) >= SENDERS_MAX:
            before_ns = frame.t_ns - KEPT_NS
            self._senders = {k: v for k, v in self._senders.items() if v.heard_ns >= before_ns}
            if len(self._senders) >= SENDERS_MAX:
                return None
        return self._senders.setdefault(frame.source, _SenderPaths(heard_ns=frame.t_ns))

    def _add_peer(self, sender: _SenderPaths, link: str, peer: str, t_ns: int) -> _Path:
        """Start to follow a peer of a sender; forget silent peers."""
        paths = sender.paths
        for name in [name for name, path in paths.items() if t_ns - path.heard_ns > KEPT_NS]:
            del paths[name]
        if len(paths) >= PEERS_MAX:
            strangers = [name for name, path in paths.items() if not path.is_router]
            del paths[min(strangers or paths, key=lambda name: paths[name].heard_ns)]
        known = {link, peer, peer.rpartition(":")[0].strip("[]")}
        return paths.setdefault(peer, _Path(not known.isdisjoint(self._routers), t_ns))

    def _contradicts(self, sender: _SenderPaths, path: _Path, said: OwnPosition) -> bool:
        """Add a report to its path. Return whether it proves two senders.

        The report is compared with the stretches of other peers, and their reports with the stretch
        that it ends.
        """
        before = path.reports[-1] if path.reports else None
        if before is not None and said.boot_ms <= before.boot_ms:
            if before.boot_ms - said.boot_ms > RESTARTED_MS:
                path.reports.clear()
            return False
        path.reports.append(said)
        for other in sender.paths.values():
            if other is path or (other.is_router and path.is_router):
                continue
            if any(
                _contradicts_stretch(said, *stretch)
                for stretch in _around(other.reports, said.boot_ms)
            ):
                return True
            if before is not None and any(
                _contradicts_stretch(q, before, said) for q in _within(other.reports, before, said)
            ):
                return True
        return False

    def _is_duplicate(self, frame: Frame, sender: _SenderPaths) -> bool:
        """Return whether a sender's peers contradict each other; if so, add it to ``found``."""
        when = sender.contradicted_ns
        while when and frame.t_ns - when[0] > KEPT_NS:
            when.popleft()
        if sender.is_reported:
            sender.is_reported = bool(when)
        elif len(when) >= CONTRADICTIONS:
            sender.is_reported = True
            self.found.append((str(frame.source), tuple(sender.paths)))
        return sender.is_reported


def _around(reports: deque[OwnPosition], boot_ms: int) -> Iterator[tuple[OwnPosition, OwnPosition]]:
    """Yield the stretches of a path that contain a stamp (one, or two that meet), newest first."""
    for last, first in pairwise(reversed(reports)):
        if boot_ms > last.boot_ms:
            return
        if first.boot_ms <= boot_ms:
            yield first, last


def _within(
    reports: deque[OwnPosition], first: OwnPosition, last: OwnPosition
) -> Iterator[OwnPosition]:
    """Yield the reports of a path with stamps between those of two others, the newest first."""
    for one in reversed(reports):
        if one.boot_ms < first.boot_ms:
            return
        if one.boot_ms <= last.boot_ms:
            yield one


def _contradicts_stretch(said: OwnPosition, first: OwnPosition, last: OwnPosition) -> bool:
    """Return whether a report between the stamps of two others cannot be from their sender."""
    stretch_ms = last.boot_ms - first.boot_ms
    if stretch_ms > STRETCH_MS:
        return False
    share, dt_s = (said.boot_ms - first.boot_ms) / stretch_ms, stretch_ms * 1e-3
    velocities = [v for v in (one.velocity_ned_mps for one in (said, first, last)) if v is not None]
    fastest_mps = max((math.hypot(*velocity) for velocity in velocities), default=0.0)
    limit_m = SLACK_M + STALE_S * fastest_mps + ACCELERATION_MPS2 * dt_s**2 / 8
    scales = (_METRES, _METRES * math.cos(math.radians(said.lat_1e7 * 1e-7)), 1.0)
    between = _between(_place(first), _place(last), share)
    places = zip(scales, _place(said), between, strict=True)
    if math.hypot(*(scale * (a - b) for scale, a, b in places)) > limit_m:
        return True
    if len(velocities) < 3:
        return False
    velocity, before, after = velocities
    off_mps = math.dist(velocity, _between(before, after, share))
    return off_mps > SLACK_MPS + ACCELERATION_MPS2 * dt_s / 2


def _place(said: OwnPosition) -> Vector:
    return said.lat_1e7, said.lon_1e7, said.alt_m


def _between(one: Vector, two: Vector, share: float) -> list[float]:
    return [a + share * (b - a) for a, b in zip(one, two, strict=True)]
