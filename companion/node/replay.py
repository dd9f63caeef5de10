"""Replay: logs through the same pipeline as the live service, as fast as possible."""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import companion
from companion.node.replay_summary import Tally, summary
from companion.pipeline import assembly
from companion.pipeline.fold import Pipeline
from companion.pipeline.ticks import with_ticks
from companion.recording import ends, parts
from companion.recording.folders import DIRECTORY_OPTION, make_recording_folder
from companion.recording.parts import RecordingInfo
from companion.recording.reader import (
    LogError,
    center_of,
    log_kind,
    read_flight,
    read_log,
    read_parts,
    read_settings,
    require_distinct,
    vehicles,
)
from companion.recording.scene import Scene
from companion.recording.truncated import truncated
from companion.recording.writer import Writer
from companion.settings.files import embedded, layered
from companion.settings.model import Settings
from companion.settings.origins import Origin, Origins, changed, of_options
from companion.values import Estimate, Event, Output, Refuted, Tick, Tock, Update

SLEEP_S: Final = 3600.0  # longest sleep at once: the system has a limit
FLUSH_EVERY_S: Final = 1.0  # time between two flushes of the recording
Progress = Callable[[int, float, float], None]
"""Shows the progress: frames, seconds of log, and wall-clock seconds since the start."""
TICKED: Final = "mcap"  # kind of log that contains the ticks of its run


def settings_for(logs: Sequence[Path], config: Path | None, center: str | None) -> Settings:
    """Return the settings of a replay: from a given file, else from a recording, else the defaults.

    ``center`` may name one of the logs: the vehicle that wrote it carries the array. Raises
    ``LogError`` or ``ConfigError`` for an unusable log or settings.
    """
    return layers_for(logs, config, center)[0]


def layers_for(
    logs: Sequence[Path], config: Path | None, center: str | None
) -> tuple[Settings, Origins]:
    """Return the settings as ``settings_for`` does, and the origin of each setting.

    A recording contains every setting. Values at their default, and sections that do not affect
    estimates or beams (``Settings.from_recording``), count as defaults.
    """
    options = {"center": {"source": center_of(logs, center)}}
    recorded = read_settings(logs[0]) if config is None else None
    if recorded:
        settings = Settings.from_recording(recorded.text, str(logs[0]), recorded.files)
        origins = changed(settings, Origin("recording", str(logs[0])))
        return settings.override(**options), {**origins, **of_options(options)}
    settings, origins = layered(config, options)
    several = vehicles(logs)
    if len(several) > 1:
        apart = {str(one.source): one.apart_s for one in several if one.apart_s}
        settings = settings.override(clocks={"apart_s": apart | settings.clocks.apart_s})
    return settings, origins


def writer_for(logs: Sequence[Path], settings: Settings, out: Path | None) -> Writer:
    """Return the writer of a replay's recording, at ``out`` or in the recordings' folder."""
    complete, kept = embedded(settings), settings.recording
    first_ns = next(read_flight(logs)).t_ns
    where = out or Path(kept.directory or "recordings")
    make_recording_folder(where, DIRECTORY_OPTION if out is None else "--out")
    weights_hz = None if kept.weights_hz == "all" else kept.weights_hz
    scene = Scene(assembly.array(settings), kept.scene_hz)
    versions = {"companion": companion.__version__}
    return Writer(
        where=where,
        settings_toml=complete.to_toml(),
        files=complete.files,
        versions=versions,
        weights_hz=weights_hz,
        started_ns=first_ns,
        scene=scene,
    )


class Run:
    """A replay in progress: the pipeline, its figures so far, and its recording."""

    def __init__(self, settings: Settings, writer: Writer | None) -> None:
        self.pipeline = Pipeline(settings)
        self.writer = writer
        self.tally = Tally()
        self._started_s = time.monotonic()

    @property
    def at_s(self) -> float:
        """Time within the log so far, seconds."""
        return (self.tally.last_ns - (self.tally.first_ns or 0)) * 1e-9

    @property
    def took_s(self) -> float:
        """Wall-clock time since the start, seconds."""
        return time.monotonic() - self._started_s

    def step(self, event: Event) -> list[Output]:
        """Process the next event; return its outputs.

        Raises ``OSError`` if it cannot be recorded.
        """
        outputs = self.pipeline.step(event)
        self.tally.event(event)
        if self.writer:
            self.writer.event(event)
        if not outputs:  # most frames
            return outputs
        for output in outputs:
            if isinstance(output, Estimate):
                self.tally.estimate(output)
            elif isinstance(output, Update):
                self.tally.update(output)
            elif isinstance(output, Refuted):
                self.tally.refuted[output.uav] += 1
            if self.writer:
                self.writer.output(output, self.pipeline.geodetic)
        return outputs

    def steps(
        self, events: Iterable[Event], progress: Progress | None = None
    ) -> Iterator[tuple[Event, list[Output]]]:
        """Process events; yield each with its outputs.

        Each ``FLUSH_EVERY_S`` the recording is flushed and ``progress`` called. Raises ``OSError``
        if an event cannot be recorded.
        """
        due_s = time.monotonic() + FLUSH_EVERY_S
        for event in events:
            yield event, self.step(event)
            if time.monotonic() >= due_s:
                due_s += FLUSH_EVERY_S
                if self.writer:
                    self.writer.flush()
                if progress:
                    progress(self.pipeline.frames, self.at_s, self.took_s)

    def finish(self) -> dict[str, Any]:
        """Close the recording and return the summary.

        Raises ``OSError`` if the recording cannot be written.
        """
        digests = self.pipeline.digest.both()
        recording = self.writer.close(digests) if self.writer else None
        return summary(self.pipeline, self.tally) | {
            "wall_s": self.took_s,
            "recording": str(recording) if recording else None,
            **digests,
        }


