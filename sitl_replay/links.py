"""Where traffic goes to and comes from: link URLs, and sending endpoints over asyncio."""

import asyncio
import os
import socket
from collections.abc import Sequence
from typing import NamedTuple, Protocol, Self

SENDING = ("udpout", "tcp")
RECEIVING = ("udpin", "tcp")
MAX_PORT = 65_535


class LinkError(Exception):
    """A link that cannot be opened, or whose peer is gone. The message names the URL."""


class Url(NamedTuple):
    """A link as users of MAVLink write it: ``SCHEME:HOST:PORT``, IPv6 hosts in brackets."""

    scheme: str
    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.scheme}:{host}:{self.port}"

    @classmethod
    def parse(cls, text: str, schemes: Sequence[str] = SENDING) -> Self:
        """Read a URL of one of ``schemes``; ``ValueError`` says what is wrong with it."""
        scheme, _, rest = text.partition(":")
        host, _, port = rest.rpartition(":")
        bracketed = host.startswith("[") and host.endswith("]")
        host = host[1:-1] if bracketed else host
        if scheme not in schemes or not host or (":" in host) != bracketed:
            forms = " or ".join(f"{known}:HOST:PORT" for known in schemes)
            raise ValueError(f"{text!r} is not {forms} (an IPv6 host in brackets)")
        if not (port.isdecimal() and port.isascii() and 1 <= int(port) <= MAX_PORT):
            raise ValueError(f"{text!r}: {port!r} is not a port, 1 to {MAX_PORT}")
        return cls(scheme, host, int(port))


class Peer(Protocol):
    """Something that frames are sent to."""

    url: Url
    dropped: int
    """Frames not sent because the peer does not take them fast enough."""
    lost: str
    """Why the peer is gone for good; empty while it is there."""

    def send(self, raw: bytes) -> None:
        """Send one frame, or drop it when the peer is behind. Never waits, never raises."""

    async def writable(self) -> None:
        """Wait until a frame would not be dropped, or the peer is lost."""

    async def close(self) -> None:
        """Send what is buffered, within a second, and close."""


class _FlowControl:
    """What both transports have: they say when their buffer is full and when it is not."""

    def __init__(self, url: Url) -> None:
        self.url = url
        self.dropped = 0
        self.lost = ""
        self.closed = asyncio.Event()
        self._room = asyncio.Event()
        self._room.set()

    def pause_writing(self) -> None:
        self._room.clear()

    def resume_writing(self) -> None:
        self._room.set()

    def connection_lost(self, exc: Exception | None) -> None:
        self.lost = self.lost or (str(exc) if exc else "the peer closed the connection")
        self._room.set()
        self.closed.set()

    async def writable(self) -> None:
        await self._room.wait()

    def has_room(self) -> bool:
        if not self._room.is_set():
            self.dropped += 1
        return self._room.is_set() and not self.lost


class UdpPeer(_FlowControl, asyncio.DatagramProtocol):
    """One datagram a frame. A peer that is not there yet (ICMP refused) is no error."""

    transport: asyncio.DatagramTransport

    def connection_made(self, transport: asyncio.DatagramTransport) -> None:  # type: ignore[override]
        self.transport = transport

    def error_received(self, exc: Exception) -> None:
        """Refused or unreachable: datagrams may be lost, and the next may arrive."""

    def send(self, raw: bytes) -> None:
        if self.has_room():
            self.transport.sendto(raw)

    async def close(self) -> None:
        await _close(self, self.transport)


class TcpPeer(_FlowControl, asyncio.Protocol):
    """A connection, opened once. What the peer sends is read and thrown away."""

    transport: asyncio.Transport

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        self.transport = transport

    def send(self, raw: bytes) -> None:
        if self.has_room():
            self.transport.write(raw)

    async def close(self) -> None:
        await _close(self, self.transport)


async def _close(
    peer: UdpPeer | TcpPeer, transport: asyncio.DatagramTransport | asyncio.Transport
) -> None:
    transport.close()
    try:
        await asyncio.wait_for(peer.closed.wait(), timeout=1.0)
    except TimeoutError:
        transport.abort()


async def open_peer(url: Url) -> Peer:
    """Open a link to send over. ``LinkError`` where that is not possible."""
    loop = asyncio.get_running_loop()
    peer: UdpPeer | TcpPeer
    try:
        if url.scheme == "tcp":
            _, peer = await loop.create_connection(lambda: TcpPeer(url), url.host, url.port)
        else:
            _, peer = await loop.create_datagram_endpoint(
                lambda: UdpPeer(url), remote_addr=(url.host, url.port)
            )
    except (OSError, UnicodeError) as error:
        raise LinkError(f"{url}: {reason(error)}") from error
    return peer


def reason(error: Exception) -> str:
    """What the system says of a failure, in a few words."""
    # asyncio words its own ("Connect call failed …"); a failed look-up has errors of its own.
    if isinstance(error, OSError) and error.errno and not isinstance(error, socket.gaierror):
        return os.strerror(error.errno)
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
