"""Subscriptions to the reports and offers of near nodes only."""

from collections.abc import Callable

from companion.mavlink.links.zenoh_bus import Bus

Take = Callable[[str, bytes], None]


class Listening:
    """Subscriptions to other nodes. ``base`` is the site's key.

    ``heard`` and ``offered`` are called with the key and the payload of a sample.
    """

    def __init__(self, *, bus: Bus, base: str, heard: Take, offered: Take) -> None:
        self._bus = bus
        self._base = base
        self._takes = {"heard": heard, "offers": offered}
        self._ends: dict[str, list[Callable[[], None]]] = {}

    def to(self, nodes: frozenset[str]) -> None:
        """Subscribe to these nodes, and end all other subscriptions."""
        for node in nodes - self._ends.keys():
            self._ends[node] = [
                self._bus.subscribe(f"{self._base}/{node}/{what}", take)
                for what, take in self._takes.items()
            ]
        for node in self._ends.keys() - nodes:
            for end in self._ends.pop(node):
                end()
