"""Comparison of beam widths and predictors over links: gains, guarantees, rates, with truth.

Each UAV's own frames pass through a link, the log's own or one of ``studies.prediction``; the
carrier's frames stay as logged. At every tick beams are computed in each of the three widths for
the product's tracks. Sharp beams are also computed for the positions of other predictors: the last
report (``hold``), a Kalman filter of known noise (``kalman-peng``), and AntennaTracker's method
(``dead-reckoning-arrival``). Their gains are evaluated towards the true directions.
"""

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from companion.beams import hysteresis
from companion.beams.aim import directions
from companion.beams.array.steering import steering_matrix
from companion.beams.hysteresis import Hysteresis
from companion.beams.worth import link_budget
from companion.node.replay import log_events
from companion.pipeline import assembly
from companion.pipeline.fold import Pipeline
from companion.pipeline.ticks import with_ticks
from companion.recording.reader import read_flight
from companion.settings.model import Settings
from companion.studies.beams.worth import aimed, cell, given, mean, percentile, share
from companion.studies.figures.text_tables import text_table
from companion.studies.origin import Progress, Row, silent
from companion.studies.prediction.baselines import ObservedReport, Predictor
from companion.studies.prediction.delivery import deliver
from companion.studies.prediction.kalman import Kalman
from companion.studies.prediction.predictors import SIMPLE, known_tuning
from companion.studies.prediction.radio_link import RadioLink
from companion.studies.truth import array_truth, vehicles
from companion.studies.truth.array_truth import ArrayTruth
from companion.tracking.geodesy import LocalFrame
from companion.values import (
    BeamSet,
    Event,
    FloatArray,
    Frame,
    Tick,
    Tock,
    Track,
    Update,
    Widen,
    kind_of,
)

OTHER_PREDICTORS: Final = ("hold", "kalman-peng", "dead-reckoning-arrival")
"""Other predictors, whose sharp beams are compared with the product's."""
LOOK_EVERY: Final = 4  # ticks from one look to the next; beams are computed at each tick
ALIKE: Final = 0.9  # correlation of two shapes of one beam below which it has changed
JUMP_DB: Final = 1.0  # change of a predicted gain from tick to tick that is a jump


@dataclass(slots=True, kw_only=True)
class _Variant:
    """One compared case, a beam width or a predictor, with its results."""

    name: str
    widen: Widen
    state: Hysteresis | None = None
    last: dict[str, tuple[Any, float]] = field(default_factory=dict)
    true_db: list[float] = field(default_factory=list)
    predicted_db: list[float] = field(default_factory=list)
    sure_db: list[float] = field(default_factory=list)
    rates: list[float] = field(default_factory=list)
    correlations: list[float] = field(default_factory=list)
    jumps_db: list[float] = field(default_factory=list)
    violations: int = 0

    def row(self) -> Row:
        """Return the figures of a case; shares are of beams, and None without data."""
        return {
            "beams": self.name,
            "n": len(self.predicted_db),
            "true_gain_p5_db": percentile(self.true_db, 5),
            "true_gain_median_db": percentile(self.true_db, 50),
            "predicted_gain_median_db": percentile(self.predicted_db, 50),
            "guaranteed_above_0_db_share": share(sure > 0 for sure in self.sure_db),
            "guaranteed_gain_median_db": percentile(self.sure_db, 50),
            "violations": self.violations,
            "spectral_efficiency_mean": mean(self.rates),
            "changed_shape_share": share(one < ALIKE for one in self.correlations),
            "jump_share": share(jump_db > JUMP_DB for jump_db in self.jumps_db),
        }


# --- the events of a link -----------------------------------------------------------------------


def events(
    logs: Sequence[Path], link: RadioLink, settings: Settings, seed: int = 1
) -> tuple[Iterator[Event], dict[str, list[ObservedReport]], LocalFrame]:
    """Return a node's events over a link, with ticks; each UAV's reports; the local frame."""
    center = settings.center.source or "home"
    flown = vehicles.load(logs, center)
    streams = {
        flight.uav: deliver(flight, link, seed, lambda: assembly.clock(settings))
        for flight in flown.flights
    }
    observed = {uav: list(one.observed) for uav, one in streams.items()}
    local = LocalFrame(*flown.origin)
    if link.as_logged:
        return log_events(logs, settings), observed, local
    others = (
        event
        for event in read_flight(logs)
        if not isinstance(event, Tick | Tock)
        and not (isinstance(event, Frame) and str(event.source) in streams)
    )
    heard = heapq.merge(
        *(one.events for one in streams.values()), others, key=lambda event: event.t_ns
    )
    return with_ticks(heard, settings.beams.update_hz), observed, local


class _OtherPredictor:
    """Another predictor for all UAVs, in the pipeline's local frame."""

    def __init__(
        self, name: str, observed: dict[str, list[ObservedReport]], settings: Settings
    ) -> None:
        tuning = known_tuning(settings)
        self._make: Callable[[], Predictor] = SIMPLE.get(name, lambda: Kalman(2, tuning))
        self._waiting = {uav: list(reversed(reports)) for uav, reports in observed.items()}
        self._predictors = {uav: self._make() for uav in observed}

    def tracks(self, update: Update, local: LocalFrame, pipeline: Pipeline) -> tuple[Track, ...]:
        """Return the tracks of an update with this predictor's positions."""
        found = []
        for track in update.tracks:
            waiting, predictor = self._waiting.get(track.uav, []), self._predictors.get(track.uav)
            while waiting and waiting[-1].arrival_ns <= update.t_ns and predictor is not None:
                predictor.report(waiting.pop())
            made = predictor and predictor.predict(update.t_ns, track.valid_at_ns)
            if not made or pipeline.local is None:
                continue
            (lat_deg,), (lon_deg,), (alt_m,) = local.geodetic(made.position_ned_m[np.newaxis])
            there = pipeline.local.position_ned_m(lat_deg, lon_deg, alt_m)
            found.append(replace(track, position_ned_m=there))
        return tuple(found)


