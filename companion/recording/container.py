"""Walks an MCAP file in the order in which it was written, as far as it is intact.

The index at a file's end is not used: a killed process leaves none, and it serves the order by
time, which is not the order in which things happened. Where the end exists, its copies of the
schemas and channels make up for a damaged chunk that held the originals.

Layout: https://mcap.dev/spec. A chunk counts only when its checksum holds. A damaged chunk in the
middle of a file is passed over and counted; a record that goes on past the end of the file ends the
walk.
"""

import contextlib
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Final, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema, Statistics
from mcap.stream_reader import get_chunk_data_stream
from zstandard import ZstdError

MAGIC: Final = b"\x89MCAP0\r\n"
_HEADER: Final = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_END: Final = struct.Struct("<BQQQI8s")
"""The footer record and the magic bytes.

Opcode, length, start of the summary, start of its offsets, and CRC-32 from the start of the summary
to just before itself.
"""
_UNCHECKED: Final = 4 + len(MAGIC)
_LARGEST_CHUNK: Final = 1 << 28
"""Largest chunk that is read, bytes, so that a damaged size does not ask for all of the memory.

Chunks of this program are about a mebibyte.
"""

# What torn or damaged bytes make the libraries raise; a failed checksum is a ValueError.
_DAMAGE: Final = (McapError, struct.error, ZstdError, ValueError, MemoryError)


class Message(NamedTuple):
    """A message of a recording, with the channel it is on."""

    channel: Channel
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes


class Damage(NamedTuple):
    """Bytes that could not be read, or whose meaning nothing describes."""

    size_bytes: int


Content = Message | Attachment | Metadata | Damage


class Walk:
    """One pass over a file. Iterate once; its attributes are complete afterwards.

    ``topics`` are those whose messages are returned; None: all; empty: none, and chunks are passed
    over unread. Raises ``OSError`` where the file cannot be read.
    """

    def __init__(self, path: Path, topics: frozenset[str] | None = None) -> None:
        self.schemas: dict[int, Schema] = {}
        self._described: set[int] = {0}  # 0: a channel without a schema, of other programs
        self.channels: dict[int, Channel] = {}
        self.complete = False
        """True if the file's end is there, so that it was closed in order."""
        self.lost_bytes = 0
        """Bytes that belong to no readable record."""
        self._path = path
        self._topics = topics

    def __iter__(self) -> Iterator[Content]:
        self._read_descriptions()
        for opcode, size, body in self._records():
            try:
                contents = self._contents(opcode, body)
            except _DAMAGE:
                self.lost_bytes += size
                yield Damage(size)
                continue
            yield from contents

    def _read_descriptions(self) -> None:
        """Read schemas and channels from the summary, if there is one and its checksum holds."""
        with contextlib.suppress(*_DAMAGE):  # another program's: the data has them as well
            self._in_chunk(_summary(self._path))

    def _records(self) -> Iterator[tuple[int, int, bytes]]:
        """(opcode, bytes in the file, body) of the records up to the file's end."""
        size = self._path.stat().st_size
        with self._path.open("rb") as file:
            at = len(file.read(len(MAGIC)))
            while len(header := file.read(_HEADER.size)) == _HEADER.size:
                opcode, length = _HEADER.unpack(header)
                stop = at + _HEADER.size + length
                if stop > size or opcode == 0:
                    break
                body = file.read(length)
                at = stop
                if opcode == Opcode.FOOTER:
                    self.complete = file.read(len(MAGIC)) == MAGIC
                    return
                yield opcode, _HEADER.size + length, body
        self.lost_bytes += size - at

    def _contents(self, opcode: int, body: bytes) -> list[Content]:
        if opcode == Opcode.CHUNK and self._topics != frozenset():
            chunk = Chunk.read(ReadDataStream(BytesIO(body)))
            if chunk.uncompressed_size > _LARGEST_CHUNK:
                raise ValueError("no chunk is that large")
            stream, size = get_chunk_data_stream(chunk, validate_crc=True)
            return self._in_chunk(stream.read(size))
        if opcode == Opcode.ATTACHMENT:
            return [Attachment.read(ReadDataStream(BytesIO(body)))]
        if opcode == Opcode.METADATA:
            return [Metadata.read(ReadDataStream(BytesIO(body)))]
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):  # a file without chunks
            return self._in_chunk(_HEADER.pack(opcode, len(body)) + body)
        return []

    def _in_chunk(self, data: bytes) -> list[Content]:
        """The wanted messages of a chunk; remembers the schemas and channels between them."""
        found: list[Content] = []
        at = orphaned = 0
        while at < len(data):
            opcode, length = _HEADER.unpack_from(data, at)
            start, at = at + _HEADER.size, at + _HEADER.size + length
            if opcode == Opcode.MESSAGE:
                channel_id, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(data, start)
                channel = self.channels.get(channel_id)
                if channel is None or channel.schema_id not in self._described:
                    orphaned += _HEADER.size + length
                elif self._topics is None or channel.topic in self._topics:
                    raw = data[start + _MESSAGE.size : at]
                    found.append(Message(channel, sequence, log_ns, publish_ns, raw))
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(data[start:at])))
                self.schemas[schema.id] = schema
                self._described.add(schema.id)
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(ReadDataStream(BytesIO(data[start:at])))
                self.channels[channel.id] = channel
        if orphaned:  # the chunk that described their channel was damaged
            self.lost_bytes += orphaned
            found.append(Damage(orphaned))
        return found


def span_ns(path: Path) -> tuple[int, int] | None:
    """The first and last time of the messages of a finished file, by its summary; else None.

    Raises ``OSError`` where the file cannot be read.
    """
    summary, at = _summary(path), 0
    with contextlib.suppress(*_DAMAGE):
        while at < len(summary):
            opcode, length = _HEADER.unpack_from(summary, at)
            at += _HEADER.size
            if opcode == Opcode.STATISTICS:
                found = Statistics.read(ReadDataStream(BytesIO(summary[at : at + length])))
                times_ns = found.message_start_time, found.message_end_time
                return times_ns if found.message_count else None
            at += length
    return None


def _summary(path: Path) -> bytes:
    """The records of a file's summary; empty without one, or where its checksum does not hold."""
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(0, size - _END.size))
        end = file.read()
        if not end.endswith(MAGIC) or end[0] != Opcode.FOOTER:  # a short file starts otherwise
            return b""
        _, _, summary_at, _, checksum, _ = _END.unpack(end)
        if not 0 < summary_at <= size - _END.size:
            return b""
        file.seek(summary_at)
        summary = file.read(size - summary_at)
    return summary[: -_END.size] if zlib.crc32(summary[:-_UNCHECKED]) == checksum else b""
