"""Handling of Ctrl-C: while a command loads, while it runs, and after it has ended."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

IMPORT_TIMEOUT_S = 0.02  # delay before an interrupt that met an import is tried again


@contextmanager
def interrupts_end(name: str) -> Iterator[None]:
    """Context in which Ctrl-C ends the process at once, with one line under this program name.

    An exception raised by the signal could surface inside a package's import, which may turn it
    into another error. Nothing is open yet, so the process can simply end. After the context,
    Ctrl-C has its default action: it ends the interpreter silently.
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
    """Context in which Ctrl-C raises ``KeyboardInterrupt``, delayed until running imports end.

    Commands import modules while they run. A package may turn an exception raised during its import
    into another error, or suppress it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may set signal handlers
        return
    before = signal.signal(signal.SIGINT, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        signal.setitimer(signal.ITIMER_REAL, 0.0)  # the command ended before the retry


def _interrupt(_number: int, at: FrameType | None) -> None:
    if _imports(at):
        signal.signal(signal.SIGALRM, _interrupt)
        signal.setitimer(signal.ITIMER_REAL, IMPORT_TIMEOUT_S)
        return
    raise KeyboardInterrupt


def _imports(at: FrameType | None) -> bool:
    """Return whether this frame or one of its callers belongs to the import machinery."""
    while at is not None:
        if at.f_code.co_filename.startswith("<frozen importlib"):
            return True
        at = at.f_back
    return False
