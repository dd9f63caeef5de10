"""Counts of what was received and not used, by sender and reason."""

from collections import Counter, OrderedDict, deque
from dataclasses import dataclass, field
from typing import Final

from companion.values import Reason, Rejection

RECENT: Final = 8
"""Recent rejections kept per sender."""
SENDERS_MAX: Final = 4096
"""Senders remembered; beyond it the one heard longest ago is forgotten.

A flood of made-up addresses must not fill the memory.
"""


@dataclass(slots=True)
class OfSender:
    """Rejections of one sender (a UAV, a component or a link): counts by reason, and the newest."""

    counts: Counter[Reason] = field(default_factory=Counter)
    recent: deque[Rejection] = field(default_factory=lambda: deque(maxlen=RECENT))


class Refusals:
    """Counts rejections. ``total`` includes those of senders that were forgotten."""

    def __init__(self) -> None:
        self.total: Counter[Reason] = Counter()
        self._senders: OrderedDict[str, OfSender] = OrderedDict()

    def add(self, refused: Rejection) -> None:
        """Count one rejection."""
        self.total[refused.reason] += refused.count
        sender = self._senders.get(refused.source)
        if sender is None:
            sender = self._senders.setdefault(refused.source, OfSender())
            if len(self._senders) > SENDERS_MAX:
                self._senders.popitem(last=False)
        else:
            self._senders.move_to_end(refused.source)
        sender.counts[refused.reason] += refused.count
        sender.recent.append(refused)

    def of(self, sender: str) -> OfSender:
        """The rejections of one sender; empty for one that is not known."""
        return self._senders.get(sender) or OfSender()

    def senders(self) -> list[str]:
        """Senders with rejections, the one with the newest last."""
        return list(self._senders)
