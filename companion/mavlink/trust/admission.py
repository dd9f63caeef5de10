"""Who may be tracked, by the allow and deny lists of the settings."""

from collections.abc import Iterable
from fnmatch import fnmatchcase
from typing import Final

KNOWN_MAX: Final = 8192
"""Ids whose answer is kept; a cache only, since senders may invent as many as they like."""


class Admission:
    """Decides which UAVs may be tracked.

        allow  patterns of the UAVs that may be; everyone if empty
        deny   patterns of those that may not, whatever ``allow`` says

    Patterns are ids in which ``*`` stands for anything.
    """

    def __init__(self, allow: Iterable[str], deny: Iterable[str]) -> None:
        self._allow = tuple(allow)
        self._deny = tuple(deny)
        self._known: dict[str, bool] = {}

    def admits(self, uav: str) -> bool:
        """Whether this UAV may be tracked."""
        known = self._known.get(uav)
        if known is None:
            if len(self._known) >= KNOWN_MAX:
                self._known.clear()
            known = self._known.setdefault(uav, self._decide(uav))
        return known

    def _decide(self, uav: str) -> bool:
        if any(fnmatchcase(uav, pattern) for pattern in self._deny):
            return False
        return not self._allow or any(fnmatchcase(uav, pattern) for pattern in self._allow)
