"""Replay: logs through the same fold as the live service, as fast as it goes.            [shell]"""

import heapq
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

import companion
from companion.pipeline.fold import Pipeline
from companion.pipeline.ticks import with_ticks
from companion.recording import parts
from companion.recording.parts import Story
from companion.recording.reader import LogError, log_kind, read_log, read_parts, read_settings
from companion.recording.writer import Writer
from companion.settings.files import load
from companion.settings.model import Settings
from companion.values import Estimate, Event, Output, Refuted, Tick, Update

FLUSH_EVERY_S: Final = 1.0
"""Time between two flushes of the recording."""
TICKED: Final = "mcap"
"""Kind of log that holds the ticks of the run from which it was recorded."""


@dataclass(slots=True)
class Tally:
    """Figures of a replay, gathered as it goes."""

    reports: Counter[str] = field(default_factory=Counter)
    dt_s: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    latency_s: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    innovation_m: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    reacquired: Counter[str] = field(default_factory=Counter)
    refuted: Counter[str] = field(default_factory=Counter)
    updates: int = 0
    regularised: int = 0
    condition_number_max: float | None = None
    first_ns: int | None = None
    last_ns: int = 0

    def event(self, event: Event) -> None:
        """Note the time span of the events."""
        if self.first_ns is None:
            self.first_ns = event.t_ns
        self.last_ns = max(self.last_ns, event.t_ns)  # a frame may be taken in after a later tick

    def estimate(self, estimate: Estimate) -> None:
        """Take in an accepted report."""
        fix = estimate.fix
        self.reports[fix.uav] += 1
        self.reacquired[fix.uav] += estimate.reacquired
        self.latency_s[fix.uav].append((fix.arrival_ns - fix.t_ns) * 1e-9)
        if estimate.dt_s is not None and estimate.innovation_m is not None:
            self.dt_s[fix.uav].append(estimate.dt_s)
            self.innovation_m[fix.uav].append(estimate.innovation_m)

    def update(self, update: Update) -> None:
        """Take in a beam update; those without beams do not count."""
        condition = update.beams.condition_number
        if condition is None:
            return
        self.updates += 1
        self.regularised += update.beams.regularised
        self.condition_number_max = max(condition, self.condition_number_max or 0.0)


def settings_for(logs: Sequence[Path], config: Path | None, center: str | None) -> Settings:
    """The settings of a replay: a given file, else those in a recording, else the defaults.

    Raises ``LogError`` or ``ConfigError`` where a log or the settings cannot be used.
    """
    recorded = read_settings(logs[0]) if config is None else None
    settings = Settings.from_toml(recorded, str(logs[0])) if recorded else load(config)
    return settings.override(center={"source": center})


def writer_for(logs: Sequence[Path], settings: Settings, out: Path | None) -> Writer:
    """A recording of the replay: at ``out``, else in the settings' directory or ``recordings/``."""
    kept = settings.recording
    first_ns = next(read_log(logs[0])).t_ns
    where = out or Path(kept.directory or "recordings")
    weights_hz = None if kept.weights_hz == "all" else kept.weights_hz
    return Writer(
        where, settings.to_toml(), {"companion": companion.__version__}, weights_hz, first_ns
    )


class Run:
    """A replay under way: the pipeline, its figures so far, and its recording."""

    def __init__(self, settings: Settings, writer: Writer | None) -> None:
        self.pipeline = Pipeline(settings)
        self.writer = writer
        self.tally = Tally()
        self._started_s = time.monotonic()

    @property
    def at_s(self) -> float:
        """Seconds of log so far."""
        return (self.tally.last_ns - (self.tally.first_ns or 0)) * 1e-9

    def step(self, event: Event) -> list[Output]:
        """Take in the next event; returns its outputs.

        Raises ``OSError`` where it cannot be recorded.
        """
        outputs = self.pipeline.step(event)
        self.tally.event(event)
        if self.writer:
            self.writer.event(event)
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

    def finish(self) -> dict[str, Any]:
        """Close the recording and sum up.

        Raises ``OSError`` where the recording cannot be written.
        """
        digest = self.pipeline.digest.hexdigest()
        recording = self.writer.close({"digest": digest}) if self.writer else None
        return _summary(self.pipeline, self.tally) | {
            "wall_s": time.monotonic() - self._started_s,
            "recording": str(recording) if recording else None,
            "digest": digest,
        }


