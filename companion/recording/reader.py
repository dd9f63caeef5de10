"""Reader of every kind of log, detected by content and never by name.

Recordings of this program return exactly the events of the live run, in order; telemetry logs, raw
MAVLink, captures and MCAP by others return the events of an equivalent live run. Onboard logs
become the frames that the vehicle would have sent: several such logs are one flight.

Over 300 lines: all kinds of logs become the same events.
"""

import heapq
import mmap
import os
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import IO, Final, Literal, NamedTuple, cast

from google.protobuf.message import DecodeError
from mcap.records import Attachment, Metadata

from companion.mavlink.links.regular_file import NotRegularError, open_regular
from companion.mavlink.wire.framing import is_shaped
from companion.recording import codec, schemas, tlog
from companion.recording.container import MAGIC, Damage, Message, Walk
from companion.recording.errors import LogError
from companion.recording.foreign import capture, kinds, together
from companion.recording.foreign.together import Vehicle
from companion.recording.writer import SETTINGS, SUMMARY
from companion.settings.model import NAMED_FILES
from companion.values import ClockSet, Event, Frame, Reason, Rejection, Source

__all__ = ["LogError", "LogKind", "center_of", "flights", "log_kind", "read_flight", "read_log",
           "read_parts", "read_settings", "utc_offset_ns", "vehicles"]  # fmt: skip

LogKind = Literal["tlog", "mavlink", "mcap", "foreign-mcap", "capture", "dataflash", "ulog", "csv"]
ATTACHMENTS: Final = frozenset(file.attachment for file in NAMED_FILES)
_MAPPED_BYTES: Final = 1 << 26
"""Least size of a log that is memory-mapped instead of read."""
_LATEST_NS: Final = 1 << 62
"""Latest time of an event, the year 2116: results computed from times fit into 63 bits."""
LARGEST_EVENT: Final = 1 << 21
"""Limit on the bytes of an event: a duty with the largest number of names."""
_UNCERTAINTY_MAX_NS: Final = 3_600_000_000_000
"""Largest uncertainty of a frame's arrival: results computed from it fit into 63 bits."""
DAMAGED: Final = "recording damaged"  # detail of a rejection for bytes of a recording
_EVENT_TOPICS: Final = frozenset((schemas.FRAMES_TOPIC, *codec.EVENTS))


def log_kind(path: Path) -> LogKind:
    """Return the kind of a log. Raises ``LogError`` if the file is not a log."""
    return _open(path)[0]


def read_log(log: Path | str, latency_s: float = 0.0) -> Iterator[Event]:
    """Return the events of a log, in order. Raises ``LogError`` at once if the file is unusable.

    ``Frame.link`` is the recorded link, or the file's name if the log has no links. A truncated
    recording returns its intact events; damage in it becomes a ``Rejection`` of that many bytes of
    garbage. Onboard logs have no arrivals: their frames arrive ``latency_s`` after
    they were true.
    """
    path = Path(log)
    kind, data = _open(path)
    if kind == "tlog":
        return tlog.read_tlog(data, path.name)
    if kind == "mavlink":
        return tlog.read_raw(data, path.name)
    if kind in together.READERS:
        return together.events(together.opened([(path, kind)]), latency_s)
    if kind == "mcap":
        return _begun(path, _recorded, "an MCAP file", object)
    if kind == "capture":
        return _begun(path, capture.read_capture, "a capture", Frame)
    return _begun(path, capture.read_mcap, "an MCAP file", Frame)


def _begun(
    path: Path, read: Callable[[Path], Iterator[Event]], what: str, kind: type
) -> Iterator[Event]:
    """Return the events of a file, so that errors before the first of a kind are raised at once.

    The file is read again from its start: any number of rejections may precede that event.
    """
    damaged = 0
    try:
        for event in read(path):
            if isinstance(event, Rejection) and event.detail == DAMAGED:
                damaged += event.count
            elif isinstance(event, kind):
                return read(path)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None
    why = f": {damaged} bytes are damaged" if damaged else ""
    raise LogError(f"{path}: {what}, but no MAVLink frame in it{why}")


