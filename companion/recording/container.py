"""Walks an MCAP file in the order in which it was written, as far as it is intact.

The index at a file's end is not used: a killed process leaves none, and it serves the order by
time, which is not the order in which things happened. Where the end exists, its copies of the
schemas and channels make up for a damaged chunk that held the originals.

Layout: https://mcap.dev/spec. A chunk counts only when its checksum holds. A damaged chunk in the
middle of a file is passed over and counted; a record that goes on past the end of the file ends the
walk. No length is believed: each is held against what is there and against the limits below, so
that memory and time are bounded by the size of the file, whoever made it.
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
_HEADER: Final = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE: Final = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_END: Final = struct.Struct("<BQQQI8s")
"""The footer record and the magic bytes.

Opcode, length, start of the summary, start of its offsets, and CRC-32 from the start of the summary
to just before itself.
"""
_UNCHECKED: Final = 4 + len(MAGIC)

LARGEST: Final = 1 << 25
"""Most bytes of a record, or of a chunk's contents, that are read; chunks of this program have
about a mebibyte, and the largest settings 27."""
_LARGEST_MESSAGE: Final = 1 << 24
_LARGEST_SUMMARY: Final = 1 << 26  # two weeks of a chunk a second
_DESCRIPTIONS: Final = 1 << 25  # most bytes of all schemas and channels together
_LARGEST_PAIRS: Final = 1 << 16
"""Most bytes of a channel, or of a record of metadata: names and values, many of which are
objects of far more bytes; those of this program have hundreds."""
_PAIR: Final = 256  # bytes that a name and its value take in memory, beside their own
_MOST: Final = 10_000  # most attachments, and most records of metadata, that are read of a file
_PACKED: Final = 50
"""Most bytes of contents for each byte of a file, beside one largest chunk: as much as ten times
what is found in recordings, where a bomb has thousands."""

# What torn or damaged bytes make the library raise; a failed checksum is a ValueError.
_DAMAGE: Final = (McapError, struct.error, ValueError, OverflowError)


_READ: Final = frozenset(
    (Opcode.ATTACHMENT, Opcode.METADATA, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
)
"""Records beside chunks that are read; the others are indexes."""


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
        self.complete = False  # true if the file's end is there, so that it was closed in order
        self.lost_bytes = 0  # bytes that belong to no readable record
        self.path = path
        self._topics = topics
        self._described_bytes = 0
        self._channel_bodies: dict[bytes, bytes] = {}  # by the bytes of its id, as it was read
        self._counts: Counter[int] = Counter()  # attachments and metadata, by opcode
        self._room = 0  # bytes that chunks may yet unpack to

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
        """Read schemas and channels from the summary, if there is one and its checksum holds."""
        with contextlib.suppress(*_DAMAGE):  # another program's: the data has them as well
            for opcode, body in _split(_summary(self.path)):
                self._describe(opcode, body)

    def _records(self, file: IO[bytes]) -> Iterator[tuple[int, int]]:
        """(opcode, length) of the records up to the file's end, the file standing at the body."""
        size = self.path.stat().st_size
        self._room = LARGEST + _PACKED * size
        at = len(file.read(len(MAGIC)))
        while len(header := file.read(_HEADER.size)) == _HEADER.size:
            opcode, length = _HEADER.unpack(header)
            stop = at + _HEADER.size + length
            if stop > size or opcode == 0:
                break
            if opcode == Opcode.FOOTER:
                file.seek(stop)
                self.complete = file.read(len(MAGIC)) == MAGIC
                return
            yield opcode, length
            file.seek(stop)
            at = stop
        self.lost_bytes += size - at

    def _is_wanted(self, opcode: int) -> bool:
        if opcode == Opcode.CHUNK:
            return self._topics != frozenset()
        return opcode in _READ

    def _is_beyond(self, opcode: int) -> bool:
        """Whether this is an attachment or a record of metadata more than any file has."""
        if opcode not in (Opcode.ATTACHMENT, Opcode.METADATA):
            return False
        self._counts[opcode] += 1
        return self._counts[opcode] > _MOST

    def _contents(self, opcode: int, file: IO[bytes], length: int) -> Iterator[Content]:
        if length > (_LARGEST_PAIRS if opcode == Opcode.METADATA else LARGEST):
            raise ValueError("no record is that large")
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
        """The wanted messages of a chunk; remembers the schemas and channels between them."""
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
        if orphaned:  # the chunk that described their channel was damaged
            self.lost_bytes += orphaned
            yield Damage(orphaned)

    def _describe(self, opcode: int, body: bytes) -> None:
        """Remember a schema or a channel. Raises ``ValueError`` where they are too large."""
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
                raise ValueError("no channel is that large")
            self._take(len(body))
            channel = Channel.read(ReadDataStream(BytesIO(body)))
            self._take(_PAIR * len(channel.metadata))
            self.channels[channel.id] = channel
            self._channel_bodies[body[:2]] = body

    def _take(self, size: int) -> None:
        """Count what is described; once it is too much, nothing further is read."""
        self._described_bytes += size
        if self._described_bytes > _DESCRIPTIONS:
            raise ValueError("no file describes so much")


def _split(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(opcode, body) of the records in a chunk. Raises ``ValueError`` where one is not whole."""
    at, end = 0, len(data)
    while at < end:
        opcode, length = _HEADER.unpack_from(data, at)
        start = at + _HEADER.size
        at = start + length
        if at > end or not opcode or (opcode == Opcode.MESSAGE and length > _LARGEST_MESSAGE):
            raise ValueError("no record, or one that is longer than what holds it")
        yield opcode, data[start:at]


def span_ns(path: Path) -> tuple[int, int] | None:
    """The first and last time of the messages of a finished file, by its summary; else None.

    Raises ``OSError`` where the file cannot be read.
    """
    with contextlib.suppress(*_DAMAGE):
        for opcode, body in _split(_summary(path)):
            if opcode == Opcode.STATISTICS:
                found = Statistics.read(ReadDataStream(BytesIO(body)))
                times_ns = found.message_start_time, found.message_end_time
                return times_ns if found.message_count else None
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
        if not 0 < summary_at <= size - _END.size or size - summary_at > _LARGEST_SUMMARY:
            return b""
        file.seek(summary_at)
        summary = file.read(size - summary_at)
    return summary[: -_END.size] if zlib.crc32(summary[:-_UNCHECKED]) == checksum else b""
