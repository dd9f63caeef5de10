"""The same report over several links, or twice over one, counts once.

A report is known by its content: sender, message and payload. The sequence number is no part of
it, since every link has its own. GLOBAL_POSITION_INT carries a boot time, so equal content is the
same report; ADSB_VEHICLE carries none, and a receiver that sends the same content again within
the window has heard nothing new.
"""

from collections import deque
from typing import Final

from companion.values import Frame

WINDOW_NS: Final = 30_000_000_000
"""Longer than any link has been seen to lag behind another."""


class Dedupe:
    """Remembers the reports of the last ``WINDOW_NS``, by content."""

    def __init__(self) -> None:
        self._seen: dict[bytes, int] = {}
        self._order: deque[tuple[int, bytes]] = deque()

    def is_repeat(self, frame: Frame) -> bool:
        """True if the same content came before, within the window."""
        while self._order and self._order[0][0] < frame.t_ns - WINDOW_NS:
            self._forget(*self._order.popleft())
        key = bytes(frame.source) + frame.msgid.to_bytes(3, "little") + frame.payload.rstrip(b"\0")
        repeat = key in self._seen
        if not repeat:
            self._seen[key] = frame.t_ns
            self._order.append((frame.t_ns, key))
        return repeat

    def _forget(self, t_ns: int, key: bytes) -> None:
        if self._seen.get(key) == t_ns:
            del self._seen[key]
