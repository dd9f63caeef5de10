"""What is remembered of each sender and UAV: a record each, in tables of bounded size."""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice
from typing import Final, TypeVar

from companion.values import Reason

RECORDS_MAX: Final = 4096
"""Records kept. Beyond it those that nothing protects are dropped, the oldest first."""
DROPPED_AT_ONCE: Final = 256  # records dropped at once: made-up ids may come in any number

_T = TypeVar("_T")


class Records(dict[str, _T]):
    """Records by id. ``records[uav]`` begins one where there is none; to forget is to drop it.

    ``make`` makes a new record, ``is_kept`` says which ids are never dropped for want of room.
    There may be more of these than ``RECORDS_MAX``: the table is searched again only after as many
    were added as are dropped at once.
    """

    def __init__(self, make: Callable[[], _T], is_kept: Callable[[str], bool]) -> None:
        super().__init__()
        self._make = make
        self._is_kept = is_kept
        self._most = RECORDS_MAX

    def __missing__(self, uav: str) -> _T:
        if len(self) >= self._most:
            unwanted = (one for one in self if not self._is_kept(one))
            for one in list(islice(unwanted, DROPPED_AT_ONCE)):
                del self[one]
            self._most = max(RECORDS_MAX, len(self) + DROPPED_AT_ONCE)
        return self.setdefault(uav, self._make())


@dataclass(slots=True, kw_only=True)
class UnusedRun:
    """A run of reports of which none was used: since when, and why the newest was not."""

    since_ns: int
    reason: Reason
    reports: int = 0
    is_reported: bool = False


@dataclass(slots=True, kw_only=True)
class UavRecord:
    """What is remembered of a UAV until it is restarted or its track is dropped.

    proven          greatest value that was reported of each refuted setting
    """

    refuted: int = 0  # how often assumptions about it were refuted
    proven: dict[str, float] = field(default_factory=dict)
    clock_notice_ns: int | None = None  # when a change of its clock or link was last reported
    waits_ns: int | None = None  # since when its GNSS receiver has not confirmed its reports
    unused: UnusedRun | None = None  # the present run of reports that are not used
    unused_notice_ns: int | None = None  # when such a run was last reported


UavRecords = Records[UavRecord]
