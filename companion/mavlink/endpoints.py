"""What the endpoints of links have in common.                                            [shell]

An endpoint lives through one connection after the other: ``serve`` ends, by an exception that says
why, when one is lost, and is called again after a while. It tells its link what happens through
``Upcalls``, and writes at once or not at all.
"""

import asyncio
import os
import socket
from collections.abc import Callable, Collection, Hashable
from typing import Any, NamedTuple, Protocol

from companion.mavlink.urls import LinkUrl

Address = tuple[Any, ...]
"""A socket address, as the system writes it: for IPv6 with flow and scope."""


class Upcalls(NamedTuple):
    """What an endpoint tells its link: a connection stands; a peer, named by a key of the
    endpoint's, sent bytes, or hung up; the system has dropped so many more datagrams."""

    up: Callable[[], None]
    take: Callable[[Hashable, bytes], None]
    hang_up: Callable[[Hashable], None]
    overflow: Callable[[int], None]


class Endpoint(Protocol):
    """One end of a link, of whichever kind."""

    def open(self) -> int | None:
        """Take what can be had before the loop runs; the port that a listening link got.
        ``OSError`` where it cannot be had."""

    async def serve(self) -> None:
        """Serve until the connection is lost, which an exception tells: ``OSError``, unless it is
        a fault of the program. Or until cancelled."""

    def peers(self) -> Collection[Hashable] | None:
        """To whom a message for everybody goes; None: to those who were heard lately."""

    def write(self, key: Hashable, raw: bytes) -> bool:
        """Send a frame to a peer. Never waits, never raises: False if it was not taken."""


def reason(error: OSError) -> str:
    """Why something failed, in the system's words: without addresses and numbers."""
    if error.errno is not None and error.errno > 0:
        return os.strerror(error.errno)
    return error.strerror or str(error) or "timed out"


def settle(lost: asyncio.Future[Exception], why: Exception) -> None:
    """Say why a connection is lost: the first reason counts, and none after a cancellation."""
    if not lost.done():
        lost.set_result(why)


def bound(url: LinkUrl, kind: socket.SocketKind) -> socket.socket:
    """A socket bound to a listening link's address; ``OSError`` where that cannot be had.

    A name is looked up here and now: before the loop runs there is nobody to hold up.
    """
    infos = socket.getaddrinfo(url.host, url.port, type=kind, flags=socket.AI_PASSIVE)
    family, _, _, _, address = infos[0]
    sock = socket.socket(family, kind)
    try:
        sock.setblocking(False)
        if kind == socket.SOCK_STREAM:  # else the port stays taken a minute after a connection
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(address)
    except OSError:
        sock.close()
        raise
    return sock


async def resolved(
    url: LinkUrl, kind: socket.SocketKind
) -> list[tuple[socket.AddressFamily, Address]]:
    """The addresses of a link's host, at least one; looked up beside the loop."""
    loop = asyncio.get_running_loop()
    infos = await loop.getaddrinfo(url.host, url.port, type=kind)
    return [(family, address) for family, _, _, _, address in infos]
