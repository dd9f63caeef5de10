"""Recorder of tlogs for QGroundControl and MAVProxy: 8 bytes of Unix µs (big-endian) per frame."""

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
    """Tlog that is being written, as a context manager; an existing file is overwritten.

    The file is flushed every second of time stamps, so a killed process loses at most a second.
    Raises ``OSError`` if the file cannot be opened or written.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._flushed_ns = 0

    def write(self, t_ns: int, raw: bytes) -> None:
        """Append one frame, received or sent at ``t_ns`` (Unix time)."""
        self._file.write(struct.pack(">Q", t_ns // 1000) + raw)
        if abs(t_ns - self._flushed_ns) >= FLUSH_EVERY_NS:
            self.flush()
            self._flushed_ns = t_ns

    def flush(self) -> None:
        """Flush the buffer to the operating system."""
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
class RecordingTally:
    """Counts of a recording so far: frames, their bytes, and unusable data."""

    frames: int = 0
    octets: int = 0
    duration_s: float = 0.0
    messages: Counter[int] = field(default_factory=Counter)
    rejected: Counter[str] = field(default_factory=Counter)


async def record(
    url: LinkUrl, out: Path, duration_s: float | None = None, *, heard: RecordingTally | None = None
) -> RecordingTally:
    """Record what arrives over ``url`` to the tlog ``out``.

    Nothing is sent, except over ``udpout``: an empty datagram each second until the first reply, to
    make this end known to the peer.

    Ends after ``duration_s``, when a TCP peer closes, when a serial port disappears, or on
    cancellation. Time stamps are Unix time at the start, continued with the monotonic clock, and
    never step back. Data is in the file after at most a second. Frames with a wrong checksum or an
    unknown message id are counted in ``RecordingTally.rejected`` and not written.

    Raises ``OSError`` if ``out`` cannot be written, and ``LinkError`` if the link cannot be opened,
    fails, or closes before ``duration_s``.
    """
    heard = RecordingTally() if heard is None else heard
    loop = asyncio.get_running_loop()
    with TlogWriter(out) as writer:
        frame_writer = _FrameWriter(url, writer, heard)
        endpoint = await open_link(url, frame_writer.take)
        if endpoint.url != url:
            log.warning("listening on %s", endpoint.url)
        start_s = loop.time()
        try:
            ended = await _listen(endpoint, frame_writer, duration_s)
        finally:
            heard.duration_s = loop.time() - start_s
            await endpoint.close()
            frame_writer.finish()
    if ended and endpoint.broken:
        raise LinkError(f"{url}: {endpoint.lost}")
    if ended and duration_s is not None:
        raise LinkError(f"{url}: closed after {heard.duration_s:.1f} s, {heard.frames} frames")
    return heard


async def _listen(
    endpoint: TrafficLink, frame_writer: "_FrameWriter", duration_s: float | None
) -> bool:
    """Receive until the duration is over (return False) or the link has ended (True)."""
    loop = asyncio.get_running_loop()
    end_s = math.inf if duration_s is None else loop.time() + duration_s
    while (left_s := end_s - loop.time()) > 0.0:
        if not frame_writer.has_heard:
            endpoint.send_empty()
        waited_s = min(FLUSH_EVERY_NS * 1e-9, left_s)
        ends: set[asyncio.Future[Any]] = {frame_writer.failed, endpoint.serving}
        await asyncio.wait(ends, timeout=waited_s, return_when=asyncio.FIRST_COMPLETED)
        if frame_writer.failed.done():
            raise frame_writer.failed.result()
        if endpoint.serving.done():
            return True
        frame_writer.writer.flush()
    return False


class _FrameWriter:
    """Writer that splits the bytes of peers into frames and writes the frames."""

    def __init__(self, url: LinkUrl, writer: TlogWriter, heard: RecordingTally) -> None:
        self.writer = writer
        self.failed: asyncio.Future[OSError] = asyncio.get_running_loop().create_future()
        """Done if the file cannot be written, with the error."""
        self.has_heard = False
        self._url = url
        self._heard = heard
        # A splitter per peer: a truncated datagram must not affect frames of other peers.
        self._splitters: dict[object, Splitter] = {}
        self._unix_less_monotonic_ns = time.time_ns() - time.monotonic_ns()

    def take(self, peer: object, data: bytes) -> None:
        """Process the bytes of a peer; ``b""`` if the peer has closed."""
        if self.failed.done():
            return
        self.has_heard = True
        try:
            if data:
                self._keep(self._splitter(peer).feed(self._now_ns(), data))
            else:
                self._give_up(peer)
        except OSError as error:  # such as a full disk; ends the recording
            self.failed.set_result(error)

    def finish(self) -> None:
        """Process the remaining bytes of each peer's unfinished frame."""
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
