"""What was received and not used: how much, of whom, and why."""

from collections import Counter, OrderedDict, deque
from dataclasses import dataclass, field
from typing import Final

from companion.values import Reason, Rejection

RECENT: Final = 8
"""Of each sender so many are kept to be shown."""
SENDERS_MAX: Final = 4096
"""A flood of made-up addresses must not fill the memory: the sender heard of longest ago goes."""


@dataclass(slots=True)
class OfSender:
    """What was refused of one sender, a UAV, a component or a link: by reason, and the newest."""

    counts: Counter[Reason] = field(default_factory=Counter)
    recent: deque[Rejection] = field(default_factory=lambda: deque(maxlen=RECENT))


class Refusals:
    """Counts rejections. ``total`` holds all of them, also of senders that were forgotten."""

    def __init__(self) -> None:
        self.total: Counter[Reason] = Counter()
        self._senders: OrderedDict[str, OfSender] = OrderedDict()

    def add(self, refused: Rejection) -> None:
        """Count one."""
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
        """What was refused of a sender; nothing for one that is not known."""
        return self._senders.get(sender) or OfSender()

    def senders(self) -> list[str]:
        """Of whom something was refused, the newest last."""
        return list(self._senders)
