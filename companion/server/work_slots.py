"""Slots for work off the event loop: a few requests run at once, some wait, the rest fail."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from typing import Final, TypeVar

from starlette.exceptions import HTTPException

from companion.server.threads import in_thread

AT_ONCE: Final = 2
"""Number of requests that compute at once; each takes interpreter time from the links."""
WAITING: Final = 64  # requests that wait for a slot; one second of work
SHARED_WAITING: Final = 16  # answers for all that wait for the slot of their own

T = TypeVar("T")


class WorkSlots:
    """Work slots of one node. A request beyond the queue is rejected with status 503.

    ``running`` is the number of requests that compute now.
    """

    def __init__(self, at_once: int = AT_ONCE, waiting: int = WAITING) -> None:
        self.running = 0
        self._free = asyncio.Semaphore(at_once)
        self._no_long = asyncio.Semaphore(1)
        self._room = at_once + waiting
        self._shared_free = asyncio.Semaphore(1)
        self._shared_room = SHARED_WAITING

    def refuse_if_full(self, *, is_shared: bool = False) -> None:
        """Raise ``HTTPException`` 503 if the queue of waiting requests is full."""
        if self._room == 0 and not (is_shared and self._shared_room):
            raise HTTPException(503, "too many requests at once", {"retry-after": "1"})

    @contextlib.asynccontextmanager
    async def slot(self, *, is_long: bool = False) -> AsyncIterator[None]:
        """Hold a slot, as soon as one is free. Raises ``HTTPException`` 503.

        Long work holds one slot at a time, so that the other one is left for short work.
        """
        self.refuse_if_full()
        self._room -= 1
        try:
            async with self._no_long if is_long else contextlib.nullcontext(), self._free:
                self.running += 1
                try:
                    yield
                finally:
                    self.running -= 1
        finally:
            self._room += 1

    @contextlib.asynccontextmanager
    async def _shared_slot(self) -> AsyncIterator[None]:
        self._shared_room -= 1
        try:
            async with self._shared_free:
                self.running += 1
                try:
                    yield
                finally:
                    self.running -= 1
        finally:
            self._shared_room += 1

    async def run(self, work: Callable[[], T], *, is_shared: bool = False) -> T:
        """Run work on another thread when a slot is free. Raises ``HTTPException`` 503.

        ``is_shared``: all clients share the answer. It has a slot of its own, so that it does not
        wait for requests whose answers nobody shares.
        """
        async with self._shared_slot() if is_shared and self._shared_room else self.slot():
            return await in_thread(work)
