"""What had waited in a stream while this process was held up, as by SIGSTOP or a sleep.   [shell]

A stream's bytes bear no stamps of the system. What was there when the process went on may be as old
as it was held up, and must not look as if it had just arrived.
"""

import asyncio
import fcntl
import struct
import termios
from typing import Final

from companion.mavlink.links.kernel_time import since_boot_ns

STALE_NS: Final = 2_500_000_000  # time without a look beyond which what waits is stale
LOOK_S: Final = 0.5  # time between two looks


class StaleBytes:
    """Tells which bytes of a stream are stale, from ``watch`` until ``close``; for a descriptor."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._seen_ns = since_boot_ns()
        self._stale_bytes = 0
        self._next: asyncio.TimerHandle | None = None

    def watch(self) -> None:
        """Look, and go on looking on the running loop."""
        self.stale(b"")
        self._next = asyncio.get_running_loop().call_later(LOOK_S, self.watch)

    def close(self) -> None:
        """Look no more."""
        if self._next is not None:
            self._next.cancel()

    def stale(self, data: bytes) -> int:
        """How many of the bytes that were read just now, from their first, are stale."""
        before_ns, self._seen_ns = self._seen_ns, since_boot_ns()
        if self._seen_ns - before_ns > STALE_NS:
            self._stale_bytes = len(data) + _unread(self._descriptor)
        stale = min(self._stale_bytes, len(data))
        self._stale_bytes -= stale
        return stale


def _unread(descriptor: int) -> int:
    """Bytes that wait to be read; 0 where the stream has ended."""
    try:
        (waiting,) = struct.unpack("i", fcntl.ioctl(descriptor, termios.FIONREAD, bytes(4)))
    except OSError:
        return 0
    return int(waiting)
