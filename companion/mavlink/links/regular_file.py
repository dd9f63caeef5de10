"""Opening of files that users, settings or other files name."""

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO


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
