"""TCP endpoints of a link: a client, and a server.

Over 300 lines: both endpoints, and the connections that they share.
"""

import asyncio
import socket
from collections import deque
from collections.abc import Callable, Collection, Hashable
from dataclasses import replace
from typing import Final, cast

from companion.mavlink.links.connecting import HostLookup, connected, notice_silence
from companion.mavlink.links.descriptors import share
from companion.mavlink.links.endpoints import HungUpError, Upcalls, address_text, bound, settle
from companion.mavlink.links.stale_bytes import StaleBytes
from companion.mavlink.links.urls import LinkUrl

WRITE_BUFFER_BYTES: Final = 64 << 10
"""Unsent bytes of a connection beyond which further frames are dropped."""
CONNECTIONS_MAX: Final = 256
"""Most connections of a listening link; more are closed at once."""
DESCRIPTORS: Final = 0.1  # ratio of the descriptors that the connections of a link may take
PIECE_BYTES: Final = 4096
"""Bytes that are read and processed before other work runs; some hundred frames.

A link processes one such piece in an iteration of the event loop, of one connection after the
other: many take no more of the processor than one. The rest waits in the system's buffers.
"""


class TcpOut:
    """TCP client of a link: connects to one peer."""

    def __init__(self, url: LinkUrl, upcalls: Upcalls) -> None:
        self._lookup = HostLookup(url, socket.SOCK_STREAM)
        self._upcalls = upcalls
        self._stream: _Stream | None = None

    def open(self) -> None:
        """Do nothing: the peer may start later."""

    async def serve(self) -> None:
        """Connect and serve until the connection is lost."""
        loop = asyncio.get_running_loop()
        sock = await connected(self._lookup)
        lost: asyncio.Future[Exception] = loop.create_future()
        stream = _Stream(
            upcalls=self._upcalls, on_close=lambda _, why: settle(lost, why), order=_ReadOrder()
        )
        try:
            await loop.create_connection(lambda: stream, sock=sock)
            self._stream = stream
            self._upcalls.up()
            raise await lost
        finally:
            self._stream = None
            stream.abort()

    def peers(self) -> Collection[Hashable]:
        """Return the one peer, while it is connected."""
        return () if self._stream is None else (self._stream,)

    def write(self, key: Hashable, raw: bytes) -> bool:
        """Send a frame to the peer if its buffer has room."""
        return cast(_Stream, key).write(raw)

    def fullness(self, key: Hashable) -> float:
        """Return the filled share of the connection's buffer."""
        return cast(_Stream, key).fullness()


class TcpIn:
    """TCP server of a link. Each connection is a separate peer."""

    def __init__(self, url: LinkUrl, upcalls: Upcalls) -> None:
        self._url = url
        self._upcalls = upcalls
        self._socket: socket.socket | None = None
        self._streams: dict[_Stream, None] = {}  # the oldest first
        self._order = _ReadOrder()

    def open(self) -> int:
        """Listen; return the port. Raises ``OSError`` if the address is not available."""
        self._socket = _listening(self._url)
        port = cast(int, self._socket.getsockname()[1])
        self._url = replace(self._url, port=port)
        return port

    async def serve(self) -> None:
        """Serve connections. The loss of one does not end the endpoint."""
        loop = asyncio.get_running_loop()
        fault: asyncio.Future[Exception] = loop.create_future()
        sock, self._socket = self._socket or _listening(self._url), None
        # start_serving=True yields to the loop once; a cancellation there would leak the server.
        server = await loop.create_server(lambda: self._met(fault), sock=sock, start_serving=False)
        try:
            await server.start_serving()
            self._upcalls.up()
            raise await fault
        finally:
            server.close()
            for stream in tuple(self._streams):
                stream.abort()

    def peers(self) -> Collection[Hashable]:
        """Return every connection to which frames can be written."""
        return tuple(stream for stream in self._streams if stream.is_open())

    def write(self, key: Hashable, raw: bytes) -> bool:
        """Send a frame to a connection if its buffer has room."""
        return cast(_Stream, key).write(raw)

    def fullness(self, key: Hashable) -> float:
        """Return the filled share of a connection's buffer."""
        return cast(_Stream, key).fullness()

    def _met(self, fault: asyncio.Future[Exception]) -> "_Stream":
        def on_close(stream: _Stream, why: Exception) -> None:
            self._streams.pop(stream, None)
            if not isinstance(why, OSError):
                settle(fault, why)

        if len(self._streams) >= share(CONNECTIONS_MAX, DESCRIPTORS) and not self._make_room():
            return _Stream(
                upcalls=self._upcalls, on_close=on_close, order=self._order, is_accepted=False
            )
        stream = _Stream(upcalls=self._upcalls, on_close=on_close, order=self._order)
        self._streams[stream] = None
        return stream

    def _make_room(self) -> bool:
        """Close the oldest connection over which no frame came; False if there is none."""
        unused = next((one for one in self._streams if not self._upcalls.has_sent(one)), None)
        if unused is None:
            return False
        del self._streams[unused]
        unused.abort()
        return True


