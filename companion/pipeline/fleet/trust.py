"""Trust in other nodes. Repeated contradictions exclude a node for some time, with a notice.

A node is excluded if it

- shares frames before they can have been received, by the bounds on its clock;
- has an inconsistent clock: repeated round trips that no drift explains;
- shares reports of ``FALSE_MIN`` vehicles or more that contradict those received here, which began
  before that node shared the vehicle: of one vehicle, the sender here may be the false one;
- shares vehicles that only it receives, at positions where others receive everything: at least
  ``PHANTOMS_MIN`` of them for ``PHANTOM_AFTER_NS``, and most of what it receives. A few such
  vehicles may be hidden by an obstacle: they cause a notice and stay unconfirmed.

Of other contradictions, either side may be wrong. The reports that are received here are used, or
those of the node that shared the vehicle first, with a notice.
"""

import math
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Final, NamedTuple

from companion.values import Notice, Severity

OWN_NODE: Final = "this node"  # has a blank, so that no node has this name
CONTRADICTIONS: Final = (
    3  # contradictions within CONTRADICTION_WINDOW_NS after which a node is excluded
)
CONTRADICTION_WINDOW_NS: Final = 30_000_000_000
EXCLUDED_NS: Final = 300_000_000_000  # duration of an exclusion
PHANTOMS_MIN: Final = 2  # number of phantom vehicles from which on their node is excluded
PHANTOM_AFTER_NS: Final = 8_000_000_000
"""Time without reception elsewhere after which a vehicle counts as a phantom."""
FALSE_MIN: Final = 2  # vehicles with false reports from which on their node is excluded
DISPUTED_NS: Final = 60_000_000_000  # least time between two notices about a vehicle's dispute
REACH_SHARE: Final = 0.7
"""Fraction of a node's range within which it receives every vehicle."""


class Witness(NamedTuple):
    """Node that can confirm or refute that a vehicle is at a position."""

    place_ned_m: tuple[float, float, float]  # position of its array in the local frame
    reach_m: float  # distance of the farthest vehicle that it receives itself
    heard: frozenset[str]  # vehicles that it has received itself


class UnconfirmedVehicle(NamedTuple):
    """A vehicle that only one other node has shared, with that node and its position."""

    uav: str
    node: str
    position_ned_m: tuple[float, float, float]


