"""Files of ``/v1/recordings``.

Served are only files directly in the recording directory that are named like a recording: no
folders, no symbolic links. A recording in progress can be read up to its last flush: every reader
that accepts truncated files can open it, and ``companion recover`` completes it.
"""

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, BinaryIO, Final, Literal, NamedTuple

from companion.mavlink.links.regular_file import open_regular
from companion.recording.writer import ACTIVE
from companion.values import UtcNs
from companion.values.described import Meaning
from companion.views.as_json import Json, rfc3339

MEDIA_TYPE: Final = "application/x-mcap"
_NAME: Final = re.compile(r"[A-Za-z0-9][\w.-]*\.mcap(\.active)?", re.ASCII)
_STARTED: Final = re.compile(r"companion-(\d{8}T\d{6}Z)")


@dataclass(frozen=True, slots=True)
class Current:
    """Recording in progress: its name, and how many of its bytes are on the disk."""

    name: str | None
    bytes: int


class Version(NamedTuple):
    """File of a recording as it is now; another file that replaced it differs."""

    path: Path
    inode: int
    bytes: int
    modified_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """Recording that is available at ``/v1/recordings/{name}``."""

    name: Annotated[str, Meaning("name of the file", example="companion-20261120T130000Z.mcap")]
    bytes: Annotated[int | None, Meaning("size of the file")]
    state: Annotated[
        Literal["recording", "finished", "unfinished"],
        Meaning("state of the recording: recording, finished, or unfinished if it was cut short"),
    ]
    started: Annotated[str | None, Meaning("start time of the recording")]


@dataclass(frozen=True, slots=True)
class Recordings:
    """List of the available recordings, by name."""

    recordings: Annotated[list[Recording], Meaning("the recordings, by name")]


def listed(where: str | None, current: Current) -> list[Json]:
    """Return the recordings by name. ``where`` as in the settings: a folder, or one file."""
    entries = sorted(_entries(where), key=lambda entry: entry.name)
    return [_shown(entry, current) for entry in entries]


def _entries(where: str | None) -> Iterator[os.DirEntry[str]]:
    if where is None:
        return
    path = Path(where)
    try:
        only_file = path.suffix == ".mcap" and not path.is_dir()
        names = {path.name, path.name + ACTIVE} if only_file else None
        with os.scandir(path.parent if only_file else path) as found:
            for entry in found:
                is_file = entry.is_file(follow_symlinks=False)
                if is_file and _NAME.fullmatch(entry.name) and (not names or entry.name in names):
                    yield entry
    except OSError:
        return


def _shown(entry: os.DirEntry[str], current: Current) -> Json:
    is_current = entry.name == current.name
    state = "unfinished" if entry.name.endswith(ACTIVE) else "finished"
    started = _STARTED.match(entry.name)
    started_ns = _utc_ns(started[1]) if started else None
    try:
        size: int | None = (
            current.bytes if is_current else entry.stat(follow_symlinks=False).st_size
        )
    except OSError:  # renamed or deleted since the folder was read, or not permitted
        size = None
    return {
        "name": entry.name,
        "bytes": size,
        "state": "recording" if is_current else state,
        "started": None if started_ns is None else rfc3339(started_ns),
    }


def _utc_ns(text: str) -> UtcNs | None:
    """Return the time in a file's name; None if it is none, such as the 99th of a month."""
    try:
        at = datetime.strptime(text, "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC)
    except ValueError:
        return None
    return UtcNs(int(at.timestamp()) * 1_000_000_000)


def opened(where: str | None, name: str, current: Current) -> tuple[BinaryIO, int] | None:
    """Return an open recording, and how many bytes may be read; None if it cannot be opened.

    The open file remains the same if its name changes afterwards.
    """
    found = find(where, name)
    if found is None:
        return None
    try:
        file = open_regular(found, follow_links=False)
    except OSError:
        return None
    size = os.fstat(file.fileno()).st_size
    return file, min(size, current.bytes) if name == current.name else size


def find(where: str | None, name: str) -> Path | None:
    """Return the path of a recording; None if the name is unknown."""
    return next((Path(entry.path) for entry in _entries(where) if entry.name == name), None)


def version(where: str | None, name: str) -> Version | None:
    """Return which file a recording is at present; None if the name is unknown."""
    path = find(where, name)
    if path is None:
        return None
    try:
        status = path.stat()
    except OSError:  # removed a moment ago, or in a folder that may not be searched
        return None
    return Version(
        path=path, inode=status.st_ino, bytes=status.st_size, modified_ns=status.st_mtime_ns
    )
