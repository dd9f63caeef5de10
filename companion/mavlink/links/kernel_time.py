"""Kernel time stamps of received datagrams: SO_TIMESTAMPNS.

A datagram may wait in its socket while this process is busy. The stamp, which Linux sets on
reception, shows how long, so that a busy host is not mistaken for a slow radio.

Stamps are of the wall clock, which can be set at any time; the node's timeline never steps.
Therefore only an age is computed from a stamp, and none from stamps older than the last setting of
the wall clock (``SetWatch``).
"""

import contextlib
import socket
import struct
import sys
import time
from typing import Final

SO_TIMESTAMPNS: Final[int] = getattr(socket, "SO_TIMESTAMPNS", 35)
"""Socket option, and type of its control message: Linux, include/uapi/asm-generic/socket.h."""
SET_NS: Final = 1_000_000  # least step of the wall clock that matters

_BOOTTIME: Final[int] = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
"""Linux's clock that continues during suspend; on other systems, one that stops."""
_TIMESPEC: Final = struct.Struct("@ll")
_HEAD: Final = struct.Struct("@Nii")  # struct cmsghdr: length, level, type
_STAMP_AT: Final[int] = socket.CMSG_LEN(0)
ANCILLARY_BYTES: Final[int] = socket.CMSG_SPACE(_TIMESPEC.size)
"""Buffer size that ``recvmsg`` needs for the stamp."""

Ancillary = list[tuple[int, int, bytes]]
"""Control messages as ``recvmsg`` returns them: level, type, data."""


def stamped(sock: socket.socket) -> bool:
    """Enable time stamps on a socket's datagrams; False if they are not supported.

    Linux starts some milliseconds after the first socket on the machine enabled them. Until then it
    stamps a datagram when it is read, which is the arrival time without stamps.
    """
    if sys.platform != "linux":
        return False
    with contextlib.suppress(OSError):
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        return True
    return False


def stamp_ns(ancillary: Ancillary) -> int | None:
    """Return the kernel's stamp of a datagram, ns of the wall clock; None without one."""
    for level, kind, data in ancillary:
        if kind == SO_TIMESTAMPNS and level == socket.SOL_SOCKET:
            seconds, ns = _TIMESPEC.unpack_from(data)
            return int(seconds * 1_000_000_000 + ns)
    return None


def stamp_in(control: bytearray) -> int | None:
    """Return the stamp in the buffer of a single control message, as ``stamp_ns``."""
    _, level, kind = _HEAD.unpack_from(control)
    if kind != SO_TIMESTAMPNS or level != socket.SOL_SOCKET:
        return None
    seconds, ns = _TIMESPEC.unpack_from(control, _STAMP_AT)
    return int(seconds * 1_000_000_000 + ns)


def since_boot_ns() -> int:
    """Return the time since the machine booted, ns.

    It never steps, and continues during suspend.
    """
    return time.clock_gettime_ns(_BOOTTIME)


class SetWatch:
    """Detector of wall clock steps since ``note``, by the clock's distance from ``since_boot_ns``.

    Both clocks are disciplined alike and continue during suspend; only a step changes their
    distance.
    """

    def __init__(self) -> None:
        self._least_ns, self._greatest_ns = _distance_ns()

    def note(self) -> None:
        """Start to watch: no datagram with an earlier stamp is waiting."""
        self._least_ns, self._greatest_ns = _distance_ns()

    def was_set(self) -> bool:
        """Return whether the wall clock was set since the last ``note``."""
        least_ns, greatest_ns = _distance_ns()
        return least_ns > self._greatest_ns + SET_NS or greatest_ns < self._least_ns - SET_NS


def _distance_ns() -> tuple[int, int]:
    """Return wall clock less time since boot, ns: least and most, as reading takes time."""
    before_ns = since_boot_ns()
    wall_ns = time.time_ns()
    return wall_ns - since_boot_ns(), wall_ns - before_ns
