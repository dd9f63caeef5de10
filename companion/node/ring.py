"""Records in shared memory: a ring buffer with one writing process and any number of readers.

All processes map one file. It has a header of 64 bytes, then slots of equal size: a lock (8 bytes),
the length of the record (4), 4 reserved bytes, and the record. Record n, from 0, is in slot n
modulo the number of slots. Its lock is 2 n + 1 while it is being written and 2 n + 2 when it is
complete; a reader copies the record and compares the lock before and after (a seqlock). The writer
never waits for a reader: a reader that falls a whole ring behind sees by ``written`` how many
records it lost. The record's own checksum detects reordering by the processor.
"""

import contextlib
import fcntl
import mmap
import os
from pathlib import Path
from typing import Final

import numpy as np

from companion.mavlink.links.regular_file import is_locked, open_regular
from companion.recording.folders import DISK_FAULTS
from companion.values import UserError

MAGIC: Final = b"UAVBRING"
VERSION: Final = 1
SLOTS: Final = 256  # a quarter of a second at 1000 records/s, for a delayed reader
SLOT_BYTES: Final = 1 << 16
"""Size of a ring buffer's slot."""
HEAD_BYTES: Final = 64
SLOT_HEAD_BYTES: Final = 16
LARGEST_RECORD: Final = SLOT_BYTES - SLOT_HEAD_BYTES
LIVE: Final = 1  # state of a ring with a writer; 0: its writer has ended


def _require_free(path: Path) -> None:
    """Raise ``UserError`` if a file exists that is not a ring buffer, or has a writer."""
    if path.exists():
        with open_regular(path) as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise UserError(f"{path} exists and is not a ring of records; choose another name")
            if is_locked(file):
                raise UserError(f"{path} is in use by another process; choose another name")


def _allocate(fd: int, size: int, replaced: Path) -> None:
    """Allocate all of a file. If there is no room beside the ring that it replaces, delete that.

    Its service was killed.
    """
    try:
        os.posix_fallocate(fd, 0, size)
    except OSError as error:
        try:
            replaced.unlink()
        except FileNotFoundError:
            raise error from None
        os.posix_fallocate(fd, 0, size)


class Ring:
    """Writer of a ring buffer in shared memory.

    Raises ``UserError`` for an unusable path, ``OSError`` if its disk or memory is full, or is
    another of ``DISK_FAULTS``. All of it is allocated at once: a write to a page that the kernel
    cannot allocate ends the process (SIGBUS). The file replaces an earlier ring of that name, which
    its readers keep until they reopen it; a file that is not a ring, or whose writer runs, is kept.
    Readable by the owner and the group.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        beside = path.with_name(f".{path.name}.{os.getpid()}")
        size = HEAD_BYTES + SLOTS * SLOT_BYTES
        try:
            _require_free(path)
            beside.unlink(missing_ok=True)
            fd = os.open(beside, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o640)
            try:
                fcntl.flock(fd, fcntl.LOCK_EX)
                _allocate(fd, size, path)
                self._map = mmap.mmap(fd, size)  # its copy of the descriptor keeps the lock
                self._identity = os.fstat(fd).st_ino
            finally:
                os.close(fd)
            self._words = np.frombuffer(self._map, dtype="<u8")  # stores of 8 bytes are atomic
            self._halves = np.frombuffer(self._map, dtype="<u4")
            self._halves[2:6] = VERSION, SLOTS, SLOT_BYTES, LIVE
            self._map[: len(MAGIC)] = MAGIC
            beside.replace(path)
        except OSError as error:
            with contextlib.suppress(OSError):
                beside.unlink(missing_ok=True)
            if error.errno in DISK_FAULTS:
                raise
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
        """Mark the ring buffer as ended, and delete its file unless another one has replaced it."""
        self._halves[5] = 0
        del self._words, self._halves
        self._map.close()
        with contextlib.suppress(OSError):
            if self._path.stat().st_ino == self._identity:
                self._path.unlink()
