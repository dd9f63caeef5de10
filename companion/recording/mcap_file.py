"""Writer of MCAP files: chunks of messages with indexes, attachments, metadata, summary.

The library's writer creates objects for every message and packs each of its fields separately,
which takes most of the time of a recording. Here a message is one packed head and its bytes; rare
records are written with the library. Reading uses the library.

Layout: https://mcap.dev/spec.
"""

import errno
import struct
import zlib
from collections.abc import Mapping
from typing import BinaryIO, Final

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from zstandard import ZstdCompressor

from companion.recording.container import MAGIC

CHUNK_BYTES: Final = 1 << 20  # size of its contents at which a chunk ends
_MESSAGE: Final = struct.Struct("<BQHIQQ")
"""Layout of a message: opcode, body length, channel, sequence, log time, publish time."""
CHANNELS_MAX: Final = 0xFFFF
_FIELDS: Final = _MESSAGE.size - 9  # size of a message's head, without opcode and length
_INDEX: Final = struct.Struct("<BQHI")  # opcode, length, channel, length of the entries
_FOOTER_START: Final = struct.Struct("<BQQQ")  # the part of the footer that its checksum covers


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


class McapFile:
    """MCAP file that is written to a stream, which stays open.

    Log times must be at least 0, sequence numbers below 2^32. Any method raises ``OSError`` if the
    stream does.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._compressor = ZstdCompressor()
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._counts: dict[int, int] = {}  # messages by channel
        self._least_ns = self._greatest_ns = 0  # of all messages
        # The index entries of the chunks, as bytes: an object for each channel takes ten times as
        # much memory, and a chunk of a second may have hundreds of channels.
        self._chunk_indexes = bytearray()
        self._chunk_count = 0
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        # The chunk in progress: its records, their size, and the times and places by channel.
        self._parts: list[bytes] = []
        self._size = 0
        self._entries: dict[int, list[int]] = {}
        stream.write(MAGIC)
        stream.write(_bytes(Header("", "companion")))

    # --- records ----------------------------------------------------------------------------

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema. Returns its id."""
        number = len(self._schemas) + 1
        self._schemas.append(Schema(id=number, data=data, encoding=encoding, name=name))
        self._describe(self._schemas[-1])
        return len(self._schemas)

    def channel(
        self, topic: str, encoding: str, schema_id: int, metadata: Mapping[str, str] | None = None
    ) -> int:
        """Add a channel. Returns its id. Raises ``OSError`` beyond the largest id, 65 535."""
        number = len(self._channels) + 1
        if number > CHANNELS_MAX:
            raise OSError(errno.EFBIG, f"a file has at most {CHANNELS_MAX} topics")
        channel = Channel(
            id=number,
            topic=topic,
            message_encoding=encoding,
            metadata=dict(metadata or {}),
            schema_id=schema_id,
        )
        self._channels.append(channel)
        self._describe(self._channels[-1])
        return number

    def _describe(self, record: Schema | Channel) -> None:
        self._parts.append(_bytes(record))
        self._size += len(self._parts[-1])

    def message(
        self, channel_id: int, log_ns: int, publish_ns: int, sequence: int, data: bytes
    ) -> None:
        """Add a message."""
        entries = self._entries.get(channel_id)
        if entries is None:
            entries = self._entries[channel_id] = []
        entries += (log_ns, self._size)
        size = _FIELDS + len(data)
        head = _MESSAGE.pack(Opcode.MESSAGE, size, channel_id, sequence, log_ns, publish_ns)
        self._parts += (head, data)
        self._size += 9 + size
        if self._size > CHUNK_BYTES:
            self._end_chunk()

    def attachment(self, at_ns: int, created_ns: int, name: str, kind: str, data: bytes) -> None:
        """Attach a file; ``kind`` is its media type."""
        at = self._stream.tell()
        record = _bytes(
            Attachment(
                create_time=created_ns, log_time=at_ns, name=name, media_type=kind, data=data
            )
        )
        self._stream.write(record)
        self._attachments.append(
            AttachmentIndex(
                offset=at,
                length=len(record),
                log_time=at_ns,
                create_time=created_ns,
                data_size=len(data),
                name=name,
                media_type=kind,
            )
        )

    def metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Add a metadata record."""
        at = self._stream.tell()
        record = _bytes(Metadata(name, dict(data)))
        self._stream.write(record)
        self._metadata.append(MetadataIndex(at, len(record), name))

    def flush(self) -> None:
        """End the current chunk and pass everything to the operating system."""
        self._end_chunk()
        self._stream.flush()

    def _end_chunk(self) -> None:
        if not self._entries:
            return
        contents = b"".join(self._parts)
        times = [time for entries in self._entries.values() for time in entries[::2]]
        least_ns, greatest_ns = min(times), max(times)
        packed = self._compressor.compress(contents)
        chunk = _bytes(
            Chunk(
                compression="zstd",
                data=packed,
                message_end_time=greatest_ns,
                message_start_time=least_ns,
                uncompressed_crc=zlib.crc32(contents),
                uncompressed_size=len(contents),
            )
        )
        chunk_at = self._stream.tell()
        self._stream.write(chunk)
        index_at, offsets, indexes = chunk_at + len(chunk), {}, []
        for channel_id, entries in self._entries.items():
            offsets[channel_id] = index_at
            many = 8 * len(entries)
            head = _INDEX.pack(Opcode.MESSAGE_INDEX, 6 + many, channel_id, many)
            indexes.append(head + struct.pack(f"<{len(entries)}Q", *entries))
            index_at += len(indexes[-1])
            self._counts[channel_id] = self._counts.get(channel_id, 0) + len(entries) // 2
        self._stream.write(b"".join(indexes))
        self._chunk_indexes += _bytes(
            ChunkIndex(
                chunk_length=len(chunk),
                chunk_start_offset=chunk_at,
                compression="zstd",
                compressed_size=len(packed),
                message_end_time=greatest_ns,
                message_index_length=index_at - chunk_at - len(chunk),
                message_index_offsets=offsets,
                message_start_time=least_ns,
                uncompressed_size=len(contents),
            )
        )
        self._chunk_count += 1
        first = self._chunk_count == 1
        self._least_ns = least_ns if first else min(self._least_ns, least_ns)
        self._greatest_ns = max(self._greatest_ns, greatest_ns)
        self._parts, self._size, self._entries = [], 0, {}

    # --- the end ----------------------------------------------------------------------------

    @property
    def index_bytes(self) -> int:
        """Size of the chunks' index, which is kept in memory until the end."""
        return len(self._chunk_indexes)

    @property
    def channels(self) -> int:
        """Number of channels so far."""
        return len(self._channels)

    def finish(self) -> None:
        """End the current chunk, and write the summary and the footer."""
        self._end_chunk()
        self._stream.write(_bytes(DataEnd(0)))
        start = place = self._stream.tell()
        groups: list[tuple[int, list[bytes]]] = [
            (Opcode.SCHEMA, [_bytes(one) for one in self._schemas]),
            (Opcode.CHANNEL, [_bytes(one) for one in self._channels]),
            (Opcode.STATISTICS, [_bytes(self._statistics())]),
            (Opcode.CHUNK_INDEX, [bytes(self._chunk_indexes)]),
            (Opcode.ATTACHMENT_INDEX, [_bytes(one) for one in self._attachments]),
            (Opcode.METADATA_INDEX, [_bytes(one) for one in self._metadata]),
        ]
        offsets, checksum = [], 0
        for opcode, records in groups:
            joined = b"".join(records)
            offsets.append(_bytes(SummaryOffset(opcode, place, len(joined))))
            self._stream.write(joined)
            checksum = zlib.crc32(joined, checksum)
            place += len(joined)
        ending = b"".join(offsets)
        checked = ending + _FOOTER_START.pack(Opcode.FOOTER, 20, start, place)
        self._stream.write(ending)
        self._stream.write(_bytes(Footer(start, place, zlib.crc32(checked, checksum))))
        self._stream.write(MAGIC)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=self._chunk_count,
            message_count=sum(self._counts.values()),
            message_end_time=self._greatest_ns,
            message_start_time=self._least_ns,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
