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
    """

    def __init__(self, descriptor: int) -> None:
        self._failure: OSError | None = None
        self._descriptor = descriptor
        self._is_terminal = os.isatty(descriptor)
        self._lines = deque[str]()
        self._waiting = self._dropped = 0
        self._status: str | None = None
        self._is_idle = True
        self._changed = threading.Condition()
        threading.Thread(target=self._run, name="printer", daemon=True).start()

    def line(self, text: str) -> None:
        """Print a line, with control characters escaped."""
        text = f"{CLEAR if self._is_terminal else ''}{printable(text)}\n"
        with self._changed:
            if self._waiting + len(text) > WAITING_MAX:
                self._dropped += 1
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
                while data:
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
            taken = list[str]()
            while self._lines and (not taken or self._waiting_in(taken) < AT_ONCE):
                taken.append(self._lines.popleft())
            self._waiting -= self._waiting_in(taken)
            if self._dropped and not self._lines:
                taken.append(f"{self._dropped} lines were not printed: nobody read them\n")
                self._dropped = 0
            if self._status is not None and not self._lines:
                taken.append(self._status)
                self._status = None
            return "" if self._failure else "".join(taken)

    @staticmethod
    def _waiting_in(taken: list[str]) -> int:
        return sum(map(len, taken))
