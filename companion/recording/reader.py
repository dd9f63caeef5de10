"""Opens every kind of log, by what is in the file and never by its name.

Recordings of this program give back exactly the events that drove the live run, in that order;
telemetry logs and raw MAVLink give the events that a live run would have had.
"""

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Final, Literal

from google.protobuf.message import DecodeError
from mcap.records import Attachment, Metadata

from companion.recording import codec, foreign, schemas, tlog
from companion.recording.container import MAGIC, Damage, Walk
from companion.recording.writer import SETTINGS
from companion.values import Event, Reason, Rejection, Source, Tick, UserError

LogKind = Literal["tlog", "mavlink", "mcap"]
_EVENT_TOPICS: Final = frozenset(
    (
        schemas.FRAMES_TOPIC,
        schemas.TICKS_TOPIC,
        schemas.REJECTIONS_TOPIC,
        schemas.ROUND_TRIPS_TOPIC,
    )
)


class LogError(UserError):
    """A file that cannot be used. The message is one line: the file, and why."""


def log_kind(path: Path) -> LogKind:
    """The kind of a log. Raises ``LogError`` where the file is none."""
    return _open(path)[0]


def read_log(log: Path | str) -> Iterator[Event]:
    """The events of a log, in order. Raises ``LogError`` at once where the file cannot be used.

    ``Frame.link`` is the recorded link, or the file's name where the log knows of no links. A
    recording cut short gives what is intact, and then ends; damage with intact events after it is a
    ``Rejection`` of so many bytes of garbage.
    """
    path = Path(log)
    kind, data = _open(path)
    if kind == "tlog":
        return tlog.read_tlog(data, path.name)
    if kind == "mavlink":
        return tlog.read_raw(data, path.name)
    events = _recorded(path)
    first = next(events, None)
    if first is None:
        raise LogError(f"{path}: an MCAP file, but no MAVLink frame in it")
    return chain((first,), events)


def read_parts(paths: Sequence[Path]) -> Iterator[Event]:
    """The events of recordings one after the other; some of them may hold none.

    As ``read_log``, but ``LogError`` is raised only when a file is reached.
    """
    return chain.from_iterable(map(_recorded, paths))


def read_settings(path: Path) -> str | None:
    """The settings (TOML) with which a recording was made; None where the log has none."""
    if log_kind(path) != "mcap":
        return None
    for content in Walk(path, frozenset()):
        if isinstance(content, Attachment) and content.name == SETTINGS:
            return content.data.decode()
    return None


def _open(path: Path) -> tuple[LogKind, bytes]:
    """The kind of a log, and its bytes unless it is an MCAP file, which is read piece by piece."""
    try:
        with path.open("rb") as file:
            head = file.read(len(MAGIC))
            if head == MAGIC:
                return "mcap", b""
            data = head + file.read()
    except FileNotFoundError:
        raise LogError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise LogError(f"{path}: is a folder: name the logs in it") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None
    if not data:
        raise LogError(f"{path}: is empty")
    other = foreign.named(data[: foreign.HEAD_BYTES])
    if other is not None:
        raise LogError(f"{path}: no MAVLink, but {other}")
    kind = tlog.sniff(data)
    if kind is None:
        text = ": it is text" if foreign.looks_like_text(data[:512]) else ""
        raise LogError(f"{path}: no MAVLink frame in it{text}")
    return kind, data


def _recorded(path: Path) -> Iterator[Event]:
    sources: dict[tuple[int, int], Source] = {}
    t_ns = 0
    damaged = 0
    try:
        for content in Walk(path, _EVENT_TOPICS):
            if isinstance(content, Damage):
                damaged += content.size_bytes
                continue
            if isinstance(content, Attachment | Metadata):
                continue
            event = _event(content.channel.topic, content.data, sources)
            if event is None:
                continue
            if damaged:
                yield Rejection(
                    t_ns, path.name, Reason.GARBAGE, damaged, detail="recording damaged"
                )
                damaged = 0
            t_ns = event.t_ns
            yield event
    except (DecodeError, ValueError) as error:
        raise LogError(f"{path}: not a recording of this program: {error}") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None


def _event(topic: str, data: bytes, sources: dict[tuple[int, int], Source]) -> Event | None:
    if topic == schemas.FRAMES_TOPIC:
        return codec.to_frame(data, sources)
    if topic == schemas.TICKS_TOPIC:
        return Tick(schemas.TickMessage.FromString(data).t_ns)
    if topic == schemas.ROUND_TRIPS_TOPIC:
        return codec.to_round_trip(data)
    return codec.to_rejection(data)
