"""Who serves whom: claims, leases and handovers, without a leader.

Every node says some times a second whom it serves (``Standing``). A word holds for one lease; a
node that was not heard for so long, or whose liveliness went, holds nothing.

- A UAV that nobody serves is claimed by the node that the assignment names, at once where its
  holder is gone, else after ``GRACE_NS``; by the next one if that does not happen within a lease.
- A UAV that should be elsewhere is handed over: its holder says to whom, and serves on until that
  node says that it serves it. It is served by two then for one message's way, by none never.
- Of two that serve the same UAV without a handover, as after a partition, the one lets go to which
  it was worth less when it was claimed: a number that both see and that does not change, so that
  never both let go. Names decide between equals.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Final

from companion.pipeline.fleet.assignment import assign
from companion.values import Standing
from companion.values.described import Meaning

GRACE_NS: Final = 500_000_000
"""Time without a holder after which a UAV is claimed: longer than a word takes to come."""
ASSIGNED_NS: Final = 500_000_000  # time between two assignments while the same nodes are there
SETTLED_NS: Final = 2_000_000_000
"""Time for which a UAV must belong elsewhere before it is handed over."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Handover:
    """A change of the node that serves a UAV, in which this node took part."""

    t_ns: Annotated[int, Meaning("when this node changed it")]
    uav: Annotated[str, Meaning("UAV that changed its node", example="3:1")]
    before: Annotated[str | None, Meaning("node that served it before; null: none")]
    after: Annotated[str | None, Meaning("node that serves it from then on; null: none")]


