"""Writes a recording: an MCAP file that replays to what happened, and that viewers can draw.

What drove the pipeline (frames, ticks, rejections made while framing) is written whole and in
order. What came of it is there to be looked at: every fix, and tracks and weights as often as
asked, since a replay derives them again.

While open the file is called ``….mcap.active``. After ``flush`` everything so far is on the
disk and readable whatever happens to the process; ``close`` writes the index and takes the
``.active`` off. Not for use by two threads at once.
"""

import fcntl
import os
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from io import BufferedWriter
from pathlib import Path
from typing import Final, Self

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from companion.recording import messages, schemas
from companion.values import (
    BeamSet,
    Estimate,
    Event,
    FloatArray,
    Frame,
    Notice,
    Output,
    Rejection,
    RoundTrip,
    Tick,
    Track,
    Update,
)

ACTIVE: Final = ".active"
SETTINGS: Final = "settings.toml"
VERSIONS: Final = "versions"
SUMMARY: Final = "summary"
_CHUNK_BYTES: Final = 1 << 20

Geodetic = Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]
"""(N, 3) positions in the local frame, metres, to latitude and longitude in degrees and altitude
in metres, each (N,)."""


class Writer:
    """One recording, open from the start until ``close`` or ``abandon``.

    ``where``: a folder (made if missing), in which the file is called
    ``companion-YYYYmmddTHHMMSSZ.mcap`` after ``started_ns`` (UTC), with -1, -2 … where that is
    taken; or, when the name ends in ``.mcap``, the file itself, which replaces one of that name
    on ``close``. ``weights_hz``: how often at most, by the updates' own time, tracks and weights
    are written (None: at every update). ``OSError`` where the file cannot be written, from any
    method.
    """

    def __init__(
        self,
        where: Path,
        settings_toml: str,
        versions: Mapping[str, str],
        weights_hz: float | None,
        started_ns: int,
    ) -> None:
        self.messages = 0
        """Messages recorded so far."""
        self.size_bytes = 0
        """The size of the file at the last ``flush``."""
        self._replace = where.suffix == ".mcap" and not where.is_dir()
        self._final = where if self._replace else _reserve(where, started_ns)
        self._finished = False
        self._period_ns = 0 if weights_hz is None else int(1e9 / weights_hz)
        self._due_ns: int | None = None
        self._last_event: Event | None = None
        self._frame_bytes = schemas.FrameEncoder().encode
        self._schema_ids: dict[str, int] = {}
        self._channel_ids: dict[str, int] = {}
        self._file = _open_alone(_beside(self._final))
        self._mcap = McapWriter(
            self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD
        )
        self._write_head(settings_toml, versions, max(0, started_ns))

    def _write_head(self, settings_toml: str, versions: Mapping[str, str], at_ns: int) -> None:
        self._mcap.start(library="companion")
        self._mcap.add_attachment(
            at_ns, at_ns, SETTINGS, "application/toml", settings_toml.encode()
        )
        self._mcap.add_metadata(VERSIONS, dict(versions))
        self._frames = self._channel(schemas.FRAMES_TOPIC, schemas.FRAME)
        self._ticks = self._channel(schemas.TICKS_TOPIC, schemas.TICK)
        self._rejections = self._channel(schemas.REJECTIONS_TOPIC, schemas.REJECTION)
        self.flush()
        sync_folder(self._final.parent)

    @property
    def path(self) -> Path:
        """Where the file is now: ``….mcap.active`` until it is closed."""
        return self._final if self._finished else _beside(self._final)

    def event(self, event: Event) -> None:
        """Record what drives the pipeline: in the order of the calls, before its outputs."""
        self._last_event = event
        match event:
            case Frame():
                self._add(self._frames, event.t_ns, self._frame_bytes(event))
            case Tick():
                self._add(self._ticks, event.t_ns, schemas.encode_tick(event.t_ns))
            case Rejection():
                self._add_rejection(event, is_event=True)
            case RoundTrip():
                channel = self._channel(schemas.ROUND_TRIPS_TOPIC, schemas.ROUND_TRIP)
                self._add(channel, event.t_ns, messages.round_trip(event).SerializeToString())

    def output(self, output: Output, geodetic: Geodetic) -> None:
        """Record what came of an event. A rejection that is that very event is not written twice.

        A fix is logged at its arrival, its message bearing the time at which it was true.
        ``geodetic`` is only called with the positions of an update's tracks, when there are any.
        """
        match output:
            case Estimate(fix=fix):
                channel = self._channel(f"/uav/{fix.uav}/fix", schemas.LOCATION_FIX)
                self._add(channel, fix.arrival_ns, messages.fix(fix).SerializeToString())
            case Update():
                if self._is_due(output.t_ns):
                    self._add_tracks(output.t_ns, output.tracks, geodetic)
                    self._add_weights(output.beams)
            case Rejection():
                if output is not self._last_event:
                    self._add_rejection(output, is_event=False)
            case Notice():
                channel = self._channel(schemas.LOG_TOPIC, schemas.LOG)
                self._add(channel, output.t_ns, messages.log(output).SerializeToString())

    def flush(self) -> None:
        """Everything so far onto the disk; a killed process loses nothing of it."""
        self._mcap.flush()  # type: ignore[no-untyped-call]
        os.fsync(self._file.fileno())
        self.size_bytes = self._file.tell()

    def close(self, metadata: Mapping[str, str]) -> Path:
        """Finish the file and give it its name; ``metadata`` becomes the record ``summary``.

        Returns the file's path. Closing twice does nothing.
        """
        if self._finished:
            return self._final
        self._mcap.add_metadata(SUMMARY, dict(metadata))
        self._mcap.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())
        self.size_bytes = self._file.tell()
        self._file.close()
        active = _beside(self._final)
        if not self._replace:
            self._final = free_name(self._final)
        active.rename(self._final)
        self._finished = True
        sync_folder(self._final.parent)
        return self._final

    def abandon(self) -> None:
        """Let go of the file as it is, ``.active``: what has been flushed can be recovered."""
        self._file.close()

    def _is_due(self, t_ns: int) -> bool:
        """At most once a period; an update a little early is not made up for by a burst."""
        due_ns = self._due_ns
        if due_ns is None or not due_ns - self._period_ns <= t_ns < due_ns + self._period_ns:
            due_ns = t_ns
        if t_ns < due_ns:
            return False
        self._due_ns = due_ns + self._period_ns
        return True

    def _add_tracks(self, t_ns: int, tracks: tuple[Track, ...], geodetic: Geodetic) -> None:
        if not tracks:
            return
        channel = self._channel(schemas.TRACKS_TOPIC, schemas.TRACK)
        positions = geodetic(np.array([track.position_ned_m for track in tracks], dtype=float))
        for track, lat_deg, lon_deg, alt_m in zip(tracks, *positions, strict=True):
            where = messages.predicted(track, float(lat_deg), float(lon_deg), float(alt_m))
            place = self._channel(f"/uav/{track.uav}/predicted", schemas.LOCATION_FIX)
            self._add(place, t_ns, where.SerializeToString())
            self._add(channel, t_ns, messages.track(track, t_ns).SerializeToString())

    def _add_weights(self, beams: BeamSet) -> None:
        channel = self._channel(schemas.WEIGHTS_TOPIC, schemas.WEIGHTS)
        self._add(channel, beams.t_ns, messages.weights(beams).SerializeToString())

    def _add_rejection(self, rejection: Rejection, *, is_event: bool) -> None:
        message = messages.rejection(rejection, is_event=is_event)
        self._add(self._rejections, rejection.t_ns, message.SerializeToString())

    def _add(self, channel_id: int, t_ns: int, data: bytes) -> None:
        stamp_ns = max(0, t_ns)
        self._mcap.add_message(channel_id, stamp_ns, data, stamp_ns, self.messages & 0xFFFFFFFF)
        self.messages += 1

    def _channel(self, topic: str, schema: schemas.Schema) -> int:
        known = self._channel_ids.get(topic)
        if known is not None:
            return known
        schema_id = self._schema_ids.get(schema.name)
        if schema_id is None:
            schema_id = self._mcap.register_schema(schema.name, "protobuf", schema.descriptor_set)
            self._schema_ids[schema.name] = schema_id
        channel_id = self._mcap.register_channel(topic, "protobuf", schema_id)
        return self._channel_ids.setdefault(topic, channel_id)

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


def _open_alone(path: Path) -> BufferedWriter:
    """Open and empty a file that no other process is recording to; ``BlockingIOError`` if one is.

    The lock goes with the process, however that ends, so it also tells leftovers from live files.
    """
    file = path.open("ab")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        file.truncate(0)
        file.seek(0)
    except OSError:
        file.close()
        raise
    return file


def _reserve(folder: Path, started_ns: int) -> Path:
    """A name that no recording has, finished or open; its ``.active`` file is now there."""
    folder.mkdir(parents=True, exist_ok=True)
    started = datetime.fromtimestamp(started_ns // 1_000_000_000, tz=UTC)
    name, number = f"companion-{started:%Y%m%dT%H%M%SZ}", 0
    while True:
        path = folder / f"{name}{f'-{number}' if number else ''}.mcap"
        number += 1
        if path.exists():
            continue
        try:
            _beside(path).touch(exist_ok=False)
        except FileExistsError:
            continue
        return path


def sync_folder(folder: Path) -> None:
    """A new name is on the disk only when its folder is."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
