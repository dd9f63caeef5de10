"""Records kept for each sender and UAV, in tables of bounded size."""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice
from typing import Final, TypeVar

from companion.values import Reason

RECORDS_MAX: Final = 4096
"""Limit on records. Beyond it, the oldest unprotected ones are dropped."""
DROPPED_TOGETHER: Final = 256  # records dropped at once: forged ids may come in any number

_T = TypeVar("_T")


class Records(dict[str, _T]):
    """Records by id. ``records[uav]`` creates a missing one; deleting it forgets the id.

    ``make`` creates a record, ``is_kept`` says which ids are never dropped to make room. There may
    be more protected ids than ``RECORDS_MAX``, so the table is searched again only after
    ``DROPPED_TOGETHER`` additions.
    """

    def __init__(self, make: Callable[[], _T], is_kept: Callable[[str], bool]) -> None:
        super().__init__()
        self._make = make
        self.is_kept = is_kept
        self._most = RECORDS_MAX

    def __missing__(self, uav: str) -> _T:
        if len(self) >= self._most:
            unwanted = (one for one in self if not self.is_kept(one))
            for one in list(islice(unwanted, DROPPED_TOGETHER)):
                del self[one]
            self._most = max(RECORDS_MAX, len(self) + DROPPED_TOGETHER)
        return self.setdefault(uav, self._make())


@dataclass(slots=True, kw_only=True)
class UnusedRun:
    """Run of reports that were all rejected: its start, and time and reason of the newest."""

    since_ns: int
    newest_ns: int
    reason: Reason
    reports: int = 0
    is_reported: bool = False


@dataclass(slots=True, kw_only=True)
class UavRecord:
    """Record of a UAV, kept until it reboots or its track is dropped.

    proven          by refuted setting: when it was reported last, ns, and with which value
    """

    refuted: int = 0  # how often assumptions about it were refuted
    proven: dict[str, tuple[int, float]] = field(default_factory=dict)
    waits_ns: int | None = None  # start of the wait for its GNSS receiver to confirm its reports
    unused: UnusedRun | None = None  # current run of rejected reports
    unused_notice_ns: int | None = None  # when such a run was last reported


UavRecords = Records[UavRecord]
