"""Shares of this process's file descriptors, so that no server takes those of the others.

Each connection takes a descriptor, and so does each link, file and recording.
"""

import contextlib
import os
import resource
from typing import Final

from companion.values import UserError

WANTED: Final = 4096  # enough for all servers at their largest
RESERVED: Final = 96  # descriptors for links, recordings and files
LEAST: Final = 8  # connections of any server
NEEDED: Final = 64  # least limit with which a service starts
SCARCE: Final = 0.8  # ratio of descriptors in use above which they are scarce


def raise_limit() -> None:
    """Raise this process's limit to ``WANTED``, as far as the system permits.

    Raises ``UserError`` if it permits fewer than ``NEEDED``.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < NEEDED:
        given = f"file descriptor limit is {hard}, the service needs {NEEDED}"
        raise UserError(f"{given}; raise it with `ulimit -n`")
    wanted = WANTED if hard == resource.RLIM_INFINITY else min(WANTED, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def are_scarce() -> bool:
    """Return whether nearly all descriptors are in use.

    A new one has the lowest free number.
    """
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return False
    try:
        lowest = os.open(os.devnull, os.O_RDONLY)
    except OSError:
        return True
    os.close(lowest)
    return lowest > SCARCE * soft


def share(most: int, ratio: float) -> int:
    """Return how many connections a server may have: ``most``, or its ratio of the descriptors."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return most
    return min(most, max(LEAST, int(ratio * (soft - RESERVED))))
