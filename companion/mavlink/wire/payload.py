"""Unpacking of the fields of a message's payload."""

import struct
from typing import Any

from companion.values import Frame


def unpack(frame: Frame, layout: struct.Struct) -> tuple[Any, ...]:
    """Unpack the fields of a payload; truncated or absent ones are zeros."""
    raw = frame.raw
    start = 10 if raw[0] == 0xFD else 6
    if raw[1] >= layout.size:
        return layout.unpack_from(raw, start)
    return layout.unpack(frame.payload.ljust(layout.size, b"\0"))
