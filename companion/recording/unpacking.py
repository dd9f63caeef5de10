"""Unpacks a chunk of an MCAP file, to no more than a given size, whatever it says of itself.

A frame of zstd names the size of its contents, and the library makes room for that before it reads
on: 131 kB asked for 4.2 GB. So it is looked at first.
"""

import struct
import zlib
from typing import Final

from zstandard import ZstdDecompressor, ZstdError, frame_content_size

_HEAD: Final = struct.Struct("<QQQII")
"""Start and end of the times, size and CRC-32 of the contents, length of the compression's name."""
_SIZE: Final = struct.Struct("<Q")
_NAME_MAX: Final = 16
_UNKNOWN: Final = -1


class DamagedChunkError(ValueError):
    """A chunk that cannot be unpacked."""


def unpacked(body: bytes, most: int) -> bytes:
    """The contents of a chunk's record, of at most ``most`` bytes.

    Raises ``DamagedChunkError`` where they are more, are not what the chunk says of them, or are
    packed in a way that is not known.
    """
    try:
        _, _, size, checksum, name = _HEAD.unpack_from(body)
        if name > _NAME_MAX:
            raise DamagedChunkError("no compression has such a name")
        at = _HEAD.size + name
        compression = body[_HEAD.size : at]
        (length,) = _SIZE.unpack_from(body, at)
    except struct.error as error:
        raise DamagedChunkError("a chunk without its head") from error
    if size > most or length > len(body) - at - _SIZE.size:
        raise DamagedChunkError("larger than can be")
    packed = memoryview(body)[at + _SIZE.size : at + _SIZE.size + length]
    data = _unpack(compression, packed, size)
    if len(data) != size or (checksum and zlib.crc32(data) != checksum):
        raise DamagedChunkError("not what was packed")
    return data


def _unpack(compression: bytes, packed: memoryview, size: int) -> bytes:
    """What is packed, if that is ``size`` bytes; else any number of at most one more."""
    match compression:
        case b"":
            return bytes(packed)
        case b"zstd":
            return _zstd(packed, size)
        case b"lz4":
            return _lz4(packed, size)
    raise DamagedChunkError("an unknown compression")


def _zstd(packed: memoryview, size: int) -> bytes:
    try:
        if frame_content_size(packed) not in (size, _UNKNOWN):
            raise DamagedChunkError("the frame is of another size than the chunk")
        return ZstdDecompressor().decompress(packed, max_output_size=size) if size else b""
    except ZstdError as error:
        raise DamagedChunkError(str(error)) from error


def _lz4(packed: memoryview, size: int) -> bytes:
    """No recording of this program has it, but those of others do."""
    from lz4.frame import LZ4FrameDecompressor

    try:
        data: bytes = LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    except RuntimeError as error:
        raise DamagedChunkError(str(error)) from error
    return data
