"""Recovery: completion of a truncated recording.

Intact content is written again like a recording, so the result has its index and opens in every
viewer. The truncated original is removed only when its replacement is complete and on the disk.
"""

import fcntl
import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from mcap.records import Attachment, Metadata

from companion.mavlink.links.regular_file import NotRegularError, is_locked, open_regular
from companion.recording.container import MAGIC, Content, Damage, Message, Walk
from companion.recording.mcap_file import McapFile
from companion.recording.reader import LogError
from companion.recording.writer import ACTIVE, free_name, opened, sync_folder

_PARTIAL: Final = ".recovering"
CHANNELS_MAX: Final = 65_535
"""Limit on channels with messages, which are numbered from 1, in two bytes."""
DAMAGED: Final = ".damaged"
LOST_MAX: Final = 10_000
"""Most bytes that are dropped from a file of which no message is recovered; if more, it is kept."""


class UnreadableError(LogError):
    """Error of a file that contains no recording."""


class BeingRecordedError(LogError):
    """Error of a recording that is still open in another process."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recovered:
    """The result of recovering a recording."""

    path: Path  # the finished file
    messages: Mapping[str, int]  # number of messages by topic
    last_ns: int | None  # latest time among them; None without any
    lost_bytes: int  # bytes of the original that could not be used
    changed: bool  # False for a complete file, which is left unchanged


def recover(path: Path) -> Recovered:
    """Complete ``x.mcap.active`` as ``x.mcap``, a truncated ``x.mcap`` as ``x.recovered.mcap``.

    Existing files are never overwritten: the new file is then ``x-1.mcap`` and so on.
    ``x.mcap.active`` is removed afterwards, a truncated ``x.mcap`` is kept. Raises ``LogError`` if
    the file is not an MCAP file, is being recorded, cannot be read, or if its replacement cannot be
    written.
    """
    try:
        return _recover(path)
    except FileNotFoundError:
        raise LogError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise LogError(f"{path}: is a directory, not a recording") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be recovered: {error.strerror}") from None


def holds_recording(wanted: Path) -> bool:
    """Return whether a file is a finished recording, or the leftover of one, not to be replaced."""
    if wanted.is_dir():
        return False
    active = wanted.with_name(wanted.name + ACTIVE)
    if not active.is_file():
        return wanted.is_file()
    with active.open("rb") as file:
        return wanted.is_file() or not is_locked(file)


def recover_leftovers(folder: Path) -> list[Recovered | LogError]:
    """Recover every ``*.mcap.active`` in a folder.

    A file that is not a recording, or causes an unexpected error, is reported and kept as
    ``x.mcap.damaged``, so that it is not tried again at each start. After a disk error the file is
    reported and left.

    A file that another process is recording is skipped, and is not in the list.
    """
    results: list[Recovered | LogError] = []
    for path in sorted(folder.glob(f"*.mcap{ACTIVE}")):
        try:
            results.append(recover(path))
        except BeingRecordedError:
            continue
        except UnreadableError as error:
            results.append(_keep_damaged(path, str(error)))
        except LogError as error:
            results.append(error)
        except Exception as error:  # no leftover may prevent the service from starting
            results.append(_keep_damaged(path, f"{path}: {type(error).__name__}: {error}"))
    return results


def _keep_damaged(path: Path, why: str) -> LogError:
    aside = free_name(path.with_suffix(DAMAGED))
    try:
        path.rename(aside)
    except OSError as error:
        return LogError(f"{why}; it cannot be renamed: {error.strerror}")
    return LogError(f"{why}; kept as {aside.name}")


def _recover(path: Path) -> Recovered:
    try:
        file = open_regular(path)
    except NotRegularError as error:
        raise UnreadableError(f"{path}: {error.strerror}") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BeingRecordedError(f"{path}: is being recorded; stop that run first") from None
        return _rewrite(path, file.read(len(MAGIC)))


def _rewrite(path: Path, head: bytes) -> Recovered:
    active = path.name.endswith(ACTIVE)
    # A process killed at the start may leave only some of the magic bytes.
    if not (head == MAGIC or (active and MAGIC.startswith(head))):
        raise UnreadableError(f"{path}: not an MCAP recording")
    final = path.with_suffix("") if active else path.with_suffix(".recovered.mcap")
    partial = final.with_name(final.name + _PARTIAL)
    walk = Walk(path)
    tally = _Tally()
    try:
        with opened(partial, os.O_TRUNC | os.O_NOFOLLOW) as out:
            _Copy(McapFile(out), walk, tally).run()
            out.flush()
            os.fsync(out.fileno())
        whole = walk.complete and not walk.lost_bytes
        if whole and not active:
            return tally.result(path, 0, changed=False)
        if active and not tally.messages and walk.lost_bytes > LOST_MAX:
            raise UnreadableError(f"{path}: no message can be recovered")
        final = free_name(final)
        (path if whole else partial).rename(final)
    finally:
        partial.unlink(missing_ok=True)
    sync_folder(final.parent)
    if active:
        path.unlink(missing_ok=True)
    return tally.result(final, walk.lost_bytes, changed=True)


class _Tally:
    """Counts of the messages that were recovered."""

    def __init__(self) -> None:
        self.messages: Counter[str] = Counter()
        self._last_ns: int | None = None

    def count(self, message: Message) -> None:
        self.messages[message.channel.topic] += 1
        self._last_ns = max(self._last_ns or 0, message.log_time_ns)

    def result(self, path: Path, lost_bytes: int, *, changed: bool) -> Recovered:
        return Recovered(
            path=path,
            messages=dict(self.messages),
            last_ns=self._last_ns,
            lost_bytes=lost_bytes,
            changed=changed,
        )


class _Copy:
    """Copy of a walk's contents to a new file, with new ids of schemas and channels."""

    def __init__(self, mcap: McapFile, walk: Walk, tally: _Tally) -> None:
        self._mcap = mcap
        self._walk = walk
        self._tally = tally
        self._schemas: dict[int, int] = {}
        self._channels: dict[int, int] = {}

    def run(self) -> None:
        for content in self._walk:
            self._add(content)
        self._mcap.finish()

    def _add(self, content: Content) -> None:
        match content:
            case Message(channel, sequence, log_ns, publish_ns, data):
                channel_id = self._channels.get(channel.id) or self._register(content)
                self._mcap.message(channel_id, log_ns, publish_ns, sequence, data)
                self._tally.count(content)
            case Attachment():
                self._mcap.attachment(
                    content.log_time,
                    content.create_time,
                    content.name,
                    content.media_type,
                    content.data,
                )
            case Metadata():
                self._mcap.metadata(content.name, content.metadata)
            case Damage():
                pass  # the walk has counted its bytes

    def _register(self, message: Message) -> int:
        channel = message.channel
        if len(self._channels) == CHANNELS_MAX:
            raise UnreadableError(f"{self._walk.path}: more than {CHANNELS_MAX} channels")
        schema_id = self._schemas.get(channel.schema_id)
        if schema_id is None:
            schema_id = 0  # other programs write channels without a schema
            if schema := self._walk.schemas.get(channel.schema_id):
                schema_id = self._mcap.schema(schema.name, schema.encoding, schema.data)
            self._schemas[channel.schema_id] = schema_id
        channel_id = self._mcap.channel(
            channel.topic, channel.message_encoding, schema_id, channel.metadata
        )
        return self._channels.setdefault(channel.id, channel_id)
