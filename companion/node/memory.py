"""Memory of a long-running process: freed blocks go back to the system.

glibc keeps them for later ones. With many UAVs, freed large blocks (bodies of answers, arrays of an
update) between small ones that stay were a fifth of the memory.
"""

import ctypes
import sys
from typing import Final

LARGE_BYTES: Final = 256 << 10
"""Size from which a block has pages of its own, which are returned when it is freed."""
ARENAS: Final = 2
"""Heaps of all threads together; only one thread at a time runs Python."""
# glibc, malloc.h
_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_THRESHOLD: Final = -3
_M_ARENA_MAX: Final = -8


def return_freed_memory() -> None:
    """Set glibc's allocator to return large blocks; leave other allocators as they are."""
    if sys.platform != "linux":
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:  # musl
        return
    for option, value in (
        (_M_MMAP_THRESHOLD, LARGE_BYTES),
        (_M_TRIM_THRESHOLD, 4 * LARGE_BYTES),
        (_M_ARENA_MAX, ARENAS),
    ):
        mallopt(option, value)
