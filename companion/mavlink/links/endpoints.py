"""The interface of a link's endpoints, and what they share.                              [shell]

An endpoint serves one connection after the other. ``serve`` ends, by an exception that says why,
when a connection is lost, and is called again after a while. The endpoint tells its link what
happens through ``Upcalls``. A write succeeds at once or not at all.
"""

import asyncio
import ipaddress
import os
import socket
import struct
from collections.abc import Callable, Collection, Hashable
from typing import Any, NamedTuple, Protocol

from companion.mavlink.links.urls import LinkUrl

Address = tuple[Any, ...]  # a socket address as the system writes it: for IPv6 with flow and scope


class Upcalls(NamedTuple):
    """Functions by which an endpoint tells its link what happens.

    take      a peer, named by the endpoint's key for it, sent bytes; the last argument is how long
              ago they arrived by the system's own stamp, ns, or None where they bear none
    stale     bytes of a peer that had waited for too long to be believed
    """

    up: Callable[[], None]  # a connection stands
    take: Callable[[Hashable, bytes, int | None], None]
    stale: Callable[[Hashable, bytes], None]
    hang_up: Callable[[Hashable], None]  # that peer is gone
    overflow: Callable[[int], None]  # the system has dropped this many more datagrams


class Endpoint(Protocol):
    """One end of a link, of whichever kind."""

    def open(self) -> int | None:
        """Claim what can be had before the loop runs; returns the port that a listening link got.

        Raises ``OSError`` where it cannot be had.
        """

    async def serve(self) -> None:
        """Serve until cancelled, or until the connection is lost.

        A lost connection raises ``OSError``; any other exception is a fault of the program.
        """

    def peers(self) -> Collection[Hashable] | None:
        """Peers to which a message for everybody goes; None: those heard lately."""

    def write(self, key: Hashable, raw: bytes) -> bool:
        """Send a frame to a peer. Never waits and never raises; False if it was not taken."""

    def fullness(self, key: Hashable) -> float:
        """The share, 0 to 1, of a peer's buffer that holds what was written and not yet sent.

        For who would rather wait than lose a frame. 0 for a peer that is gone.
        """


class HungUpError(ConnectionError):
    """The other end closed the connection in good order."""


def reason(error: OSError) -> str:
    """The cause of an error in the system's words, without addresses and numbers."""
    if error.errno is not None and error.errno > 0:
        return os.strerror(error.errno)
    return error.strerror or str(error) or "timed out"


def address_text(address: Address | None) -> str:
    """HOST:PORT of a socket address; empty where there is none, as on a local socket."""
    if not address:
        return ""
    host, port = address[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def settle(lost: asyncio.Future[Exception], why: Exception) -> None:
    """Record why a connection is lost.

    Only the first reason counts, and none after a cancellation.
    """
    if not lost.done():
        lost.set_result(why)


def bound(url: LinkUrl, kind: socket.SocketKind) -> socket.socket:
    """A socket bound to a listening link's address. Raises ``OSError`` where that cannot be had.

    A name is looked up synchronously: this is called before the loop runs, and holds nobody up.
    At a group's address (multicast) others of this machine may listen too, and the group is joined.
    """
    infos = socket.getaddrinfo(url.host, url.port, type=kind, flags=socket.AI_PASSIVE)
    family, _, _, _, address = infos[0]
    sock = socket.socket(family, kind)
    try:
        sock.setblocking(False)
        if kind == socket.SOCK_STREAM:  # else the port stays taken a minute after a connection
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        group = ipaddress.ip_address(str(address[0]).partition("%")[0])
        if group.is_multicast:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(address)
        if group.is_multicast:
            _join(sock, group, address)
    except OSError:
        sock.close()
        raise
    return sock


def _join(
    sock: socket.socket, group: ipaddress.IPv4Address | ipaddress.IPv6Address, address: Address
) -> None:
    if group.version == 4:
        anywhere = socket.inet_aton("0.0.0.0")
        joined = group.packed + anywhere
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, joined)
    else:
        joined = group.packed + struct.pack("@I", address[3])
        sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, joined)


async def resolved(
    url: LinkUrl, kind: socket.SocketKind
) -> list[tuple[socket.AddressFamily, Address]]:
    """The addresses of a link's host, at least one, looked up without blocking the loop."""
    loop = asyncio.get_running_loop()
    infos = await loop.getaddrinfo(url.host, url.port, type=kind)
    return [(family, address) for family, _, _, _, address in infos]
