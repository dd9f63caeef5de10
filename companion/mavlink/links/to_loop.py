"""From threads to the event loop: one queue, one wake-up for all that waits in it.       [shell]"""

import asyncio
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final

QUEUE_MAX: Final = 20_000
"""Calls that may wait for the loop; what comes beyond is dropped and counted."""
SLICE_S: Final = 0.003  # time slice, after which other work of the event loop runs


class ToLoop:
    """Calls that threads want made on the loop, in order, until ``end`` or until one fails.

    handed_over  calls made
    dropped      calls that found ``QUEUE_MAX`` waiting
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.handed_over = 0
        self.dropped = 0
        self._loop = loop
        self._lock = threading.Lock()
        self._waiting: deque[Callable[[], None]] = deque()
        self._is_woken = False
        self._is_over = False
        self._fault: asyncio.Future[None] = loop.create_future()

    def post(self, call: Callable[[], None]) -> None:
        """Have a call made on the loop; from any thread."""
        with self._lock:
            if self._is_over:
                return
            if len(self._waiting) >= QUEUE_MAX:
                self.dropped += 1
                return
            self._waiting.append(call)
            if self._is_woken:
                return
            self._is_woken = True
        try:
            self._loop.call_soon_threadsafe(self._hand_over)
        except RuntimeError:  # the loop has ended, and with it whoever would listen
            self.end()

    def fail(self, fault: Exception) -> None:
        """End, on the loop, by a defect of a call, which must not vanish: ``run`` raises it."""
        self.end()
        if not self._fault.done():
            self._fault.set_exception(fault)

    def end(self) -> None:
        """Make no further call; from any thread."""
        with self._lock:
            self._is_over = True
            self._waiting.clear()

    async def run(self) -> None:
        """Wait until cancelled; raises what a call raised."""
        await asyncio.shield(self._fault)

    def _hand_over(self) -> None:
        until_s = time.monotonic() + SLICE_S
        while time.monotonic() < until_s:
            with self._lock:
                if not self._waiting:
                    self._is_woken = False
                    return
                call = self._waiting.popleft()
            try:
                call()
            except Exception as fault:
                self.fail(fault)
                return
            self.handed_over += 1
        self._loop.call_soon(self._hand_over)
