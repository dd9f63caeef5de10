"""HTTP service of a node until it is stopped; shared by live runs and replays."""

import asyncio
import contextlib
import gc
import logging
import os
import socket
import sys
import threading
from collections import deque
from collections.abc import Callable, Coroutine, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar

import uvicorn

from companion.mavlink.links.daemon_threads import in_daemon_thread
from companion.mavlink.links.descriptors import raise_limit
from companion.node.memory import return_freed_memory
from companion.node.printing import STDERR, Printer, prints_unblocked
from companion.node.signals import ENDS, interrupts_held, release_interrupts
from companion.server.app import create_app
from companion.server.connections import BoundedProtocol
from companion.server.request_queue import RequestQueue
from companion.server.websocket_connections import PING_S, PONG_S, BoundedWebSocket
from companion.server.work_slots import WorkSlots
from companion.views.state import Node

T = TypeVar("T")

RATE_WINDOW_S: Final = 2.0  # time over which frames and updates per second are averaged
NOTICES_KEPT: Final = 200
STREAM_TAKES_BYTES: Final = 1024  # largest message accepted from a WebSocket client
BACKLOG: Final = 512  # connections that wait to be accepted; one beyond it is repeated after 1 s
ACCEPTS: Final = 16
"""Connections accepted in one iteration of the event loop.

uvloop accepts one for each listening descriptor. New connections would wait, first come, first
served, behind all others and their answers, before anything is known of what they request.
"""
CLOSE_TIMEOUT_S: Final = 2
"""Longest wait at shutdown for clients that do not read, and for unfinished downloads."""
DISK_WAIT_NOTICE_S: Final = 2.0  # wait for a disk at the end after which it is announced
_waits_for_disk = threading.Event()
"""Set while the end waits for a disk: then a signal ends the process at once."""


class Server(uvicorn.Server):
    """uvicorn server for a node, without signal handlers.

    ``serve(sockets=[bound socket])`` runs until ``should_exit`` is set; ``answering`` is set once
    it accepts requests. ``token`` and ``area``: see ``create_app``.
    """

    def __init__(
        self, *, node: Node, token: str | None, answering: asyncio.Event, area: Path | None = None
    ) -> None:
        work_slots = WorkSlots()
        queue = RequestQueue(lambda: node.pipeline.aiming is not None or work_slots.running > 0)
        app = create_app(node, token, area, work_slots=work_slots)
        super().__init__(
            uvicorn.Config(
                app,
                log_level="error",  # a warning for each malformed request could fill a disk
                lifespan="off",
                http=partial(BoundedProtocol, queue),  # type: ignore[arg-type]
                ws=BoundedWebSocket,
                backlog=BACKLOG,
                access_log=False,
                ws_ping_interval=PING_S,
                ws_ping_timeout=PONG_S,
                ws_max_size=STREAM_TAKES_BYTES,
                ws_per_message_deflate=False,  # a message is encoded once for all clients
                timeout_graceful_shutdown=CLOSE_TIMEOUT_S,
            )
        )
        self._answering = answering
        logging.getLogger("uvicorn.error").addFilter(_is_useful)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start to accept requests; see ``uvicorn.Server.startup``."""
        await super().startup(sockets and [one.dup() for one in sockets for _ in range(ACCEPTS)])
        self._answering.set()

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Install no signal handlers."""
        yield


def _is_useful(record: logging.LogRecord) -> bool:
    """Return whether the operator can use a line of the HTTP server's log.

    At the end the server logs how many requests it cancels: those of clients that do not read.
    """
    return not str(record.msg).startswith("Cancel %s running task(s)")


class RateMeter:
    """Frames and beam updates per second over the last seconds."""

    def __init__(self) -> None:
        self._counts: deque[tuple[int, int, int]] = deque()

    def count(self, now_ns: int, frames: int, updates: int) -> None:
        """Note the total numbers of frames and updates so far."""
        self._counts.append((now_ns, frames, updates))
        while self._counts[0][0] < now_ns - RATE_WINDOW_S * 1e9:
            self._counts.popleft()

    def newest(self) -> dict[str, float | None]:
        """Return ``frames_hz`` and ``updates_hz``; both None before the second count."""
        if len(self._counts) < 2:
            return {"frames_hz": None, "updates_hz": None}
        (t0, frames0, updates0), (t1, frames1, updates1) = self._counts[0], self._counts[-1]
        seconds = (t1 - t0) * 1e-9
        return {
            "frames_hz": (frames1 - frames0) / seconds,
            "updates_hz": (updates1 - updates0) / seconds,
        }


