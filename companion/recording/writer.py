"""Writes a recording: an MCAP file that replays to what happened, and that viewers can draw.

While open the file is called ``….mcap.active``. After ``flush`` everything so far is on the disk
and readable whatever happens to the process; ``close`` writes the index and removes the ending
``.active``. Not for use by two threads at once.
"""

import contextlib
import errno
import fcntl
import os
from collections.abc import Mapping
from datetime import UTC, datetime
from io import BufferedWriter
from pathlib import Path
from types import MappingProxyType
from typing import Final, Self

from companion.recording import schemas
from companion.recording.entries import Encoder, Geodetic
from companion.recording.mcap_file import McapFile
from companion.recording.parts import HOLE, PART, Hole, Part
from companion.recording.scene import Scene
from companion.values import Event, Output

FILE_MODE: Final = 0o640
FOLDER_MODE: Final = 0o750
ACTIVE: Final = ".active"
SETTINGS: Final = "settings.toml"
NO_FILES: Final[Mapping[str, bytes]] = MappingProxyType({})
MEDIA_TYPES: Final = {
    ".toml": "application/toml",
    ".json": "application/json",
    ".csv": "text/csv",
    ".npy": "application/x-npy",
}
"""Media types of attachments, by the endings of their names."""
VERSIONS: Final = "versions"
SUMMARY: Final = "summary"


class _Topics:
    """The channels of a file by their topics; each is described with its first message.

    Not part of the writer, which would then be part of its own encoder: such a circle keeps a
    finished file's megabytes until a full garbage collection, and those are rare in the service.
    """

    def __init__(self, mcap: McapFile) -> None:
        self.messages = 0
        self._mcap = mcap
        self._schema_ids: dict[str, int] = {}
        self._channel_ids: dict[str, int] = {}

    def add(self, topic: str, schema: schemas.Schema, t_ns: int, data: bytes) -> None:
        """Write a message; ``Encoder`` calls it."""
        channel_id = self._channel_ids.get(topic) or self._channel(topic, schema)
        stamp_ns = t_ns if t_ns > 0 else 0
        self._mcap.message(channel_id, stamp_ns, stamp_ns, self.messages & 0xFFFFFFFF, data)
        self.messages += 1

    def _channel(self, topic: str, schema: schemas.Schema) -> int:
        schema_id = self._schema_ids.get(schema.name)
        if schema_id is None:
            schema_id = self._mcap.schema(schema.name, "protobuf", schema.descriptor_set)
            self._schema_ids[schema.name] = schema_id
        channel_id = self._mcap.channel(topic, "protobuf", schema_id)
        return self._channel_ids.setdefault(topic, channel_id)


