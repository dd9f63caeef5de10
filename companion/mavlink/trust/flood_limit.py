"""Limit of a sender that floods: to messages that matter, and to ``LIMITED_PER_S`` of these.

A vehicle whose log is downloaded floods too: its positions are still used, so that it keeps its
beam. Who floods in its own name takes no more time than a vehicle.
"""

from typing import Final

from companion.values.budget import Budget

LIMITED_NS: Final = 10_000_000_000  # time for which a sender that floods is limited
LIMITED_PER_S: Final = 100.0  # frames a second of a limited sender
FLOOD_PER_S: Final = 1000.0  # frames a second, dropped meanwhile, above which it stays limited


class FloodLimit:
    """Limit of a sender that floods; it lasts while the flood does."""

    def __init__(self, now_ns: int) -> None:
        self._until_ns = now_ns + LIMITED_NS
        self._frames = Budget(per_s=LIMITED_PER_S, most=LIMITED_PER_S / 4)
        self._dropped = 0  # since it was last extended

    def holds(self, now_ns: int) -> bool:
        """Return whether the limit holds."""
        if now_ns >= self._until_ns and self._dropped >= FLOOD_PER_S * LIMITED_NS * 1e-9:
            self._until_ns, self._dropped = now_ns + LIMITED_NS, 0
        return now_ns < self._until_ns

    def admits(self, now_ns: int, *, matters: bool) -> bool:
        """Return whether a frame is within the limit, while that holds."""
        is_admitted = matters and self._frames.spend(1, now_ns * 1e-9)
        self._dropped += not is_admitted
        return is_admitted

    def is_used_up(self, now_ns: int) -> bool:
        """Return whether the next frame would be dropped."""
        return not self._frames.has(1, now_ns * 1e-9)
