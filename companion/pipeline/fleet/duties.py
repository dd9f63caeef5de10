"""Duties of nodes: claims, leases and handovers, without a leader.

Every node publishes several times a second which UAVs it serves (``Standing``). A message is valid
for one lease. A node without a message for that time, or whose liveliness token is gone, serves
nothing.

- A UAV without a node is claimed by the assigned node: at once if its holder left, otherwise after
  ``CLAIM_DELAY_NS``. If the assigned node does not claim it within a lease, the next one does.
- A UAV that belongs elsewhere is handed over: its holder announces the new node, and serves until
  that node announces that it serves. Two nodes then serve it for the delay of one message, and
  never none.
- If two nodes serve the same UAV without a handover, as after a partition, the node whose value at
  its claim was lower drops it. Both nodes know these constant values, so never both drop it. Names
  decide between equal values. If a third node is taking the UAV over meanwhile, the three can yield
  in a circle: it is free then, and claimed after ``CLAIM_DELAY_NS``.
- A claim counts only while its node's own offer supports it: a node cannot take UAVs by claiming
  more than it offers. Nor can it keep them by offering little: what is assigned to another node and
  not handed over for ``WITHHELD_NS`` is taken.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Final

from companion.pipeline.fleet.assignment import assign
from companion.values import Standing
from companion.values.budget import Budget
from companion.values.described import Meaning

CLAIM_DELAY_NS: Final = 500_000_000
"""Time without a serving node after which a UAV is claimed; longer than a message's delay."""
ASSIGNED_NS: Final = 500_000_000  # time between two assignments while the nodes are the same
ASSIGNMENTS_PER_S: Final = 3.0
"""Most assignments per second, however often nodes come and go: each may take 50 ms."""
ASSIGNMENTS_SAVED: Final = 4.0
CLAIM_EXCESS_DB: Final = 20.0
"""Largest excess of a claim over the present offer of its node; offers change after a claim."""
SETTLED_NS: Final = 2_000_000_000
"""Time for which a UAV must be assigned elsewhere before it is handed over."""
WITHHELD_NS: Final = 6_000_000_000
"""Time for which a UAV must be assigned here and not be handed over before it is taken."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Handover:
    """Change of the node that serves a UAV; this node is the old or the new one."""

    t_ns: Annotated[int, Meaning("when this node changed it")]
    uav: Annotated[str, Meaning("UAV that changed its node", example="3:1")]
    before: Annotated[str | None, Meaning("node that served the UAV before; null: none")]
    after: Annotated[str | None, Meaning("node that serves the UAV from then on; null: none")]


class Duties:
    """Duties of one node: the UAVs that it serves, and its handovers.

    name           its name
    most           largest number of UAVs that it serves
    lease_ns       validity of another node's message
    hysteresis_db  least gain for which a UAV changes its node

    ``serves`` maps the UAVs that it serves to their values when it claimed them, dB; ``handing``
    maps those in a handover to the new node.
    """

    def __init__(self, *, name: str, most: int, lease_ns: int, hysteresis_db: float) -> None:
        self.serves: dict[str, float] = {}
        self.handing: dict[str, str] = {}
        self._name = name
        self._most = most
        self._lease_ns = lease_ns
        self._hysteresis_db = hysteresis_db
        self._others: dict[str, tuple[int, Standing]] = {}  # with the time of reception
        self._free_since: dict[str, int] = {}
        self._elsewhere: dict[str, tuple[str, int]] = {}
        self._withheld_since: dict[str, int] = {}
        self._begun_ns: int | None = None
        self._wanted: dict[str, str] = {}
        self._assigned: tuple[int, frozenset[str]] = (0, frozenset())
        self._assignments = Budget(per_s=ASSIGNMENTS_PER_S, most=ASSIGNMENTS_SAVED)

    # --- input ------------------------------------------------------------------------------

    def hear(self, now_ns: int, said: Standing) -> None:
        """Process the ``Standing`` of another node."""
        self._others[said.node] = (now_ns, said)

    def gone(self, now_ns: int, node: str) -> None:
        """Remove a node that left: the UAVs that it served may be claimed at once."""
        _, said = self._others.pop(node, (0, None))
        for uav, _ in said.serves if said else ():
            self._free_since[uav] = now_ns - CLAIM_DELAY_NS

    def others(self, now_ns: int) -> dict[str, Standing]:
        """Return the newest ``Standing`` of each other node whose lease has not expired."""
        for name in [n for n, (t_ns, _) in self._others.items() if now_ns - t_ns > self._lease_ns]:
            self.gone(now_ns, name)
        return {name: said for name, (_, said) in self._others.items()}

    # --- decisions --------------------------------------------------------------------------

    def decide(
        self, now_ns: int, offers: Mapping[str, Mapping[str, float]], trusted: frozenset[str]
    ) -> list[Handover]:
        """Decide which UAVs this node serves. Returns the changes.

        offers   value of each node's offers, dB, by node and UAV, including this node's; those in
                 the order in which it serves UAVs if there are too many
        trusted  names of the other nodes that are trusted
        """
        if self._begun_ns is None:
            self._begun_ns = now_ns
        standing = {n: s for n, s in self.others(now_ns).items() if n in trusted}
        before = dict(self.serves)
        known = {node: given for node, given in offers.items() if node in {*standing, self._name}}
        claims = _claims(standing, known)
        at_ns, nodes = self._assigned
        is_due = now_ns - at_ns >= ASSIGNED_NS or nodes != standing.keys()
        if is_due and self._assignments.spend(1.0, now_ns * 1e-9):
            self._assigned = now_ns, frozenset(standing)
            self._wanted = self._assign(claims, standing, known)
        wanted = self._wanted
        self._drop_lost_claims(claims, standing, known)
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
        """Assign the UAVs that this node offers to serve, or already serves.

        If all nodes receive all UAVs, these are all UAVs, and every node finds the same assignment.
        """
        matters = {*offers.get(self._name, {}), *self.serves}
        given = {
            node: {uav: worth for uav, worth in one.items() if uav in matters}
            for node, one in offers.items()
        }
        given = {node: one for node, one in given.items() if one or node == self._name}
        holders = {uav: _best_claim(claims[uav]) for uav in matters if uav in claims}
        holders |= dict.fromkeys(self.serves, self._name)
        most = {node: said.most for node, said in standing.items()} | {self._name: self._most}
        beside = {
            node: sum(uav not in matters for uav, _ in said.serves)
            for node, said in standing.items()
        }
        return assign(given, holders, most, self._hysteresis_db, beside)

    def _change(self, now_ns: int, uav: str, claims: Mapping[str, Mapping[str, float]]) -> Handover:
        other = _best_claim(claims[uav]) if uav in claims else None
        before, after = (other, self._name) if uav in self.serves else (self._name, other)
        return Handover(t_ns=now_ns, uav=uav, before=before, after=after)

    def _drop_lost_claims(
        self,
        claims: Mapping[str, Mapping[str, float]],
        standing: Mapping[str, Standing],
        offers: Mapping[str, Mapping[str, float]],
    ) -> None:
        """Drop UAVs that another node took over, holds by a better claim, or that no node can
        serve."""
        for uav in [uav for uav in self.serves if uav in claims]:
            rivals = {
                node: worth
                for node, worth in claims[uav].items()
                if (uav, self._name) not in standing[node].handing
            }
            mine = {self._name: self.serves[uav]}
            if self.handing.get(uav) in rivals or _best_claim(rivals | mine) != self._name:
                self._drop(uav)
        for uav in [uav for uav in self.serves if all(uav not in one for one in offers.values())]:
            self._drop(uav)  # no node can serve it

    def _drop(self, uav: str) -> None:
        self.serves.pop(uav, None)
        self.handing.pop(uav, None)
        self._elsewhere.pop(uav, None)

    def _hand_over(
        self, now_ns: int, wanted: Mapping[str, str], offers: Mapping[str, Mapping[str, float]]
    ) -> None:
        """Announce the new node of UAVs assigned elsewhere for ``SETTLED_NS``, or out of reach
        here."""
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
        """Claim UAVs handed to this node, and unserved ones that are due."""
        mine = offers.get(self._name, {})
        handed = {uav for said in standing.values() for uav, to in said.handing if to == self._name}
        has_listened = self._begun_ns is not None and now_ns - self._begun_ns >= self._lease_ns
        rank = {uav: number for number, uav in enumerate(mine)}
        for uav in mine:
            if uav in self.serves:
                continue
            if not self._has_place(uav, rank):
                break  # all that follow rank lower, too
            if uav in claims:
                self._free_since.pop(uav, None)
                is_better = wanted.get(uav) == self._name and max(claims[uav].values()) < mine[uav]
                if uav in handed or self._is_withheld(now_ns, uav, is_better):
                    self._serve(uav, mine[uav], rank)
                continue
            free_ns = now_ns - self._free_since.setdefault(uav, now_ns)
            late_ns = 0 if wanted.get(uav) == self._name else self._lease_ns
            if has_listened and free_ns >= CLAIM_DELAY_NS + late_ns:
                self._serve(uav, mine[uav], rank)
        for uav in [uav for uav in self._free_since if uav not in mine or uav in self.serves]:
            del self._free_since[uav]
        for uav in [uav for uav in self._withheld_since if uav not in claims or uav in self.serves]:
            del self._withheld_since[uav]

    def _is_withheld(self, now_ns: int, uav: str, is_better: bool) -> bool:
        """Return whether this node has been the better one for long, but is not given the UAV."""
        if not is_better:
            self._withheld_since.pop(uav, None)
            return False
        return now_ns - self._withheld_since.setdefault(uav, now_ns) >= WITHHELD_NS

    def _has_place(self, uav: str, rank: Mapping[str, int]) -> bool:
        """Return whether this node serves fewer UAVs than it may, or one that ranks lower."""
        if len(self.serves) < self._most:
            return True
        return any(rank.get(served, len(rank)) > rank[uav] for served in self.serves)

    def _serve(self, uav: str, worth_db: float, rank: Mapping[str, int]) -> None:
        """Serve a UAV; drop the one that ranks lowest if there are too many."""
        if len(self.serves) >= self._most:
            self._drop(max(self.serves, key=lambda served: rank.get(served, len(rank))))
        self.serves[uav] = worth_db


def _claims(
    standing: Mapping[str, Standing], offers: Mapping[str, Mapping[str, float]]
) -> dict[str, dict[str, float]]:
    """Return the other nodes that serve each UAV, with its value to each at the claim, dB.

    Claims that the offer of their node does not support are left out.
    """
    claims = dict[str, dict[str, float]]()
    for node, said in standing.items():
        given = offers.get(node, {})
        for uav, worth in said.serves:
            if uav in given and worth <= given[uav] + CLAIM_EXCESS_DB:
                claims.setdefault(uav, {})[node] = worth
    return claims


def _best_claim(claims: Mapping[str, float]) -> str:
    """Return the node that keeps a UAV: the one with the highest value, by name between equals."""
    return max(sorted(claims), key=lambda node: claims[node])
