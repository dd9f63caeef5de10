"""Scenarios of the link study: true and assumed directions of its UAVs at many instants.

``perfect`` is the truth at the time of use, ``predicted`` the product's prediction from received
reports, ``held`` the last report. A scenario is the paper's circles, or a log with SIM_STATE.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Final

import numpy as np

from companion.beams import line_of_sight
from companion.beams.array.geometry import Array
from companion.beams.array.steering import steering_matrix
from companion.beams.weights.precoding import precode
from companion.pipeline import assembly
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.studies.beams.flight import updates
from companion.studies.link.track_predictor import TrackPredictor
from companion.studies.origin import Progress
from companion.studies.prediction.baselines import Hold, ObservedReport, Predictor
from companion.studies.truth import array_truth
from companion.studies.truth.vehicles import named
from companion.values import FloatArray, Method, Update, UserError, kind_of

RADII_M: Final = (100.0, 150.0, 200.0, 250.0)
RATE_RADPS: Final = 0.5
GUST: Final = 0.2  # gust over nominal speed; gusts turn ten times as fast
GUST_RATIO: Final = 10.0
REPORTED_M: Final = 0.01
"""Resolution of positions (m) and velocities (m/s) in GLOBAL_POSITION_INT."""
WARM_UP_S: Final = 5.0
DURATION_S: Final = 60.0
LOOKS_HZ: Final = 10.0
MAX_DRAWS: Final = 100  # largest number of draws per instant


class PositionSource(StrEnum):
    """Source of the positions at which beams point: truth, prediction or last report."""

    PERFECT = "perfect"
    PREDICTED = "predicted"
    HELD = "held"


@dataclass(frozen=True, slots=True, eq=False)
class Instant:
    """Directions at one instant: unit vectors (N, 3) by kind of positions, array frame."""

    t_s: float
    towards: dict[PositionSource, FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """Instants of the link study, with the array.

    ``unresolved_share`` is the share of excluded instants: even for the true directions, zero
    forcing within the limits of the settings cannot separate all UAVs.
    """

    description: str
    array: Array
    instants: tuple[Instant, ...]
    unresolved_share: float


@dataclass(frozen=True, slots=True)
class Reports:
    """Interval and latency of the reports of circling UAVs, seconds.

    Raises ``UserError`` for values out of range.
    """

    interval_s: float = 0.15
    latency_s: float = 0.05

    def __post_init__(self) -> None:
        if not 0.01 <= self.interval_s <= 2:
            raise UserError(f"--interval {self.interval_s:g}: give seconds from 0.01 to 2")
        if not 0 <= self.latency_s <= 2:
            raise UserError(f"--latency {self.latency_s:g}: give seconds from 0 to 2")


# --- the paper's circles ------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Circle:
    """Circle around the array, flown clockwise with gusts: the paper's flight, continuous in time.

    Velocity R w [cos, -sin](w t + phase), plus a fifth of that at ten times the rate (docs/math.md
    8.2).
    """

    radius_m: float
    phase_rad: float

    def at(self, t_s: float) -> tuple[FloatArray, FloatArray]:
        """Return position and velocity (3,), local frame; position is the integral of velocity."""
        turn = RATE_RADPS * t_s + self.phase_rad
        gust = GUST_RATIO * RATE_RADPS * t_s + self.phase_rad
        reach = GUST / GUST_RATIO
        north = math.sin(turn) + reach * math.sin(gust)
        east = math.cos(turn) + reach * math.cos(gust)
        north_rate = math.cos(turn) + GUST * math.cos(gust)
        east_rate = -math.sin(turn) - GUST * math.sin(gust)
        speed_mps = self.radius_m * RATE_RADPS
        return (
            self.radius_m * np.array([north, east, 0.0]),
            speed_mps * np.array([north_rate, east_rate, 0.0]),
        )


PAPER: Final = tuple(Circle(radius_m, i * math.pi / 2) for i, radius_m in enumerate(RADII_M))


def circles(
    settings: Settings, reports: Reports, instants: int, rng: np.random.Generator
) -> Scenario:
    """Return the scenario of the paper's four UAVs at ``instants`` random times of a minute.

    The array is level and faces north. Times at which it cannot separate the UAVs are drawn again.
    The observer has the true bounds of the circles.
    """
    array = assembly.array(settings)
    times_s, tried = _resolved_times(settings, array, instants, rng)
    bounded = _bounded(settings)
    towards: dict[PositionSource, list[FloatArray]] = {kind: [] for kind in PositionSource}
    for number, circle in enumerate(PAPER):
        starts_s = number / len(PAPER) * reports.interval_s  # staggered
        answers = _positions_by_source(circle, starts_s, times_s, reports, bounded)
        for kind, positions in answers.items():
            towards[kind].append(positions @ array.array_from_body.T)
    seen = {kind: _unit(np.stack(found, axis=1)) for kind, found in towards.items()}
    found = tuple(
        Instant(float(t_s), {kind: seen[kind][i] for kind in PositionSource})
        for i, t_s in enumerate(times_s)
    )
    description = (
        f"four UAVs on circles of {', '.join(f'{r:g}' for r in RADII_M)} m,"
        f" {RATE_RADPS:g} rad/s, a report every {reports.interval_s:g} s with a latency of"
        f" {reports.latency_s:g} s, beams for {settings.beams.actuation_delay_s:g} s ahead"
    )
    return Scenario(
        description=description, array=array, instants=found, unresolved_share=1 - instants / tried
    )


def _resolved_times(
    settings: Settings, array: Array, instants: int, rng: np.random.Generator
) -> tuple[FloatArray, int]:
    """Return times of use at which the array separates the UAVs, and how many were drawn."""
    times_s = list[float]()
    for tried in range(1, MAX_DRAWS * instants + 1):
        t_s = WARM_UP_S + DURATION_S * float(rng.random())
        offsets = np.array([circle.at(t_s)[0] for circle in PAPER])
        if _resolved(settings, array, _unit(offsets @ array.array_from_body.T)):
            times_s.append(t_s)
        if len(times_s) == instants:
            return np.sort(np.array(times_s)), tried
    raise UserError("the array can rarely separate the circling UAVs; give more elements")


def _resolved(settings: Settings, array: Array, truly: FloatArray) -> bool:
    """Return whether zero forcing for true directions (N, 3) is within the settings' limits."""
    asked = replace(assembly.precoder(settings), method=Method.ZERO_FORCING)
    made = precode(steering_matrix(array, truly), asked)
    return made.method is Method.ZERO_FORCING and not made.groups.any() and not made.dropped


