"""Logs of which not all is read: cut within a record, never closed, or with another one appended.

A reader uses everything before the cut, so only the end of the file tells. Raw MAVLink and tables
that are cut between two records are not recognised.
"""

import struct
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from companion.mavlink.wire.framing import examine
from companion.recording.container import Walk
from companion.recording.foreign import together
from companion.recording.foreign.packets import PCAP, PCAPNG
from companion.recording.reader import log_kind

_TAIL_BYTES: Final = 1 << 16  # bytes at the end of a log of frames that are searched
_PCAP_HEAD: Final = 24
_PCAP_RECORD: Final = 16
_BLOCK_LEAST: Final = 12
_BIG_ENDIAN: Final = b"\x1a\x2b\x3c\x4d"


class TruncatedLog(NamedTuple):
    """Log that ends early, and the bytes after its last complete record.

    ``bytes_after_end`` are those after the end of a recording that is complete.
    """

    path: Path
    incomplete_bytes: int
    bytes_after_end: int = 0

    def notice(self) -> str:
        """Return one line for the user."""
        if self.bytes_after_end:
            return (
                f"{self.path}: {self.bytes_after_end} bytes after the end of the recording are not"
                " used; give joined recordings as separate files"
            )
        rest = (
            f"its last {self.incomplete_bytes} bytes are an incomplete record"
            if self.incomplete_bytes
            else "the file was never closed"
        )
        return f"{self.path}: log is truncated: {rest}; everything before is used"

    def as_json(self) -> dict[str, object]:
        """Return name and unused bytes as JSON."""
        return {
            "log": self.path.name,
            "incomplete_bytes": self.incomplete_bytes,
            "bytes_after_end": self.bytes_after_end,
        }


def truncated(logs: Sequence[Path]) -> list[TruncatedLog]:
    """Return those logs of which not all is read. Raises ``LogError`` for an unusable log."""
    return [found for log in logs if (found := _truncated(log)) is not None]


def _truncated(log: Path) -> TruncatedLog | None:
    kind = log_kind(log)
    if kind in ("mcap", "foreign-mcap"):
        walk = Walk(log, frozenset())
        deque(walk, maxlen=0)
        if walk.complete and not walk.bytes_after_end:
            return None
        return TruncatedLog(log, walk.incomplete_bytes, walk.bytes_after_end)
    rest = _incomplete_bytes(log, kind)
    return TruncatedLog(log, rest) if rest else None


def _incomplete_bytes(log: Path, kind: str) -> int:
    """Return the bytes after the last complete record of a log that is no recording."""
    if kind in together.READERS:
        (vehicle,) = together.opened([(log, kind)])
        return vehicle.log.incomplete_bytes
    if kind == "capture":
        return _of_capture(log)
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - _TAIL_BYTES))
        return _after_last_frame(file.read())


def _after_last_frame(tail: bytes) -> int:
    end = len(tail)
    for at in range(end - 1, -1, -1):
        if tail[at] in (0xFD, 0xFE) and (length := examine(tail, at, end)) > 0:
            return end - at - length
    return 0


def _of_capture(log: Path) -> int:
    """Return the bytes of a capture's last record if the file ends within it; else 0."""
    size, at = log.stat().st_size, 0
    with log.open("rb") as file:
        head = file.read(4)
        if head != PCAPNG:
            order, at = PCAP[head][0], _PCAP_HEAD
        while at < size:
            file.seek(at)
            record = file.read(_PCAP_RECORD)
            if head == PCAPNG:
                if record[:4] == PCAPNG:
                    order = ">" if record[8:12] == _BIG_ENDIAN else "<"
                least, length = _BLOCK_LEAST, _number(order, record[4:8])
            else:
                least, length = _PCAP_RECORD, _PCAP_RECORD + _number(order, record[8:12])
            if length < least or at + length > size:
                return size - at
            at += length
    return 0


def _number(order: str, data: bytes) -> int:
    return int(struct.unpack(f"{order}I", data)[0]) if len(data) == 4 else 0
