"""Nodes that are there and do not answer: their connection carries one way only.

Seen with Zenoh 1.10 and two links to a neighbour, reliable and not: after a parting, one end may
join a new link to what it still holds of the old ones, which the other end has given up. What one
says the other then never hears, and neither finds out: signs of life come. Questions for a node's
clock find out. Only a new session heals it.
"""

from collections.abc import Mapping
from typing import Final

MOST_NS: Final = 60_000_000_000
"""Time between two sessions that is enough: a node that never answers, or names that somebody makes
up, must not cost the others theirs.
"""
CALM_NS: Final = 600_000_000_000
"""Time after a new session after which the next one may come as soon as the first."""
HELD_UP_NS: Final = 3_000_000_000
"""Time without a look after which this process was held up, and answers may wait for it."""


class Unanswered:
    """Since when questions to other nodes have had no answer.

    A node may be silent for ``patience_ns``. From one new session to the next it is twice that at
    least, and twice as long each time. ``alive`` are the nodes that show signs of life.
    """

    def __init__(self, patience_ns: int) -> None:
        self.alive: set[str] = set()
        self._patience_ns = patience_ns
        self._since: dict[str, int] = {}
        self._gap_ns = patience_ns
        self._found_ns: int | None = None
        self._looked_ns: int | None = None

    def asked(self, now_ns: int, node: str) -> None:
        """A node is asked."""
        self._since.setdefault(node, now_ns)

    def answered(self, node: str) -> None:
        """A node answered."""
        self._since.pop(node, None)

    def gone(self, now_ns: int, heard_ns: Mapping[str, int]) -> list[str]:
        """Nodes that have shown nothing for long; ``heard_ns`` is when each was heard last."""
        before_ns = now_ns - self._patience_ns
        return [n for n, at_ns in heard_ns.items() if n not in self.alive and at_ns < before_ns]

    def mute(self, now_ns: int, heard_ns: Mapping[str, int]) -> list[str]:
        """Nodes that are there and have not answered for too long. All are waited for anew then.

        There is who shows signs of life, or was heard since half of the patience.
        """
        if self._looked_ns is not None and now_ns - self._looked_ns > HELD_UP_NS:
            self._since.clear()
        self._looked_ns = now_ns
        lately_ns = now_ns - self._patience_ns // 2
        there = self.alive | {node for node, at_ns in heard_ns.items() if at_ns > lately_ns}
        self._since = {node: since for node, since in self._since.items() if node in there}
        before_ns = now_ns - self._patience_ns
        found = [node for node, since_ns in self._since.items() if since_ns <= before_ns]
        if not found or not self._may_find(now_ns):
            return []
        self._since.clear()
        return found

    def _may_find(self, now_ns: int) -> bool:
        passed_ns = CALM_NS if self._found_ns is None else now_ns - self._found_ns
        if passed_ns >= CALM_NS:
            self._gap_ns = self._patience_ns
        if passed_ns < self._gap_ns:
            return False
        self._found_ns = now_ns
        self._gap_ns = min(2 * self._gap_ns, MOST_NS)
        return True