def _bounded(settings: Settings) -> Settings:
    speed = max(RADII_M) * RATE_RADPS
    bounds = {
        "speed_max_mps": speed * (1 + GUST),
        "acceleration_max_mps2": speed * RATE_RADPS * (1 + GUST * GUST_RATIO),
        "position_noise_m": REPORTED_M,
        "velocity_noise_mps": REPORTED_M,
    }
    return settings.override(observer=bounds)


def _positions_by_source(
    circle: Circle, starts_s: float, times_s: FloatArray, reports: Reports, settings: Settings
) -> dict[PositionSource, FloatArray]:
    """Return positions (K, 3) of one UAV at the times of use (K,), by position source."""
    predictors: dict[PositionSource, Predictor] = {
        PositionSource.PREDICTED: TrackPredictor(settings),
        PositionSource.HELD: Hold(),
    }
    found: dict[PositionSource, list[FloatArray]] = {kind: [] for kind in PositionSource}
    sent = 0
    for t_s in times_s.tolist():
        now_s = t_s - settings.beams.actuation_delay_s
        while (made_s := starts_s + sent * reports.interval_s) + reports.latency_s <= now_s:
            for predictor in predictors.values():
                predictor.report(_report(circle, made_s, reports.latency_s))
            sent += 1
        found[PositionSource.PERFECT].append(circle.at(t_s)[0])
        for kind, predictor in predictors.items():
            predicted = predictor.predict(round(now_s * 1e9), round(t_s * 1e9))
            if predicted is None:
                raise UserError(f"no {kind} position {t_s:.1f} s into the flight")
            found[kind].append(predicted.position_ned_m)
    return {kind: np.array(positions) for kind, positions in found.items()}


