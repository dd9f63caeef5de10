"""Which nodes are trusted. Contradictions exclude a node for a while, with a notice.

A node is excluded that

- tells frames before they can have been heard, by all that is known of its clock;
- has a clock that contradicts itself: round trips that no drift explains, again and again;
- tells reports that contradict what is heard here, or what others tell;
- tells of several vehicles that only it has ever heard, though they are said to be where others
  hear everybody: ``PHANTOMS`` of them for ``UNHEARD_NS``, and most of what it hears. A few such
  vehicles may be hidden: they are told, and stay unconfirmed.
"""

import math
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Final, NamedTuple

from companion.values import Notice, Severity

CONTRADICTIONS: Final = 3  # contradictions within WITHIN_NS after which a node is excluded
WITHIN_NS: Final = 30_000_000_000
EXCLUDED_NS: Final = 300_000_000_000  # how long a node is excluded
PHANTOMS: Final = 2  # vehicles that nobody else can hear, from which on their node is excluded
UNHEARD_NS: Final = 8_000_000_000
"""Time after which a vehicle that others ought to hear is one that they cannot."""
REACH_SHARE: Final = 0.7
"""Share of the distance to the farthest vehicle that a node hears, within which it hears all."""


class Witness(NamedTuple):
    """A node that can say whether a vehicle is where another says."""

    place_ned_m: tuple[float, float, float]  # of its array, in the local frame
    reach_m: float  # distance of the farthest vehicle that it hears itself
    heard: frozenset[str]  # vehicles that it has heard itself


class UnconfirmedVehicle(NamedTuple):
    """A vehicle that only one other node has told of: which, and where it is said to be."""

    uav: str
    node: str
    position_ned_m: tuple[float, float, float]


class Trust:
    """Trust in the other nodes. ``excluded`` holds the nodes that are not, with the reason."""

    def __init__(self) -> None:
        self.excluded: dict[str, str] = {}
        self._until_ns: dict[str, int] = {}
        self._times: dict[tuple[str, str], deque[int]] = {}
        self._unheard: dict[str, tuple[str, int]] = {}
        self._notified: set[str] = set()

    def is_trusted(self, node: str) -> bool:
        """Whether the messages of a node are used."""
        return node not in self.excluded

    def note_contradiction(self, now_ns: int, node: str, what: str) -> list[Notice]:
        """Take in a contradiction, in words that go on after "it"."""
        times = self._times.setdefault((node, what), deque(maxlen=CONTRADICTIONS))
        times.append(now_ns)
        if len(times) < CONTRADICTIONS or now_ns - times[0] > WITHIN_NS:
            return []
        return self._exclude(now_ns, node, what)

    def check_vehicles(
        self,
        now_ns: int,
        told: Iterable[UnconfirmedVehicle],
        witnesses: Mapping[str, Witness],
        heard: Mapping[str, int],
    ) -> list[Notice]:
        """Hold vehicles that only one other node tells of against who ought to hear them.

        ``heard`` is how many vehicles each node says that it has heard.
        """
        before, self._unheard = self._unheard, {}
        for one in told:
            others = [w for name, w in witnesses.items() if name != one.node]
            has_been_heard = any(one.uav in w.heard for w in others)
            if not has_been_heard and any(_should_receive(w, one) for w in others):
                node, since_ns = before.get(one.uav, (one.node, now_ns))
                self._unheard[one.uav] = (one.node, since_ns if node == one.node else now_ns)
        phantoms = dict[str, list[str]]()
        for uav, (node, since_ns) in self._unheard.items():
            if now_ns - since_ns >= UNHEARD_NS:
                phantoms.setdefault(node, []).append(uav)
        said = []
        for node, uavs in phantoms.items():
            names = ", ".join(sorted(uavs)[:6])
            if len(uavs) >= PHANTOMS and 2 * len(uavs) > heard.get(node, 0):
                what = f"tells of vehicles where nobody else hears one: {names}"
                said += self._exclude(now_ns, node, what)
            elif not self._notified.issuperset(uavs):
                text = f"tells of {names}, where nobody else hears one: hidden, or made up"
                said.append(_notice(now_ns, node, text, Severity.WARNING))
            self._notified.update(uavs)
        self._notified &= self._unheard.keys()
        return said

    @property
    def unconfirmed(self) -> frozenset[str]:
        """Vehicles of which only one node tells, where others ought to hear them."""
        return frozenset(self._unheard)

    def forget(self, now_ns: int) -> None:
        """Forget contradictions that count no more."""
        before_ns = now_ns - WITHIN_NS
        self._times = {what: times for what, times in self._times.items() if times[-1] > before_ns}

    def readmit(self, now_ns: int) -> list[Notice]:
        """Try again those whose time is over."""
        over = [node for node, until_ns in self._until_ns.items() if now_ns >= until_ns]
        for node in over:
            del self._until_ns[node], self.excluded[node]
        return [_notice(now_ns, node, "is believed again", Severity.INFO) for node in over]

    def _exclude(self, now_ns: int, node: str, what: str) -> list[Notice]:
        if node in self.excluded:
            return []
        self.excluded[node] = what
        self._until_ns[node] = now_ns + EXCLUDED_NS
        text = f"is not believed for {EXCLUDED_NS / 60e9:.0f} minutes: it {what}"
        return [_notice(now_ns, node, text, Severity.WARNING)]


def _should_receive(witness: Witness, told: UnconfirmedVehicle) -> bool:
    """Whether a vehicle is said to be where a node hears everybody."""
    away_m = math.dist(witness.place_ned_m, told.position_ned_m)
    return away_m < REACH_SHARE * witness.reach_m


def _notice(t_ns: int, node: str, what: str, severity: Severity) -> Notice:
    return Notice(t_ns=t_ns, severity=severity, subject=f"node {node}", text=f"node {node} {what}")