def address(http: socket.socket) -> str:
    """Return the URL of a listening socket."""
    host, port = http.getsockname()[:2]
    return f"http://{f'[{host}]' if ':' in host else host}:{port}"


async def pause(until: asyncio.Event, seconds: float) -> None:
    """Wait for ``seconds``, or until ``until`` is set."""
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(until.wait(), seconds)


async def saved_at_end(
    save: Callable[[], None], what: str, say: Callable[[str], None], *, most_s: float | None
) -> bool:
    """Save something on a thread, and say so if the disk lets it wait; return whether it is saved.

    After ``most_s`` more seconds it is not waited for; None: ``save`` has a limit of its own.
    """
    saving = asyncio.create_task(in_daemon_thread(save, at_once=True))
    _, unfinished = await asyncio.wait([saving], timeout=DISK_WAIT_NOTICE_S)
    if unfinished:
        _waits_for_disk.set()
        say(f"waiting for the disk to take {what}; a signal ends the service at once")
        _, unfinished = await asyncio.wait([saving], timeout=most_s)
        _waits_for_disk.clear()
    if unfinished:
        saving.cancel()
        return False
    await saving
    return True


def run_until_stopped(
    main: Callable[[asyncio.Event], Coroutine[Any, Any, None]], seconds: float | None = None
) -> bool:
    """Run ``main`` on a new event loop; return whether a signal stopped it.

    ``main`` gets an event that is set by a signal of ``ENDS``, or after ``seconds``; it must then
    finish. While it waits for a disk then, a signal ends the process at once.
    """
    _configure_interpreter()
    raise_limit()
    # Held until the loop has handlers: an exception would leave the loop half started.
    with (
        prints_unblocked(),
        interrupts_held(),
        asyncio.Runner(loop_factory=_loop_factory()) as runner,
    ):
        return runner.run(_stopped_by_signal(main, seconds))


async def _stopped_by_signal(
    main: Callable[[asyncio.Event], Coroutine[Any, Any, None]], seconds: float | None
) -> bool:
    loop, until = asyncio.get_running_loop(), asyncio.Event()
    received: list[int] = []

    def stop(number: int) -> None:
        if _waits_for_disk.is_set():
            try:
                last = Printer(STDERR)
                last.line("companion: ended by a signal, without waiting for the disk")
                last.finish()
            finally:  # also if it has no thread
                os._exit(1)
        received.append(number)
        until.set()

    for number in ENDS:
        loop.add_signal_handler(number, stop, number)
    release_interrupts()
    if seconds is not None:
        loop.call_later(seconds, until.set)
    await main(until)
    return bool(received)


def _configure_interpreter() -> None:
    """Keep garbage collection and threads from blocking the event loop.

    The time of a collection is proportional to the objects that it examines. Objects loaded by now
    are exempt; small collections are frequent and full ones rare (measured at 10 000 frames/s: 3 ms
    for 2 000 objects, 50 ms for 50 000; with 1000 UAVs, 190 ms every few minutes): until one,
    the memory of closed connections is not freed. The recorder's thread yields after a millisecond,
    because each HTTP answer waits for the interpreter several times.
    """
    sys.setswitchinterval(0.001)
    return_freed_memory()
    gc.collect()
    gc.freeze()
    gc.set_threshold(2_000, 10, 100)


def _loop_factory() -> Callable[[], asyncio.AbstractEventLoop] | None:
    """Return uvloop's loop factory, which handles ten times as many datagrams; None without uvloop.

    Measured: docs/field-notes.md 3.
    """
    try:
        import uvloop
    except ImportError:
        return None
    return uvloop.new_event_loop
