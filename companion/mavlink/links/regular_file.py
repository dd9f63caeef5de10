"""Reading and replacing of files that users, settings or other files name."""

import errno
import fcntl
import os
import stat
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, Final

BESIDE: Final = ".new"  # ending of a file that is being written


class NotRegularError(OSError):
    """Error of a pipe, a device or a socket in place of a file: reading it could block for ever."""


def open_regular(path: Path, *, follow_links: bool = True) -> BinaryIO:
    """Open a file for reading, in bytes. Raises ``OSError`` and ``NotRegularError``."""
    links = 0 if follow_links else os.O_NOFOLLOW
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | links)
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise NotRegularError(errno.EINVAL, "not a file", str(path))


def is_locked(file: BinaryIO) -> bool:
    """Return whether another process has locked a file, as it does while it writes it."""
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    fcntl.flock(file, fcntl.LOCK_UN)
    return False


def replace_file(path: Path, data: bytes, *, mode: int | None = None) -> None:
    """Write a file durably: the earlier one stays until all bytes are on the disk.

    ``mode``: its permissions; None: those of the earlier file, or the usual ones of a new one.
    Raises ``OSError``.
    """
    beside = path.with_name(path.name + BESIDE)
    try:
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC
        with os.fdopen(os.open(beside, flags, 0o666 if mode is None else mode), "wb") as file:
            if mode is None and path.exists():
                os.fchmod(file.fileno(), stat.S_IMODE(path.stat().st_mode))
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except BaseException:
        with suppress(OSError):
            beside.unlink()
        raise
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