class Duties:
    """The duties of one node.

    name           its name
    most           UAVs that it serves at most
    lease_ns       how long another node's word holds
    hysteresis_db  least gain for which a UAV changes its node

    ``serves`` are the UAVs that it serves with their worth when it claimed them, dB; ``handing``
    those of them that another is to take.
    """

    def __init__(self, *, name: str, most: int, lease_ns: int, hysteresis_db: float) -> None:
        self.serves: dict[str, float] = {}
        self.handing: dict[str, str] = {}
        self._name = name
        self._most = most
        self._lease_ns = lease_ns
        self._hysteresis_db = hysteresis_db
        self._others: dict[str, tuple[int, Standing]] = {}  # with when that was heard
        self._free_since: dict[str, int] = {}
        self._elsewhere: dict[str, tuple[str, int]] = {}
        self._begun_ns: int | None = None
        self._wanted: dict[str, str] = {}
        self._assigned: tuple[int, frozenset[str]] = (0, frozenset())

    # --- what others say --------------------------------------------------------------------

    def hear(self, now_ns: int, said: Standing) -> None:
        """Take in what another node says of itself."""
        self._others[said.node] = (now_ns, said)

    def gone(self, now_ns: int, node: str) -> None:
        """A node is gone: whom it served may be claimed at once."""
        _, said = self._others.pop(node, (0, None))
        for uav, _ in said.serves if said else ():
            self._free_since[uav] = now_ns - GRACE_NS

    def others(self, now_ns: int) -> dict[str, Standing]:
        """What the other nodes said last, of those whose word still holds."""
        for name in [n for n, (t_ns, _) in self._others.items() if now_ns - t_ns > self._lease_ns]:
            self.gone(now_ns, name)
        return {name: said for name, (_, said) in self._others.items()}

    # --- what follows -----------------------------------------------------------------------

    def decide(
        self, now_ns: int, offers: Mapping[str, Mapping[str, float]], trusted: frozenset[str]
    ) -> list[Handover]:
        """Decide anew whom this node serves. Returns what changed.

        offers   worth of each node's offers, dB, by node and UAV, this node's among them
        trusted  names of the other nodes that are believed
        """
        if self._begun_ns is None:
            self._begun_ns = now_ns
        standing = {n: s for n, s in self.others(now_ns).items() if n in trusted}
        claims = _claims(standing)
        before = dict(self.serves)
        known = {node: given for node, given in offers.items() if node in {*standing, self._name}}
        at_ns, nodes = self._assigned
        if now_ns - at_ns >= ASSIGNED_NS or nodes != standing.keys():
            self._assigned = now_ns, frozenset(standing)
            self._wanted = self._assign(claims, standing, known)
        wanted = self._wanted
        self._let_go(claims, standing, known)
        self._hand_over(now_ns, wanted, known)
        self._take(now_ns, wanted, claims, standing, known)
        changed = [
            uav for uav in {**before, **self.serves} if (uav in before) != (uav in self.serves)
        ]
        return [self._change(now_ns, uav, claims) for uav in changed]

    def _assign(
        self,
        claims: Mapping[str, Mapping[str, float]],
        standing: Mapping[str, Standing],
        offers: Mapping[str, Mapping[str, float]],
    ) -> dict[str, str]:
        """Who is to serve each UAV that is this node's matter: that it offers to serve, or serves.

        Where all nodes hear all UAVs these are all, and every node finds the same.
        """
        matters = {*offers.get(self._name, {}), *self.serves}
        given = {
            node: {uav: worth for uav, worth in one.items() if uav in matters}
            for node, one in offers.items()
        }
        given = {node: one for node, one in given.items() if one or node == self._name}
        holders = {uav: _keeper(claims[uav]) for uav in matters if uav in claims}
        holders |= dict.fromkeys(self.serves, self._name)
        most = {node: said.most for node, said in standing.items()} | {self._name: self._most}
        beside = {
            node: sum(uav not in matters for uav, _ in said.serves)
            for node, said in standing.items()
        }
        return assign(given, holders, most, self._hysteresis_db, beside)

    def _change(self, now_ns: int, uav: str, claims: Mapping[str, Mapping[str, float]]) -> Handover:
        other = _keeper(claims[uav]) if uav in claims else None
        before, after = (other, self._name) if uav in self.serves else (self._name, other)
        return Handover(t_ns=now_ns, uav=uav, before=before, after=after)

    def _let_go(
        self,
        claims: Mapping[str, Mapping[str, float]],
        standing: Mapping[str, Standing],
        offers: Mapping[str, Mapping[str, float]],
    ) -> None:
        """Let go of what another has taken over, or has by better right."""
        for uav in [uav for uav in self.serves if uav in claims]:
            rivals = {
                node: worth
                for node, worth in claims[uav].items()
                if (uav, self._name) not in standing[node].handing
            }
            mine = {self._name: self.serves[uav]}
            if self.handing.get(uav) in rivals or _keeper(rivals | mine) != self._name:
                self._drop(uav)
        for uav in [uav for uav in self.serves if all(uav not in one for one in offers.values())]:
            self._drop(uav)  # nobody can serve it

    def _drop(self, uav: str) -> None:
        self.serves.pop(uav, None)
        self.handing.pop(uav, None)
        self._elsewhere.pop(uav, None)

    def _hand_over(
        self, now_ns: int, wanted: Mapping[str, str], offers: Mapping[str, Mapping[str, float]]
    ) -> None:
        """Say of UAVs that have belonged elsewhere for long who is to take them."""
        for uav in self.serves:
            to = wanted.get(uav, self._name)
            if to == self._name:
                self._elsewhere.pop(uav, None)
                self.handing.pop(uav, None)
                continue
            place, since_ns = self._elsewhere.get(uav, (to, now_ns))
            if place != to:
                since_ns = now_ns
            self._elsewhere[uav] = (to, since_ns)
            lost = uav not in offers.get(self._name, {})
            if lost or now_ns - since_ns >= SETTLED_NS:
                self.handing[uav] = to

    def _take(
        self,
        now_ns: int,
        wanted: Mapping[str, str],
        claims: Mapping[str, Mapping[str, float]],
        standing: Mapping[str, Standing],
        offers: Mapping[str, Mapping[str, float]],
    ) -> None:
        """Take what is handed to this node, and what nobody serves and is this node's to serve."""
        mine = offers.get(self._name, {})
        handed = {uav for said in standing.values() for uav, to in said.handing if to == self._name}
        has_listened = self._begun_ns is not None and now_ns - self._begun_ns >= self._lease_ns
        for uav in mine:
            if uav in self.serves or len(self.serves) >= self._most:
                continue
            if uav in claims:
                self._free_since.pop(uav, None)
                if uav in handed:
                    self.serves[uav] = mine[uav]
                continue
            free_ns = now_ns - self._free_since.setdefault(uav, now_ns)
            late_ns = 0 if wanted.get(uav) == self._name else self._lease_ns
            if has_listened and free_ns >= GRACE_NS + late_ns:
                self.serves[uav] = mine[uav]
        for uav in [uav for uav in self._free_since if uav not in mine or uav in self.serves]:
            del self._free_since[uav]


def _claims(standing: Mapping[str, Standing]) -> dict[str, dict[str, float]]:
    """Who of the others serves each UAV, and what it was worth to them when they claimed it."""
    claims = dict[str, dict[str, float]]()
    for node, said in standing.items():
        for uav, worth in said.serves:
            claims.setdefault(uav, {})[node] = worth
    return claims


def _keeper(claims: Mapping[str, float]) -> str:
    """The one of several nodes that keeps a UAV: the worthiest, by name between equals."""
    return max(sorted(claims), key=lambda node: claims[node])