# --- the comparison -----------------------------------------------------------------------------


def compare(
    logs: Sequence[Path], settings: Settings, link: RadioLink, progress: Progress = silent
) -> list[Row]:
    """Return a row for each width and predictor, over one link."""
    pipeline = Pipeline(settings)
    heard, observed, local = events(logs, link, settings)
    ways = [_Variant(name=str(widen), widen=widen) for widen in Widen]
    rivals = {name: _OtherPredictor(name, observed, settings) for name in OTHER_PREDICTORS}
    theirs = {name: _Variant(name=f"{name}, sharp", widen=Widen.NO) for name in OTHER_PREDICTORS}
    truth: ArrayTruth | None = None
    flight, sought, ticks = vehicles.named(logs), False, 0
    for event in heard:
        outputs = pipeline.step(event)
        update = next((one for one in outputs if isinstance(one, Update)), None)
        if update is None or not update.tracks:
            continue
        if not sought and any(kind_of(track.uav).reports_itself for track in update.tracks):
            truth, sought = array_truth.load(logs, pipeline), True
        if update.carrier is None:
            continue
        ticks += 1
        looks = ticks % LOOK_EVERY == 0
        for way in ways:
            _make(pipeline, update, update.tracks, way=way, truth=truth, looks=looks)
        for name, rival in rivals.items():
            if looks:
                tracks = rival.tracks(update, local, pipeline)
                _make(pipeline, update, tracks, way=theirs[name], truth=truth, looks=looks)
        if looks and ticks % (25 * LOOK_EVERY) == 0:
            progress(f"{flight}, {link.name}: {ticks} ticks")
    head = {"log": flight, "link": link.name, "truth": None if truth is None else truth.kind}
    return [head | way.row() for way in (*ways, *theirs.values())]


def _make(
    pipeline: Pipeline,
    update: Update,
    tracks: tuple[Track, ...],
    *,
    way: _Variant,
    truth: ArrayTruth | None,
    looks: bool,
) -> None:
    """Compute the beams of one beam width or predictor, and record their performance."""
    assert update.carrier is not None
    made = aimed(pipeline, update, way.widen, tracks=tracks, before=way.state)
    way.state = hysteresis.updated(way.state, made)
    steering = steering_matrix(pipeline.array, directions(made))
    shapes = made.weights * steering
    seen = {
        beam.uav: (shapes[:, n] / np.linalg.norm(shapes[:, n]), beam.gain_db)
        for n, beam in enumerate(made.beams)
    }
    if set(seen) == set(way.last):
        for uav, (shape, gain_db) in seen.items():
            way.correlations.append(float(abs(np.vdot(way.last[uav][0], shape))))
            way.jumps_db.append(abs(way.last[uav][1] - gain_db))
    way.last = seen
    if looks and made.beams:
        true = array_truth.known_directions(truth, tracks, update.carrier, pipeline.array)
        _evaluate(pipeline, made, true, way)


def _evaluate(
    pipeline: Pipeline, made: BeamSet, true: dict[str, FloatArray], way: _Variant
) -> None:
    array, how = pipeline.array, pipeline.precoder
    sure, gains = given(pipeline, made, true)
    gains_db = 10 * np.log10(gains)
    way.sure_db += [-np.inf if one is None else one for one in sure]
    way.predicted_db += [beam.gain_db for beam in made.beams]
    there = directions(made)
    for n, uav in enumerate(made.uavs):
        there[n] = true.get(uav, there[n])
    sinr_db = link_budget.sinr_of_beams_db(array, made, there, how.budget, how.uav_antennas)
    rates = link_budget.spectral_efficiency(10 ** (sinr_db / 10), made.groups)
    for n in np.flatnonzero(~np.isnan(gains_db)).tolist():
        way.true_db.append(float(gains_db[n]))
        way.rates.append(float(rates[n]))
        one = sure[n]
        way.violations += int(one is not None and one > gains_db[n] + 1e-9)


COLUMNS: Final = (
    ("link", "link"), ("beams", "beams"), ("true 5 %", "true_gain_p5_db"),
    ("true 50 %", "true_gain_median_db"), ("predicted", "predicted_gain_median_db"),
    ("guar. > 0 dB", "guaranteed_above_0_db_share"), ("guar. 50 %", "guaranteed_gain_median_db"),
    ("violated", "violations"), ("bit/s/Hz", "spectral_efficiency_mean"),
    ("changed", "changed_shape_share"), ("jumps", "jump_share"),
)  # fmt: skip
"""Headings and keys of the table of beam widths and predictors."""


def cells(row: Row) -> list[str]:
    """Format a row of the table of beam widths and predictors."""
    return [cell(key, row[key]) for _, key in COLUMNS]


def text(rows: Sequence[Row]) -> str:
    """Return the table of beam widths and predictors as text."""
    return text_table([[words for words, _ in COLUMNS], *map(cells, rows)])
