"""One flight with one receiver: what each method knows of the directions of UAVs."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from companion.beams.aim import SeenDirection, directions
from companion.beams.array import steering
from companion.beams.array.geometry import Array
from companion.node.replay import log_events
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.studies.beams.worth import aimed, degrees, given, percentile
from companion.studies.compass.kalman import POSITION_SHARE, ErrorFilter
from companion.studies.compass.receiver import ArrayReceiver, observations
from companion.studies.origin import Row
from companion.studies.prediction.delivery import known_round_trips
from companion.studies.truth import array_truth, vehicles
from companion.studies.truth.array_truth import ArrayTruth
from companion.tracking.rotations import rotation
from companion.values import (
    BeamSet,
    Cap,
    Carrier,
    Event,
    FloatArray,
    Observation,
    RoundTrip,
    Tick,
    Track,
    Update,
    UserError,
    Widen,
    angle_rad,
)

NONE: Final = "none"
ARRAY: Final = "array"
KALMAN: Final = "kalman"
ORACLE: Final = "oracle"
METHODS: Final = (NONE, ARRAY, KALMAN, ORACLE)
"""Reported attitude alone; the product; the rival filter; the true attitude."""
WARM_UP_S: Final = 40.0  # part of the log before the first measurement that is replayed
LOOK_HZ: Final = 5.0  # looks a second, at random times
UPDATE_NS: Final = 100_000_000  # period of ticks


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One flight, one receiver, one error of the mount, and the UAVs that are measured.

    mount_deg  angle of the mount's error, about a random axis
    uavs       number of UAVs that are measured; None: all
    settle_s   time from the first measurement to the first look
    """

    logs: tuple[Path, ...]
    settings: Settings
    receiver: ArrayReceiver
    mount_deg: float
    uavs: int | None = None
    seconds: float = 60.0
    settle_s: float = 10.0
    seed: int = 0


