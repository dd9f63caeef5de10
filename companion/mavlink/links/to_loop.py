"""Calls from threads to the event loop: one queue, with one wake-up for all its entries."""

import asyncio
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final

QUEUE_MAX: Final = 20_000
"""Most calls that may wait for the event loop; more are dropped and counted."""
BYTES_MAX: Final = 64 << 20
"""Most bytes that the waiting calls may hold; calls beyond it are dropped and counted."""
SLICE_S: Final = 0.001  # time slice, after which other work of the event loop runs


class ToLoop:
    """Queue of calls from threads, run on the event loop in order until ``end`` or a failure.

    handed_over  calls made
    dropped      calls that found ``QUEUE_MAX`` waiting, or no room for their bytes
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.handed_over = 0
        self.dropped = 0
        self._loop = loop
        self._lock = threading.Lock()
        self._waiting: deque[tuple[Callable[[], object], int]] = deque()
        self._bytes = 0
        self._is_woken = False
        self._is_over = False
        self._fault: asyncio.Future[None] = loop.create_future()

    def post(self, call: Callable[[], object], size: int = 0) -> None:
        """Queue a call for the event loop, which holds this many bytes; on any thread.

        A call that returns True is made again, before all others.
        """
        with self._lock:
            if self._is_over:
                return
            if len(self._waiting) >= QUEUE_MAX or self._bytes + size > BYTES_MAX:
                self.dropped += 1
                return
            self._waiting.append((call, size))
            self._bytes += size
            if self._is_woken:
                return
            self._is_woken = True
        try:
            self._loop.call_soon_threadsafe(self._hand_over)
        except RuntimeError:  # the loop is closed
            self.end()

    def fail(self, fault: Exception) -> None:
        """Stop on the event loop after a call failed; ``run`` raises its exception."""
        self.end()
        if not self._fault.done():
            self._fault.set_exception(fault)

    def end(self) -> None:
        """Make no further call; may be called on any thread."""
        with self._lock:
            self._is_over = True
            self._waiting.clear()
            self._bytes = 0

    async def run(self) -> None:
        """Wait until cancelled; raise the exception of a failed call."""
        await asyncio.shield(self._fault)

    def _hand_over(self) -> None:
        until_s = time.monotonic() + SLICE_S
        while time.monotonic() < until_s:
            with self._lock:
                if not self._waiting:
                    self._is_woken = False
                    return
                call, size = self._waiting[0]
            try:
                has_more = call() is True
            except Exception as fault:
                self.fail(fault)
                return
            if has_more:
                continue
            self.handed_over += 1
            with self._lock:
                if self._waiting:  # not ended by the call
                    self._waiting.popleft()
                    self._bytes -= size
        self._loop.call_soon(self._hand_over)
