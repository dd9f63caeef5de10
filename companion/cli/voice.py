"""Output of the commands ``run`` and ``demo``: notices and a status line, or JSON.

A service does not end because nobody can read its notices: its terminal was closed, or the disk of
its log file is full. The page shows them too. JSON is a program's input: without it, it ends.
"""

import json
from contextlib import suppress

import click

from companion.cli.console import Progress, say, say_if_heard
from companion.node.service import Service
from companion.views import glance


class Lines:
    """Writer of notices as lines on stderr; on a terminal, with a status line below them."""

    def __init__(self) -> None:
        self._progress = Progress()

    def say(self, text: str) -> None:
        """Print a line above the status line."""
        self._clear()
        say_if_heard(text)

    def serves(self, text: str) -> None:
        """Print a line on stdout, such as the address of the page."""
        self._clear()
        say(text)

    def show(self, service: Service) -> None:
        """Refresh the status line on the terminal."""
        with suppress(OSError):
            self._progress.show(glance.line(service))

    def _clear(self) -> None:
        with suppress(OSError):
            self._progress.clear()


class JsonLines:
    """Writer of one JSON object a second on stdout: the status, and the new events."""

    def __init__(self) -> None:
        self._seen_ns = 0

    def say(self, text: str) -> None:
        """Print a line for the operator on stderr."""
        say_if_heard(text)

    def serves(self, text: str) -> None:
        """Print the address or recording on stderr."""
        say(text, err=True)

    def show(self, service: Service) -> None:
        """Print the status as a JSON object."""
        fresh = [notice for notice in service.events() if notice.t_ns > self._seen_ns]
        self._seen_ns = max([self._seen_ns, *(notice.t_ns for notice in fresh)])
        click.echo(
            json.dumps(glance.glance(service) | {"events": glance.as_events(service, fresh)})
        )
