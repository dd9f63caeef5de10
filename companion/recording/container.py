"""Parser of MCAP files in the order in which they were written, up to their damage.

The index at a file's end is not used: a killed process leaves none, and it orders by time, which is
not the order of events. If the end exists, its copies of the schemas and channels replace those of
a damaged chunk.

Layout: https://mcap.dev/spec. A chunk counts only if its checksum is valid. A damaged chunk in the
middle of a file is skipped and counted; a record that extends past the end of the file ends the
parsing. Lengths are checked against the file and against the limits below, so that memory and time
are bounded by the size of the file, also for malicious files.
"""

import contextlib
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, Final, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema, Statistics

from companion.recording.unpacking import unpacked

MAGIC: Final = b"\x89MCAP0\r\n"
_HEADER: Final = struct.Struct("<BQ")  # opcode, length of the body
_MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_END: Final = struct.Struct("<BQQQI8s")
"""Layout of an MCAP file's footer record and magic bytes.

Opcode, length, start of the summary, start of its offsets, and CRC-32 from the start of the summary
to just before itself.
"""
_UNCHECKED: Final = 4 + len(MAGIC)

LARGEST: Final = 1 << 25
"""Limit on the bytes of an MCAP record, or of a chunk's contents.

Chunks of this program have about 1 MiB, the largest settings 27 MiB.
"""
_LARGEST_MESSAGE: Final = 1 << 24
_LARGEST_SUMMARY: Final = 1 << 26  # two weeks of a chunk a second
_DESCRIPTIONS: Final = 1 << 25  # limit on all schemas and channels together, bytes
_LARGEST_PAIRS: Final = 1 << 16
"""Limit on the bytes of a channel record or of a metadata record.

Their names and values become objects of many more bytes; those of this program have hundreds.
"""
_PAIR: Final = 256  # overhead of a name and its value in memory, bytes
_MOST: Final = 10_000  # limit each on attachments and on metadata records of a file
_RATIO_MAX: Final = 50
"""Limit on unpacked bytes per byte of a file, beyond the contents of one largest chunk.

Ten times the ratio found in recordings; a decompression bomb has thousands.
"""

# Exceptions of the library for damaged bytes; a failed checksum is a ValueError.
_DAMAGE: Final = (McapError, struct.error, ValueError, OverflowError)


