"""Computation of beams from tracks: which UAVs get a beam, its direction, and all weights.

Over 300 lines: the way from tracks to weights, in one direction.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from companion.beams import hysteresis, line_of_sight
from companion.beams.array import steering
from companion.beams.array.coverage import EVERYWHERE, Coverage, refusals
from companion.beams.array.elements import ElementPattern
from companion.beams.array.geometry import Array
from companion.beams.hysteresis import Hysteresis
from companion.beams.weights import shapes, widening
from companion.beams.weights.precoding import (
    Precoder,
    Precoding,
    Radio,
    gain_db,
    normalise,
    precode,
)
from companion.beams.weights.widening import DirectionErrors
from companion.beams.worth import link_budget
from companion.values import (
    Beam,
    BeamSet,
    Cap,
    Carrier,
    Cause,
    FloatArray,
    LeftOut,
    Track,
    TrackState,
    Widen,
)

AIMABLE: Final = (TrackState.LIVE, TrackState.COASTING)  # states of a track that gets a beam
NEAREST_M: Final = 1.0
"""Distance from the array below which a direction is meaningless.

The far field is tens of metres away.
"""
UNKNOWN_SHARE: Final = 0.25
"""Estimated ratio of a usual (95 %) error to its bound, before reports have revealed it.

In the logs it is 1/20 for positions, and 1/10 to 1/5 for attitudes.
"""
USUAL_SEEN: Final = 0.5
"""Estimated ratio of the usual (95 %) error of a seen direction to its bound.