class Trust:
    """Trust in other nodes. ``excluded`` maps excluded nodes to the reason."""

    def __init__(self) -> None:
        self.excluded: dict[str, str] = {}
        self._until_ns: dict[str, int] = {}
        self._times: dict[tuple[str, str], deque[int]] = {}
        self._unconfirmed_since: dict[str, tuple[str, int]] = {}
        self._notified: set[str] = set()
        self._disputed_ns: dict[str, int] = {}  # newest notice about a vehicle
        self._false_ns: dict[str, dict[str, int]] = {}  # newest false report, by node and vehicle

    def is_trusted(self, node: str) -> bool:
        """Return whether the messages of a node are used."""
        return node not in self.excluded

    def note_contradiction(self, now_ns: int, node: str, what: str) -> list[Notice]:
        """Note a node's contradiction; ``what`` is a predicate, to follow "it"."""
        times = self._times.setdefault((node, what), deque(maxlen=CONTRADICTIONS))
        times.append(now_ns)
        if len(times) < CONTRADICTIONS or now_ns - times[0] > CONTRADICTION_WINDOW_NS:
            return []
        return self._exclude(now_ns, node, what)

    def note_false_report(self, now_ns: int, uav: str, node: str) -> list[Notice]:
        """Note that a node's report of a vehicle contradicts what this node received before it."""
        false_ns = self._false_ns.setdefault(node, {})
        false_ns[uav] = now_ns
        before_ns = now_ns - CONTRADICTION_WINDOW_NS
        if sum(at_ns > before_ns for at_ns in false_ns.values()) < FALSE_MIN:
            return []
        return self.note_contradiction(
            now_ns, node, "shares reports that contradict those received here"
        )

    def note_dispute(self, now_ns: int, uav: str, node: str, believed: str) -> list[Notice]:
        """Note that reports of a vehicle that a node shares contradict those that are believed."""
        if now_ns - self._disputed_ns.get(uav, -DISPUTED_NS) < DISPUTED_NS:
            return []
        self._disputed_ns[uav] = now_ns
        name = believed if believed == OWN_NODE else f"node {believed}"
        what = f"shares other positions of {uav} than {name}, which is believed"
        return [_notice(now_ns, node, what, Severity.WARNING)]

    def check_vehicles(
        self,
        now_ns: int,
        told: Iterable[UnconfirmedVehicle],
        witnesses: Mapping[str, Witness],
        heard: Mapping[str, int],
    ) -> list[Notice]:
        """Check vehicles that only one other node shares against those that should receive them.

        ``heard`` is the number of vehicles that each node claims to receive.
        """
        before, self._unconfirmed_since = self._unconfirmed_since, {}
        for one in told:
            others = [w for name, w in witnesses.items() if name != one.node]
            has_been_heard = any(one.uav in w.heard for w in others)
            if not has_been_heard and any(_should_receive(w, one) for w in others):
                node, since_ns = before.get(one.uav, (one.node, now_ns))
                self._unconfirmed_since[one.uav] = (
                    one.node,
                    since_ns if node == one.node else now_ns,
                )
        phantoms = dict[str, list[str]]()
        for uav, (node, since_ns) in self._unconfirmed_since.items():
            if now_ns - since_ns >= PHANTOM_AFTER_NS:
                phantoms.setdefault(node, []).append(uav)
        said = []
        for node, uavs in phantoms.items():
            names = ", ".join(sorted(uavs)[:6])
            if len(uavs) >= PHANTOMS_MIN and 2 * len(uavs) > heard.get(node, 0):
                what = f"shares vehicles that other nodes should receive, but do not: {names}"
                said += self._exclude(now_ns, node, what)
            elif not self._notified.issuperset(uavs):
                text = (
                    f"shares {names}, which other nodes should receive, but do not:"
                    " hidden by an obstacle, or forged"
                )
                said.append(_notice(now_ns, node, text, Severity.WARNING))
            self._notified.update(uavs)
        self._notified &= self._unconfirmed_since.keys()
        return said

    @property
    def unconfirmed(self) -> frozenset[str]:
        """Vehicles that only one other node shares, though more nodes should receive them."""
        return frozenset(self._unconfirmed_since)

    def forget(self, now_ns: int) -> None:
        """Forget contradictions that have expired."""
        before_ns = now_ns - CONTRADICTION_WINDOW_NS
        self._times = {what: times for what, times in self._times.items() if times[-1] > before_ns}
        for node, false_ns in list(self._false_ns.items()):
            recent = {uav: at_ns for uav, at_ns in false_ns.items() if at_ns > before_ns}
            self._false_ns[node] = recent
            if not recent:
                del self._false_ns[node]
        before_ns = now_ns - DISPUTED_NS
        self._disputed_ns = {
            k: at_ns for k, at_ns in self._disputed_ns.items() if at_ns > before_ns
        }

    def readmit(self, now_ns: int) -> list[Notice]:
        """Trust nodes again whose exclusion has expired."""
        over = [node for node, until_ns in self._until_ns.items() if now_ns >= until_ns]
        for node in over:
            del self._until_ns[node], self.excluded[node]
        return [_notice(now_ns, node, "is trusted again", Severity.INFO) for node in over]

    def _exclude(self, now_ns: int, node: str, what: str) -> list[Notice]:
        if node in self.excluded:
            return []
        self.excluded[node] = what
        self._until_ns[node] = now_ns + EXCLUDED_NS
        text = f"is excluded for {EXCLUDED_NS / 60e9:.0f} minutes: it {what}"
        return [_notice(now_ns, node, text, Severity.WARNING)]


def _should_receive(witness: Witness, told: UnconfirmedVehicle) -> bool:
    """Return whether a vehicle is at a position where the witness should receive every vehicle."""
    away_m = math.dist(witness.place_ned_m, told.position_ned_m)
    return away_m < REACH_SHARE * witness.reach_m


def _notice(t_ns: int, node: str, what: str, severity: Severity) -> Notice:
    return Notice(t_ns=t_ns, severity=severity, subject=f"node {node}", text=f"node {node} {what}")
