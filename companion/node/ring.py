"""Records in shared memory: a ring that one process writes and any number follow.       [shell]

The file is mapped by all. A header of 64 bytes, then slots of equal size, each a lock (8 bytes),
the length of its record (4), 4 bytes of nothing, and the record. Record n, from 0, is in slot n
modulo the number of slots. Its lock is 2 n + 1 while it is written and 2 n + 2 once it is whole; a
reader copies the record and looks at the lock before and after (a seqlock). Nobody ever waits for a
reader: one that falls a whole ring behind knows by ``written`` how many records it lost. What a
processor may reorder is found by the record's own checksum.
"""

import contextlib
import mmap
import os
from pathlib import Path
from typing import Final

import numpy as np

from companion.values import UserError

MAGIC: Final = b"UAVBRING"
VERSION: Final = 1
SLOTS: Final = 256  # a quarter of a second at 1000 records/s, for a reader that is held up
SLOT_BYTES: Final = 1 << 16
"""Memory is taken as it is touched: a slot costs what its largest record takes."""
HEAD_BYTES: Final = 64
SLOT_HEAD_BYTES: Final = 16
LARGEST_RECORD: Final = SLOT_BYTES - SLOT_HEAD_BYTES
LIVE: Final = 1  # state of a ring that is written to; 0: its writer has ended


def _require_ring(path: Path) -> None:
    """Raise ``UserError`` where there is a file that no ring may replace."""
    if path.exists():
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise UserError(f"{path} is there and is no ring of records")


class Ring:
    """The writer's end. Raises ``UserError`` for a place that cannot be used.

    The file takes the place of an earlier ring of that name, which its readers keep until they open
    it anew; a file that is no ring stays as it is. Readable by the owner and the group.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        beside = path.with_name(f".{path.name}.{os.getpid()}")
        size = HEAD_BYTES + SLOTS * SLOT_BYTES
        try:
            _require_ring(path)
            beside.unlink(missing_ok=True)
            fd = os.open(beside, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o640)
            try:
                os.ftruncate(fd, size)
                self._map = mmap.mmap(fd, size)
                self._identity = os.fstat(fd).st_ino
            finally:
                os.close(fd)
            self._words = np.frombuffer(self._map, dtype="<u8")  # stores of 8 bytes are whole
            self._halves = np.frombuffer(self._map, dtype="<u4")
            self._halves[2:6] = VERSION, SLOTS, SLOT_BYTES, LIVE
            self._map[: len(MAGIC)] = MAGIC
            beside.replace(path)
        except OSError as error:
            raise UserError(f"{path}: {error.strerror}") from error
        self.written = 0

    def put(self, record: bytes) -> None:
        """Write the next record, of at most ``LARGEST_RECORD`` bytes."""
        at = HEAD_BYTES + self.written % SLOTS * SLOT_BYTES
        self._words[at // 8] = 2 * self.written + 1
        self._halves[at // 4 + 2] = len(record)
        start = at + SLOT_HEAD_BYTES
        self._map[start : start + len(record)] = record
        self._words[at // 8] = 2 * self.written + 2
        self.written += 1
        self._words[3] = self.written

    def close(self) -> None:
        """Tell readers that nothing more comes, and take the name away if it is still this ring."""
        self._halves[5] = 0
        del self._words, self._halves
        self._map.close()
        with contextlib.suppress(OSError):
            if self._path.stat().st_ino == self._identity:
                self._path.unlink()
