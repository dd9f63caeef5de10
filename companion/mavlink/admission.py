"""Who may be tracked: the lists of the settings."""

from collections.abc import Iterable
from fnmatch import fnmatchcase


class Admission:
    """``allow``: patterns of those who may, everybody where it is empty; ``deny``: of those who may
    not, whatever ``allow`` says. Patterns are ids in which ``*`` stands for anything."""

    def __init__(self, allow: Iterable[str], deny: Iterable[str]) -> None:
        self._allow = tuple(allow)
        self._deny = tuple(deny)
        self._known: dict[str, bool] = {}

    def admits(self, uav: str) -> bool:
        """Whether a UAV may be tracked."""
        known = self._known.get(uav)
        if known is None:
            known = self._known.setdefault(uav, self._decide(uav))
        return known

    def _decide(self, uav: str) -> bool:
        if any(fnmatchcase(uav, pattern) for pattern in self._deny):
            return False
        return not self._allow or any(fnmatchcase(uav, pattern) for pattern in self._allow)
