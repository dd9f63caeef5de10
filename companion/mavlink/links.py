"""Where MAVLink comes from: asyncio endpoints.                                           [shell]

    udpin:HOST:PORT    listen for datagrams, from any number of peers
    tcp:HOST:PORT      connect, and connect again when the peer goes away

IPv6 hosts stand in brackets. Every peer has its own splitter: what one peer truncates cannot
damage another's frames.
"""

import asyncio
import contextlib
import socket
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from companion.mavlink.framing import Splitter
from companion.mavlink.urls import LinkError, LinkUrl
from companion.values import Frame, Rejection

RECEIVE_BUFFER_BYTES: Final = 4 << 20
"""Stock socket buffers lose frames from about 20 000 a second on (measured)."""
PEERS_MAX: Final = 4096
"""Splitters kept for the peers heard last: a scan of the port must not fill the memory."""
RETRY_S: Final = (0.2, 0.5, 1.0, 2.0, 5.0)

Receive = Callable[[list[Frame | Rejection]], None]


@dataclass(slots=True)
class LinkStatus:
    """What a link has seen so far."""

    url: str
    state: str = "down"
    frames: int = 0
    bytes: int = 0
    peers: int = 0
    lost: dict[str, int] = field(default_factory=dict)


class Link:
    """One endpoint: call ``open`` for early errors, then ``run`` until cancelled.

    ``receive`` is called with what each datagram or read held, on the event loop; ``now_ns`` is
    the node's timeline.
    """

    def __init__(self, url: LinkUrl, receive: Receive, now_ns: Callable[[], int]) -> None:
        self.url = url
        self.status = LinkStatus(str(url))
        self._receive = receive
        self._now_ns = now_ns
        self._splitters: OrderedDict[object, Splitter] = OrderedDict()
        self._socket: socket.socket | None = None

    def open(self) -> None:
        """Bind a listening link; ``LinkError`` where the address cannot be had."""
        if self.url.scheme != "udpin":
            return
        self._socket = _bound_udp(self.url)
        self.status.url = str(LinkUrl("udpin", self.url.host, self._socket.getsockname()[1]))

    async def run(self) -> None:
        """Serve until cancelled."""
        try:
            await (self._run_udp() if self.url.scheme == "udpin" else self._run_tcp())
        finally:
            self.status.state = "down"

    def _hang_up(self, peer: object) -> None:
        """The peer is gone: what its last, unfinished frame swallowed is looked through."""
        splitter = self._splitters.pop(peer, None)
        if splitter is not None:
            self._count(splitter.finish(self._now_ns()))

    def take(self, peer: object, data: bytes) -> None:
        """Split what a peer sent and hand it on."""
        splitter = self._splitters.get(peer)
        if splitter is None:
            splitter = self._splitters.setdefault(peer, Splitter(self.status.url))
            self.status.peers += 1
            if len(self._splitters) > PEERS_MAX:
                self._splitters.popitem(last=False)
        else:
            self._splitters.move_to_end(peer)
        self.status.bytes += len(data)
        self._count(splitter.feed(self._now_ns(), data))

    def _count(self, found: list[Frame | Rejection]) -> None:
        for item in found:
            if isinstance(item, Rejection):
                self.status.lost[item.reason] = self.status.lost.get(item.reason, 0) + item.count
            else:
                self.status.frames += 1
        if found:
            self._receive(found)

    async def _run_udp(self) -> None:
        assert self._socket is not None, "open() comes first"
        loop = asyncio.get_running_loop()
        transport, _ = await loop.create_datagram_endpoint(
            lambda: _Datagrams(self), sock=self._socket
        )
        self.status.state = "up"
        try:
            await loop.create_future()  # until cancelled
        finally:
            transport.close()

    async def _run_tcp(self) -> None:
        attempt = 0
        while True:
            with contextlib.suppress(OSError):
                reader, writer = await asyncio.open_connection(self.url.host, self.url.port)
                attempt = 0
                self.status.state = "up"
                try:
                    while data := await reader.read(1 << 16):
                        self.take(None, data)
                finally:
                    self._hang_up(None)
                    writer.close()
            self.status.state = "connecting"
            await asyncio.sleep(RETRY_S[min(attempt, len(RETRY_S) - 1)])
            attempt += 1


class _Datagrams(asyncio.DatagramProtocol):
    """One socket serves all its senders."""

    def __init__(self, link: Link) -> None:
        self._link = link

    def datagram_received(self, data: bytes, addr: tuple[str | int, ...]) -> None:
        self._link.take(addr, data)


def _bound_udp(url: LinkUrl) -> socket.socket:
    try:
        family = socket.AF_INET6 if url.is_ipv6 else socket.AF_INET
        bound = socket.socket(family, socket.SOCK_DGRAM)
    except OSError as error:
        raise LinkError(f"{url}: {error.strerror}") from error
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        bound.setblocking(False)
        bound.bind((url.host, url.port))
    except OSError as error:
        bound.close()
        raise LinkError(f"{url}: {error.strerror}") from error
    return bound
