"""Connections to another machine: lookup of its name, and TCP to the first address that accepts.

The event loop looks names up on a few threads. A name server that does not answer would occupy each
for half a minute; meanwhile no other link could connect, and the service could not end.
"""

import asyncio
import contextlib
import errno
import os
import socket
from typing import Final

from companion.mavlink.links.daemon_threads import in_daemon_thread
from companion.mavlink.links.endpoints import Address
from companion.mavlink.links.urls import LinkUrl

LOOKUP_S: Final = 3.0  # wait for a name server after which an attempt has failed
CONNECT_S: Final = 5.0
"""Timeout of a connection attempt; the system's own is two minutes, with ever longer pauses."""
SILENCE_S: Final = 12
"""Seconds without an acknowledgement after which a connection is closed."""

Found = list[tuple[socket.AddressFamily, Address]]


class HostLookup:
    """Lookup of the addresses of a link's host, at most one at a time.

    A lookup cannot be cancelled. One that takes longer than an attempt is used by a later attempt.
    """

    def __init__(self, url: LinkUrl, kind: socket.SocketKind) -> None:
        self._host = url.host
        self._port = url.port
        self._kind = kind
        self._pending: asyncio.Task[Found | OSError] | None = None

    async def addresses(self) -> Found:
        """Return the addresses, at least one.

        Raises ``OSError`` if the name is unknown, or no name server answers in ``LOOKUP_S``.
        """
        with contextlib.suppress(socket.gaierror):  # raised for a name
            return self._look_up(socket.AI_NUMERICHOST)
        if self._pending is None:
            self._pending = asyncio.create_task(in_daemon_thread(self._attempt), name="lookup")
        await asyncio.wait([self._pending], timeout=LOOKUP_S)
        if not self._pending.done():
            raise OSError(f"no name server has answered for {LOOKUP_S:.0f} s")
        found, self._pending = self._pending.result(), None
        if isinstance(found, OSError):
            raise found
        return found

    def _attempt(self) -> Found | OSError:
        """Return the addresses, or the error, which nobody may be waiting for."""
        try:
            return self._look_up(0)
        except OSError as error:
            return error

    def _look_up(self, flags: int) -> Found:
        infos = socket.getaddrinfo(self._host, self._port, type=self._kind, flags=flags)
        return [(family, address) for family, _, _, _, address in infos]


async def connected(lookup: HostLookup) -> socket.socket:
    """Connect to the first address of a host that accepts; else raise the last address's error."""
    loop = asyncio.get_running_loop()
    error: OSError | None = None
    for family, address in await lookup.addresses():
        sock = socket.socket(family, socket.SOCK_STREAM)
        try:
            sock.setblocking(False)
            notice_silence(sock)
            async with asyncio.timeout(CONNECT_S):
                await loop.sock_connect(sock, address)
            if sock.getsockname() != sock.getpeername():
                return sock
            # No program listens on this machine, and the system chose that very port for our end:
            # a connection to itself, which would also prevent the peer from listening.
            error = OSError(errno.ECONNREFUSED, os.strerror(errno.ECONNREFUSED))
        except OSError as refused:
            error = refused
        except BaseException:
            sock.close()
            raise
        sock.close()
    assert error is not None, "a resolved name has an address"
    raise error


def notice_silence(sock: socket.socket) -> None:
    """Enable keep-alive, to detect a peer that vanished silently (RFC 9293, 3.8.4).

    Without it, a connection that is only read from would never fail.
    """
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    options = {
        "TCP_KEEPIDLE": SILENCE_S // 2,
        "TCP_KEEPINTVL": max(1, SILENCE_S // 6),
        "TCP_KEEPCNT": 3,
        "TCP_USER_TIMEOUT": SILENCE_S * 1000,
    }
    for name, value in options.items():
        if hasattr(socket, name):  # not every system has them all
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
