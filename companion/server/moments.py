"""Answers about beams, made once for all who ask for the same moment.

Moments are ``EVERY_NS`` apart. Who asks between two of them is answered for the next one: beams are
never for a time that has passed, and at most that much later than asked for. On the event loop UAVs
are predicted, as all is known there; the rest is done in a work slot off it.
"""

import asyncio
import threading
from collections.abc import Callable, Hashable
from typing import Any, Final, TypeVar

from companion.server.work_slots import WorkSlots
from companion.values import Update
from companion.views.state import Node

EVERY_NS: Final = 10_000_000  # time between two moments

T = TypeVar("T")


class Moments:
    """What was made for the present moment. One for a node, used on its event loop."""

    def __init__(self, node: Node, work_slots: WorkSlots) -> None:
        self._node = node
        self._work_slots = work_slots
        self._moment = 0
        self._looks: dict[float, Callable[[], Update]] = {}
        self._answers: dict[tuple[float, Hashable], asyncio.Task[Any]] = {}

    async def made(self, lead_ms: float, what: Hashable, make: Callable[[Update], T]) -> T:
        """``make`` of the beams that are applied ``lead_ms`` from the moment, on another thread.

        Unless it was made before: ``what`` names it among all that is made of the same beams.
        Raises what ``make`` raises, and ``HTTPException`` 503 where too many ask for different
        things.
        """
        now_ns = self._node.now_ns()
        moment = -(-now_ns // EVERY_NS)
        if moment != self._moment:
            self._moment = moment
            self._looks.clear()
            self._answers.clear()
        task = self._answers.get((lead_ms, what))
        if task is None:
            self._work_slots.refuse_if_full()  # before anything is predicted
            look = self._look(now_ns, moment * EVERY_NS - now_ns, lead_ms)
            task = asyncio.create_task(self._work_slots.run(lambda: make(look())))
            task.add_done_callback(_seen)
            self._answers[lead_ms, what] = task
        found: T = await asyncio.shield(task)  # one who leaves does not take it from the others
        return found

    def _look(self, now_ns: int, until_ns: int, lead_ms: float) -> Callable[[], Update]:
        """What makes the beams that are applied ``lead_ms`` from the moment, once for all."""
        found = self._looks.get(lead_ms)
        if found is None:
            lead_s = until_ns * 1e-9 + lead_ms * 1e-3
            found = self._looks[lead_ms] = _once(self._node.pipeline.sighted(now_ns, lead_s))
        return found


def _once(make: Callable[[], T]) -> Callable[[], T]:
    """What ``make`` makes, for whichever thread asks first; the others wait and have it too."""
    lock, made = threading.Lock(), list[T]()

    def found() -> T:
        with lock:
            if not made:
                made.append(make())
            return made[0]

    return found


def _seen(task: asyncio.Task[Any]) -> None:
    """Look at an error that all who asked have left, so that nothing warns of it."""
    if not task.cancelled():
        task.exception()