def replay(
    logs: Sequence[Path],
    settings: Settings,
    writer: Writer | None = None,
    speed: float | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> dict[str, Any]:
    """Run logs through a pipeline and sum up, as ``companion replay --json`` prints it.

        logs      merged by time; the parts of one run follow one another
        settings  those of the pipeline
        writer    gets everything and is closed
        speed     multiple of the log's own speed; None: as fast as it goes
        progress  called now and then with frames and seconds of log

    ``missing`` in the summary is what the parts lack. Raises ``LogError`` for a log that cannot be
    used, ``OSError`` where the recording cannot be written.
    """
    run = Run(settings, writer)
    flush_due_s = time.monotonic() + FLUSH_EVERY_S
    events = log_events(logs, settings)
    for event in events if speed is None else _paced(events, speed):
        run.step(event)
        if time.monotonic() >= flush_due_s:
            flush_due_s += FLUSH_EVERY_S
            if writer:
                writer.flush()
            if progress:
                progress(run.pipeline.frames, run.at_s)
    return run.finish() | {"missing": missing(logs)}


def log_events(logs: Sequence[Path], settings: Settings) -> Iterator[Event]:
    """All events in order of time, with ticks; those of several parts of one run as they were.

    Raises ``LogError`` where a log cannot be used, or one part of a run is given twice.
    """
    if len(logs) == 1 and log_kind(logs[0]) == TICKED:
        return read_log(logs[0])
    ordered = _in_order(_stories(logs))
    if ordered is not None:
        return read_parts(ordered)
    without_ticks = [_without_ticks(log) for log in logs]
    merged = (
        heapq.merge(*without_ticks, key=lambda event: event.t_ns)
        if len(logs) > 1
        else without_ticks[0]
    )
    return with_ticks(merged, settings.beams.update_hz)


def missing(logs: Sequence[Path]) -> list[str]:
    """What recordings say of events that they do not hold, one line each.

    A replay of such recordings cannot come to the live run's digest. Raises ``LogError`` as for a
    replay.
    """
    stories = _stories(logs)
    return parts.missing(stories, _in_order(stories) or logs)


def _stories(logs: Sequence[Path]) -> dict[Path, Story]:
    try:
        return {log: parts.read_story(log) for log in logs}
    except (OSError, ValueError) as error:
        raise LogError(f"{logs[0]}: cannot be read: {error}") from None


def _in_order(stories: dict[Path, Story]) -> list[Path] | None:
    try:
        return parts.in_order(stories)
    except ValueError as error:
        raise LogError(str(error)) from None


def _without_ticks(log: Path) -> Iterator[Event]:
    events = read_log(log)
    if log_kind(log) != TICKED:
        return events
    return (event for event in events if not isinstance(event, Tick))


def _paced(events: Iterable[Event], speed: float) -> Iterator[Event]:
    """Hold each event back until its time, at ``speed`` times the time of the log."""
    first: tuple[int, float] | None = None
    for event in events:
        if first is None:
            first = (event.t_ns, time.monotonic())
        due_s = first[1] + (event.t_ns - first[0]) * 1e-9 / speed
        time.sleep(max(0.0, due_s - time.monotonic()))
        yield event


def _summary(pipeline: Pipeline, tally: Tally) -> dict[str, Any]:
    now_ns = tally.last_ns
    tracks = {track.uav: track for track in pipeline.tracks(now_ns, now_ns)}
    carrier = str(pipeline.center.place)
    heard = [uav for uav in dict.fromkeys([*tally.reports, *tracks]) if uav != carrier]
    return {
        "frames": pipeline.frames,
        "rejected": {
            str(reason): count for reason, count in sorted(pipeline.refusals.total.items())
        },
        "reports": {uav: tally.reports[uav] for uav in heard},
        "uavs": {
            uav: {
                "reports": tally.reports[uav],
                "dt_median_s": _percentile(tally.dt_s[uav], 50),
                "dt_max_s": _percentile(tally.dt_s[uav], 100),
                "latency_p50_s": _percentile(tally.latency_s[uav], 50),
                "latency_p95_s": _percentile(tally.latency_s[uav], 95),
                "innovation_rms_m": _rms(tally.innovation_m[uav]),
                "gamma": tracks[uav].gamma if uav in tracks else None,
                "state": str(tracks[uav].state) if uav in tracks else "dropped",
                "restarts": pipeline.restarts[uav],
                "reacquired": tally.reacquired[uav],
                "refuted": tally.refuted[uav],
                "rejected": {
                    str(reason): count
                    for reason, count in sorted(pipeline.refusals.of(uav).counts.items())
                },
            }
            for uav in heard
        },
        "center": str(pipeline.center.place),
        "beams": {
            "updates": tally.updates,
            "condition_number_max": tally.condition_number_max,
            "regularised": tally.regularised,
        },
        "duration_s": (now_ns - (tally.first_ns or now_ns)) * 1e-9,
    }


def _percentile(values: list[float], percent: float) -> float | None:
    return float(np.percentile(values, percent)) if values else None


def _rms(values: list[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None
