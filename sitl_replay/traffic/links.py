"""Links of the generator, one endpoint of ``companion.mavlink.links`` each, open for one run.

udpout:HOST:PORT      one datagram per frame, to one peer
udpin:HOST:PORT       to every peer that has sent a datagram to this port
tcp:HOST:PORT         connect, once
tcpin:HOST:PORT       to every client from its connection on, as SITL does
serial:DEVICE:BAUD    a serial port
zenoh:KEY             to every listener over Zenoh; ?as=hub is the vehicles' end

There is no reconnection to a lost peer. Sending never waits for a slow peer: a frame that it does
not accept is dropped and counted. To wait for room instead, await ``writable`` first.
"""

import asyncio
import contextlib
from collections.abc import Callable, Collection, Hashable
from typing import Final

from companion.mavlink.links import transport
from companion.mavlink.links.endpoints import HungUpError, Upcalls, reason
from companion.mavlink.links.status import LinkStatus
from companion.mavlink.links.urls import LinkError, LinkUrl

PEERS_MAX: Final = (
    256  # maximum peers of a listening UDP link; the one silent for longest is removed
)
LINGER_S: Final = 1.0  # maximum wait for buffered data when closing
FULL: Final = 0.5  # share of a peer's buffer above which writable waits
RETRY_S: Final = 1.0
"""Time from the loss of a network route to the next attempt; datagrams are dropped meanwhile."""
_ROOM_POLL_S: Final = 0.001
_FIRST_PEER_POLL_S: Final = 0.01

Receive = Callable[[Hashable, bytes], None]
"""Function called with a peer's key and the received bytes; ``b""`` if the peer has closed."""


def ignore(_peer: Hashable, _data: bytes) -> None:
    """Discard received bytes: a ``Receive`` for links that only send."""


class TrafficLink:
    """Link to send and receive frames; made by ``open_link``.

    url      the link, with the port that the system chose for port 0
    lost     why the link has ended; empty while it is open
    broken   whether it ended by an error, rather than closed by the peer
    dropped  frames not sent, because a peer is too slow or there is none
    serving  done when the link has ended
    """

    def __init__(self, url: LinkUrl, receive: Receive) -> None:
        self.url = url
        self.lost = ""
        self.broken = False
        self.dropped = 0
        self.serving: asyncio.Task[None]
        self._receive = receive
        self._up = asyncio.Event()
        self._heard: dict[Hashable, None] = {}  # the most recent one last
        upcalls = Upcalls(
            up=self._up.set,
            take=self._take,
            stale=lambda *_: None,
            on_peer_gone=self._hang_up,
            overflow=lambda _: None,
        )
        self._endpoint = transport.endpoint(url, LinkStatus(url=str(url)), upcalls)

    async def open(self) -> None:
        """Bind the address, connect or open the device. Raises ``LinkError`` if impossible."""
        try:
            port = self._endpoint.open()
        except OSError as error:
            raise LinkError(f"{self.url}: {reason(error)}") from error
        if port is not None:
            self.url = LinkUrl(scheme=self.url.scheme, host=self.url.host, port=port)
        self.serving = asyncio.create_task(self._serve())
        up = asyncio.create_task(self._up.wait())
        try:
            await asyncio.wait({self.serving, up}, return_when=asyncio.FIRST_COMPLETED)
        except asyncio.CancelledError:
            self.serving.cancel()
            raise
        finally:
            up.cancel()
        if not self._up.is_set():
            self.serving.result()
            raise LinkError(f"{self.url}: {self.lost}")

    async def _serve(self) -> None:
        while True:
            try:
                await self._endpoint.serve()
            except OSError as error:
                # A UDP route may recover; a stream that has ended does not.
                if self.url.scheme != "udpout" or not self._up.is_set():
                    self.lost = reason(error)
                    self.broken = not isinstance(error, HungUpError)
                    return
            await asyncio.sleep(RETRY_S)

    def peers(self) -> Collection[Hashable]:
        """All peers to which a frame is sent."""
        peers = self._endpoint.peers()
        return tuple(self._heard) if peers is None else peers

    async def first_peer(self) -> None:
        """Wait until a peer is connected, or the link has ended."""
        while not self.peers() and not self.serving.done():
            await asyncio.sleep(_FIRST_PEER_POLL_S)

    def send(self, raw: bytes) -> None:
        """Send one frame to all peers, or drop it. Never waits, never raises."""
        if self.serving.done():
            return
        peers = self.peers()
        self.dropped += not peers
        for key in peers:
            self.dropped += not self._endpoint.write(key, raw)

    def send_empty(self) -> None:
        """Send an empty datagram, for peers that only answer senders they know.

        No effect on links other than ``udpout``.
        """
        if self.url.scheme == "udpout":
            self._endpoint.write(None, b"")

    async def writable(self) -> None:
        """Wait until all peers, at least one, accept a frame, or the link has ended."""
        await self.first_peer()
        while self._max_fullness() > FULL:
            await asyncio.sleep(_ROOM_POLL_S)
            await self.first_peer()

    async def close(self) -> None:
        """Send the buffered data, within a second, and close the link.

        Raises the exception that ended the link, if it was a defect.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LINGER_S):
                while self._max_fullness() > 0.0:
                    await asyncio.sleep(_ROOM_POLL_S)
        self.serving.cancel()
        await asyncio.wait({self.serving})
        if not self.serving.cancelled():
            self.serving.result()

    def _max_fullness(self) -> float:
        return max((self._endpoint.fullness(key) for key in self.peers()), default=0.0)

    def _take(self, key: Hashable, data: bytes, _age_ns: int | None) -> bool:
        if self.url.scheme == "udpin":
            self._heard.pop(key, None)
            self._heard[key] = None
            if len(self._heard) > PEERS_MAX:
                del self._heard[next(iter(self._heard))]
        if data:
            self._receive(key, data)
        return False

    def _hang_up(self, key: Hashable) -> None:
        self._receive(key, b"")


async def open_link(url: LinkUrl, receive: Receive = ignore) -> TrafficLink:
    """Open a link. Raises ``LinkError`` if the link cannot be opened."""
    link = TrafficLink(url, receive)
    await link.open()
    return link
