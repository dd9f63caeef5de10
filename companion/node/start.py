"""Start and stop of the live service from the command line."""

import asyncio
import os
import socket
import threading
import webbrowser
from collections.abc import Callable, Coroutine
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol

from companion.node import systemd
from companion.node.service import Service, require_center
from companion.node.serving import address, run_until_stopped
from companion.recording.folders import make_service_folder
from companion.server.access import bind
from companion.settings.model import Settings
from companion.settings.origins import Origins
from companion.values import UserError

STATUS_EVERY_S: Final = 1.0  # time between two status lines


class Console(Protocol):
    """Output of a run to its terminal or pipe."""

    def say(self, text: str) -> None:
        """Print a line about an event."""

    def serves(self, text: str) -> None:
        """Print the address that is served."""

    def recorded(self, text: str) -> None:
        """Print the recording, at the end."""

    def show(self, service: Service) -> None:
        """Print the status of the service."""

    def finish(self) -> None:
        """Wait a moment until all is printed."""


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

        settings   settings of the service
        voice      its output
        origins    origins of the settings, for display
        token      bearer token required for HTTP; None: none
        insecure   serve other machines without a token
        traffic    coroutine that runs alongside, called with the URL of the first link
        seconds    duration; None: until a signal
        open_page  open the dashboard in a browser

    A service manager that started this process is notified (``companion.node.systemd``). Raises
    ``UserError`` or ``OSError`` if the settings do not allow a start.
    """
    require_center(settings)
    if not settings.links.urls:
        raise UserError("links.urls is empty; give --link udpin:0.0.0.0:14550")
    if settings.recording.directory is not None:
        make_service_folder(Path(settings.recording.directory))
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
        try:
            run_until_stopped(serve, seconds)
        finally:
            voice.finish()


async def _keep_shown(
    service: Service, voice: Console, until: asyncio.Event, lost: list[OSError]
) -> None:
    """Show the status every second. Without its reader the service ends in order."""
    try:
        while True:
            await asyncio.sleep(STATUS_EVERY_S)
            voice.show(service)
    except OSError as error:  # the reader of a pipe has ended
        lost.append(error)
        until.set()


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
    page = address(http)
    voice.serves(
        f"companion serves {page} and listens on {', '.join(link.url for link in service.links())}"
    )
    if open_page:  # on a thread: a browser of the terminal keeps its caller waiting
        threading.Thread(target=webbrowser.open, args=(page,), daemon=True).start()
    lost: list[OSError] = []
    others = [partial(_keep_shown, service, voice, until, lost)]
    others += [partial(traffic, service.links()[0].url)] if traffic else []
    if manager:
        others.append(partial(systemd.keep_informed, manager, service, voice.say, until))
    await service.run(http, token, until, *others)
    if lost:
        raise lost[0]
    recording = service.recording()
    if recording.file:
        voice.recorded(f"recording {recording.file}: {recording.messages} messages")
