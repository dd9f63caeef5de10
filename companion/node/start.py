"""Starts and stops the live service from the command line.                               [shell]"""

import asyncio
import os
import socket
import webbrowser
from collections.abc import Callable, Coroutine
from functools import partial
from typing import Any

import click

from companion.node import systemd
from companion.node.service import Service, require_center
from companion.node.serving import address, run_until_told
from companion.server.access import bind
from companion.settings.model import Settings
from companion.values import UserError


def run(
    settings: Settings,
    *,
    token: str | None = None,
    insecure: bool = False,
    traffic: Callable[[str], Coroutine[Any, Any, None]] | None = None,
    seconds: float | None = None,
    open_page: bool = False,
) -> None:
    """Serve until SIGINT, SIGTERM or ``seconds`` have passed; then finish the recording.

        settings   those of the service
        token      bearer token that HTTP asks for; None: none
        insecure   serve beyond this machine without a token
        traffic    coroutine run beside, with the address of the first link
        seconds    how long to run; None: until a signal
        open_page  open the dashboard in a browser

    A service manager that started this process is told how it goes (``companion.node.systemd``).
    Raises ``UserError`` or ``OSError`` where the settings do not allow to start.
    """
    require_center(settings)
    if not settings.links.urls:
        raise UserError("say where MAVLink comes from: --link udpin:0.0.0.0:14550")
    manager = systemd.manager(os.environ)
    http = bind(settings.server.listen, token=token, insecure=insecure)
    with http:
        service = Service(settings, _say)
        run_until_told(partial(_serve, service, http, token, traffic, manager, open_page), seconds)


def _say(text: str) -> None:
    click.echo(text, err=True)


async def _serve(
    service: Service,
    http: socket.socket,
    token: str | None,
    traffic: Callable[[str], Coroutine[Any, Any, None]] | None,
    manager: systemd.Manager | None,
    open_page: bool,
    until: asyncio.Event,
) -> None:
    others = [traffic(service.links()[0].url)] if traffic else []
    if manager:
        others.append(systemd.keep_informed(manager, service, _say, until))
    page = address(http)
    click.echo(
        f"companion serves {page} and listens on {', '.join(link.url for link in service.links())}"
    )
    if open_page:
        webbrowser.open(page)
    await service.run(http, token, until, *others)
    recording = service.recording()
    if recording.file:
        click.echo(f"recording {recording.file}: {recording.messages} messages")
