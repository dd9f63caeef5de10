"""What frames are sent to, and heard from, once it is open: UDP and TCP over asyncio.

Nothing here waits for a peer that is behind: a frame that it does not take is dropped and counted.
"""

import asyncio
import contextlib
import os
import socket
from collections.abc import Callable
from typing import Final, Protocol

from companion.mavlink.urls import LinkUrl

PEERS_MAX: Final = 256
LINGER_S: Final = 1.0
"""How long closing waits for what is buffered to be sent."""

Receive = Callable[[object, bytes], None]
"""Called with who sent it (one object a peer) and what; with ``b""`` when that peer has left."""


class Endpoint(Protocol):
    """Something that frames are sent to."""

    url: LinkUrl
    """With the port that the system chose, where it was asked to choose one."""
    lost: str
    """Why the peer is gone for good; empty while it is there, or while another may come."""
    broken: bool
    """Whether it is gone by a failure, and not because it closed the link in good order."""
    somebody: asyncio.Event
    """Set while there is somebody to send to."""

    @property
    def dropped(self) -> int:
        """Frames not sent: a peer does not take them fast enough, or there is none."""

    def send(self, raw: bytes) -> None:
        """Send one frame, or drop it. Never waits, never raises."""

    async def writable(self) -> None:
        """Wait until a frame would not be dropped, or the peer is lost."""

    async def close(self) -> None:
        """Send what is buffered, within a second, and close."""


def ignore(_peer: object, _data: bytes) -> None:
    """What a peer sends is read and thrown away."""


class FlowControl:
    """What transports have in common: they say when their buffer is full and when it is not."""

    def __init__(self, url: LinkUrl, receive: Receive) -> None:
        self.url = url
        self.dropped = 0
        self.lost = ""
        self.broken = False
        self.somebody = asyncio.Event()
        self.somebody.set()
        self.closed = asyncio.Event()
        self._receive = receive
        self._room = asyncio.Event()
        self._room.set()

    def pause_writing(self) -> None:
        """The buffer is full."""
        self._room.clear()

    def resume_writing(self) -> None:
        """There is room again."""
        self._room.set()

    def connection_lost(self, exc: Exception | None) -> None:
        """The peer is gone; ``exc`` is None where it closed the link in good order."""
        self.broken = exc is not None
        self.lost = reason(exc) if exc else "the peer closed the connection"
        self._room.set()
        self.closed.set()
        self._receive(self, b"")

    async def writable(self) -> None:
        """Wait until there is room, or the peer is lost."""
        await self._room.wait()

    def has_room(self) -> bool:
        """Whether a frame may be sent; where it may not, it is counted."""
        if not self._room.is_set():
            self.dropped += 1
        return self._room.is_set() and not self.lost


class UdpPeer(FlowControl, asyncio.DatagramProtocol):
    """One datagram a frame. A peer that is not there yet (ICMP refused) is no error."""

    transport: asyncio.DatagramTransport

    def __init__(self, url: LinkUrl, receive: Receive, connected: socket.socket) -> None:
        super().__init__(url, receive)
        self._socket = connected

    def connection_made(self, transport: asyncio.DatagramTransport) -> None:  # type: ignore[override]
        self.transport = transport

    def datagram_received(self, data: bytes, addr: object) -> None:
        if data:
            self._receive(self, data)

    def error_received(self, exc: Exception) -> None:
        """Refused or unreachable: datagrams may be lost, and the next may arrive."""

    def send(self, raw: bytes) -> None:
        if self.has_room():
            self.transport.sendto(raw)

    def knock(self) -> None:
        """Send an empty datagram, which makes us known to who answers to senders alone."""
        with contextlib.suppress(OSError):  # refused, as ``error_received``
            self._socket.send(b"")  # the transport of Python 3.11 sends no empty one

    async def close(self) -> None:
        await _close(self, self.transport)


