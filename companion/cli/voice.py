"""How ``run`` and ``demo`` speak: lines, the last of them alive on a terminal; or JSON."""

import json

import click

from companion.cli.console import Progress, say
from companion.node.service import Service
from companion.views import glance


class Lines:
    """What happened as lines on stderr, and under them, on a terminal alone, how it goes."""

    def __init__(self) -> None:
        self._progress = Progress()

    def say(self, text: str) -> None:
        """Print a line above the one that is alive."""
        self._progress.clear()
        say(text, err=True)

    def serves(self, text: str) -> None:
        """Print a line on stdout."""
        self._progress.clear()
        say(text)

    def show(self, service: Service) -> None:
        """Renew the line that is alive."""
        self._progress.show(glance.line(service))


class JsonLines:
    """An object a second on stdout: how it goes, and the events since the last. Words on stderr."""

    def __init__(self) -> None:
        self._seen_ns = 0

    def say(self, text: str) -> None:
        """Print a line on stderr."""
        say(text, err=True)

    def serves(self, text: str) -> None:
        """Print a line on stderr."""
        say(text, err=True)

    def show(self, service: Service) -> None:
        """Print the object."""
        fresh = [notice for notice in service.events() if notice.t_ns > self._seen_ns]
        self._seen_ns = max([self._seen_ns, *(notice.t_ns for notice in fresh)])
        click.echo(
            json.dumps(glance.glance(service) | {"events": glance.as_events(service, fresh)})
        )
