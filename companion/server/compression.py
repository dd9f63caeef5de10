"""Compression of answers: zstd or gzip, whichever the client prefers.

A large answer is compressed on a thread, and once for all who get the same bytes: the answers
about many UAVs are shared (``companion.server.large_answers``). A small one takes less time than a
thread. Brotli would need another package, and packs these answers no smaller than zstd.
"""

import asyncio
import zlib
from typing import Final

import zstandard

from companion.server.shared_work import seen
from companion.server.threads import in_thread

LEAST_BYTES: Final = 1024  # a smaller body fits into one packet as it is
AT_ONCE_BYTES: Final = 16_384  # largest body that is compressed on the event loop, within 1 ms
KEPT: Final = 32  # compressed bodies that are kept for the next client
KEPT_BYTES: Final = 4 << 20  # most bytes of these before compression; one larger body is kept
GZIP_LEVEL, ZSTD_LEVEL = 6, 6
_GZIP_WINDOW: Final = 31  # zlib's largest window, with the head of gzip
_TEXTS: Final = ("text/", "application/json", "application/javascript", "image/svg+xml")


def is_text(media_type: str | None) -> bool:
    """Return whether a media type is worth compressing."""
    return media_type is not None and media_type.startswith(_TEXTS)


def preferred(accepted: str) -> str | None:
    """Return "zstd" or "gzip" by an Accept-Encoding header; None if it accepts neither."""
    offered = dict[str, float]()
    for part in accepted.lower().replace(" ", "").split(",")[:16]:
        name, _, quality = part.partition(";q=")
        try:
            offered[name] = float(quality) if quality else 1.0
        except ValueError:
            offered[name] = 0.0
    other = offered.get("*", 0.0)
    qualities = {name: offered.get(name, other) for name in ("zstd", "gzip")}
    best = max(qualities, key=lambda name: qualities[name])
    return best if qualities[best] > 0 else None


def compressed(body: bytes, encoding: str) -> bytes:
    """Return a body in an encoding of ``preferred``."""
    if encoding == "zstd":
        return zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress(body)
    packer = zlib.compressobj(GZIP_LEVEL, zlib.DEFLATED, _GZIP_WINDOW)
    return packer.compress(body) + packer.flush()


class SharedCompression:
    """Compressed bodies, each made once for all clients that get the same bytes."""

    def __init__(self) -> None:
        # The body is kept with its task: another one may not get its identity meanwhile.
        self._made: dict[tuple[int, str], tuple[bytes, asyncio.Task[bytes]]] = {}
        self._made_bytes = 0

    async def of(self, body: bytes, encoding: str) -> bytes:
        """Return a body in an encoding of ``preferred``."""
        if len(body) <= AT_ONCE_BYTES:
            return compressed(body, encoding)
        key = id(body), encoding
        found = self._made.get(key)
        if found is None:
            task = asyncio.create_task(in_thread(compressed, body, encoding))
            task.add_done_callback(seen)
            found = self._made[key] = body, task
            self._made_bytes += len(body)
            while len(self._made) > KEPT or (self._made_bytes > KEPT_BYTES and len(self._made) > 1):
                oldest, _ = self._made.pop(next(iter(self._made)))
                self._made_bytes -= len(oldest)
        return await asyncio.shield(found[1])  # a client that leaves must not cancel it for others