@dataclass(slots=True, kw_only=True)
class _Score:
    """What one method answered at the looks."""

    bounds_rad: list[float] = field(default_factory=list)
    errors_rad: list[float] = field(default_factory=list)
    guaranteed_db: list[float] = field(default_factory=list)
    true_db: list[float] = field(default_factory=list)
    missed: int = 0  # true directions outside the stated set

    def row(self) -> Row:
        """Return the figures for a table."""
        return {
            "n": len(self.errors_rad),
            "pointing_bound_median_deg": degrees(percentile(self.bounds_rad, 50)),
            "pointing_error_p95_deg": degrees(percentile(self.errors_rad, 95)),
            "pointing_error_max_deg": degrees(max(self.errors_rad, default=None)),
            "beyond": self.missed,
            "beyond_share": self.missed / len(self.errors_rad) if self.errors_rad else None,
            "guaranteed_gain_median_db": percentile(self.guaranteed_db, 50),
            "true_gain_median_db": percentile(self.true_db, 50),
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Flown:
    """Events of a flight, its truth, the array as it is mounted, and the measured span."""

    events: list[Event]
    truth: ArrayTruth
    span_ns: tuple[int, int]

    def truly(self, update: Update, array: Array) -> dict[str, FloatArray]:
        """Return the true directions of the UAVs of an update, by UAV, array frame."""
        at_ns = update.beams.valid_at_ns
        found = {one.uav: self.truth.direction(one.uav, at_ns, array) for one in update.tracks}
        return {uav: towards for uav, towards in found.items() if towards is not None}


def run(case: Case) -> list[Row]:
    """Return a row for each method. Raises ``UserError`` for a flight without truth."""
    rng = np.random.default_rng(case.seed)
    flown = _flight(case)
    with_array, without = Pipeline(case.settings), Pipeline(case.settings)
    axis = rng.standard_normal(3)
    mount = rotation(axis / np.linalg.norm(axis) * math.radians(case.mount_deg))
    array = replace(without.array, array_from_body=mount @ without.array.array_from_body)
    uavs = sorted(flown.truth.flights)[: case.uavs]
    measured = [
        one
        for uav in uavs
        for one in observations(
            case.receiver,
            uav,
            flown.span_ns,
            lambda uav, at_ns: flown.truth.direction(uav, at_ns, array),
            rng,
        )
    ]
    rival = ErrorFilter(
        without.center.attitude_bound_rad, math.radians(case.settings.observations.drift_max_degps)
    )
    scores = {method: _Score() for method in METHODS}
    attitude_rad: list[float] = []
    looks = _looks(case, flown.span_ns, rng)
    for event in sorted([*flown.events, *measured], key=lambda one: one.t_ns):
        while looks and looks[-1] < event.t_ns:
            now_ns = looks.pop()
            found, plain = with_array.look(now_ns), without.look(now_ns)
            if found.carrier is None or plain.carrier is None:
                continue
            attitude_rad.append(found.carrier.attitude_bound_rad)
            truly = flown.truly(found, array)
            _add(scores[NONE], without, plain.beams, truly)
            _add(scores[ARRAY], with_array, found.beams, truly)
            _add_rival(scores[KALMAN], without, plain, truly, rival)
            _add(scores[ORACLE], without, _aimed(without, plain, truly), truly)
        if isinstance(event, Observation):
            _filter(rival, without, event, case.receiver)
        else:
            without.step(event)
        with_array.step(event)
    head = {
        "log": vehicles.named(case.logs),
        "receiver": case.receiver.name,
        "mount_deg": case.mount_deg,
        "uavs": len(uavs),
    }
    rows = [{**head, "method": name, **score.row()} for name, score in scores.items()]
    for row in rows:
        if row["method"] in (KALMAN, ORACLE):  # they state no bound
            row["pointing_bound_median_deg"] = row["guaranteed_gain_median_db"] = None
    of_array = rows[METHODS.index(ARRAY)]
    of_array["attitude_bound_median_deg"] = degrees(percentile(attitude_rad, 50))
    of_array["refuted"] = with_array.observing.compass.refuted
    return rows


def _looks(case: Case, span_ns: tuple[int, int], rng: np.random.Generator) -> list[int]:
    """Return the times of looks, the last first."""
    first_ns = span_ns[0] + round(case.settle_s * 1e9)
    count = max(round((span_ns[1] - first_ns) * 1e-9 * LOOK_HZ), 0)
    times: list[int] = rng.uniform(first_ns, span_ns[1], count).astype(np.int64).tolist()
    return sorted(times, reverse=True)


def _flight(case: Case) -> _Flown:
    """Return a flight; without round trips in its logs, with those that would have been measured.

    Raises ``UserError`` without the truth of the carrier and of a UAV, and for a short flight.
    """
    events: list[Event] = []
    pipeline = Pipeline(case.settings)
    for event in log_events(case.logs, case.settings):
        events.append(event)
        if pipeline.local is None:
            pipeline.step(event)
    truth = None if pipeline.local is None else array_truth.load(case.logs, pipeline)
    if truth is None or truth.carrier is None:
        raise UserError(
            f"{vehicles.named(case.logs)}: no SIM_STATE of the array's carrier, a vehicle, and of"
            " another one; give such a log, and --center SYSID:COMPID"
        )
    flights = [*truth.flights.values(), truth.carrier.flight]
    begins = []
    for flight in flights:
        (flies,) = np.nonzero(flight.flying(flight.arrival_ns))
        if len(flies):
            begins.append(int(flight.arrival_ns[flies[0]]))
    begins_ns = max(begins, default=events[0].t_ns) + round(WARM_UP_S * 1e9)
    ends_ns = min(begins_ns + round(case.seconds * 1e9), events[-1].t_ns)
    if ends_ns - begins_ns <= case.settle_s * 1e9:
        least_s = WARM_UP_S + case.settle_s
        raise UserError(
            f"{vehicles.named(case.logs)}: less than {least_s:.0f} s with all vehicles in the air;"
            " give a longer flight"
        )
    trips: list[RoundTrip] = []
    if not any(isinstance(event, RoundTrip) for event in events):
        for flight in flights:
            trips += known_round_trips(flight)
    kept = [event for event in (*events, *trips) if event.t_ns < ends_ns]
    ticks = range(events[0].t_ns, ends_ns, UPDATE_NS)
    if not any(isinstance(event, Tick) for event in events):
        kept += [Tick(t_ns) for t_ns in ticks]
    return _Flown(events=kept, truth=truth, span_ns=(begins_ns, ends_ns))


def _add(score: _Score, pipeline: Pipeline, beams: BeamSet, truly: dict[str, FloatArray]) -> None:
    if not beams.beams:
        return
    guaranteed, true_gains = given(pipeline, beams, truly)
    for i, (beam, towards) in enumerate(zip(beams.beams, directions(beams), strict=True)):
        if beam.uav not in truly:
            continue
        bound_rad = math.inf if beam.pointing_bound_rad is None else beam.pointing_bound_rad
        off_rad = angle_rad(towards, truly[beam.uav])
        score.bounds_rad.append(bound_rad)
        score.errors_rad.append(off_rad)
        score.missed += off_rad > bound_rad
        sure = guaranteed[i]
        score.guaranteed_db.append(-math.inf if sure is None else sure)
        score.true_db.append(10.0 * math.log10(float(true_gains[i])))


def _add_rival(
    score: _Score,
    pipeline: Pipeline,
    plain: Update,
    truly: dict[str, FloatArray],
    rival: ErrorFilter,
) -> None:
    """Add a look of the filter; ``missed`` counts true directions outside its ellipse."""
    assert plain.carrier is not None
    array_from_local = pipeline.array.array_from_body @ plain.carrier.body_from_local
    expected = {}
    before = score.missed
    for track in plain.tracks:
        if track.uav not in truly:
            continue
        reported, position_rad = _reported(track, plain.carrier)
        expected[track.uav] = array_from_local @ rival.direction(reported)
        there = array_from_local.T @ truly[track.uav]
        before += not rival.contains(reported, there, position_rad * POSITION_SHARE)
    _add(score, pipeline, _aimed(pipeline, plain, expected), truly)
    score.missed = before


def _reported(track: Track, carrier: Carrier) -> tuple[FloatArray, float]:
    """Return a UAV's reported direction, local frame, and the bound that positions give it."""
    offset_m = track.position_ned_m - carrier.position_ned_m
    range_m = math.sqrt(offset_m @ offset_m)
    return offset_m / range_m, (track.bound_m + carrier.bound_m) / range_m


def _filter(
    rival: ErrorFilter, pipeline: Pipeline, event: Observation, receiver: ArrayReceiver
) -> None:
    """Pass a measurement to the filter, with what is reported at its time."""
    tracks = pipeline.tracks(event.t_ns, event.measured_ns, [event.uav])
    carrier = pipeline.carrier(event.t_ns, event.measured_ns)
    if not tracks or isinstance(carrier, str):
        return
    assert event.azimuth_rad is not None and event.elevation_rad is not None
    (seen,) = steering.unit_directions(
        np.array([event.azimuth_rad]), np.array([event.elevation_rad])
    )
    reported, position_rad = _reported(tracks[0], carrier)
    deviation = math.hypot(math.radians(receiver.bound_deg) / 2.0, position_rad * POSITION_SHARE)
    local_from_array = (pipeline.array.array_from_body @ carrier.body_from_local).T
    rival.add(event.measured_ns, reported, local_from_array @ seen, deviation)


def _aimed(pipeline: Pipeline, update: Update, towards: dict[str, FloatArray]) -> BeamSet:
    """Return sharp beams of an update aimed at given directions."""
    seen = {uav: SeenDirection(Cap(found, 1e-6), is_alone=True) for uav, found in towards.items()}
    return aimed(pipeline, update, Widen.NO, seen_directions=seen)
