"""Signals that end a process, held back while a handler cannot be called."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

_IS_DETACHED: Final = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN  # by nohup
ENDS: Final = (signal.SIGINT, signal.SIGTERM, *(() if _IS_DETACHED else (signal.SIGHUP,)))
"""Signals that end a command; SIGHUP: its terminal was closed, or its SSH connection."""
LAST_S: Final = 1.0  # longest wait at the end until the last line is read, seconds
HELD: Final = (*ENDS, signal.SIGALRM)
"""The alarm is a postponed interrupt (``companion.cli.interrupts``)."""


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Context in which the signals of ``ENDS`` wait, also in processes started in it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, HELD)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def release_interrupts() -> None:
    """Deliver the signals that waited."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, HELD)