def read_flight(logs: Sequence[Path], latency_s: float = 0.0) -> Iterator[Event]:
    """Return the events of logs of one flight, merged by time: see ``read_log``.

    Logs of one vehicle each are converted to GPS time, with distinct ids for their vehicles.
    """
    if len(logs) == 1:
        return read_log(logs[0], latency_s)
    aboard = vehicles(logs)
    those = {one.path for one in aboard}
    streams = [read_log(log) for log in logs if log not in those]
    if aboard:
        streams.append(together.events(aboard, latency_s))
    return heapq.merge(*streams, key=lambda event: event.t_ns)


def require_distinct(logs: Sequence[Path]) -> None:
    """Raise ``LogError`` if a log is given twice."""
    known = set[str]()
    for log in logs:
        place = os.path.realpath(log)
        if place in known:
            raise LogError(f"{log} is given twice")
        known.add(place)


def vehicles(logs: Sequence[Path]) -> list[Vehicle]:
    """Return the vehicles of the onboard logs among some logs; empty without onboard logs.

    Raises ``LogError`` for an unusable log, or logs of different flights.
    """
    known = [(log, log_kind(log)) for log in logs]
    return together.opened([(log, kind) for log, kind in known if kind in together.READERS])


def flights(logs: Sequence[Path]) -> list[tuple[Path, ...]]:
    """Group logs by flight: all onboard logs are one flight, every other log is its own.

    Raises ``LogError`` for an unusable log.
    """
    aboard = tuple(log for log in logs if log_kind(log) in together.READERS)
    alone: list[tuple[Path, ...]] = [(log,) for log in logs if log not in aboard]
    return [aboard, *alone] if aboard else alone


def center_of(logs: Sequence[Path], center: str | None) -> str | None:
    """Return the carrier of the array: as given, or the vehicle whose onboard log is named.

    Raises ``LogError`` if the named log contains several vehicles, or is not one of ``logs``.
    """
    if center is None:
        return None
    named = [log for log in logs if center in (str(log), log.name)]
    if not named and Path(center).is_file():
        raise LogError(f"{center}: name the carrier's log among the logs, too")
    if not named:
        return center
    for one in vehicles(logs):
        if one.path in named:
            return str(one.source)
    raise LogError(f"{center}: not the log of one vehicle; give the carrier as SYSID:COMPID")


def read_parts(paths: Sequence[Path]) -> Iterator[Event]:
    """Return the events of recordings one after the other; some may contain none.

    Like ``read_log``, except that ``LogError`` is raised only when a file is reached.
    """
    return chain.from_iterable(map(_recorded, paths))


class RecordedSettings(NamedTuple):
    """Settings of a run, as its recording contains them."""

    text: str  # TOML
    files: dict[str, bytes]  # files that they name, by name of the attachment


def read_settings(path: Path) -> RecordedSettings | None:
    """Return the settings in a recording; None if the log has none."""
    if log_kind(path) != "mcap":
        return None
    files: dict[str, bytes] = {}
    for content in Walk(path, frozenset()):
        if not isinstance(content, Attachment):
            continue
        if content.name in ATTACHMENTS:
            files.setdefault(content.name, content.data)
        if content.name == SETTINGS:
            try:
                return RecordedSettings(content.data.decode(), files)
            except UnicodeDecodeError:
                raise LogError(f"{path}: its settings are not UTF-8 text") from None
    return None


def digest_of(path: Path) -> str | None:
    """Return the digest in a recording; None if the recording is truncated."""
    if log_kind(path) != "mcap":
        return None
    for content in Walk(path, frozenset()):
        if isinstance(content, Metadata) and content.name == SUMMARY:
            return content.metadata.get("digest")
    return None


def utc_offset_ns(paths: Sequence[Path]) -> int:
    """Return UTC less the timeline of recordings, by the latest value in them; 0 without a value.

    Raises ``LogError`` if a value is invalid.
    """
    latest = (0, 0)  # time, offset
    for path in paths:
        walk = Walk(path, frozenset())
        next(iter(walk), None)  # the end of the file, if it exists, has all channels
        topics = {channel.topic for channel in walk.channels.values()}
        if log_kind(path) == "mcap" and (not topics or schemas.CLOCK_TOPIC in topics):
            for content in Walk(path, frozenset((schemas.CLOCK_TOPIC,))):
                if isinstance(content, Message):
                    found = _clock_set(path, content.data)
                    latest = max(latest, (found.t_ns, found.utc_offset_ns))
    return latest[1]


