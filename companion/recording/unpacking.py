"""Decompression of an MCAP chunk, limited to a given size whatever the chunk's header claims.

A zstd frame states the size of its contents, and the library allocates it before reading: 131 kB
asked for 4.2 GB. So the size is checked first.
"""

import struct
import zlib
from typing import Final

from zstandard import ZstdDecompressor, ZstdError, frame_content_size

_HEAD: Final = struct.Struct("<QQQII")
"""Layout of a chunk's head: start and end time, size and CRC-32 of the contents, name length."""
_SIZE: Final = struct.Struct("<Q")
_NAME_MAX: Final = 16
_UNKNOWN: Final = -1


class DamagedChunkError(ValueError):
    """Error of a chunk that cannot be decompressed."""


def unpacked(body: bytes, most: int) -> bytes:
    """Return the contents of a chunk record, at most ``most`` bytes.

    Raises ``DamagedChunkError`` if the contents are larger, do not match their header, or have an
    unknown compression.
    """
    try:
        _, _, size, checksum, name = _HEAD.unpack_from(body)
        if name > _NAME_MAX:
            raise DamagedChunkError("invalid name of a compression")
        at = _HEAD.size + name
        compression = body[_HEAD.size : at]
        (length,) = _SIZE.unpack_from(body, at)
    except struct.error as error:
        raise DamagedChunkError("incomplete header of a chunk") from error
    if size > most or length > len(body) - at - _SIZE.size:
        raise DamagedChunkError("chunk exceeds the size limit")
    packed = memoryview(body)[at + _SIZE.size : at + _SIZE.size + length]
    data = _unpack(compression, packed, size)
    if len(data) != size or (checksum and zlib.crc32(data) != checksum):
        raise DamagedChunkError("size or checksum mismatch")
    return data


def _unpack(compression: bytes, packed: memoryview, size: int) -> bytes:
    """Return the unpacked contents if they have ``size`` bytes; else at most one byte more."""
    match compression:
        case b"":
            return bytes(packed)
        case b"zstd":
            return _zstd(packed, size)
        case b"lz4":
            return _lz4(packed, size)
    raise DamagedChunkError("unknown compression")


def _zstd(packed: memoryview, size: int) -> bytes:
    try:
        if frame_content_size(packed) not in (size, _UNKNOWN):
            raise DamagedChunkError("size of the zstd frame differs from that of the chunk")
        return ZstdDecompressor().decompress(packed, max_output_size=size) if size else b""
    except ZstdError as error:
        raise DamagedChunkError(str(error)) from error


def _lz4(packed: memoryview, size: int) -> bytes:
    """Decompress lz4, which only other programs use."""
    from lz4.frame import LZ4FrameDecompressor

    try:
        data: bytes = LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    except RuntimeError as error:
        raise DamagedChunkError(str(error)) from error
    return data
