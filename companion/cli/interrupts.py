"""Handling of Ctrl-C, SIGTERM and SIGHUP: while a command loads, runs, and after it has ended.

Each ends a command with one line and the exit status ``INTERRUPTED``. A service that runs handles
them itself (``companion.node.serving``), and ends with the status 0.
"""

import atexit
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Final

from companion.node.signals import ENDS, LAST_S

INTERRUPTED: Final = 130  # exit status
RETRY_S: Final = 0.02  # delay before an interrupt that could not be raised is tried again
IMPORTS_S: Final = 3.0
"""Time after which running imports no longer delay an interrupt: a busy machine takes far longer.

What is recorded by then is recovered at the next start, as after SIGKILL.
"""

_has_ended: Final = threading.Event()


def command_ended() -> None:
    """Note that the command ends with a line of its own, so that an interrupt adds no other."""
    _has_ended.set()


@contextmanager
def interrupts_end(name: str) -> Iterator[None]:
    """Context in which an interrupt ends the process at once, with one line under this name.

    An exception raised by the signal could surface inside a package's import, which may turn it
    into another error. Nothing is open yet, so the process can simply end. Signals that the script
    has blocked since its start (``scripts/companion``) are delivered now. After the context the
    same applies, until the command has ended (``command_ended``, or the interpreter is being torn
    down): then an interrupt changes nothing.
    """

    def end(_number: int, _frame: object) -> None:
        if _has_ended.is_set():
            return
        if select.select((), (2,), (), LAST_S)[1]:  # a full pipe would block for ever
            os.write(2, f"{name}: interrupted\n".encode())
        os._exit(INTERRUPTED)

    for number in ENDS:
        signal.signal(number, end)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDS)
    atexit.register(_ignore)
    try:
        yield
    finally:
        for number in ENDS:
            signal.signal(number, end)


@contextmanager
def threads_abandoned() -> Iterator[None]:
    """Context after which the process ends at once, also if other threads still run.

    The interpreter would wait for all non-daemon threads, for ever if they never end: those of a
    device's library, or one that writes to a full pipe (``companion.cli.console.print_last``).
    Functions that were registered with ``atexit`` are then not called.
    """
    try:
        yield
    except SystemExit as end:
        main = threading.main_thread()
        if any(one is not main and not one.daemon for one in threading.enumerate()):
            with suppress(OSError):
                sys.stdout.flush()
            os._exit(end.code if isinstance(end.code, int) else bool(end.code))
        raise


def open_missing_streams() -> None:
    """Open the null device for each standard stream that the caller has closed.

    Otherwise the next file that is opened would take its number, and its place.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))  # noqa: SIM115


def name_process(name: str) -> None:
    """Name this process for ``ps`` and ``top``, which would show the interpreter's name."""
    with suppress(OSError):  # a system without this file
        descriptor = os.open("/proc/self/comm", os.O_WRONLY)
        os.write(descriptor, name.encode())
        os.close(descriptor)


def _ignore() -> None:
    for number in ENDS:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def interrupts_raised() -> Iterator[None]:
    """Context in which an interrupt raises ``KeyboardInterrupt``, once running imports have ended.

    If they take longer than ``IMPORTS_S``, it has the effect that it had outside the context.
    Commands import modules while they run. A package may turn an exception raised during its import
    into another error, or suppress it; so does the interpreter in a finalizer. A second interrupt
    has the effect that it had outside the context.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may set signal handlers
        return
    raised, began_s = False, 0.0

    def interrupt(number: int, at: FrameType | None) -> None:
        nonlocal raised, began_s
        if _imports(at):
            began_s = began_s or time.monotonic()
            if time.monotonic() - began_s > IMPORTS_S and not isinstance(outside, int | None):
                outside(number, at)
            retry()
            return
        if raised and not isinstance(outside, int | None):
            outside(number, at)
        raised = True
        raise KeyboardInterrupt

    def retry() -> None:
        nonlocal raised
        raised = False
        signal.signal(signal.SIGALRM, interrupt)
        signal.setitimer(signal.ITIMER_REAL, RETRY_S)

    def lost(error: "sys.UnraisableHookArgs") -> None:
        if error.exc_type is KeyboardInterrupt:
            retry()
        else:
            unraisable(error)

    unraisable, sys.unraisablehook = sys.unraisablehook, lost
    before = {number: signal.signal(number, interrupt) for number in ENDS}
    outside = before[signal.SIGINT]
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.setitimer(signal.ITIMER_REAL, 0.0)  # the command ended before the retry
        sys.unraisablehook = unraisable


def _imports(at: FrameType | None) -> bool:
    """Return whether this frame or one of its callers belongs to the import machinery."""
    while at is not None:
        if at.f_code.co_filename.startswith("<frozen importlib"):
            return True
        at = at.f_back
    return False
