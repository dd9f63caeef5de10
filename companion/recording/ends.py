"""First and last time of a log, from its two ends without reading the rest."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from companion.mavlink.wire.framing import examine
from companion.recording import container
from companion.recording.container import MAGIC
from companion.recording.tlog import STAMP

_TAIL: Final = 1 << 16  # bytes at the end of a telemetry log that are searched for its last frame
_LONGEST_NS: Final = 10 * 86_400 * 1_000_000_000
"""Longest plausible log; a longer one has a wrong stamp at one end."""


def span_ns(logs: Sequence[Path]) -> tuple[int, int] | None:
    """Return the common first and last time of some logs, ns since 1970.

    None if the ends of one of them are unknown: raw MAVLink, a truncated recording, jumping stamps.
    Raises ``OSError`` for a file that cannot be read.
    """
    ends = [_ends_ns(log) for log in logs]
    known = [one for one in ends if one is not None]
    if not known or len(known) < len(ends):
        return None
    return min(first for first, _ in known), max(last for _, last in known)


def _ends_ns(log: Path) -> tuple[int, int] | None:
    with log.open("rb") as file:
        head = file.read(STAMP + 300)
        size = file.seek(0, os.SEEK_END)
        if head.startswith(MAGIC):
            return container.span_ns(log)
        file.seek(max(0, size - _TAIL))
        tail = file.read(_TAIL)
    if len(head) <= STAMP or examine(head, STAMP, len(head)) <= 0:
        return None
    first_ns, last_ns = _stamp_ns(head, STAMP), _last_stamp_ns(tail)
    if last_ns is None or not 0 <= last_ns - first_ns <= _LONGEST_NS:
        return None
    return first_ns, last_ns


def _last_stamp_ns(tail: bytes) -> int | None:
    end = len(tail)
    for at in range(end - 1, STAMP - 1, -1):
        if tail[at] in (0xFD, 0xFE) and examine(tail, at, end) > 0:
            return _stamp_ns(tail, at)
    return None


def _stamp_ns(data: bytes, frame_at: int) -> int:
    return int.from_bytes(data[frame_at - STAMP : frame_at], "big") * 1000
