"""Interface of a link's endpoints, and the functions that endpoints share.

An endpoint serves one connection after the other. ``serve`` ends with an exception, the reason,
when a connection is lost, and is called again after a while. The endpoint reports events to its
link through ``Upcalls``. A write succeeds at once or not at all.
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
    """Callbacks by which an endpoint reports events to its link.

    take      a peer sent bytes: its key, the bytes, and their age by the system's time stamp, ns
              (None without a stamp); returns whether there is more, with which a call without
              bytes continues; raises ``StalledError`` to end the connection
    stale     bytes of a peer that waited too long to be used
    request   called before a document is requested from the only peer
    has_sent  returns whether a peer has sent a valid frame
    """

    up: Callable[[], None]  # connected
    take: Callable[[Hashable, bytes, int | None], bool]
    stale: Callable[[Hashable, bytes], None]
    on_peer_gone: Callable[[Hashable], None]  # that peer is gone
    overflow: Callable[[int], None]  # the system dropped this many more datagrams
    request: Callable[[], None] = lambda: None
    has_sent: Callable[[Hashable], bool] = lambda _: True


class Endpoint(Protocol):
    """One end of a link, of any kind: a socket, a serial device, a Zenoh session."""

    def open(self) -> int | None:
        """Claim local resources before the loop runs; return the port of a listening link.

        Raises ``OSError`` if they are not available.
        """

    async def serve(self) -> None:
        """Serve until cancelled, or until the connection is lost.

        A lost connection raises ``OSError``; any other exception is a defect of the program.
        """

    def peers(self) -> Collection[Hashable] | None:
        """Return the peers that get a broadcast; None: those received recently."""

    def write(self, key: Hashable, raw: bytes) -> bool:
        """Send a frame to a peer. Never waits, never raises; False if it was not accepted."""

    def fullness(self, key: Hashable) -> float:
        """Return the filled share, 0 to 1, of a peer's send buffer; 0 for a disconnected peer.

        For callers that prefer to wait rather than lose a frame.
        """


class HungUpError(ConnectionError):
    """The other end closed the connection properly."""


class StalledError(ConnectionAbortedError):
    """Error of a peer that sends bytes, but completes no message."""


def reason(error: OSError) -> str:
    """Return the system's text for an error, without addresses and numbers."""
    if error.errno is not None and error.errno > 0:
        return os.strerror(error.errno)
    return error.strerror or str(error) or "timed out"


def address_text(address: Address | None) -> str:
    """Return HOST:PORT of a socket address; empty without one, as on a local socket."""
    if not address:
        return ""
    host, port = address[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def settle(lost: asyncio.Future[Exception], why: Exception) -> None:
    """Record why a connection is lost: only the first reason, and none after a cancellation."""
    if not lost.done():
        lost.set_result(why)


def bound(url: LinkUrl, kind: socket.SocketKind) -> socket.socket:
    """Return a socket bound to a link's address. Raises ``OSError`` if the address is unavailable.

    The name lookup is synchronous: this is called before the loop runs. At a multicast address the
    group is joined, and other programs of this machine may listen too.
    """
    infos = socket.getaddrinfo(url.host, url.port, type=kind, flags=socket.AI_PASSIVE)
    family, _, _, _, address = infos[0]
    sock = socket.socket(family, kind)
    try:
        sock.setblocking(False)
        if kind == socket.SOCK_STREAM:  # else the port stays in use a minute after a connection
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
