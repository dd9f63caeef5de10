"""Writes tlogs for QGroundControl and MAVProxy: 8 bytes of Unix µs (big-endian) per frame."""

import asyncio
import logging
import math
import struct
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from companion.mavlink.links.urls import LinkError, LinkUrl
from companion.mavlink.wire.framing import Splitter
from companion.values import Frame, Rejection
from sitl_replay.traffic.links import PEERS_MAX, TrafficLink, open_link

log = logging.getLogger(__name__)

FLUSH_EVERY_NS: Final = 1_000_000_000


class TlogWriter:
    """A tlog being written; an existing file is replaced. Use it as a context manager.

    Flushed whenever the stamps have moved on by a second, which is what a killed process loses.
    Raises ``OSError`` where the file cannot be opened or written.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._flushed_ns = 0

    def write(self, t_ns: int, raw: bytes) -> None:
        """Append one whole frame, received or sent at ``t_ns`` (Unix time)."""
        self._file.write(struct.pack(">Q", t_ns // 1000) + raw)
        if abs(t_ns - self._flushed_ns) >= FLUSH_EVERY_NS:
            self.flush()
            self._flushed_ns = t_ns

    def flush(self) -> None:
        """Hand what was written so far to the system."""
        self._file.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()


@dataclass(slots=True, kw_only=True)
class Heard:
    """Counts of a recording so far: whole frames, their bytes, and what was not usable."""

    frames: int = 0
    octets: int = 0
    duration_s: float = 0.0
    messages: Counter[int] = field(default_factory=Counter)
    rejected: Counter[str] = field(default_factory=Counter)


async def record(
    url: LinkUrl, out: Path, duration_s: float | None = None, *, heard: Heard | None = None
) -> Heard:
    """Write what arrives over ``url`` to the tlog ``out``, and send nothing.

    The one exception: over ``udpout`` an empty datagram goes out each second until something is
    heard, since the peer cannot know otherwise that somebody listens.

    It ends when ``duration_s`` has passed, a TCP peer closes, a serial port vanishes, or it is
    cancelled. Stamps are Unix time at the start and go on with the monotonic clock: they never step
    back. What was heard is in the file a second later at the latest. Frames whose checksum is
    wrong, or cannot be checked because their id is unknown, are counted in ``Heard.rejected`` and
    not written.

    Raises ``OSError`` where ``out`` cannot be written, and ``LinkError`` where the link cannot be
    opened, breaks, or closes before ``duration_s``.
    """
    heard = Heard() if heard is None else heard
    loop = asyncio.get_running_loop()
    with TlogWriter(out) as writer:
        ear = _Ear(url, writer, heard)
        endpoint = await open_link(url, ear.take)
        if endpoint.url != url:
            log.warning("listening on %s", endpoint.url)
        start_s = loop.time()
        try:
            ended = await _listen(endpoint, ear, duration_s)
        finally:
            heard.duration_s = loop.time() - start_s
            await endpoint.close()
            ear.finish()
    if ended and endpoint.broken:
        raise LinkError(f"{url}: {endpoint.lost}")
    if ended and duration_s is not None:
        raise LinkError(f"{url}: closed after {heard.duration_s:.1f} s, {heard.frames} frames")
    return heard


async def _listen(endpoint: TrafficLink, ear: "_Ear", duration_s: float | None) -> bool:
    """Listen until the duration is over (False) or the link has ended (True)."""
    loop = asyncio.get_running_loop()
    end_s = math.inf if duration_s is None else loop.time() + duration_s
    while (left_s := end_s - loop.time()) > 0.0:
        if not ear.has_heard:
            endpoint.knock()
        waited_s = min(FLUSH_EVERY_NS * 1e-9, left_s)
        ends: set[asyncio.Future[Any]] = {ear.failed, endpoint.serving}
        await asyncio.wait(ends, timeout=waited_s, return_when=asyncio.FIRST_COMPLETED)
        if ear.failed.done():
            raise ear.failed.result()
        if endpoint.serving.done():
            return True
        ear.writer.flush()
    return False


class _Ear:
    """Bytes from peers, split into frames and written."""

    def __init__(self, url: LinkUrl, writer: TlogWriter, heard: Heard) -> None:
        self.writer = writer
        self.failed: asyncio.Future[OSError] = asyncio.get_running_loop().create_future()
        """Done where the file cannot be written, with the reason."""
        self.has_heard = False
        self._url = url
        self._heard = heard
        # One splitter a peer: a truncated datagram must not damage the next peer's frame.
        self._splitters: dict[object, Splitter] = {}
        self._unix_less_monotonic_ns = time.time_ns() - time.monotonic_ns()

    def take(self, peer: object, data: bytes) -> None:
        """Take in what a peer sent; ``b""`` when it has left."""
        if self.failed.done():
            return
        self.has_heard = True
        try:
            if data:
                self._keep(self._splitter(peer).feed(self._now_ns(), data))
            else:
                self._give_up(peer)
        except OSError as error:  # a full disk: it ends the recording, not the link
            self.failed.set_result(error)

    def finish(self) -> None:
        """Keep what an unfinished frame of each peer still hides."""
        for peer in tuple(self._splitters):
            self._give_up(peer)

    def _give_up(self, peer: object) -> None:
        splitter = self._splitters.pop(peer, None)
        if splitter is not None:
            self._keep(splitter.finish(self._now_ns()))

    def _keep(self, items: list[Frame | Rejection]) -> None:
        for item in items:
            if isinstance(item, Rejection):
                self._heard.rejected[item.reason.value] += item.count
                continue
            self.writer.write(item.t_ns, item.raw)
            self._heard.frames += 1
            self._heard.octets += len(item.raw)
            self._heard.messages[item.msgid] += 1

    def _splitter(self, peer: object) -> Splitter:
        if peer not in self._splitters:
            if len(self._splitters) >= PEERS_MAX:
                self._give_up(next(iter(self._splitters)))
            self._splitters[peer] = Splitter(str(self._url))
        return self._splitters[peer]

    def _now_ns(self) -> int:
        return time.monotonic_ns() + self._unix_less_monotonic_ns
