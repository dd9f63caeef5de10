"""Starts and stops the live service from the command line.                              [shell]"""

import asyncio
import gc
import signal
import socket
import sys
import webbrowser
from collections.abc import Callable, Coroutine
from typing import Any

import click

from companion.config import Settings
from companion.server.access import bind
from companion.service import Service, require_center


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

    ``traffic`` is run beside, with the address of the first link. ``ValueError`` or ``OSError``
    where the settings do not allow to start.
    """
    require_center(settings)
    if not settings.links.urls:
        raise ValueError("say where MAVLink comes from: --link udpin:0.0.0.0:14550")
    http = bind(settings.server.listen, token=token, insecure=insecure)
    with http:
        service = Service(settings, lambda text: click.echo(text, err=True))
        host, port = http.getsockname()[:2]
        page = f"http://{f'[{host}]' if ':' in host else host}:{port}"
        _tame_interpreter()
        with asyncio.Runner(loop_factory=_loop_factory()) as runner:
            runner.run(_serve(service, http, token, traffic, seconds, page, open_page))


def _tame_interpreter() -> None:
    """Nothing may hold the event loop up. A collection of garbage takes as long as what it looks
    through is large: what is loaded by now is left out, small ones come often and full ones
    rarely (measured at 10 000 frames/s: 2 000 objects, 3 ms; 50 000, 50 ms). The recorder's thread
    gives way after a millisecond: each answer over HTTP waits for its turn several times."""
    sys.setswitchinterval(0.001)
    gc.collect()
    gc.freeze()
    gc.set_threshold(2_000, 10, 1000)


def _loop_factory() -> Callable[[], asyncio.AbstractEventLoop] | None:
    """uvloop where there is one: it keeps up with ten times the datagrams."""
    try:
        import uvloop
    except ImportError:
        return None
    return uvloop.new_event_loop


async def _serve(
    service: Service,
    http: socket.socket,
    token: str | None,
    traffic: Callable[[str], Coroutine[Any, Any, None]] | None,
    seconds: float | None,
    page: str,
    open_page: bool,
) -> None:
    loop, until = asyncio.get_running_loop(), asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, until.set)
    if seconds is not None:
        loop.call_later(seconds, until.set)
    others = [traffic(service.links()[0].url)] if traffic else []
    click.echo(
        f"companion serves {page} and listens on {', '.join(link.url for link in service.links())}"
    )
    if open_page:
        webbrowser.open(page)
    await service.run(http, token, until, *others)
    recording = service.recording()
    if recording.file:
        click.echo(f"recording {recording.file}: {recording.messages} messages")
