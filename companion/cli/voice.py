"""Output of the commands ``run`` and ``demo``: notices and a status line, or JSON.

A service does not end because nobody can read its notices: its terminal was closed, or the disk of
its log file is full. The page shows them too. JSON is a program's input: a service whose reader
has ended ends too.
"""

import json

from companion.node.printing import STDERR, STDOUT, Printer
from companion.node.service import Service
from companion.views import glance


class Lines:
    """Writer of notices as lines on stderr; on a terminal, with a status line below them."""

    def __init__(self) -> None:
        self._printer, self._results = Printer(STDERR), Printer(STDOUT)

    def say(self, text: str) -> None:
        """Print a line above the status line."""
        self._printer.line(text)

    def serves(self, text: str) -> None:
        """Print the address of the page on stdout; on stderr if that is not possible."""
        self._results.line(text)
        self._results.finish()
        if self._results.has_failed:
            self._printer.line(text)

    def recorded(self, text: str) -> None:
        """Print the recording on stdout."""
        self._printer.finish()
        self._results.line(text)
        self._results.finish()

    def show(self, service: Service) -> None:
        """Refresh the status line on the terminal."""
        self._printer.status(glance.line(service))

    def finish(self) -> None:
        """Wait a moment for the last lines to be read."""
        self._printer.finish()


class JsonLines:
    """Writer of one JSON object a second on stdout: the status, and the new events."""

    def __init__(self) -> None:
        self._seen_ns = 0
        self._printer = Printer(STDERR)
        self._objects = Printer(STDOUT, are_data=True)
        self._has_dropped = False

    def say(self, text: str) -> None:
        """Print a line for the operator on stderr."""
        self._printer.line(text)

    serves = recorded = say

    def show(self, service: Service) -> None:
        """Print the status as a JSON object. Raises ``OSError`` if stdout takes none.

        Objects that nobody reads, or that a full disk does not take, are dropped; stderr says so.
        """
        self._objects.require_output()
        if self._objects.dropped and not self._has_dropped:
            self._has_dropped = True
            self._printer.line(f"some status objects are not printed: {self._objects.why}")
        fresh = [notice for notice in service.events() if notice.t_ns > self._seen_ns]
        self._seen_ns = max([self._seen_ns, *(notice.t_ns for notice in fresh)])
        found = glance.glance(service) | {"events": glance.as_events(service, fresh)}
        self._objects.line(json.dumps(found))

    def finish(self) -> None:
        """Wait a moment for the last lines to be read."""
        self._objects.finish()
        self._printer.finish()
