"""The newest frame of every message from every sender; frames are decoded only on request."""

from collections import OrderedDict
from collections.abc import Iterable
from typing import Final, NamedTuple

from companion.values import Frame, Source

KEPT_MAX: Final = 8192
"""Most frames kept, so that a flood of forged senders cannot exhaust the memory.

Beyond it the least recently received one is dropped.
"""


class Kept(NamedTuple):
    """Newest frame of one message of one sender, the number of frames, and the first arrival."""

    frame: Frame
    first_ns: int
    counter: int = 1

    @property
    def frequency_hz(self) -> float | None:
        """Mean rate of the message; None after a single one."""
        passed_ns = self.frame.t_ns - self.first_ns
        return (self.counter - 1) / (passed_ns * 1e-9) if passed_ns > 0 else None


class LastMessages:
    """Newest frames by sender and message id. ``add`` is called for every frame."""

    def __init__(self, most: int = KEPT_MAX) -> None:
        self._most = most
        self._kept: OrderedDict[tuple[Source, int], Kept] = OrderedDict()

    def add(self, frame: Frame) -> None:
        """Store a frame in place of the sender's previous frame of that message."""
        key = frame.source, frame.msgid
        kept = self._kept.get(key)
        if kept is not None:
            self._kept[key] = Kept(frame, kept.first_ns, kept.counter + 1)
            self._kept.move_to_end(key)
            return
        self._kept[key] = Kept(frame, frame.t_ns)
        if len(self._kept) > self._most:
            self._kept.popitem(last=False)

    def find(self, source: Source, msgid: int) -> Kept | None:
        """Return the newest message of a kind from a sender; None if none was received."""
        return self._kept.get((source, msgid))

    def all(self) -> list[Kept]:
        """Return all frames, for any thread."""
        return list(self._kept.values())


def by_sender(kept: Iterable[Kept]) -> dict[Source, list[Kept]]:
    """Return frames by sender, ordered by sender and message id."""
    found: dict[Source, list[Kept]] = {}
    for one in sorted(kept, key=lambda one: (one.frame.source, one.frame.msgid)):
        found.setdefault(one.frame.source, []).append(one)
    return found
