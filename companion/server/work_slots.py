"""Slots for work off the event loop: a few requests run at once, some wait, the rest fail."""

import asyncio
import contextlib
import heapq
import time
from collections.abc import AsyncIterator, Callable
from typing import Final, TypeVar

from starlette.exceptions import HTTPException

from companion.server.threads import in_thread

AT_ONCE: Final = 2
"""Number of requests that compute at once; each takes interpreter time from the links."""
REST: Final = 3.0
"""Time for which a slot stays empty after work, as a multiple of the work's time.

All threads share one interpreter. Beside threads that compute without a pause, each call of the
event loop to the system waits a millisecond for it, so that few frames are read.
"""
REST_SHARED: Final = 1.0  # the same after work whose answer all clients get, without overload
REST_MAX_S: Final = 1.0  # longest rest: answers about thousands of UAVs follow one another
OVERLOADED_REST_MAX_S: Final = 5.0  # the same while the links need more of the time
RESTS_FROM_S: Final = 0.02  # shorter work needs no rest: a few UAVs take some milliseconds
WAITING: Final = 64  # requests that wait for a slot; one second of work
SHARED_WAITING: Final = 16  # answers for all that wait for the slot of their own

T = TypeVar("T")


class _Slots:
    """Slots of one kind, and the room for requests that wait for them.

    A slot that rests is given to the next request, which waits until the rest is over.
    """

    def __init__(self, at_once: int, waiting: int = 0) -> None:
        self.room = at_once + waiting
        self._free = asyncio.Semaphore(at_once)
        self._rested_s = [0.0] * at_once  # when each free slot has rested, a heap

    async def acquire(self) -> None:
        """Wait until a slot is free and has rested, and take it."""
        await self._free.acquire()
        rested_s = heapq.heappop(self._rested_s)
        try:
            await asyncio.sleep(max(0.0, rested_s - time.monotonic()))
        except BaseException:
            self._give_back(rested_s)
            raise

    def release(self, rest_s: float = 0.0) -> None:
        """Return a slot, which rests."""
        self._give_back(time.monotonic() + rest_s)

    def _give_back(self, rested_s: float) -> None:
        heapq.heappush(self._rested_s, rested_s)
        self._free.release()


class WorkSlots:
    """Work slots of one node. A request beyond the queue is rejected with status 503.

    ``running`` is the number of requests that compute now; ``is_overloaded`` says whether the links
    need more of the time.
    """

    def __init__(self, at_once: int = AT_ONCE, waiting: int = WAITING) -> None:
        self.running = 0
        self.is_overloaded: Callable[[], bool] = lambda: False
        self._usual = _Slots(at_once, waiting)
        self._shared = _Slots(1, SHARED_WAITING - 1)
        self._no_long = _Slots(1)

    def refuse_if_full(self, *, is_shared: bool = False) -> None:
        """Raise ``HTTPException`` 503 if the queue of waiting requests is full."""
        if self._usual.room == 0 and not (is_shared and self._shared.room):
            raise HTTPException(503, "too many requests at once", {"retry-after": "1"})

    @contextlib.asynccontextmanager
    async def slot(self, *, is_long: bool = False, is_shared: bool = False) -> AsyncIterator[None]:
        """Hold a slot, as soon as one is free. Raises ``HTTPException`` 503.

        Long work holds one slot at a time, so that the other one is left for short work. Shared
        work, whose answer all clients get, has a slot of its own.
        """
        self.refuse_if_full(is_shared=is_shared)
        slots = self._shared if is_shared and self._shared.room else self._usual
        slots.room -= 1
        held, rest_s = list[_Slots](), 0.0
        try:
            for one in [self._no_long, slots] if is_long else [slots]:
                await one.acquire()
                held.append(one)
            self.running += 1
            began_s = time.monotonic()
            try:
                yield
            finally:
                self.running -= 1
                worked_s = time.monotonic() - began_s
                if worked_s >= RESTS_FROM_S:
                    rest_s = self._rest_s(worked_s, is_shared=slots is self._shared)
        finally:
            for one in held:
                one.release(rest_s)
            slots.room += 1

    def _rest_s(self, worked_s: float, *, is_shared: bool) -> float:
        if self.is_overloaded():
            return min(OVERLOADED_REST_MAX_S, REST * worked_s)
        return min(REST_MAX_S, (REST_SHARED if is_shared else REST) * worked_s)

    async def run(self, work: Callable[[], T], *, is_shared: bool = False) -> T:
        """Run work on another thread when a slot is free. Raises ``HTTPException`` 503."""
        async with self.slot(is_shared=is_shared):
            return await in_thread(work)