def _clock_set(path: Path, data: bytes) -> ClockSet:
    try:
        found = codec.to_event(schemas.CLOCK_TOPIC, data)
    except (DecodeError, ValueError) as error:
        raise LogError(f"{path}: not a recording of this program: {error}") from None
    assert isinstance(found, ClockSet)
    return found


def _open(path: Path) -> tuple[LogKind, bytes]:
    """Return the kind of a log, and its bytes unless they are read piece by piece."""
    try:
        with open_regular(path) as file:
            head = file.read(kinds.HEAD_BYTES)
            if head.startswith(MAGIC):
                return ("mcap" if _ours(path) else "foreign-mcap"), b""
            piecewise = kinds.read_piecewise(head)
            if piecewise is not None:
                return piecewise, b""
            data = _whole(file)
    except FileNotFoundError:
        raise LogError(f"{path}: no such file") from None
    except NotRegularError as error:
        raise LogError(f"{path}: {error.strerror}") from None
    except IsADirectoryError:
        raise LogError(f"{path}: is a folder; name the logs in it") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None
    if not data:
        raise LogError(f"{path}: is empty")
    other = kinds.named(head)
    if other is not None:
        raise LogError(f"{path}: no MAVLink, but {other}")
    kind = tlog.sniff(data)
    if kind is None and kinds.looks_like_text(data[:512]):
        return "csv", b""
    if kind is None and kinds.is_utf_16(head):
        raise LogError(f"{path}: no MAVLink, but text in UTF-16: save it as UTF-8")
    if kind is None:
        raise LogError(f"{path}: no MAVLink frame in it")
    return kind, data


def _whole(file: IO[bytes]) -> bytes:
    """Return all bytes of a file; a large one is memory-mapped."""
    size = file.seek(0, os.SEEK_END)
    if size > _MAPPED_BYTES:
        # It supports the same operations: index, slice and regular expressions.
        return cast(bytes, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    file.seek(0)
    return file.read()


def _ours(path: Path) -> bool:
    """Return whether this program wrote an MCAP file: it has a known channel, or no channel."""
    walk = Walk(path, frozenset())
    next(iter(walk), None)  # the end of the file, if it exists, has all channels
    if not walk.channels:
        walk = Walk(path, _EVENT_TOPICS)
        if any(isinstance(content, Message) for content in walk):
            return True
    topics = {channel.topic for channel in walk.channels.values()}
    return not topics or not topics.isdisjoint(_EVENT_TOPICS)


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
            if event.t_ns >= _LATEST_NS:
                raise ValueError("event time out of range")
            if damaged:
                yield _damage(path, t_ns or event.t_ns, damaged)
                damaged = 0
            t_ns = event.t_ns
            yield event
        if damaged:
            yield _damage(path, t_ns, damaged)
    except (DecodeError, ValueError) as error:
        raise LogError(f"{path}: not a recording of this program: {error}") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None


def _damage(path: Path, t_ns: int, count: int) -> Rejection:
    return Rejection(
        t_ns=t_ns, source=path.name, reason=Reason.GARBAGE, count=count, detail=DAMAGED
    )


def _event(topic: str, data: bytes, sources: dict[tuple[int, int], Source]) -> Event | None:
    if len(data) > LARGEST_EVENT:
        raise ValueError(f"event is longer than {LARGEST_EVENT} bytes")
    if topic == schemas.FRAMES_TOPIC:
        frame = codec.to_frame(data, sources)
        if (
            not is_shaped(frame.raw)
            or max(frame.source) > 255
            or frame.doubt_ns > _UNCERTAINTY_MAX_NS
            or len(frame.link) > codec.TEXT_MAX
        ):
            raise ValueError("malformed frame")
        return frame
    return codec.to_event(topic, data)
