"""Pauses of a thread that computes an answer, while another computes the beams of an update.

All threads share one interpreter, and the beams need it some hundred times for each update. Beside
a thread that computes an answer, each time takes a millisecond.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from typing import Final, TypeVar

PAUSE_S: Final = 0.001
PAUSES_MAX: Final = 500  # pauses of one answer, which is computed beside the beams after that

T = TypeVar("T")


class GivingWay:
    """Pauses of one answer. ``is_busy`` says whether beams are being computed."""

    def __init__(self, is_busy: Callable[[], bool]) -> None:
        self._is_busy = is_busy
        self._left = PAUSES_MAX

    def pause(self) -> None:
        """Wait until no beams are computed; at most ``PAUSES_MAX`` times for this answer."""
        while self._left and self._is_busy():
            self._left -= 1
            time.sleep(PAUSE_S)

    def between(self, items: Iterable[T]) -> Iterator[T]:
        """Yield items, with pauses between them."""
        for item in items:
            yield item
            self.pause()


NEVER: Final = GivingWay(lambda: False)
"""For answers that are computed at once, on the event loop."""
