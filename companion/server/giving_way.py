"""Pauses of a thread that computes an answer, for the event loop and the beams of an update.

All threads share one interpreter, and the beams need it some hundred times for each update, as does
the event loop for each thing that it does. Beside a thread that computes an answer, each time takes
a millisecond. So an answer is computed in turns, and while beams are computed not at all.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from typing import Final, TypeVar

TURN_S: Final = 0.002  # time of the processor after which a thread pauses
TURN_PAUSE_S: Final = 0.002
OVERLOADED: Final = 4  # multiple of that pause while the links need more of the time
PAUSE_S: Final = 0.001
PAUSES_MAX: Final = 500  # pauses of one answer, which is computed beside the beams after that

T = TypeVar("T")


class GivingWay:
    """Pauses of one answer.

    is_busy        says whether beams are being computed
    is_overloaded  whether the links need more of the time
    """

    def __init__(self, is_busy: Callable[[], bool], *, is_overloaded: bool = False) -> None:
        self._is_busy = is_busy
        self._turn_pause_s = TURN_PAUSE_S * (OVERLOADED if is_overloaded else 1)
        self._left = PAUSES_MAX
        self._turn_ends_s = 0.0

    def pause(self) -> None:
        """Wait at the end of a turn, and until no beams are computed.

        The latter at most ``PAUSES_MAX`` times for this answer.
        """
        if time.thread_time() >= self._turn_ends_s:
            time.sleep(self._turn_pause_s)
            self._turn_ends_s = time.thread_time() + TURN_S
        while self._left and self._is_busy():
            self._left -= 1
            time.sleep(PAUSE_S)

    def between(self, items: Iterable[T]) -> Iterator[T]:
        """Yield items, with pauses between them."""
        for item in items:
            yield item
            self.pause()


class _Never(GivingWay):
    """No pauses, for answers that are computed at once, on the event loop."""

    def __init__(self) -> None:
        super().__init__(lambda: False)

    def pause(self) -> None:
        """Continue."""


NEVER: Final = _Never()
