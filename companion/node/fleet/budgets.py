"""Budgets of the other nodes of a fleet: whatever one of them sends, the others are processed.

Names are free: who may publish at all can publish under hundreds of them. So a node is always
processed at the small rate that it needs, and what is more comes out of one budget for all.
"""

from typing import Final, NamedTuple

from companion.node.fleet.messages import FleetMessageError
from companion.pipeline.fleet.member import NODES_MAX
from companion.values.budget import Budget

GUARANTEED_BYTES_PER_S: Final = 20_000
"""Bytes per second of a node that are always parsed: the standing and offers of 100 UAVs."""
GUARANTEED_BYTES: Final = 100_000  # bytes at once
NODE_BYTES_PER_S: Final = 500_000  # bytes of messages of one node that are parsed
ALL_BYTES_PER_S: Final = 1_000_000  # bytes of all nodes beyond those that are always parsed
BYTES_SAVED: Final = 2_000_000  # bytes at once, of one node and of all
NODE_TIME: Final = 0.2  # share of the time that the frames of one node may take
ALL_TIME: Final = 0.3  # share of the time that those of all nodes may take
TIME_SAVED_S: Final = 0.5  # time that they may take at once
PRESENCE_PER_S: Final = 5.0
"""Changes per second in who is present that are processed. Messages show the same, later."""
PRESENCE_SAVED: Final = 2.0 * NODES_MAX


class _NodeBudget(NamedTuple):
    """Bytes of one node, those that are always parsed and those beyond; and time of its frames."""

    guaranteed: Budget
    more: Budget
    time: Budget


class NodeBudgets:
    """Budgets of bytes and time by node, and of presence; names beyond ``NODES_MAX`` share one."""

    def __init__(self) -> None:
        self._nodes: dict[str, _NodeBudget] = {}
        self._all = Budget(per_s=ALL_BYTES_PER_S, most=BYTES_SAVED)
        self._time = Budget(per_s=ALL_TIME, most=TIME_SAVED_S)
        self._presence = Budget(per_s=PRESENCE_PER_S, most=PRESENCE_SAVED)

    def spend(self, node: str, size: int, now_s: float) -> None:
        """Use the budgets for a message. Raises ``FleetMessageError`` if they are exhausted."""
        own = self._of(node)
        if own.guaranteed.spend(size, now_s):
            return
        if not own.more.spend(size, now_s):
            raise FleetMessageError(f"more than {NODE_BYTES_PER_S // 1000} kB/s of messages")
        if not self._all.spend(size, now_s):
            raise FleetMessageError(
                f"more than {ALL_BYTES_PER_S // 1000} kB/s of messages of all nodes"
            )

    def _of(self, node: str) -> _NodeBudget:
        known = node if node in self._nodes or len(self._nodes) < NODES_MAX else ""
        own = self._nodes.get(known)
        if own is None:
            own = self._nodes[known] = _NodeBudget(
                Budget(per_s=GUARANTEED_BYTES_PER_S, most=GUARANTEED_BYTES),
                Budget(per_s=NODE_BYTES_PER_S, most=BYTES_SAVED),
                Budget(per_s=NODE_TIME, most=TIME_SAVED_S),
            )
        return own

    def has_time(self, node: str, now_s: float) -> bool:
        """Return whether frames of a node may be processed."""
        return self._of(node).time.has(0.0, now_s) and self._time.has(0.0, now_s)

    def charge_time(self, node: str, spent_s: float) -> None:
        """Use time for frames of a node."""
        self._of(node).time.charge(spent_s)
        self._time.charge(spent_s)

    def spend_presence(self, now_s: float) -> bool:
        """Use the budget for one node that comes or goes; return whether it was left."""
        return self._presence.spend(1.0, now_s)
