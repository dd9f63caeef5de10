"""Writes tlogs: what QGroundControl and MAVProxy read, 8 bytes of Unix µs (big-endian) a frame."""

import asyncio
import socket
import struct
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from companion.values import Frame, Rejection
from sitl_replay.links import LinkError, Url, reason

if TYPE_CHECKING:
    from companion.mavlink.framing import Splitter

FLUSH_EVERY_NS = 1_000_000_000
RECEIVE_BUFFER_BYTES = 4 << 20
MAX_PEERS = 256


class TlogWriter:
    """A tlog being written; an existing file is replaced. Use it as a context manager.

    Flushed whenever the stamps have moved on by a second: what a killed process loses.
    Errors: ``OSError`` where the file cannot be opened or written.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._flushed_ns = 0

    def write(self, t_ns: int, raw: bytes) -> None:
        """Append one whole frame, received or sent at ``t_ns`` (Unix time)."""
        self._file.write(struct.pack(">Q", t_ns // 1000) + raw)
        if abs(t_ns - self._flushed_ns) >= FLUSH_EVERY_NS:
            self._file.flush()
            self._flushed_ns = t_ns

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()


@dataclass(slots=True)
class Heard:
    """What a recording has so far: whole frames, their bytes, and what was not usable."""

    frames: int = 0
    octets: int = 0
    duration_s: float = 0.0
    messages: Counter[int] = field(default_factory=Counter)
    rejected: Counter[str] = field(default_factory=Counter)


async def record(
    url: Url, out: Path, duration_s: float | None = None, *, heard: Heard | None = None
) -> Heard:
    """Write what arrives over ``url`` (``udpin:`` or ``tcp:``) to the tlog ``out``.

    Until ``duration_s`` has passed, a TCP peer closes, or it is cancelled. Frames whose checksum
    does not hold, or cannot be checked because their id is unknown, are counted in
    ``Heard.rejected`` and not written.
    Errors: ``OSError`` where ``out`` cannot be written; ``LinkError`` where the link cannot be
    opened, or closes before ``duration_s``.
    """
    heard = Heard() if heard is None else heard
    loop = asyncio.get_running_loop()
    with TlogWriter(out) as writer:
        listener = _Listener(url, writer, heard)
        transport = await _open(listener, url)
        start_s = loop.time()
        try:
            await asyncio.wait_for(listener.ended, duration_s)
        except TimeoutError:
            return heard
        finally:
            heard.duration_s = loop.time() - start_s
            transport.close()
            listener.finish()
    if duration_s is not None:
        raise LinkError(f"{url}: closed after {heard.duration_s:.1f} s, {heard.frames} frames")
    return heard


class _Listener(asyncio.DatagramProtocol, asyncio.Protocol):
    """Both kinds of link end here: bytes from a peer, split into frames, written."""

    def __init__(self, url: Url, writer: TlogWriter, heard: Heard) -> None:
        self.ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._url = url
        self._writer = writer
        self._heard = heard
        # One splitter a peer: a truncated datagram must not damage the next peer's frame.
        self._splitters: dict[object, Splitter] = {}

    def datagram_received(self, data: bytes, addr: object) -> None:
        self._take(data, addr)

    def data_received(self, data: bytes) -> None:
        self._take(data, self._url)

    def connection_lost(self, exc: Exception | None) -> None:
        if self.ended.done():
            return
        if exc is None:
            self.ended.set_result(None)
        else:
            self.ended.set_exception(LinkError(f"{self._url}: {reason(exc)}"))

    def _take(self, data: bytes, peer: object) -> None:
        if self.ended.done():
            return
        try:
            self._write(data, peer)
        except OSError as error:  # a full disk: asyncio would log it and go on
            self.ended.set_exception(error)

    def _write(self, data: bytes, peer: object) -> None:
        self._keep(self._splitter(peer).feed(time.time_ns(), data))

    def finish(self) -> None:
        """Keep what an unfinished frame of each peer still hides."""
        for splitter in self._splitters.values():
            self._keep(splitter.finish(time.time_ns()))

    def _keep(self, items: list[Frame | Rejection]) -> None:
        for item in items:
            if isinstance(item, Rejection):
                self._heard.rejected[item.reason.value] += item.count
                continue
            self._writer.write(item.t_ns, item.raw)
            self._heard.frames += 1
            self._heard.octets += len(item.raw)
            self._heard.messages[item.msgid] += 1

    def _splitter(self, peer: object) -> "Splitter":
        from companion.mavlink.framing import Splitter

        if peer not in self._splitters:
            if len(self._splitters) >= MAX_PEERS:
                del self._splitters[next(iter(self._splitters))]
            self._splitters[peer] = Splitter(str(self._url))
        return self._splitters[peer]


async def _open(listener: _Listener, url: Url) -> asyncio.BaseTransport:
    loop = asyncio.get_running_loop()
    transport: asyncio.BaseTransport
    try:
        if url.scheme == "tcp":
            transport, _ = await loop.create_connection(lambda: listener, url.host, url.port)
        else:
            transport, _ = await loop.create_datagram_endpoint(
                lambda: listener, local_addr=(url.host, url.port)
            )
            endpoint: socket.socket = transport.get_extra_info("socket")
            endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
    except (OSError, UnicodeError) as error:
        raise LinkError(f"{url}: {reason(error)}") from error
    return transport
