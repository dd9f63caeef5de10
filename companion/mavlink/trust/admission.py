"""Admission of UAVs by the allow and deny lists of the settings."""

from collections.abc import Callable, Iterable
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import Final

KNOWN_MAX: Final = 8192
"""Size of the cache of decisions; bounded, since senders may invent any number of ids."""


def admission(allow: Iterable[str], deny: Iterable[str]) -> Callable[[str], bool]:
    """Return the function that decides whether a UAV may be tracked.

        allow  patterns of allowed ids; all are allowed if empty
        deny   patterns of denied ids; they override ``allow``

    Patterns are ids in which ``*`` matches anything.
    """
    allowed, denied = tuple(allow), tuple(deny)

    def admits(uav: str) -> bool:
        if any(fnmatchcase(uav, pattern) for pattern in denied):
            return False
        return not allowed or any(fnmatchcase(uav, pattern) for pattern in allowed)

    return lru_cache(KNOWN_MAX)(admits)
