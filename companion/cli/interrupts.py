"""What Ctrl-C does to a command: while it loads, while it runs, and once it has ended."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

IMPORTED_BY_S = 0.02  # how soon an interrupt that met an import asks again


@contextmanager
def interrupts_end(name: str) -> Iterator[None]:
    """Context in which Ctrl-C ends the process at once, with one line under this name.

    An exception raised by the signal would surface in the middle of some package's import, and come
    out as whatever that package makes of it. While nothing is open yet, the process simply ends.
    After the context all is said: Ctrl-C ends what is left of the interpreter without a word.
    """

    def end(_number: int, _frame: object) -> None:
        os.write(2, f"{name}: interrupted\n".encode())
        os._exit(130)

    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def interrupts_raised() -> Iterator[None]:
    """Context in which Ctrl-C raises ``KeyboardInterrupt``; outside of imports, which end first.

    Commands load what they need when they run. Raised in an import, it would come out as whatever
    the package makes of it: another error, or none.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # signals are not its own
        return
    before = signal.signal(signal.SIGINT, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        signal.setitimer(signal.ITIMER_REAL, 0.0)  # the command ended first


def _interrupt(_number: int, at: FrameType | None) -> None:
    if _imports(at):
        signal.signal(signal.SIGALRM, _interrupt)
        signal.setitimer(signal.ITIMER_REAL, IMPORTED_BY_S)
        return
    raise KeyboardInterrupt


def _imports(at: FrameType | None) -> bool:
    """Whether this frame, or one that called it, is the machinery of imports."""
    while at is not None:
        if at.f_code.co_filename.startswith("<frozen importlib"):
            return True
        at = at.f_back
    return False
