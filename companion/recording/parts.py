"""Runs that were recorded in several files, and the events missing from these files.

A recording is split into *parts* by size and time, and continues in a new part after a disk error.
Each part identifies itself, so that a replay can join them. Where events could not be recorded, a
part has a record with their number.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple, Self
from uuid import uuid4

from mcap.records import Metadata

from companion.recording.container import MAGIC, Walk
from companion.values import UserError, printable

PART: Final = "part"
UNFOLLOWED: Final = (
    "the parts of the run after it are missing, or the service was killed as it began the next"
)
CONTINUED: Final = "continued"  # record of a part after which the run continues in another
HOLE: Final = "hole"
HOLES_MAX: Final = 1000
"""Limit on gaps that are listed one by one; further missing events are added to the last gap."""
WHY_MAX: Final = 200
EVENTS_MAX: Final = (1 << 63) - 1
NUMBER_DIGITS: Final = 9  # limit on the digits of a part's number
_LATEST_NS: Final = 1 << 62


class Part(NamedTuple):
    """Identity of a part of a recording: its run, and its number in the run."""

    run: str  # the same in all parts of a run
    number: int  # from 1
    continues: str  # name of the previous file when this one began

    @classmethod
    def first(cls) -> Self:
        """Return the identity of the first part of a new run."""
        return cls(uuid4().hex, 1, "")

    def after(self, name: str) -> "Part":
        """Return the identity of the next part, given that this part is in the file ``name``."""
        return Part(self.run, self.number + 1, name)

    def metadata(self) -> dict[str, str]:
        """Return the part's identity as metadata of a file."""
        return {"run": self.run, "number": str(self.number), "continues": self.continues}

    @classmethod
    def from_metadata(cls, found: Mapping[str, str]) -> "Part | None":
        """Parse a part's identity; None if the metadata contain none."""
        number = found.get("number", "")
        if not number.isdecimal() or len(number) > NUMBER_DIGITS or "run" not in found:
            return None
        return cls(found["run"], int(number), found.get("continues", ""))


class Hole(NamedTuple):
    """Gap: ``events`` events before ``t_ns``, and after the last one written, were not recorded."""

    t_ns: int
    events: int
    why: str

    def metadata(self) -> dict[str, str]:
        """Return the gap as metadata of a file."""
        return {"t_ns": str(self.t_ns), "events": str(self.events), "why": self.why}

    @classmethod
    def from_metadata(cls, found: Mapping[str, str]) -> "Hole":
        """Parse a gap. Raises ``ValueError`` if the metadata do not describe a gap."""
        try:
            why = "".join(printable(found["why"][:WHY_MAX]).split("\n"))
            hole = cls(_whole(found["t_ns"]), _whole(found["events"]), why)
        except KeyError as error:
            raise ValueError(f"hole without {error}") from None
        if hole.t_ns >= _LATEST_NS:
            raise ValueError("hole out of range")
        if hole.events > EVENTS_MAX:
            raise ValueError("hole with too many events")
        return hole


def _whole(text: str) -> int:
    """Parse a number of a gap. Raises ``ValueError`` if it is invalid or has too many digits."""
    if not text.isdecimal() or len(text) > len(str(EVENTS_MAX)):
        raise ValueError("hole with an invalid number")
    return int(text)


class RecordingInfo(NamedTuple):
    """What a log states about itself: its part, if any, and the events missing from it.

    ``is_continued``: the run continues in another part.
    """

    part: Part | None
    holes: tuple[Hole, ...]
    is_continued: bool = False


def read_recording_info(path: Path) -> RecordingInfo:
    """Read what a file states about itself; empty for a log that is not a recording.

    Raises ``OSError`` if the file cannot be read.
    """
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            return RecordingInfo(None, ())
    part: Part | None = None
    holes: list[Hole] = []
    is_continued = False
    for record in Walk(path, frozenset()):
        if isinstance(record, Metadata) and record.name == PART:
            part = Part.from_metadata(record.metadata)
        elif isinstance(record, Metadata) and record.name == CONTINUED:
            is_continued = True
        elif isinstance(record, Metadata) and record.name == HOLE:
            hole = Hole.from_metadata(record.metadata)
            if len(holes) == HOLES_MAX:
                events = min(holes.pop().events + hole.events, EVENTS_MAX)
                hole = hole._replace(events=events)
            holes.append(hole)
    return RecordingInfo(part, tuple(holes), is_continued)


def in_order(infos: Mapping[Path, RecordingInfo]) -> list[Path] | None:
    """Return the parts of one run in the order of writing; None for other logs.

    Raises ``UserError`` if two files are the same part.
    """
    runs = _by_run(infos)
    if len(runs) != 1 or len(infos) < 2:
        return None
    (ordered,) = runs.values()
    return ordered if len(ordered) == len(infos) else None


def missing(infos: Mapping[Path, RecordingInfo]) -> list[str]:
    """Return what a replay of some logs lacks, one line each; empty if all runs are complete.

    The order of the logs does not matter. Raises ``UserError`` if two files are the same part.
    """
    runs = _by_run(infos)
    lines = []
    for ordered in runs.values():
        before = 0
        for path in ordered:
            number = _number(infos[path])
            skipped = range(before + 1, number)
            if skipped:
                which = " to ".join(dict.fromkeys((str(skipped[0]), str(skipped[-1]))))
                lines.append(f"{path}: part {which} of the run is missing")
            before = number
            lines += _holes(path, infos[path])
        if infos[ordered[-1]].is_continued:
            lines.append(f"{ordered[-1]}: {UNFOLLOWED}")
    for path, info in infos.items():
        if info.part is None:
            lines += _holes(path, info)
    return lines


def _by_run(infos: Mapping[Path, RecordingInfo]) -> dict[str, list[Path]]:
    """Return the parts of each run, in the order of writing."""
    runs = defaultdict[str, list[Path]](list)
    for path, info in infos.items():
        if info.part is not None:
            runs[info.part.run].append(path)
    for paths in runs.values():
        paths.sort(key=lambda path: _number(infos[path]))
        for one, other in pairwise(paths):
            if _number(infos[one]) == _number(infos[other]):
                raise UserError(
                    f"{one} and {other} are both part {_number(infos[one])} of one run;"
                    " give it once"
                )
    return runs


def _number(info: RecordingInfo) -> int:
    assert info.part is not None
    return info.part.number


def _holes(path: Path, info: RecordingInfo) -> Iterator[str]:
    for hole in info.holes:
        at = datetime.fromtimestamp(hole.t_ns * 1e-9, tz=UTC).isoformat(timespec="seconds")
        yield f"{path}: {hole.events} events before {at} are missing: {hole.why}"