In the logs it is 0.1 with a receiver of 0.5 degrees, and 0.4 to 0.6 with one of 5 degrees.
"""
MIN_AMPLITUDE: Final = 1e-3
"""Element amplitude below which there is no beam: 60 dB below an isotropic element."""


class SeenDirection(NamedTuple):
    """Directions in which the array sees a UAV, array frame.

    cap       those directions; None: it is elsewhere than it reports, so that nothing bounds the
              error of its direction
    is_alone  whether its reported position is not used
    """

    cap: Cap | None
    is_alone: bool = False


NO_SEEN_DIRECTIONS: Final[Mapping[str, SeenDirection]] = MappingProxyType({})


def aim(
    now_ns: int,
    *,
    valid_at_ns: int,
    tracks: Sequence[Track],
    carrier: Carrier | None,
    array: Array,
    precoder: Precoder,
    coverage: Coverage = EVERYWHERE,
    before: Hysteresis | None = None,
    seen_directions: Mapping[str, SeenDirection] = NO_SEEN_DIRECTIONS,
) -> BeamSet:
    """Compute one beam for every eligible track, with nulls on the others.

        now_ns       when the beams are computed, node time
        valid_at_ns  when they are applied, node time
        tracks       UAVs predicted to ``valid_at_ns``
        carrier      position and attitude of the array then; None: unknown, and no beams
        array        the array on its mount
        precoder     how weights are computed
        coverage     directions in which beams may point
        before       state of the last beams, for hysteresis; None: no hysteresis
        seen_directions       directions in which the array sees UAVs, by UAV

    The columns of the weights are in the order of ``tracks``. UAVs without a beam are listed with
    the reason.
    """
    place = None if carrier is None else line_of_sight.place_ned_m(carrier, array)
    refused = {track.uav: _refusal(track, place) for track in tracks}
    seen = [track for track in tracks if refused[track.uav] is None]
    beams: tuple[Beam, ...] = ()
    made = None
    if carrier is not None and seen:
        ranges_m, directions = line_of_sight.directions(seen, carrier, array)
        errors = _errors(seen, ranges_m, carrier, array)
        if seen_directions:
            directions, errors = _seen_by_array(seen, directions, errors, seen_directions)
        hidden = _out_of_reach(directions, array, coverage)
        refused |= {track.uav: why for track, why in zip(seen, hidden, strict=True)}
        inside = [i for i, why in enumerate(hidden) if why is None]
        if inside:
            aimed = _Aimed(
                tracks=[seen[i] for i in inside],
                ranges_m=ranges_m[inside],
                directions=directions[inside],
                errors=[errors[i] for i in inside],
            )
            beams, made, dropped = _beams(
                aimed, carrier, array, precoder=precoder, before=before, valid_at_ns=valid_at_ns
            )
            refused |= {uav: (Cause.CROWDED, why) for uav, why in dropped.items()}
    if made is None:
        made = precode(np.empty((array.size, 0), dtype=complex), precoder)
    left_out = tuple(LeftOut(uav, *why) for uav, why in refused.items() if why is not None)
    return BeamSet(
        t_ns=now_ns,
        valid_at_ns=valid_at_ns,
        beams=beams,
        weights=made.weights,
        method=hysteresis.reported_method(before, valid_at_ns, made.method, made.exact),
        normalisation=made.normalisation,
        condition_number=made.condition_number,
        left_out=left_out,
        exact=made.exact,
    )


def without(beam_set: BeamSet, uavs: Collection[str]) -> BeamSet:
    """Remove the beams of some UAVs; the nulls towards these UAVs stay.

    The other beams of a time slot share its power. A slot without beams is removed.
    """
    kept = [i for i, beam in enumerate(beam_set.beams) if beam.uav not in uavs]
    weights = beam_set.weights[:, kept]
    slots = np.unique([beam_set.beams[i].group for i in kept], return_inverse=True)[1]
    beams = tuple(
        replace(beam_set.beams[i], group=slot) for i, slot in zip(kept, slots.tolist(), strict=True)
    )
    if kept:
        normalise(weights, beam_set.normalisation, slots)
    left_out = tuple(one for one in beam_set.left_out if one.uav not in uavs)
    return replace(beam_set, beams=beams, weights=weights, left_out=left_out)


def directions(beam_set: BeamSet) -> FloatArray:
    """Return unit directions (N, 3) of the beams in the array frame."""
    azimuths = np.array([beam.azimuth_rad for beam in beam_set.beams])
    elevations = np.array([beam.elevation_rad for beam in beam_set.beams])
    return steering.unit_directions(azimuths, elevations)


class _Aimed(NamedTuple):
    """Tracks that get beams, with ranges (N,) and unit directions (N, 3) in the array frame.

    errors  the bound on each direction's error, or None, and its usual error, rad
    """

    tracks: list[Track]
    ranges_m: FloatArray
    directions: FloatArray
    errors: list[tuple[float | None, float]]


def _beams(
    aimed: _Aimed,
    carrier: Carrier,
    array: Array,
    *,
    precoder: Precoder,
    before: Hysteresis | None,
    valid_at_ns: int,
) -> tuple[tuple[Beam, ...], Precoding, dict[str, str]]:
    """Return the beams, their weights, and the UAVs that the policy left out, with the reason."""
    tracks, ranges_m, directions, errors = aimed
    uavs = [track.uav for track in tracks]
    bounds, usual = [bound for bound, _ in errors], [usual for _, usual in errors]
    wanted = [(0.0, 0.0) if b is None else (u, b) for u, b in zip(usual, bounds, strict=True)]
    natural_rad = array.wavelength_m / max(float(shapes.aperture(array).lengths_m.max()), 1e-9)
    sure_plane = precoder.widen is Widen.GUARANTEE and array.axis is None
    pace = hysteresis.GUARANTEE_PLANE_SHARE if sure_plane else 1.0
    shaped = hysteresis.rate_limited_rad(
        before, valid_at_ns, uavs, wanted_rad=np.array(wanted), natural_rad=natural_rad, pace=pace
    )
    spread = widening.spread(
        array,
        directions,
        DirectionErrors(
            likely_rad=shaped[:, 0],
            bounds_rad=shaped[:, 1],
            floor_db=precoder.floor_db,
            worth_db=precoder.worth_db,
        ),
        precoder.widen,
    )
    matrix = steering.steering_matrix(array, directions) if spread is None else spread.centres
    rate_weights = np.array([precoder.rate_weights.get(uav, 1.0) for uav in uavs])
    made = precode(
        matrix,
        precoder,
        spread,
        priorities=_priorities(tracks, precoder.priority),
        radio=Radio(
            link_budget.isotropic_snr(ranges_m, array, precoder.budget, precoder.uav_antennas),
            rate_weights,
        ),
        before=hysteresis.previous_slots(before, valid_at_ns, uavs),
    )
    azimuths, elevations = steering.angles_rad(directions)
    served = matrix[:, made.served]
    gains = gain_db(served, made.weights).tolist()
    power = np.einsum("mn,mn->n", served, served.conj()).real
    alone = (10 * np.log10(power)).tolist()
    rates = line_of_sight.rates(tracks, carrier, array, ranges_m, directions)
    beams = tuple(
        Beam(
            uav=uavs[i],
            azimuth_rad=float(azimuths[i]),
            elevation_rad=float(elevations[i]),
            range_m=float(ranges_m[i]),
            azimuth_rate_radps=rates[i][0],
            elevation_rate_radps=rates[i][1],
            range_rate_mps=rates[i][2],
            pointing_bound_rad=bounds[i],
            gain_db=gains[column],
            loss_db=alone[column] - gains[column],
            group=int(made.groups[column]),
            widened=spread is not None and bool(spread.broadened[i]),
            pointing_p95_rad=usual[i],
            shaped_likely_rad=float(shaped[i, 0]),
            shaped_bound_rad=float(shaped[i, 1]),
        )
        for column, i in enumerate(made.served.tolist())
    )
    return beams, made, {uavs[user]: why for user, why in made.dropped.items()}


def _errors(
    tracks: Sequence[Track], ranges_m: FloatArray, carrier: Carrier, array: Array
) -> list[tuple[float | None, float]]:
    """Return the bound on each predicted direction's error, or None, and its usual error."""
    lever_m = float(np.linalg.norm(array.lever_arm_m))
    found = []
    for track, range_m in zip(tracks, ranges_m.tolist(), strict=True):
        bound = _pointing_bound_rad(track, carrier, lever_m, range_m)
        found.append((bound, _usual_rad(track, carrier, lever_m, range_m, bound)))
    return found