def replay(
    logs: Sequence[Path],
    settings: Settings,
    record: Callable[[], Writer] | None = None,
    *,
    speed: float | None = None,
    progress: Progress | None = None,
    latency_s: float = 0.0,
) -> dict[str, Any]:
    """Run logs through a pipeline and return the summary that ``companion replay --json`` prints.

        logs      merged by time; the parts of one run follow one another
        settings  settings of the pipeline
        record    creates the recording, once the logs are open; None: no recording
        speed     multiple of the log's own speed; None: as fast as possible
        progress  called once per second
        latency_s time from a sample to its arrival, for onboard logs, which contain no arrivals

    The summary includes ``log_notes``. Raises ``LogError`` for an unusable log, ``OSError`` if the
    recording cannot be written.
    """
    events = log_events(logs, settings, latency_s)
    run = Run(settings, record() if record else None)
    for _ in run.steps(events if speed is None else _paced(events, speed), progress):
        pass
    return run.finish() | log_notes(logs)


def length_s(logs: Sequence[Path]) -> float | None:
    """Return the total length of some logs, by their ends; None if unknown.

    Raises ``LogError`` for an unusable log.
    """
    span_ns = ends.span_ns(logs)
    if span_ns is not None:
        return (span_ns[1] - span_ns[0]) * 1e-9
    aboard = vehicles(logs)
    if not aboard or len(aboard) < len(logs):
        return None
    spans_us = [one.span_us for one in aboard]
    return (max(last for _, last in spans_us) - min(first for first, _ in spans_us)) * 1e-6


def log_notes(logs: Sequence[Path]) -> dict[str, Any]:
    """Return what a summary says of its logs: ``logs``, ``missing`` and ``truncated``.

    ``logs`` are the vehicles whose onboard logs were read, ``missing`` is what the parts of a
    recording lack, ``truncated`` the logs that end early. Raises ``LogError``.
    """
    return {
        "logs": [one.as_json() for one in vehicles(logs)],
        "missing": missing(logs),
        "truncated": [log.as_json() for log in truncated(logs)],
    }


def log_events(logs: Sequence[Path], settings: Settings, latency_s: float = 0.0) -> Iterator[Event]:
    """Return all events in order of time, with ticks; events of parts of one run as recorded.

    ``latency_s`` as for ``replay``. Raises ``LogError`` for an unusable log, or if a log or a part
    of a run is given twice.
    """
    require_distinct(logs)
    if len(logs) == 1 and log_kind(logs[0]) == TICKED:
        return read_log(logs[0])
    ordered = in_order(logs)
    if ordered is None:
        logs = _with_events(logs)
        ordered = in_order(logs)
    if ordered is not None:
        return read_parts(ordered)
    events = read_flight(logs, latency_s)
    if len(logs) > 1:  # one may be a recording, which has ticks
        events = (event for event in events if not isinstance(event, Tick | Tock))
    return with_ticks(events, settings.beams.update_hz)


def _with_events(logs: Sequence[Path]) -> Sequence[Path]:
    """Leave out recordings without an event, such as a part that a power loss cut as it began.

    All logs are returned if none of them has an event.
    """
    full = [log for log in logs if log_kind(log) != TICKED or any(True for _ in read_parts([log]))]
    return full or logs


def in_order(logs: Sequence[Path]) -> list[Path] | None:
    """Return the parts of one run in order; None if the logs are not parts of one run.

    Raises ``LogError`` if a log is unreadable or given twice.
    """
    return _in_order(_recording_infos(logs))


def missing(logs: Sequence[Path]) -> list[str]:
    """Return what recordings report as missing from them, one line each.

    A replay of such recordings cannot reproduce the live run's digest. Raises ``LogError`` as for a
    replay.
    """
    infos = _recording_infos(logs)
    try:
        return parts.missing(infos)
    except ValueError as error:
        raise LogError(str(error)) from None


def _recording_infos(logs: Sequence[Path]) -> dict[Path, RecordingInfo]:
    try:
        return {log: parts.read_recording_info(log) for log in logs}
    except (OSError, ValueError) as error:
        raise LogError(f"{logs[0]}: cannot be read: {error}") from None


def _in_order(infos: dict[Path, RecordingInfo]) -> list[Path] | None:
    try:
        return parts.in_order(infos)
    except ValueError as error:
        raise LogError(str(error)) from None


def _paced(events: Iterable[Event], speed: float) -> Iterator[Event]:
    """Delay each event until its time, at ``speed`` times the speed of the log."""
    first: tuple[int, float] | None = None
    for event in events:
        if first is None:
            first = (event.t_ns, time.monotonic())
        due_s = first[1] + (event.t_ns - first[0]) * 1e-9 / speed
        while (left_s := due_s - time.monotonic()) > 0.0:
            time.sleep(min(left_s, SLEEP_S))
        yield event
