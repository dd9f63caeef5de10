"""Starts and stops the live service from the command line.                               [shell]"""

import asyncio
import os
import socket
import webbrowser
from collections.abc import Callable, Coroutine
from functools import partial
from typing import Any, Final, Protocol

from companion.node import systemd
from companion.node.service import Service, require_center
from companion.node.serving import address, run_until_stopped
from companion.server.access import bind
from companion.settings.model import Settings
from companion.settings.origins import Origins
from companion.values import UserError

STATUS_EVERY_S: Final = 1.0  # time between two words on how it goes


class Console(Protocol):
    """How a run speaks to whoever started it."""

    def say(self, text: str) -> None:
        """Say a line of something that happened."""

    def serves(self, text: str) -> None:
        """Say where it serves, or at the end what it recorded."""

    def show(self, service: Service) -> None:
        """Show how it goes."""


def run(
    settings: Settings,
    voice: Console,
    *,
    origins: Origins | None = None,
    token: str | None = None,
    insecure: bool = False,
    traffic: Callable[[str], Coroutine[Any, Any, None]] | None = None,
    seconds: float | None = None,
    open_page: bool = False,
) -> None:
    """Serve until SIGINT, SIGTERM or ``seconds`` have passed; then finish the recording.

        settings   those of the service
        voice      how it speaks
        origins    where the settings come from, for who reads them
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
        service = Service(settings=settings, say=voice.say, origins=origins)
        serve = partial(
            _serve,
            service=service,
            voice=voice,
            http=http,
            token=token,
            traffic=traffic,
            manager=manager,
            open_page=open_page,
        )
        run_until_stopped(serve, seconds)


async def _keep_shown(service: Service, voice: Console) -> None:
    """Show how it goes, again and again."""
    while True:
        await asyncio.sleep(STATUS_EVERY_S)
        voice.show(service)


async def _serve(
    until: asyncio.Event,
    *,
    service: Service,
    voice: Console,
    http: socket.socket,
    token: str | None,
    traffic: Callable[[str], Coroutine[Any, Any, None]] | None,
    manager: systemd.Manager | None,
    open_page: bool,
) -> None:
    others = [_keep_shown(service, voice)]
    others += [traffic(service.links()[0].url)] if traffic else []
    if manager:
        others.append(systemd.keep_informed(manager, service, voice.say, until))
    page = address(http)
    voice.serves(
        f"companion serves {page} and listens on {', '.join(link.url for link in service.links())}"
    )
    if open_page:
        webbrowser.open(page)
    await service.run(http, token, until, *others)
    recording = service.recording()
    if recording.file:
        voice.serves(f"recording {recording.file}: {recording.messages} messages")