def _seen_by_array(
    tracks: Sequence[Track],
    directions: FloatArray,
    errors: list[tuple[float | None, float]],
    seen_directions: Mapping[str, SeenDirection],
) -> tuple[FloatArray, list[tuple[float | None, float]]]:
    """Return directions and errors confined to those in which the array sees the UAVs."""
    directions, errors = directions.copy(), list(errors)
    for i, track in enumerate(tracks):
        one = seen_directions.get(track.uav)
        if one is None:
            continue
        bound, usual = errors[i]
        if one.cap is None:
            errors[i] = None, usual
        elif bound is None or one.cap.radius_rad < bound or one.is_alone:
            directions[i] = one.cap.center
            likely = USUAL_SEEN * one.cap.radius_rad
            errors[i] = one.cap.radius_rad, likely if one.is_alone else min(usual, likely)
    return directions, errors


def _priorities(tracks: Sequence[Track], priority: Sequence[str]) -> list[int]:
    """Return indices of the tracks by descending priority: those in ``priority`` first."""
    ranks = {uav: rank for rank, uav in enumerate(priority)}
    return sorted(range(len(tracks)), key=lambda i: ranks.get(tracks[i].uav, len(ranks)))


def _out_of_reach(
    directions: FloatArray, array: Array, coverage: Coverage
) -> list[tuple[Cause, str] | None]:
    """Return for each direction why no beam can point there; None if a beam can."""
    reasons: list[str | None] = [None] * len(directions)
    if coverage != EVERYWHERE:
        reasons = refusals(coverage, directions, directions @ array.array_from_body)
    if array.element.pattern is not ElementPattern.ISOTROPIC:
        amplitudes = steering.amplitudes(array, directions)
        if array.live is not None:  # dead elements may be the ones that face there
            amplitudes = amplitudes * array.live[:, np.newaxis]
        dark = amplitudes.max(axis=0) < MIN_AMPLITUDE
        reasons = [
            why or ("no element of the array radiates there" if none else None)
            for why, none in zip(reasons, dark.tolist(), strict=True)
        ]
    return [None if why is None else (Cause.COVERAGE, why) for why in reasons]


def _pointing_bound_rad(
    track: Track, carrier: Carrier, lever_m: float, range_m: float
) -> float | None:
    """Return the bound on the angle between predicted and true direction; None: unbounded.

    The sum of: the errors of both positions as seen from the array; the displacement of the array
    by the attitude error, through the lever arm; and the attitude error itself (docs/math.md 5.3).
    """
    swing = 2.0 * math.sin(min(carrier.attitude_bound_rad, math.pi) / 2.0)
    swung_m = swing * lever_m
    seen = steering.pointing_bound_rad(track.bound_m + carrier.bound_m + swung_m, range_m)
    return None if seen is None else min(seen + carrier.attitude_bound_rad, math.pi)


def _usual_rad(
    track: Track, carrier: Carrier, lever_m: float, range_m: float, bound_rad: float | None
) -> float:
    """Return the estimated 95th percentile of the direction error.

    Errors of positions and of the attitude are independent, so they add as squares. An unknown
    error is estimated as ``UNKNOWN_SHARE`` of its bound (docs/math.md 5.3).
    """

    def usual(known: float | None, bound: float) -> float:
        return UNKNOWN_SHARE * bound if known is None else min(known, bound)

    attitude = usual(carrier.attitude_p95_rad, carrier.attitude_bound_rad)
    swung_m = attitude * lever_m
    off_m = math.hypot(
        usual(track.error_p95_m, track.bound_m),
        usual(carrier.error_p95_m, carrier.bound_m),
        swung_m,
    )
    seen = math.asin(min(off_m / range_m, 1.0))
    return min(math.hypot(seen, attitude), math.pi if bound_rad is None else bound_rad)


def _refusal(track: Track, place_ned_m: FloatArray | None) -> tuple[Cause, str] | None:
    """Return why a track gets no beam from an array at this position; None if it gets one."""
    if place_ned_m is None:
        return Cause.CARRIER, "the carrier's position or attitude is unknown"
    if track.state not in AIMABLE:
        return Cause.SILENT, f"its track is {track.state}"
    offset_m = track.position_ned_m - place_ned_m
    if offset_m @ offset_m < NEAREST_M**2:
        return Cause.COVERAGE, f"it is within {NEAREST_M:g} m of the array"
    return None
