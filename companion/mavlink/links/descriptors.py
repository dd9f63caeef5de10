"""Shares of this process's file descriptors, so that no server takes those of the others.

Each connection takes a descriptor, and so does each link, file and recording.
"""

import contextlib
import resource
from typing import Final

WANTED: Final = 4096  # enough for all servers at their largest
RESERVED: Final = 96  # descriptors for links, recordings and files
LEAST: Final = 8  # connections of any server


def raise_limit() -> None:
    """Raise this process's limit to ``WANTED``, as far as the system permits."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = WANTED if hard == resource.RLIM_INFINITY else min(WANTED, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def share(most: int, ratio: float) -> int:
    """Return how many connections a server may have: ``most``, or its ratio of the descriptors."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return most
    return min(most, max(LEAST, int(ratio * (soft - RESERVED))))
