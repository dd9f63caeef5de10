"""Lines for the operator, written on a thread: nothing waits for who reads them.

A stopped reader of a pipe, or Ctrl-S on a terminal, makes a write wait for ever. On the event loop
that would stop the beams.
"""

import errno
import io
import os
import select
import shutil
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import Final

from companion.node.signals import LAST_S
from companion.values import printable

STDOUT: Final = 1
STDERR: Final = 2
AFTER_TIMEOUT_S: Final = 0.1  # the same as ``LAST_S`` after one printer has waited in vain
WAITING_MAX: Final = 1 << 20  # characters that wait for their reader; lines beyond it are dropped
AT_ONCE: Final = 1 << 16  # characters written at once
UNREAD: Final = "nobody read them"
CLEAR: Final = "\r\033[K"
NO_READER: Final = (errno.EPIPE, errno.EBADF)  # errors that do not pass


_timed_out: Final = threading.Event()
"""Set once a printer has waited in vain at the end. Several would add up to seconds."""


class Printer:
    """Writer of lines to a file descriptor, and of a status line below them on a terminal.

    ``dropped`` counts the lines that found no room, or that a full disk did not take, for the
    reason ``why``. Their number is printed once lines can be written again, unless the lines
    ``are_data`` for a program. Once the reader has ended, all that is printed is discarded.
    """

    def __init__(self, descriptor: int, *, are_data: bool = False) -> None:
        self.dropped = 0
        self.why = UNREAD
        self._are_data = are_data
        self._failure: OSError | None = None  # error of the last write, if it failed
        self._has_written = False
        self._is_cut = False  # whether a line was written in part
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

    @property
    def has_failed(self) -> bool:
        """Whether the last line could not be written."""
        return self._failure is not None

    def require_output(self) -> None:
        """Raise the error of an output whose reader has ended, or that has never taken a line."""
        if self._failure is not None and (self._has_ended() or not self._has_written):
            raise self._failure

    def finish(self) -> None:
        """Remove the status line, and wait until all is written.

        At most ``LAST_S``; ``AFTER_TIMEOUT_S`` if another printer has already waited in vain.
        """
        self.status("")
        with self._changed:
            is_written = self._changed.wait_for(
                lambda: self._is_idle and not self._lines and self._status is None,
                AFTER_TIMEOUT_S if _timed_out.is_set() else LAST_S,
            )
        if not is_written:
            _timed_out.set()

    def _has_ended(self) -> bool:
        return self._failure is not None and self._failure.errno in NO_READER

    def _run(self) -> None:
        while True:
            text = self._next()
            if not self._has_ended():
                self._write(text, text.count("\n"))
                self._report()

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
                taken += self._status or ""
                self._status = None
            return taken

    def _report(self) -> None:
        """Print how many lines were dropped since the last report, if any can be written."""
        dropped = self.dropped
        if self._lines or self._failure or self._are_data or dropped == self._reported:
            return
        clear = CLEAR if self._is_terminal else ""
        if self._write(f"{clear}lines not printed: {dropped - self._reported} ({self.why})\n"):
            self._reported, self.why = dropped, UNREAD

    def _write(self, text: str, lines: int = 0) -> bool:
        """Write text; return whether all was written. If not, count its lines as dropped."""
        data = f"\n{text}".encode() if self._is_cut else text.encode()
        left = data
        try:
            while left:
                left = self._write_some(left)
            self._failure = None
        except OSError as error:
            self._failure, self.why = error, error.strerror or str(error)
            with self._changed:
                self.dropped += min(lines, left.count(b"\n"))
        if len(left) < len(data):
            self._has_written = True
            self._is_cut = bool(left) and not data[: -len(left)].endswith(b"\n")
        return not left

    def _write_some(self, data: bytes) -> bytes:
        """Write what finds room, or wait for room; return what is left."""
        try:
            return data[os.write(self._descriptor, data) :]
        except BlockingIOError:  # another process, which shares the pipe, set it to non-blocking
            select.select((), (self._descriptor,), ())
            return data


class _LineStream(io.TextIOBase):
    """Text stream whose lines are printed by a ``Printer``, so that a write never blocks."""

    def __init__(self, printer: Printer) -> None:
        self._printer = printer
        self._begun = ""
        self._writing = threading.RLock()  # a signal handler may write during another write

    def write(self, text: str, /) -> int:
        """Print the lines that are complete, and keep the rest for the next call."""
        with self._writing:
            *lines, begun = (self._begun + text).split("\n")
            self._begun = begun[-WAITING_MAX:]
            for line in lines:
                self._printer.line(line)
        return len(text)


@contextmanager
def prints_unblocked() -> Iterator[None]:
    """Context in which ``sys.stdout`` and ``sys.stderr`` are line by line printed on stderr.

    A write then never blocks, and stdout has the command's own lines alone: its JSON. Packages
    write there: logs of the HTTP server and the event loop, and messages of devices' libraries.
    """
    printer = Printer(STDERR)
    lines = _LineStream(printer)
    try:
        with redirect_stderr(lines), redirect_stdout(lines):
            yield
    finally:
        printer.finish()
