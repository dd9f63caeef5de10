"""Threads for work off the event loop, which end with the process.

Threads of the framework (anyio) stay for ever if they are started while the service ends, as by
work that no request awaits any more. Those of an executor are ended by the interpreter.
"""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final, ParamSpec, TypeVar

THREADS: Final = 8  # most calls at once; computing ones are limited by ``WorkSlots``
FILE_THREADS: Final = 4  # most reads of files and folders at once, beside those calls

P = ParamSpec("P")
T = TypeVar("T")
_POOL: Final = ThreadPoolExecutor(THREADS, "answers")
_FILES: Final = ThreadPoolExecutor(FILE_THREADS, "files")


async def in_thread(work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a function on a thread; return what it returns, or raise what it raises."""
    return await asyncio.get_running_loop().run_in_executor(_POOL, lambda: work(*args, **kwargs))


async def in_file_thread(work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a function that waits for the disk, so that other answers do not wait for it."""
    return await asyncio.get_running_loop().run_in_executor(_FILES, lambda: work(*args, **kwargs))