class _ReadOrder:
    """Order in which the connections of a link are processed: a piece of one per iteration."""

    def __init__(self) -> None:
        self._waiting: deque[_Stream] = deque()

    def add(self, stream: "_Stream") -> None:
        """Queue a connection with a piece that is not processed yet."""
        self._waiting.append(stream)
        if len(self._waiting) == 1:
            asyncio.get_running_loop().call_soon(self._next)

    def _next(self) -> None:
        self._waiting[0].process()
        self._waiting.popleft()
        if self._waiting:
            asyncio.get_running_loop().call_soon(self._next)


class _Stream(asyncio.BufferedProtocol):
    """One connection, which is also the key of its peer.

    ``on_close`` is called with the reason when it ends. A connection that is not ``is_accepted`` is
    closed at once.
    """

    def __init__(
        self,
        *,
        upcalls: Upcalls,
        on_close: Callable[["_Stream", Exception], None],
        order: _ReadOrder,
        is_accepted: bool = True,
    ) -> None:
        self._upcalls = upcalls
        self._on_close = on_close
        self._order = order
        self._transport: asyncio.Transport | None = None
        self._is_accepted = is_accepted
        self._address = ""
        self._held_up: StaleBytes | None = None
        self._buffer = bytearray(PIECE_BYTES)
        self._piece: bytes | None = None  # read, and not processed yet
        self._has_more = False  # frames of a processed piece wait in the splitter
        self._lost: Exception | None = None
        self._fault: Exception | None = None  # raised by the processing of a piece

    def __str__(self) -> str:
        return self._address

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self._address = address_text(transport.get_extra_info("peername"))
        self._held_up = StaleBytes(transport.get_extra_info("socket").fileno())
        self._held_up.watch()
        if not self._is_accepted:
            self._transport.abort()

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        data = bytes(self._buffer[:nbytes])
        stale = self._held_up.stale(data) if self._held_up else 0
        if stale:
            self._upcalls.stale(self, data[:stale])
        if stale < nbytes and self._transport is not None:
            self._piece = data[stale:]
            self._transport.pause_reading()
            self._order.add(self)

    def process(self) -> None:
        """Process the piece that was read, or more of it; then read the next one, or end."""
        piece, self._piece = self._piece, None
        try:
            if (piece or self._has_more) and self._upcalls.take(self, piece or b"", None):
                self._has_more, self._piece = True, b""
                self._order.add(self)
                return
            self._has_more = False
        except Exception as fault:  # a defect must end the link, not disappear
            self._fault = fault
            self.abort()
        if self._lost is not None:
            self._end(self._lost)
        elif self._transport is not None and not self._transport.is_closing():
            self._transport.resume_reading()

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        if self._held_up:
            self._held_up.close()
        self._lost = exc or self._fault or HungUpError("the peer hung up")
        if self._piece is None:
            self._end(self._lost)

    def _end(self, why: Exception) -> None:
        self._on_close(self, why)
        self._upcalls.on_peer_gone(self)

    def write(self, raw: bytes) -> bool:
        """Send a frame, or buffer it while there is room; False if the buffer is full."""
        transport = self._transport
        if transport is None or not self.is_open():
            return False
        if transport.get_write_buffer_size() + len(raw) > WRITE_BUFFER_BYTES:
            return False
        transport.write(raw)
        return True

    def is_open(self) -> bool:
        """Return whether the connection is writable."""
        return self._transport is not None and not self._transport.is_closing()

    def fullness(self) -> float:
        """Return the filled share of the buffer; 0 when the connection has ended."""
        if self._transport is None:
            return 0.0
        return self._transport.get_write_buffer_size() / WRITE_BUFFER_BYTES

    def abort(self) -> None:
        """Close the connection and discard all bytes; if not yet made, close it on connect."""
        self._is_accepted = False
        self._has_more = False
        if self._piece is not None:
            self._piece = b""
        if self._transport is not None:
            self._transport.abort()


def _listening(url: LinkUrl) -> socket.socket:
    sock = bound(url, socket.SOCK_STREAM)
    try:
        notice_silence(sock)  # connections inherit it
        sock.listen()
    except OSError:
        sock.close()
        raise
    return sock