_READ: Final = frozenset(
    (Opcode.ATTACHMENT, Opcode.METADATA, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
)
"""Record types that are read outside of chunks; the others are indexes."""


class Message(NamedTuple):
    """Message of a recording, with its channel."""

    channel: Channel
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes


class Damage(NamedTuple):
    """Bytes of a recording that could not be read, or that lack a description."""

    size_bytes: int


Content = Message | Attachment | Metadata | Damage


class Walk:
    """Single pass over an MCAP file. Iterate once; its attributes are complete afterwards.

    ``topics`` limits the messages returned. None: all. Empty: none; chunks are skipped unread.
    Raises ``OSError`` if the file cannot be read.
    """

    def __init__(self, path: Path, topics: frozenset[str] | None = None) -> None:
        self.schemas: dict[int, Schema] = {}
        self._described: set[int] = {0}  # 0: a channel without a schema, by other programs
        self.channels: dict[int, Channel] = {}
        self.complete = False  # whether the file has its end, so was closed properly
        self.lost_bytes = 0  # bytes outside of readable records
        self.incomplete_bytes = 0  # those after the last complete record of a file without end
        self.bytes_after_end = 0  # those of another file that was appended
        self.path = path
        self._topics = topics
        self._described_bytes = 0
        self._channel_bodies: dict[bytes, bytes] = {}  # by the bytes of the channel's id
        self._counts: Counter[int] = Counter()  # attachments and metadata, by opcode
        self._room = 0  # remaining limit on unpacked bytes

    def __iter__(self) -> Iterator[Content]:
        self._read_descriptions()
        with self.path.open("rb") as file:
            for opcode, length in self._records(file):
                if not self._is_wanted(opcode):
                    continue
                if self._is_beyond(opcode):
                    self.lost_bytes += _HEADER.size + length
                    continue
                try:
                    yield from self._contents(opcode, file, length)
                except _DAMAGE:
                    self.lost_bytes += _HEADER.size + length
                    yield Damage(_HEADER.size + length)

    def _read_descriptions(self) -> None:
        """Read schemas and channels from the summary, if it exists and its checksum is valid."""
        with contextlib.suppress(*_DAMAGE):  # then the data section has them as well
            for opcode, body in _split(_summary(self.path)):
                self._describe(opcode, body)

    def _records(self, file: IO[bytes]) -> Iterator[tuple[int, int]]:
        """Yield (opcode, length) of each record, with the file positioned at the record's body."""
        size = self.path.stat().st_size
        self._room = LARGEST + _RATIO_MAX * size
        at = len(file.read(len(MAGIC)))
        while len(header := file.read(_HEADER.size)) == _HEADER.size:
            opcode, length = _HEADER.unpack(header)
            stop = at + _HEADER.size + length
            if stop > size or opcode == 0:
                break
            if opcode == Opcode.FOOTER:
                file.seek(stop)
                self.complete = file.read(len(MAGIC)) == MAGIC
                self.bytes_after_end = size - file.tell()
                self.lost_bytes += self.bytes_after_end
                return
            yield opcode, length
            file.seek(stop)
            at = stop
        self.incomplete_bytes = size - at
        self.lost_bytes += size - at

    def _is_wanted(self, opcode: int) -> bool:
        if opcode == Opcode.CHUNK:
            return self._topics != frozenset()
        return opcode in _READ

    def _is_beyond(self, opcode: int) -> bool:
        if opcode not in (Opcode.ATTACHMENT, Opcode.METADATA):
            return False
        self._counts[opcode] += 1
        return self._counts[opcode] > _MOST

    def _contents(self, opcode: int, file: IO[bytes], length: int) -> Iterator[Content]:
        if length > (_LARGEST_PAIRS if opcode == Opcode.METADATA else LARGEST):
            raise ValueError("record exceeds the size limit")
        body = file.read(length)
        if opcode == Opcode.CHUNK:
            data = unpacked(body, min(LARGEST, self._room))
            self._room -= len(data)
            yield from self._in_chunk(data)
        elif opcode == Opcode.ATTACHMENT:
            yield Attachment.read(ReadDataStream(BytesIO(body)))
        elif opcode == Opcode.METADATA:
            yield Metadata.read(ReadDataStream(BytesIO(body)))
        else:  # a file without chunks
            yield from self._in_chunk(_HEADER.pack(opcode, len(body)) + body)

    def _in_chunk(self, data: bytes) -> Iterator[Content]:
        """Yield the wanted messages of a chunk; store its schemas and channels."""
        channels, topics = self.channels, self._topics
        orphaned = 0
        for opcode, body in _split(data):
            if opcode != Opcode.MESSAGE:
                self._describe(opcode, body)
                continue
            channel_id, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(body)
            channel = channels.get(channel_id)
            if channel is None or channel.schema_id not in self._described:
                orphaned += _HEADER.size + len(body)
            elif topics is None or channel.topic in topics:
                yield Message(
                    channel=channel,
                    sequence=sequence,
                    log_time_ns=log_ns,
                    publish_time_ns=publish_ns,
                    data=body[_MESSAGE.size :],
                )
        if orphaned:  # the chunk with the description of their channel was damaged
            self.lost_bytes += orphaned
            yield Damage(orphaned)

    def _describe(self, opcode: int, body: bytes) -> None:
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(BytesIO(body)))
            if schema != self.schemas.get(schema.id):
                self._take(len(body))
                self.schemas[schema.id] = schema
                self._described.add(schema.id)
        elif opcode == Opcode.CHANNEL:
            if body == self._channel_bodies.get(body[:2]):
                return
            if len(body) > _LARGEST_PAIRS:
                raise ValueError("channel exceeds the size limit")
            self._take(len(body))
            channel = Channel.read(ReadDataStream(BytesIO(body)))
            self._take(_PAIR * len(channel.metadata))
            self.channels[channel.id] = channel
            self._channel_bodies[body[:2]] = body

    def _take(self, size: int) -> None:
        self._described_bytes += size
        if self._described_bytes > _DESCRIPTIONS:
            raise ValueError("descriptions exceed the size limit")


def _split(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield (opcode, body) of the records in a chunk. ``ValueError`` for an incomplete record."""
    at, end = 0, len(data)
    while at < end:
        opcode, length = _HEADER.unpack_from(data, at)
        start = at + _HEADER.size
        at = start + length
        if at > end or not opcode or (opcode == Opcode.MESSAGE and length > _LARGEST_MESSAGE):
            raise ValueError("invalid record, or one that exceeds its chunk")
        yield opcode, data[start:at]


def span_ns(path: Path) -> tuple[int, int] | None:
    """Return the first and last time of a finished file's messages, from its summary; else None.

    Raises ``OSError`` if the file cannot be read.
    """
    with contextlib.suppress(*_DAMAGE):
        for opcode, body in _split(_summary(path)):
            if opcode == Opcode.STATISTICS:
                found = Statistics.read(ReadDataStream(BytesIO(body)))
                times_ns = found.message_start_time, found.message_end_time
                return times_ns if found.message_count else None
    return None


def _summary(path: Path) -> bytes:
    """Return the records of a file's summary; empty without one, or if its checksum is invalid."""
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(0, size - _END.size))
        end = file.read()
        if not end.endswith(MAGIC) or end[0] != Opcode.FOOTER:  # a short file starts otherwise
            return b""
        _, _, summary_at, _, checksum, _ = _END.unpack(end)
        if not 0 < summary_at <= size - _END.size or size - summary_at > _LARGEST_SUMMARY:
            return b""
        file.seek(summary_at)
        summary = file.read(size - summary_at)
    return summary[: -_END.size] if zlib.crc32(summary[:-_UNCHECKED]) == checksum else b""
