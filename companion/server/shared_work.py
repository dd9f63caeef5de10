"""Work done once for all who ask for it meanwhile."""

import asyncio
from collections.abc import Awaitable, Callable, Hashable
from typing import Any, TypeVar

T = TypeVar("T")


class SharedWork:
    """Work by what it makes, used on one event loop.

    A caller gets the result of work that starts after the call: a running one may already have read
    what has changed since. All who call while it runs share the next one, so that at most one of a
    kind runs and one waits.
    """

    def __init__(self) -> None:
        self._running: dict[Hashable, asyncio.Task[Any]] = {}
        self._next: dict[Hashable, asyncio.Task[Any]] = {}

    async def run(self, what: Hashable, work: Callable[[], Awaitable[T]]) -> T:
        """Return what ``work`` returns, or raise what it raises. ``what`` identifies it."""
        task = self._next.get(what)
        if task is None:
            task = self._next[what] = asyncio.create_task(self._after_the_last(what, work))
            task.add_done_callback(seen)
        try:
            return await asyncio.shield(task)  # a client that leaves must not cancel it for others
        finally:
            del task  # the traceback of its error would keep it, and all that its frames refer to

    async def _after_the_last(self, what: Hashable, work: Callable[[], Awaitable[T]]) -> T:
        last = self._running.get(what)
        if last is not None:
            await asyncio.wait([last])
        self._running[what] = self._next.pop(what)
        try:
            return await work()
        finally:
            del self._running[what]


def seen(task: asyncio.Task[Any]) -> None:
    """Retrieve an error that no client awaits any more, so that asyncio does not warn."""
    if not task.cancelled():
        task.exception()
