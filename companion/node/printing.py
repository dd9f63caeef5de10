"""Lines for the operator, written on a thread: nothing waits for who reads them.

A stopped reader of a pipe, or Ctrl-S on a terminal, makes a write wait for ever. On the event loop
that would stop the beams.
"""

import os
import shutil
import threading
from collections import deque
from typing import Final

from companion.values import printable

STDOUT: Final = 1
STDERR: Final = 2
LAST_S: Final = 1.0  # longest wait at the end for who reads, seconds
WAITING_MAX: Final = 1 << 20  # characters that wait for their reader; lines beyond it are dropped
AT_ONCE: Final = 1 << 16  # characters written at once
CLEAR: Final = "\r\033[K"


class Printer:
    """Writer of lines to a file descriptor, and of a status line below them on a terminal.

    ``require_reader`` raises the error that ended it; what is printed later is discarded.
    ``dropped`` counts lines that found no room. They are reported once there is room again, unless
    the lines ``are_data`` for a program.
    """

    def __init__(self, descriptor: int, *, are_data: bool = False) -> None:
        self.dropped = 0
        self._are_data = are_data
        self._failure: OSError | None = None
        self._descriptor = descriptor
        self._is_terminal = os.isatty(descriptor)
        self._lines = deque[str]()
        self._waiting = 0  # characters of these lines
        self._reported = 0  # dropped lines that were reported
        self._status: str | None = None
        self._is_idle = True
        self._changed = threading.Condition()
        threading.Thread(target=self._run, name="printer", daemon=True).start()

    def line(self, text: str) -> None:
        """Print a line, without the control characters in it."""
        text = f"{CLEAR if self._is_terminal else ''}{printable(text)}\n"
        with self._changed:
            if self._waiting + len(text) > WAITING_MAX:
                self.dropped += 1
                return
            self._lines.append(text)
            self._waiting += len(text)
            self._changed.notify_all()

    def status(self, text: str) -> None:
        """Replace the status line; without a terminal, print nothing."""
        if self._is_terminal:
            with self._changed:
                width = shutil.get_terminal_size().columns - 1  # a wrapped line stays
                self._status = f"{CLEAR}{printable(text)[:width]}"
                self._changed.notify_all()

    def require_reader(self) -> None:
        """Raise the error that ended the output, such as that of a pipe whose reader has ended."""
        if self._failure is not None:
            raise self._failure

    def finish(self) -> None:
        """Remove the status line, and wait until all is written, at most ``LAST_S``."""
        self.status("")
        with self._changed:
            self._changed.wait_for(
                lambda: self._is_idle and not self._lines and self._status is None, LAST_S
            )

    def _run(self) -> None:
        while True:
            data = self._next().encode()
            try:
                while data and self._failure is None:
                    data = data[os.write(self._descriptor, data) :]
            except OSError as error:
                self._failure = error

    def _next(self) -> str:
        """Wait for something to print, and return it."""
        with self._changed:
            self._is_idle = True
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._lines or self._status is not None)
            self._is_idle = False
            taken = ""
            while self._lines and len(taken) < AT_ONCE:
                taken += self._lines.popleft()
            self._waiting -= len(taken)
            if not self._lines:
                taken += self._lost() + (self._status or "")
                self._status = None
            return taken

    def _lost(self) -> str:
        """Return a line about those that were dropped since the last one; empty without any."""
        lost, self._reported = self.dropped - self._reported, self.dropped
        if not lost or self._are_data:
            return ""
        return f"{lost} lines were not printed: nobody read them\n"
