"""Answers about beams, computed once for all clients that request the same moment.

Moments are ``EVERY_NS`` apart. A request between two of them is answered for the next one: beams
are never for a past time. An answer that waits for a work slot is for the moment at which it gets
one, and shared by all who request it until then. UAVs are predicted on the event loop, where the
state is consistent; the rest is computed in the slot, off the loop.
"""

import asyncio
import threading
from collections.abc import Callable, Hashable
from typing import Any, Final, TypeVar

from companion.server.shared_work import seen
from companion.server.threads import in_thread
from companion.server.work_slots import WorkSlots
from companion.values import Update
from companion.views.state import Node

EVERY_NS: Final = 10_000_000  # time between two moments

T = TypeVar("T")


def moment_of(now_ns: int) -> int:
    """Return the number of the next moment."""
    return -(-now_ns // EVERY_NS)


class Moments:
    """Answers of one node for the current moment, used on its event loop."""

    def __init__(self, node: Node, work_slots: WorkSlots) -> None:
        self._node = node
        self._work_slots = work_slots
        self._moment = 0
        self._reads: dict[float, Callable[[], Update]] = {}
        self._answers: dict[tuple[float, Hashable], asyncio.Task[Any]] = {}
        self._waiting: dict[tuple[float, Hashable], asyncio.Task[Any]] = {}  # for a work slot

    async def made(
        self, lead_ms: float, what: Hashable, make: Callable[[Update], T], *, is_usual: bool = False
    ) -> T:
        """Return ``make`` of the beams for ``lead_ms`` after the moment, computed on a thread.

        ``what`` identifies the answer among those made from the same beams; an existing one is
        reused. ``is_usual``: one of a few answers, which at a lead of 0 do not wait for others.
        Raises what ``make`` raises, and ``HTTPException`` 503 if the work slots are full.
        """
        self._begin_moment()
        key = lead_ms, what
        task = self._answers.get(key) or self._waiting.get(key)
        if task is None:
            is_shared = is_usual and lead_ms == 0
            self._work_slots.refuse_if_full(is_shared=is_shared)
            task = asyncio.create_task(self._work(lead_ms, what, make, is_shared=is_shared))
            task.add_done_callback(seen)
            self._waiting[key] = task
        try:
            return await asyncio.shield(task)  # a client that leaves must not cancel it for others
        finally:
            del task  # see ``SharedWork.run``

    def _begin_moment(self) -> int:
        """Return the time of the node; forget the answers for a moment that has passed."""
        now_ns = self._node.now_ns()
        moment = moment_of(now_ns)
        if moment != self._moment:
            self._moment = moment
            self._reads.clear()
            self._answers.clear()
        return now_ns

    async def _work(
        self, lead_ms: float, what: Hashable, make: Callable[[Update], T], *, is_shared: bool
    ) -> T:
        key = lead_ms, what
        try:
            async with self._work_slots.slot(is_shared=is_shared):
                now_ns = self._begin_moment()
                self._answers[key] = self._waiting.pop(key)
                look = self._read(now_ns, lead_ms)
                return await in_thread(lambda: make(look()))
        finally:  # of a refusal; later requests may wait under the same key meanwhile
            if self._waiting.get(key) is asyncio.current_task():
                del self._waiting[key]

    def _read(self, now_ns: int, lead_ms: float) -> Callable[[], Update]:
        """Return the function that computes the beams for ``lead_ms``, shared by all answers."""
        until_ns = self._moment * EVERY_NS - now_ns
        found = self._reads.get(lead_ms)
        if found is None:
            lead_s = until_ns * 1e-9 + lead_ms * 1e-3
            found = self._reads[lead_ms] = _memoised(
                self._node.pipeline.prepare_update(now_ns, lead_s)
            )
        return found


def _memoised(make: Callable[[], T]) -> Callable[[], T]:
    """Return a function that calls ``make`` on the first calling thread; others wait for its
    result."""
    lock, made = threading.Lock(), list[T]()

    def found() -> T:
        with lock:
            if not made:
                made.append(make())
            return made[0]

    return found
