"""How late the messages of a receiver's stream arrive, by the time that each states."""

from typing import Final

OLDEST_NS: Final = 120_000_000_000
"""Greatest delay of a message; a larger step of the stated times is a restart, or a set clock."""
DRIFT: Final = 100e-6
"""Largest drift of the stated times against this clock: ten times that of a good crystal."""


class StreamLateness:
    """Delay of messages beyond the least delayed message of their stream."""

    def __init__(self) -> None:
        self._floor_ns: float | None = None  # least of arrival less stated time
        self._seen_ns = 0

    def observe_ns(self, t_ns: int, stated_ns: float) -> int:
        """Return the delay of a message that arrives at ``t_ns``, by its own time."""
        offset_ns = t_ns - stated_ns
        if self._floor_ns is not None:
            self._floor_ns += max(0, t_ns - self._seen_ns) * DRIFT
        self._seen_ns = t_ns
        if self._floor_ns is None or not 0 <= offset_ns - self._floor_ns <= OLDEST_NS:
            self._floor_ns = offset_ns
        return round(offset_ns - self._floor_ns)