def _report(circle: Circle, made_s: float, latency_s: float) -> ObservedReport:
    """Return a report as a predictor receives it; the sender's clock is known."""
    position_m, velocity_mps = (
        np.round(one / REPORTED_M) * REPORTED_M for one in circle.at(made_s)
    )
    made_ns = round(made_s * 1e9)
    return ObservedReport(
        arrival_ns=made_ns + round(latency_s * 1e9),
        sent_ns=made_ns,
        sender_ns=made_ns,
        position_ned_m=position_m,
        velocity_ned_mps=velocity_mps,
    )


def _unit(vectors: FloatArray) -> FloatArray:
    scaled: FloatArray = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return scaled


# --- a log --------------------------------------------------------------------------------------


def from_logs(
    logs: Sequence[Path],
    settings: Settings,
    instants: int,
    rng: np.random.Generator,
    progress: Progress,
) -> Scenario:
    """Draw instants of a flight, from ``LOOKS_HZ`` samples per second of the pipeline.

    Raises ``UserError``, ``LogError`` or ``ConfigError`` for logs without the simulator's truth.
    """
    pipeline, truth, looks = Pipeline(settings), None, list[Instant]()
    name = named(logs)
    for t_s, update in updates(logs, pipeline, LOOKS_HZ):
        if truth is None and any(kind_of(track.uav).reports_itself for track in update.tracks):
            truth = array_truth.load(logs, pipeline)
            if truth is None:
                raise UserError(f"{name}: no simulator truth; give a log with SIM_STATE")
        if truth is not None and (seen := _seen(t_s, update, pipeline, truth)) is not None:
            looks.append(seen)
        progress(f"{name}: {t_s:.0f} s of log")
    array = pipeline.array
    resolved = [
        one for one in looks if _resolved(settings, array, one.towards[PositionSource.PERFECT])
    ]
    if not resolved:
        raise UserError(f"{name}: never serves a UAV whose true position is known; check --center")
    chosen = np.sort(rng.choice(len(resolved), min(instants, len(resolved)), replace=False))
    return Scenario(
        description=f"{name}: array on {pipeline.center.place}",
        array=array,
        instants=tuple(resolved[i] for i in chosen),
        unresolved_share=1 - len(resolved) / len(looks),
    )


def _seen(
    t_s: float, update: Update, pipeline: Pipeline, truth: array_truth.ArrayTruth
) -> Instant | None:
    """Return the directions of UAVs that have a beam and a known truth; None without any."""
    carrier = update.carrier
    if carrier is None or not update.beams.beams:
        return None
    served = set(update.beams.uavs)
    tracks = [track for track in update.tracks if track.uav in served]
    truly = truth.directions(tracks, carrier, pipeline.array)
    known = np.flatnonzero(np.isfinite(truly).all(axis=1))
    tracks = [tracks[i] for i in known]
    held = []
    for track in tracks:
        fix = pipeline.tracker.newest(track.uav)
        if fix is None:
            return None
        held.append(replace(track, position_ned_m=np.array(fix.position_ned_m)))
    if not tracks:
        return None
    return Instant(
        t_s,
        {
            PositionSource.PERFECT: truly[known],
            PositionSource.PREDICTED: line_of_sight.directions(tracks, carrier, pipeline.array)[1],
            PositionSource.HELD: line_of_sight.directions(held, carrier, pipeline.array)[1],
        },
    )
