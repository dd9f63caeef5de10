"""Writer of a recording: an MCAP file that can be replayed, and that viewers can draw.

While open the file is called ``….mcap.active``. After ``flush`` everything so far is on the disk
and readable, even if the process is killed; ``close`` writes the index and removes the suffix
``.active``. Not for use by two threads at once.

Over 300 lines: how a file begins, is flushed and ends depend on each other.
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
from companion.recording.folders import RECORDING_MODE
from companion.recording.mcap_file import McapFile
from companion.recording.parts import CONTINUED, HOLE, PART, Hole, Part
from companion.recording.scene import Scene
from companion.values import Event, Output

FILE_MODE: Final = 0o640
ACTIVE: Final = ".active"
SETTINGS: Final = "settings.toml"
NO_FILES: Final[Mapping[str, bytes]] = MappingProxyType({})
MEDIA_TYPES: Final = {
    ".toml": "application/toml",
    ".json": "application/json",
    ".csv": "text/csv",
    ".npy": "application/x-npy",
}
"""Media types of attachments, by the suffixes of their names."""
VERSIONS: Final = "versions"
SUMMARY: Final = "summary"


class _Topics:
    """Channels of an MCAP file by topic; each is added with its first message.

    The class is separate from the writer, which would otherwise reference itself through its
    encoder. Such a cycle keeps a finished file's megabytes until a full garbage collection, which
    is rare in the service.
    """

    def __init__(self, mcap: McapFile) -> None:
        self.messages = 0
        self._mcap = mcap
        self._schema_ids: dict[str, int] = {}
        self._channel_ids: dict[str, int] = {}

    def add(self, topic: str, schema: schemas.Schema, t_ns: int, data: bytes) -> None:
        """Write a message to a topic; called by ``Encoder``."""
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
    """Recording that is open until ``close`` or ``abandon``.

        where          a folder (created if missing), where the file is called
                       ``companion-YYYYmmddTHHMMSSZ.mcap`` after ``started_ns`` (UTC), with -1, -2 …
                       if that exists; or, if the name ends in ``.mcap``, the file itself, which
                       replaces an existing one on ``close``
        settings_toml  the settings, attached to the file
        files          files that the settings name, attached before the settings; by attachment
        versions       versions of programs, as a metadata record
        weights_hz     as for ``Encoder``
        started_ns     start of the recording
        scene          as for ``Encoder``
        part           its part of a run; None: not part of one

    Any method raises ``OSError`` if the file cannot be written.
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
        self.flushed = 0  # messages on the disk
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
            settings = settings_toml.encode(errors="replace")  # names need not be UTF-8
            for name, data in {**files, SETTINGS: settings}.items():
                self._mcap.attachment(at_ns, at_ns, name, MEDIA_TYPES[Path(name).suffix], data)
            self._write_head(versions, part)
        except OSError:
            self.salvage()  # a file without a head would be recovered as an empty recording
            raise

    def _write_head(self, versions: Mapping[str, str], part: Part | None) -> None:
        self._mcap.metadata(VERSIONS, versions)
        if part is not None:
            self._mcap.metadata(PART, part.metadata())
        self.flush()
        sync_folder(self._final.parent)

    @property
    def messages(self) -> int:
        """Number of messages recorded so far."""
        return self._topics.messages

    @property
    def index_bytes(self) -> int:
        """Size of the file's index, which is kept in memory until it is closed."""
        return self._mcap.index_bytes

    @property
    def channels(self) -> int:
        """Number of the file's topics."""
        return self._mcap.channels

    @property
    def path(self) -> Path:
        """Current path of the file: ``….mcap.active`` until it is closed."""
        return self._final if self._finished else _beside(self._final)

    def event(self, event: Event) -> None:
        """Record an event that drives the pipeline: in the order of calls, before its outputs."""
        self._encoder.event(event)

    def output(self, output: Output, geodetic: Geodetic) -> None:
        """Record an output; see ``Encoder.output``."""
        self._encoder.output(output, geodetic)

    def hole(self, hole: Hole) -> None:
        """Record that events are missing at this point."""
        self._mcap.flush()
        self._mcap.metadata(HOLE, hole.metadata())

    def flush(self) -> None:
        """Write everything so far to the disk, where it survives a killed process.

        Raises ``FileNotFoundError`` if the file was removed or renamed: its contents would be lost
        with the process; or if it was truncated: what was flushed is lost already.
        """
        if os.fstat(self._file.fileno()).st_size < self.size_bytes:
            raise FileNotFoundError(errno.ENOENT, "the file was truncated", str(self.path))
        self._mcap.flush()
        os.fsync(self._file.fileno())
        if not self._is_in_place():
            raise FileNotFoundError(errno.ENOENT, "the file was removed", str(self.path))
        self.size_bytes = self._file.tell()
        self.flushed = self.messages

    def close(self, metadata: Mapping[str, str], *, is_continued: bool = False) -> Path:
        """Finish and rename the file; write ``metadata``, if any, as its record ``summary``.

        ``is_continued``: the run continues in another part, which is noted. Returns the file's
        path. Closing twice does nothing.
        """
        if self._finished:
            return self._final
        if metadata:
            self._mcap.metadata(SUMMARY, metadata)
        if is_continued:
            self._mcap.metadata(CONTINUED, {})
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
        """Close the file without finishing it: flushed content can be recovered."""
        self._file.close()

    def salvage(self) -> bool:
        """Close an unwritable file, truncated to the last flush.

        The rest can then be written to another file; a file without messages is removed. Returns
        False if the truncation failed: then it is unknown which part of the rest the file contains.
        """
        if self._file.closed:
            return True
        try:
            spare = os.dup(self._file.fileno())  # closing flushes the buffer, which may fail
        except OSError:
            return self._close_without_spare()
        try:
            with contextlib.suppress(OSError):
                self._file.close()
            os.ftruncate(spare, min(self.size_bytes, os.fstat(spare).st_size))
            if not self.flushed and self._is_in_place(spare):
                self.path.unlink()
        except OSError:
            return False
        finally:
            os.close(spare)
        return True

    def _close_without_spare(self) -> bool:
        """Close an unwritable file that cannot be truncated, since no descriptor is free.

        A file without messages is removed. Returns whether it was.
        """
        is_removed = False
        with contextlib.suppress(OSError):
            if not self.flushed and self._is_in_place():
                self.path.unlink()
                is_removed = True
        with contextlib.suppress(OSError):
            self._file.close()
        return is_removed

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
    """Return ``x.mcap``, or the first of ``x-1.mcap``, ``x-2.mcap`` … that does not exist."""
    candidate, number = wanted, 0
    while candidate.exists():
        number += 1
        candidate = wanted.with_name(f"{wanted.stem}-{number}{wanted.suffix}")
    return candidate


