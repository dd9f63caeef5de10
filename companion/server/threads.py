"""Threads for work off the event loop, which end with the process.

They are daemon threads: those of the framework (anyio) and of an executor are waited for, and a
long answer that no client awaits any more would delay the end of the service.
"""

import asyncio
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Final, ParamSpec, TypeVar

THREADS: Final = 8  # most calls at once; computing ones are limited by ``WorkSlots``
FILE_THREADS: Final = 4  # most reads of files and folders at once, beside those calls

P = ParamSpec("P")
T = TypeVar("T")


class Threads:
    """Up to ``most`` daemon threads, started as they are needed."""

    def __init__(self, most: int, name: str) -> None:
        self._most = most
        self._name = name
        self._calls = queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]]]()
        self._lock = threading.Lock()
        self._started = 0
        self._free = 0  # threads that wait for a call, less the calls that wait for a thread

    def submit(self, work: Callable[[], T]) -> Future[T]:
        """Call a function on one of the threads, in the order of submission."""
        future = Future[T]()
        with self._lock:
            if self._free <= 0 and self._started < self._most:
                self._start()
            self._free -= 1
        self._calls.put((future, work))
        return future

    def _start(self) -> None:
        """Start a thread. If the system allows no more, those that run do its work.

        Raises ``RuntimeError`` if none runs.
        """
        name = f"{self._name}_{self._started + 1}"
        try:
            threading.Thread(target=self._serve, name=name, daemon=True).start()
        except RuntimeError:
            if not self._started:
                raise
        else:
            self._started += 1
            self._free += 1

    def _serve(self) -> None:
        while True:
            self._do(*self._calls.get())

    def _do(self, future: Future[Any], work: Callable[[], Any]) -> None:
        result, error = None, None
        is_wanted = future.set_running_or_notify_cancel()
        if is_wanted:
            try:
                result = work()
            except BaseException as raised:
                error = raised
        with self._lock:
            self._free += 1
        if error is not None:
            future.set_exception(error)
        elif is_wanted:
            future.set_result(result)


_ANSWERS: Final = Threads(THREADS, "answers")
_FILES: Final = Threads(FILE_THREADS, "files")


async def in_thread(work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a function on a thread; return what it returns, or raise what it raises."""
    return await asyncio.wrap_future(_ANSWERS.submit(lambda: work(*args, **kwargs)))


async def in_file_thread(work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a function that waits for the disk, so that other answers do not wait for it."""
    return await asyncio.wrap_future(_FILES.submit(lambda: work(*args, **kwargs)))
