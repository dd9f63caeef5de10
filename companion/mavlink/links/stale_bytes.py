"""Stale bytes of a stream, which waited while this process was suspended, as by SIGSTOP.

The bytes of a stream have no time stamps. Those that were waiting when the process resumed may be
as old as the suspension, and must not count as just arrived.
"""

import asyncio
import fcntl
import struct
import termios
from typing import Final

from companion.mavlink.links.kernel_time import since_boot_ns

STALE_NS: Final = 2_500_000_000  # time between checks beyond which waiting bytes are stale
LOOK_S: Final = 0.5  # time between two checks


class StaleBytes:
    """Detector of stale bytes in the stream of a descriptor, from ``watch`` until ``close``."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._seen_ns = since_boot_ns()
        self._stale_bytes = 0
        self._next: asyncio.TimerHandle | None = None

    def watch(self) -> None:
        """Check now, and then periodically on the running loop."""
        self.stale(b"")
        self._next = asyncio.get_running_loop().call_later(LOOK_S, self.watch)

    def close(self) -> None:
        """Stop checking for stale bytes."""
        if self._next is not None:
            self._next.cancel()

    def stale(self, data: bytes) -> int:
        """Return how many of the bytes just read, from the first, are stale."""
        before_ns, self._seen_ns = self._seen_ns, since_boot_ns()
        if self._seen_ns - before_ns > STALE_NS:
            self._stale_bytes = len(data) + _unread(self._descriptor)
        stale = min(self._stale_bytes, len(data))
        self._stale_bytes -= stale
        return stale


def _unread(descriptor: int) -> int:
    """Return the number of unread bytes; 0 if the stream has ended."""
    try:
        (waiting,) = struct.unpack("i", fcntl.ioctl(descriptor, termios.FIONREAD, bytes(4)))
    except OSError:
        return 0
    return int(waiting)