class Writer:
    """One recording, open from the start until ``close`` or ``abandon``.

        where          a folder (made if missing), in which the file is called
                       ``companion-YYYYmmddTHHMMSSZ.mcap`` after ``started_ns`` (UTC), with -1, -2 …
                       where that is taken; or, when the name ends in ``.mcap``, the file itself,
                       which replaces one of that name on ``close``
        settings_toml  the settings, attached to the file
        files          files that the settings name, attached before them; by attachment
        versions       versions of programs, as a metadata record
        weights_hz     as for ``Encoder``
        started_ns     when the recording begins
        scene          as for ``Encoder``
        part           which part of which run this is; None: it stands alone

    Any method raises ``OSError`` where the file cannot be written.
    """

    def __init__(
        self,
        *,
        where: Path,
        settings_toml: str,
        versions: Mapping[str, str],
        weights_hz: float | None,
        started_ns: int,
        files: Mapping[str, bytes] = NO_FILES,
        scene: Scene | None = None,
        part: Part | None = None,
    ) -> None:
        self.flushed = 0  # messages that are on the disk
        self.size_bytes = 0  # size of the file at the last flush
        self._replace = where.suffix == ".mcap" and not where.is_dir()
        self._final = where if self._replace else _reserve(where, started_ns)
        self._finished = False
        self._file = open_alone(_beside(self._final))
        self._mcap = McapFile(self._file)
        self._topics = _Topics(self._mcap)
        self._encoder = Encoder(self._topics.add, weights_hz, scene)
        try:
            at_ns = max(0, started_ns)
            for name, data in {**files, SETTINGS: settings_toml.encode()}.items():
                self._mcap.attachment(at_ns, at_ns, name, MEDIA_TYPES[Path(name).suffix], data)
            self._write_head(versions, part)
        except OSError:
            self.salvage()  # a file without a head would be recovered as a recording of nothing
            raise

    def _write_head(self, versions: Mapping[str, str], part: Part | None) -> None:
        self._mcap.metadata(VERSIONS, versions)
        if part is not None:
            self._mcap.metadata(PART, part.metadata())
        self.flush()
        sync_folder(self._final.parent)

    @property
    def messages(self) -> int:
        """Messages recorded so far."""
        return self._topics.messages

    @property
    def path(self) -> Path:
        """Where the file is now: ``….mcap.active`` until it is closed."""
        return self._final if self._finished else _beside(self._final)

    def event(self, event: Event) -> None:
        """Record what drives the pipeline: in the order of the calls, before its outputs."""
        self._encoder.event(event)

    def output(self, output: Output, geodetic: Geodetic) -> None:
        """Record an output; see ``Encoder.output``."""
        self._encoder.output(output, geodetic)

    def hole(self, hole: Hole) -> None:
        """Record that events are missing here."""
        self._mcap.flush()
        self._mcap.metadata(HOLE, hole.metadata())

    def flush(self) -> None:
        """Write everything so far to the disk; a killed process then loses nothing of it.

        Raises ``FileNotFoundError`` where the file is no longer in its place: what is written to a
        removed file is lost with the process.
        """
        self._mcap.flush()
        os.fsync(self._file.fileno())
        if not self._is_in_place():
            raise FileNotFoundError(errno.ENOENT, "the file is no longer there", str(self.path))
        self.size_bytes = self._file.tell()
        self.flushed = self.messages

    def close(self, metadata: Mapping[str, str]) -> Path:
        """Finish the file and give it its name; ``metadata``, if any, is its record ``summary``.

        Returns the file's path. Closing twice does nothing.
        """
        if self._finished:
            return self._final
        if metadata:
            self._mcap.metadata(SUMMARY, metadata)
        self._mcap.finish()
        self._file.flush()
        os.fsync(self._file.fileno())
        self.size_bytes = self._file.tell()
        self._file.close()
        self.flushed = self.messages
        active = _beside(self._final)
        if not self._replace:
            self._final = free_name(self._final)
        active.rename(self._final)
        self._finished = True
        sync_folder(self._final.parent)
        return self._final

    def abandon(self) -> None:
        """Close the file as it is, ``.active``: what has been flushed can be recovered."""
        self._file.close()

    def salvage(self) -> bool:
        """Close a file that cannot be written, cut back to what was flushed last.

        The rest can then go into another file; a file that holds no message is removed. Returns
        False where it could not be cut: then it is not known what it holds of the rest.
        """
        if self._file.closed:
            return True
        spare = os.dup(self._file.fileno())  # closing writes the buffer, which may fail
        try:
            with contextlib.suppress(OSError):
                self._file.close()
            os.ftruncate(spare, self.size_bytes)
            if not self.flushed and self._is_in_place(spare):
                self.path.unlink()
        except OSError:
            return False
        finally:
            os.close(spare)
        return True

    def _is_in_place(self, descriptor: int | None = None) -> bool:
        try:
            named = self.path.stat()
        except FileNotFoundError:
            return False
        held = os.fstat(self._file.fileno() if descriptor is None else descriptor)
        return os.path.samestat(named, held)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.abandon()


def _beside(final: Path) -> Path:
    return final.with_name(final.name + ACTIVE)


def free_name(wanted: Path) -> Path:
    """``x.mcap``, or the first of ``x-1.mcap``, ``x-2.mcap`` … that does not exist."""
    candidate, number = wanted, 0
    while candidate.exists():
        number += 1
        candidate = wanted.with_name(f"{wanted.stem}-{number}{wanted.suffix}")
    return candidate


def open_alone(path: Path) -> BufferedWriter:
    """Open and empty a file that no other process is recording to.

    Raises ``BlockingIOError`` if one is. The lock goes with the process, however that ends, so it
    also tells leftovers from live files.
    """
    file = opened(path, os.O_APPEND)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        file.truncate(0)
        file.seek(0)
    except OSError:
        file.close()
        raise
    return file


def opened(path: Path, flags: int) -> BufferedWriter:
    """A file to write, made if missing: where everybody flies is not for all to read."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | flags, FILE_MODE)
    return os.fdopen(descriptor, "ab" if flags & os.O_APPEND else "wb")


def _reserve(folder: Path, started_ns: int) -> Path:
    """A name that no recording has, finished or open; its ``.active`` file now exists."""
    folder.mkdir(FOLDER_MODE, parents=True, exist_ok=True)
    started = datetime.fromtimestamp(started_ns // 1_000_000_000, tz=UTC)
    name, number = f"companion-{started:%Y%m%dT%H%M%SZ}", 0
    while True:
        path = folder / f"{name}{f'-{number}' if number else ''}.mcap"
        number += 1
        if path.exists():
            continue
        try:
            _beside(path).touch(FILE_MODE, exist_ok=False)
        except FileExistsError:
            continue
        return path


def sync_folder(folder: Path) -> None:
    """Bring a folder to the disk: a new name is on the disk only when its folder is."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
