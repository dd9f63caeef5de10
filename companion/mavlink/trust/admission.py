"""Who may be tracked, by the allow and deny lists of the settings."""

from collections.abc import Callable, Iterable
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import Final

KNOWN_MAX: Final = 8192
"""Ids whose answer is kept; a cache only, since senders may invent as many as they like."""


def admission(allow: Iterable[str], deny: Iterable[str]) -> Callable[[str], bool]:
    """The function that says which UAVs may be tracked.

        allow  patterns of the UAVs that may be; everyone if empty
        deny   patterns of those that may not, whatever ``allow`` says

    Patterns are ids in which ``*`` stands for anything.
    """
    allowed, denied = tuple(allow), tuple(deny)

    def admits(uav: str) -> bool:
        if any(fnmatchcase(uav, pattern) for pattern in denied):
            return False
        return not allowed or any(fnmatchcase(uav, pattern) for pattern in allowed)

    return lru_cache(KNOWN_MAX)(admits)
