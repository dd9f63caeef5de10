"""Nodes that are present but do not answer, because a connection works in one direction only.

Seen with Zenoh 1.10 and two links to a neighbour, one reliable and one not. After a disconnection,
one end may join a new link to the remains of the old ones, which the other end has dropped. Its
messages are then lost, and neither end notices, since liveliness tokens still arrive. Clock
requests detect this. Only a new session fixes it.
"""

from collections.abc import Mapping
from typing import Final

SESSION_INTERVAL_MAX_NS: Final = 60_000_000_000
"""Limit on the time between two new sessions.

A node that never answers, or forged names, must not cost the others their sessions.
"""
RESET_NS: Final = 600_000_000_000
"""Time without a new session after which the interval to the next one is reset."""
BLOCKED_NS: Final = 3_000_000_000
"""Time without a check that shows that this process was suspended; answers may be queued."""


class Unanswered:
    """Nodes with unanswered requests, each with the time of the first of these.

    A node may be silent for ``patience_ns``. The time between two new sessions is at least twice
    that, and doubles each time. ``alive`` are the nodes with a liveliness token.
    """

    def __init__(self, patience_ns: int) -> None:
        self.alive: set[str] = set()
        self._patience_ns = patience_ns
        self._since: dict[str, int] = {}
        self._gap_ns = patience_ns
        self._found_ns: int | None = None
        self._looked_ns: int | None = None

    def asked(self, now_ns: int, node: str) -> None:
        """Note a clock request to a node."""
        self._since.setdefault(node, now_ns)

    def answered(self, node: str) -> None:
        """Note a node's answer to a clock request."""
        self._since.pop(node, None)

    def gone(self, now_ns: int, heard_ns: Mapping[str, int]) -> list[str]:
        """Return nodes with neither a liveliness token nor a message within ``patience_ns``.

        heard_ns  when each node was last received
        """
        before_ns = now_ns - self._patience_ns
        return [n for n, at_ns in heard_ns.items() if n not in self.alive and at_ns < before_ns]

    def unresponsive(self, now_ns: int, heard_ns: Mapping[str, int]) -> list[str]:
        """Return nodes that are present but have not answered for too long; then restart all waits.

        A node is present if it has a liveliness token, or sent a message within half the patience.
        """
        if self._looked_ns is not None and now_ns - self._looked_ns > BLOCKED_NS:
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
        passed_ns = RESET_NS if self._found_ns is None else now_ns - self._found_ns
        if passed_ns >= RESET_NS:
            self._gap_ns = self._patience_ns
        if passed_ns < self._gap_ns:
            return False
        self._found_ns = now_ns
        self._gap_ns = min(2 * self._gap_ns, SESSION_INTERVAL_MAX_NS)
        return True
