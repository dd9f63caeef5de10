"""Calls that block, on threads that the end of the service does not wait for."""

import asyncio
import contextlib
import threading
from collections.abc import Callable
from functools import partial
from typing import Final, TypeVar

T = TypeVar("T")

CLOSE_MAX_S: Final = 1.0  # longest wait for a server or session that is closed, seconds
THREAD_RETRY_S: Final = 0.5  # time until a thread that could not be started is tried again


async def in_daemon_thread(work: Callable[[], T], *, at_once: bool = False) -> T:
    """Run a function on a daemon thread, which the shutdown of the service does not wait for.

    The function must tolerate being cut off at any point. While the system allows no more threads,
    the call waits until it does; with ``at_once``, the function runs on the event loop instead.
    """
    loop = asyncio.get_running_loop()
    done: asyncio.Future[T] = loop.create_future()

    def run() -> None:
        try:
            settle = partial(done.set_result, work())
        except Exception as error:
            settle = partial(done.set_exception, error)
        with contextlib.suppress(RuntimeError):  # the loop is closed: no caller is waiting
            loop.call_soon_threadsafe(lambda: None if done.done() else settle())

    while True:
        try:
            threading.Thread(target=run, name="background", daemon=True).start()
        except RuntimeError:  # the system allows no more threads now
            if at_once:
                return work()
            await asyncio.sleep(THREAD_RETRY_S)
        else:
            return await done


async def close_within(close: Callable[[], None], most_s: float = CLOSE_MAX_S) -> None:
    """Call ``close`` on a daemon thread, and wait until it returns, at most ``most_s`` seconds.

    A package's server may wait for its clients when it is closed: for ever, if one sends nothing.
    """
    closing = asyncio.create_task(in_daemon_thread(close, at_once=True))
    done, _ = await asyncio.wait([closing], timeout=most_s)
    closing.cancel()
    for task in done:
        task.result()
