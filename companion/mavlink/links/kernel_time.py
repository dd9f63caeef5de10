"""When the system received a datagram, by its own stamp: SO_TIMESTAMPNS.                  [shell]

A datagram may wait in its socket while this process is busy. The stamp, which Linux makes as the
datagram comes in, tells how long: a busy host is not a slow radio.

Stamps are of the wall clock, which can be set at any time; the node's timeline never steps. What
is taken from a stamp is therefore an age, and none is taken from stamps that were made before the
wall clock was set: `SetWatch` tells.
"""

import contextlib
import socket
import struct
import sys
import time
from typing import Final

SO_TIMESTAMPNS: Final[int] = getattr(socket, "SO_TIMESTAMPNS", 35)
"""Linux, include/uapi/asm-generic/socket.h; the type of the control message as well."""
SET_NS: Final = 1_000_000  # step of the wall clock that counts; a shorter one does no harm

_BOOTTIME: Final[int] = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
"""Linux's clock that goes on in a sleep; elsewhere the one that stands still in it."""
_TIMESPEC: Final = struct.Struct("@ll")
ANCILLARY_BYTES: Final[int] = socket.CMSG_SPACE(_TIMESPEC.size)
"""Room that ``recvmsg`` needs for the stamp."""

Ancillary = list[tuple[int, int, bytes]]
"""Control messages as ``recvmsg`` returns them: level, type, data."""


def stamped(sock: socket.socket) -> bool:
    """Ask the system to stamp a socket's datagrams; False where it does not.

    Linux begins some milliseconds after the first socket of all has asked. Until then it makes the
    stamp as a datagram is read, which is when that datagram would have arrived without stamps.
    """
    if sys.platform != "linux":
        return False
    with contextlib.suppress(OSError):
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        return True
    return False


def stamp_ns(ancillary: Ancillary) -> int | None:
    """The system's stamp on a datagram, ns of the wall clock; None where it has none."""
    for level, kind, data in ancillary:
        if kind == SO_TIMESTAMPNS and level == socket.SOL_SOCKET:
            seconds, ns = _TIMESPEC.unpack_from(data)
            return int(seconds * 1_000_000_000 + ns)
    return None


def since_boot_ns() -> int:
    """Time since the machine booted, ns: it never steps, and goes on while the machine sleeps."""
    return time.clock_gettime_ns(_BOOTTIME)


class SetWatch:
    """Tells whether the wall clock was set since ``note``, by its distance from ``since_boot_ns``.

    Both are disciplined alike, and both go on in a machine's sleep; only a step moves them apart.
    """

    def __init__(self) -> None:
        self._least_ns, self._greatest_ns = _distance_ns()

    def note(self) -> None:
        """Begin anew: no datagram waits that was stamped before this."""
        self._least_ns, self._greatest_ns = _distance_ns()

    def was_set(self) -> bool:
        """Whether the wall clock was set since the last ``note``."""
        least_ns, greatest_ns = _distance_ns()
        return least_ns > self._greatest_ns + SET_NS or greatest_ns < self._least_ns - SET_NS


def _distance_ns() -> tuple[int, int]:
    """Wall clock less time since boot, ns: at least and at most, for reading them takes time."""
    before_ns = since_boot_ns()
    wall_ns = time.time_ns()
    return wall_ns - since_boot_ns(), wall_ns - before_ns