def open_beside(final: Path) -> BufferedWriter:
    """Open the file that gets a name when it is complete, as ``open_alone``.

    Raises ``IsADirectoryError`` if a folder has that name.
    """
    if final.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(final))
    return open_alone(_beside(final))


def open_alone(path: Path) -> BufferedWriter:
    """Open and truncate a file, unless another process is recording to it.

    Raises ``BlockingIOError`` if another process is. The lock ends with the process, so it also
    distinguishes leftovers from files in use.
    """
    while True:
        file = opened(path, os.O_APPEND)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_at(path, file):
                file.truncate(0)
                file.seek(0)
                return file
        except BlockingIOError as error:
            file.close()
            raise BlockingIOError(error.errno, "in use by another process", str(path)) from None
        except OSError as error:
            file.close()
            raise OSError(error.errno, error.strerror, str(path)) from None
        file.close()  # another process finished and renamed it, before it was locked


def _is_at(path: Path, file: BufferedWriter) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False


def opened(path: Path, flags: int) -> BufferedWriter:
    """Open a file for writing; create it, if missing, not readable by all users.

    Raises ``OSError`` for a pipe, which would otherwise wait for a reader.
    """
    flags |= os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK
    try:
        descriptor = os.open(path, flags, FILE_MODE)
    except OSError as error:
        if error.errno == errno.ENXIO:
            raise OSError(error.errno, "is a pipe, not a file", str(path)) from None
        raise
    return os.fdopen(descriptor, "ab" if flags & os.O_APPEND else "wb")


def _reserve(folder: Path, started_ns: int) -> Path:
    """Return a name that no finished or open recording has; create its ``.active`` file."""
    folder.mkdir(RECORDING_MODE, parents=True, exist_ok=True)
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
    """Flush a folder to the disk; without that, a new file name is not durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
