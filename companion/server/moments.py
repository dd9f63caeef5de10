"""Answers about beams, made once for all who ask for the same moment.

Moments are ``EVERY_NS`` apart. Who asks between two of them is answered for the next one: beams are
never for a time that has passed, and at most that much later than asked for.
"""

import asyncio
from collections.abc import Callable, Hashable
from typing import Any, Final, TypeVar

from companion.server.turns import Turns
from companion.values import Update
from companion.views.state import Node

EVERY_NS: Final = 10_000_000
"""Time between two moments."""

T = TypeVar("T")


class Moments:
    """What was made for the present moment. One for a node, used on its event loop."""

    def __init__(self, node: Node, turns: Turns) -> None:
        self._node = node
        self._turns = turns
        self._moment = 0
        self._updates: dict[float, Update] = {}
        self._answers: dict[tuple[float, Hashable], asyncio.Task[Any]] = {}

    def look(self, lead_ms: float) -> Update:
        """The beams that are applied ``lead_ms`` from the moment."""
        now_ns = self._node.now_ns()
        moment = -(-now_ns // EVERY_NS)
        if moment != self._moment:
            self._moment = moment
            self._updates.clear()
            self._answers.clear()
        found = self._updates.get(lead_ms)
        if found is None:
            lead_s = (moment * EVERY_NS - now_ns) * 1e-9 + lead_ms * 1e-3
            found = self._updates[lead_ms] = self._node.pipeline.look(now_ns, lead_s)
        return found

    async def made(self, lead_ms: float, what: Hashable, make: Callable[[Update], T]) -> T:
        """``make`` of these beams, on another thread unless it was made before.

        ``what`` names it among all that is made of the same beams. Raises what ``make`` raises, and
        ``HTTPException`` 503 where too many ask for different things.
        """
        update = self.look(lead_ms)
        task = self._answers.get((lead_ms, what))
        if task is None:
            task = asyncio.create_task(self._turns.run(lambda: make(update)))
            task.add_done_callback(_seen)
            self._answers[lead_ms, what] = task
        found: T = await asyncio.shield(task)  # one who leaves does not take it from the others
        return found


def _seen(task: asyncio.Task[Any]) -> None:
    """Look at an error that all who asked have left, so that nothing warns of it."""
    if not task.cancelled():
        task.exception()