class UdpServer(FlowControl, asyncio.DatagramProtocol):
    """A bound socket that answers to everybody it has heard from, be it an empty datagram."""

    transport: asyncio.DatagramTransport

    def __init__(self, url: LinkUrl, receive: Receive) -> None:
        super().__init__(url, receive)
        self.somebody.clear()
        self._peers: dict[tuple[str | int, ...], None] = {}  # the one heard last comes last

    def connection_made(self, transport: asyncio.DatagramTransport) -> None:  # type: ignore[override]
        self.transport = transport

    def datagram_received(self, data: bytes, addr: tuple[str | int, ...]) -> None:
        self._peers.pop(addr, None)
        self._peers[addr] = None
        if len(self._peers) > PEERS_MAX:
            del self._peers[next(iter(self._peers))]
        self.somebody.set()
        if data:
            self._receive(addr, data)

    def error_received(self, exc: Exception) -> None:
        """One of the peers refuses; it may come back."""

    def send(self, raw: bytes) -> None:
        if not self._peers:
            self.dropped += 1
        elif self.has_room():
            for address in self._peers:
                self.transport.sendto(raw, address)

    async def writable(self) -> None:
        await self.somebody.wait()
        await super().writable()

    async def close(self) -> None:
        await _close(self, self.transport)


class TcpPeer(FlowControl, asyncio.Protocol):
    """A connection, opened once."""

    transport: asyncio.Transport

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        self.transport = transport

    def data_received(self, data: bytes) -> None:
        self._receive(self, data)

    def send(self, raw: bytes) -> None:
        if self.has_room():
            self.transport.write(raw)

    async def close(self) -> None:
        await _close(self, self.transport)


class TcpServer:
    """Serves everybody who connects, from then on. One who leaves is no loss: others may come."""

    def __init__(self, url: LinkUrl, receive: Receive) -> None:
        self.url = url
        self.lost = ""
        self.broken = False
        self.somebody = asyncio.Event()
        self.server: asyncio.Server | None = None
        self._receive = receive
        self._visitors: set[_Visitor] = set()
        self._dropped = 0

    @property
    def dropped(self) -> int:
        return self._dropped + sum(visitor.dropped for visitor in self._visitors)

    def visitor(self) -> asyncio.Protocol:
        """The protocol of a new connection."""
        return _Visitor(self.url, self._receive, self)

    def enter(self, visitor: "_Visitor") -> None:
        """A connection is there; one too many is closed."""
        if len(self._visitors) >= PEERS_MAX:
            visitor.transport.abort()
            return
        self._visitors.add(visitor)
        self.somebody.set()

    def leave(self, visitor: "_Visitor") -> None:
        """A connection is gone."""
        if visitor in self._visitors:
            self._visitors.remove(visitor)
            self._dropped += visitor.dropped
        if not self._visitors:
            self.somebody.clear()

    def send(self, raw: bytes) -> None:
        """Send one frame to everybody; it is dropped where there is nobody."""
        if not self._visitors:
            self._dropped += 1
        for visitor in tuple(self._visitors):
            visitor.send(raw)

    async def writable(self) -> None:
        """Wait until somebody is there, and all who are take a frame."""
        while True:
            await self.somebody.wait()
            for visitor in tuple(self._visitors):
                await visitor.writable()
            if self._visitors:
                return

    async def close(self) -> None:
        """Send what is buffered, within a second, and close."""
        if self.server is not None:
            self.server.close()
        await asyncio.gather(*(visitor.close() for visitor in tuple(self._visitors)))


class _Visitor(TcpPeer):
    """A connection of a server's."""

    def __init__(self, url: LinkUrl, receive: Receive, server: TcpServer) -> None:
        super().__init__(url, receive)
        self._server = server

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._server.enter(self)

    def connection_lost(self, exc: Exception | None) -> None:
        self._server.leave(self)
        super().connection_lost(exc)


async def _close(
    peer: FlowControl, transport: asyncio.DatagramTransport | asyncio.Transport
) -> None:
    transport.close()
    try:
        await asyncio.wait_for(peer.closed.wait(), LINGER_S)
    except TimeoutError:
        transport.abort()


def reason(error: Exception) -> str:
    """What the system says of a failure, in a few words."""
    # asyncio words its own ("Connect call failed …"); a failed look-up has errors of its own.
    if isinstance(error, OSError) and error.errno and not isinstance(error, socket.gaierror):
        return os.strerror(error.errno)
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
