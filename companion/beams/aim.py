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
    renewed_column,
)
from companion.beams.weights.widening import DirectionErrors
from companion.beams.worth import link_budget
from companion.values import (
    Beam,
    BeamSet,
    Cap,
    Carrier,
    Cause,
    ComplexArray,
    FloatArray,
    LeftOut,
    Normalisation,
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


Refusal = tuple[Cause, str]
"""Cause and reason in words for which a UAV gets no beam."""
NO_POSE: Final[Refusal] = (Cause.CARRIER, "the carrier's position or attitude is unknown")
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

        now_ns           when the beams are computed, node time
        valid_at_ns      when they are applied, node time
        tracks           UAVs predicted to ``valid_at_ns``
        carrier          position and attitude of the array then; None: unknown, and no beams
        array            the array on its mount
        precoder         how weights are computed
        coverage         directions in which beams may point
        before           state of the last beams, for hysteresis; None: no hysteresis
        seen_directions  directions in which the array sees UAVs, by UAV

    The columns of the weights are in the order of ``tracks``. UAVs without a beam are listed with
    the reason.
    """
    why_not: list[Refusal | None] = [NO_POSE] * len(tracks)
    beams: tuple[Beam, ...] = ()
    made, dropped = None, dict[str, str]()
    if carrier is not None:
        offsets_m = line_of_sight.offsets_ned_m(tracks, carrier, array)
        why_not = _refusals(tracks, offsets_m)
        seen = [i for i, why in enumerate(why_not) if why is None]
        if seen:
            aimed = _aimed([tracks[i] for i in seen], offsets_m[seen], carrier, array)
            if seen_directions:
                aimed = _seen_by_array(aimed, seen_directions)
            for i, why in zip(seen, _out_of_reach(aimed.directions, array, coverage), strict=True):
                why_not[i] = why
            inside = [n for n, i in enumerate(seen) if why_not[i] is None]
            if inside:
                beams, made, dropped = _beams(
                    aimed.of(inside),
                    carrier,
                    array,
                    precoder=precoder,
                    before=before,
                    valid_at_ns=valid_at_ns,
                )
    refused = {track.uav: why for track, why in zip(tracks, why_not, strict=True)}
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


class RenewedBeam(NamedTuple):
    """Beam of one UAV, aimed again between two updates.

    column  its place among the beams of the update
    one     that beam alone, with its weights (M, 1)
    """

    column: int
    one: BeamSet


def renewed(
    made: BeamSet,
    track: Track,
    *,
    now_ns: int,
    valid_at_ns: int,
    carrier: Carrier,
    array: Array,
    precoder: Precoder,
    coverage: Coverage = EVERYWHERE,
    before: Hysteresis | None = None,
    seen_directions: Mapping[str, SeenDirection] = NO_SEEN_DIRECTIONS,
) -> RenewedBeam | None:
    """Aim the beam of one UAV again, with nulls on the others of its time slot.

        made    the newest update; its other beams are kept
        track   the UAV predicted to ``valid_at_ns``

    The other arguments are those of ``aim``. The other UAVs are assumed where their rates of change
    take them from the update. Their beams keep their nulls where this UAV was then, so the result
    is not exact. The new column has the power of the one that it replaces, or unit response. None
    if the UAV cannot have a beam, or had none in the update.
    """
    column = next((i for i, beam in enumerate(made.beams) if beam.uav == track.uav), None)
    if column is None:
        return None
    offsets_m = line_of_sight.offsets_ned_m([track], carrier, array)
    if _refusals([track], offsets_m) != [None]:
        return None
    aimed = _aimed([track], offsets_m, carrier, array)
    if seen_directions:
        aimed = _seen_by_array(aimed, seen_directions)
    if _out_of_reach(aimed.directions, array, coverage) != [None]:
        return None
    slot = made.beams[column].group
    members = [i for i, beam in enumerate(made.beams) if beam.group == slot]
    user, beams = members.index(column), [made.beams[i] for i in members]
    own = _shaped_rad([track.uav], aimed.errors, array, precoder, (before, valid_at_ns))
    towards, shaped = _moved(beams, (valid_at_ns - made.valid_at_ns) * 1e-9)
    towards[user], shaped[user] = aimed.directions[0], own[0]
    spread = widening.spread(array, towards, _shapes(shaped, precoder), precoder.widen, user)
    matrix = steering.steering_matrix(array, towards) if spread is None else spread.centres
    uavs, ranges_m = [beam.uav for beam in beams], made.ranges_m[members]
    radio = _radio(uavs, ranges_m, array, precoder) if precoder.needs_radio else None
    new = renewed_column(matrix, precoder, spread, user, radio)
    weights = _at_its_power(new, made, members, column)[:, np.newaxis]
    described = _described(
        aimed,
        rates=line_of_sight.rates([track], carrier, array, aimed.ranges_m, aimed.directions),
        shaped_rad=own,
        widened=[spread is not None and bool(spread.broadened[0])],
        users=[0],
        slots=[slot],
        steering_vectors=matrix[:, [user]],
        weights=weights,
    )
    one = replace(
        made,
        t_ns=now_ns,
        valid_at_ns=valid_at_ns,
        beams=described,
        weights=weights,
        left_out=(),
        exact=False,
    )
    return RenewedBeam(column, one)


def _moved(beams: Sequence[Beam], seconds: float) -> tuple[FloatArray, FloatArray]:
    """Return unit directions (N, 3) of beams after a time, by their rates, and shapes (N, 2)."""
    rows = np.array(
        [
            (
                beam.azimuth_rad,
                beam.elevation_rad,
                beam.azimuth_rate_radps or 0.0,
                beam.elevation_rate_radps or 0.0,
                beam.shaped_likely_rad,
                beam.shaped_bound_rad,
            )
            for beam in beams
        ]
    )
    azimuths, elevations = (rows[:, :2] + seconds * rows[:, 2:4]).T
    return steering.unit_directions(azimuths, elevations), rows[:, 4:]


def _at_its_power(
    new: ComplexArray, made: BeamSet, members: list[int], column: int
) -> ComplexArray:
    """Return a new column (M,) of unit response at the scale of the one that it replaces.

    members  columns of its time slot, ``column`` among them

    Where the busiest element limits the power, no element has more than that, though all of these
    columns are replaced: each may use an equal part of what is left.
    """
    if made.normalisation is Normalisation.UNIT_RESPONSE:
        return new
    old = made.weights[:, column]
    scaled: ComplexArray = new * math.sqrt(np.vecdot(old, old).real / np.vecdot(new, new).real)
    if made.normalisation is Normalisation.ANTENNA:
        used = (np.abs(made.weights[:, members]) ** 2).sum(axis=1)
        left = np.abs(old) ** 2 + (used.max() - used) / len(members)
        share = float((left / np.maximum(np.abs(scaled) ** 2, 1e-300)).min())
        scaled *= math.sqrt(min(1.0, share))
    return scaled


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

    def of(self, which: list[int]) -> "_Aimed":
        """Return the part for some of the tracks."""
        if len(which) == len(self.tracks):
            return self
        return _Aimed(
            tracks=[self.tracks[i] for i in which],
            ranges_m=self.ranges_m[which],
            directions=self.directions[which],
            errors=[self.errors[i] for i in which],
        )


def _aimed(tracks: list[Track], offsets_m: FloatArray, carrier: Carrier, array: Array) -> _Aimed:
    """Return tracks at offsets (N, 3) from the array, local frame, by the reported positions."""
    ranges_m, directions = line_of_sight.directions_of(offsets_m, carrier, array)
    errors = _errors(tracks, ranges_m, carrier, array)
    return _Aimed(tracks=tracks, ranges_m=ranges_m, directions=directions, errors=errors)


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
    shaped = _shaped_rad(uavs, errors, array, precoder, (before, valid_at_ns))
    spread = widening.spread(array, directions, _shapes(shaped, precoder), precoder.widen)
    matrix = steering.steering_matrix(array, directions) if spread is None else spread.centres
    made = precode(
        matrix,
        precoder,
        spread,
        priorities=_priorities(tracks, precoder.priority),
        radio=_radio(uavs, ranges_m, array, precoder) if precoder.needs_radio else None,
        before=hysteresis.previous_slots(before, valid_at_ns, uavs),
    )
    served = matrix if len(made.served) == len(uavs) else matrix[:, made.served]
    beams = _described(
        aimed,
        rates=line_of_sight.rates(tracks, carrier, array, ranges_m, directions),
        shaped_rad=shaped,
        widened=[False] * len(uavs) if spread is None else spread.broadened.tolist(),
        users=made.served.tolist(),
        slots=made.groups.tolist(),
        steering_vectors=served,
        weights=made.weights,
    )
    return beams, made, {uavs[user]: why for user, why in made.dropped.items()}


def _shaped_rad(
    uavs: list[str],
    errors: list[tuple[float | None, float]],
    array: Array,
    precoder: Precoder,
    at: tuple[Hysteresis | None, int],
) -> FloatArray:
    """Return the angles (N, 2) for which beams are shaped: the likely ones, and the bounds.

    ``at`` is the state of the last beams, and when the new ones are applied.
    """
    wanted = [(0.0, 0.0) if bound is None else (usual, bound) for bound, usual in errors]
    sure_plane = precoder.widen is Widen.GUARANTEE and array.axis is None
    return hysteresis.rate_limited_rad(
        *at,
        uavs,
        wanted_rad=np.array(wanted),
        natural_rad=shapes.aperture(array).natural_rad,
        pace=hysteresis.GUARANTEE_PLANE_SHARE if sure_plane else 1.0,
    )


def _shapes(shaped_rad: FloatArray, precoder: Precoder) -> DirectionErrors:
    return DirectionErrors(
        likely_rad=shaped_rad[:, 0],
        bounds_rad=shaped_rad[:, 1],
        floor_db=precoder.floor_db,
        worth_db=precoder.worth_db,
    )


def _described(
    aimed: _Aimed,
    *,
    rates: list[line_of_sight.LineOfSightRates],
    shaped_rad: FloatArray,
    widened: list[bool],
    users: list[int],
    slots: list[int],
    steering_vectors: ComplexArray,
    weights: ComplexArray,
) -> tuple[Beam, ...]:
    """Return the beams of ``users`` (K), indices into the aimed tracks.

    slots                     the time slot of each
    steering_vectors, weights (M, K), of each
    """
    gains = gain_db(steering_vectors, weights)
    lengths = np.vecdot(steering_vectors.T, steering_vectors.T).real
    losses = (10 * np.log10(lengths) - gains).tolist()
    azimuths, elevations = (angles.tolist() for angles in steering.angles_rad(aimed.directions))
    ranges, errors = aimed.ranges_m.tolist(), aimed.errors
    likely, bounds = shaped_rad[:, 0].tolist(), shaped_rad[:, 1].tolist()
    return tuple(
        Beam(
            uav=aimed.tracks[i].uav,
            azimuth_rad=azimuths[i],
            elevation_rad=elevations[i],
            range_m=ranges[i],
            azimuth_rate_radps=rates[i][0],
            elevation_rate_radps=rates[i][1],
            range_rate_mps=rates[i][2],
            pointing_bound_rad=errors[i][0],
            gain_db=gain,
            loss_db=loss,
            group=slot,
            widened=widened[i],
            pointing_p95_rad=errors[i][1],
            shaped_likely_rad=likely[i],
            shaped_bound_rad=bounds[i],
        )
        for i, slot, gain, loss in zip(users, slots, gains.tolist(), losses, strict=True)
    )


def _radio(uavs: list[str], ranges_m: FloatArray, array: Array, precoder: Precoder) -> Radio:
    """Return the radio parameters of UAVs at ranges (N,)."""
    return Radio(
        link_budget.isotropic_snr(ranges_m, array, precoder.budget, precoder.uav_antennas),
        np.array([precoder.rate_weights.get(uav, 1.0) for uav in uavs]),
    )


def _errors(
    tracks: Sequence[Track], ranges_m: FloatArray, carrier: Carrier, array: Array
) -> list[tuple[float | None, float]]:
    """Return the bound on each predicted direction's error, or None, and its usual error.

    The bound is the sum of: the errors of both positions as seen from the array; the displacement
    of the array by the attitude error, through the lever arm; and the attitude error itself.

    The usual error is the estimated 95th percentile. Errors of positions and of the attitude are
    independent, so they add as squares (docs/math.md 5.3).
    """
    lever_m = array.lever_m
    attitude_rad, own_m = carrier.attitude_bound_rad, carrier.bound_m
    swung_m = 2.0 * math.sin(min(attitude_rad, math.pi) / 2.0) * lever_m
    usual_rad = _usual(carrier.attitude_p95_rad, attitude_rad)
    usual_own_m, usual_swung_m = _usual(carrier.error_p95_m, own_m), usual_rad * lever_m
    found = list[tuple[float | None, float]]()
    for track, range_m in zip(tracks, ranges_m.tolist(), strict=True):
        seen = steering.pointing_bound_rad(track.bound_m + own_m + swung_m, range_m)
        bound = None if seen is None else min(seen + attitude_rad, math.pi)
        off_m = math.hypot(_usual(track.error_p95_m, track.bound_m), usual_own_m, usual_swung_m)
        usual = math.hypot(math.asin(min(off_m / range_m, 1.0)), usual_rad)
        found.append((bound, min(usual, math.pi if bound is None else bound)))
    return found


def _usual(known: float | None, bound: float) -> float:
    """Return a usual (95 %) error: ``UNKNOWN_SHARE`` of its bound if it is unknown."""
    return UNKNOWN_SHARE * bound if known is None else min(known, bound)


def _seen_by_array(aimed: _Aimed, seen_directions: Mapping[str, SeenDirection]) -> _Aimed:
    """Return directions and errors confined to those in which the array sees the UAVs."""
    directions, errors = aimed.directions.copy(), list(aimed.errors)
    for i, track in enumerate(aimed.tracks):
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
    return aimed._replace(directions=directions, errors=errors)


def _priorities(tracks: Sequence[Track], priority: Sequence[str]) -> Sequence[int]:
    """Return indices of the tracks by descending priority: those in ``priority`` first."""
    everyone = range(len(tracks))
    if not priority:
        return everyone
    ranks = {uav: rank for rank, uav in enumerate(priority)}
    return sorted(everyone, key=lambda i: ranks.get(tracks[i].uav, len(ranks)))


def _out_of_reach(directions: FloatArray, array: Array, coverage: Coverage) -> list[Refusal | None]:
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


def _refusals(tracks: Sequence[Track], offsets_m: FloatArray) -> list[Refusal | None]:
    """Return why tracks at offsets (N, 3) from the array get no beam; None for one that may."""
    near = np.vecdot(offsets_m, offsets_m) < NEAREST_M**2
    return [
        (Cause.SILENT, f"its track is {track.state}")
        if track.state not in AIMABLE
        else (Cause.COVERAGE, f"it is within {NEAREST_M:g} m of the array")
        if is_near
        else None
        for track, is_near in zip(tracks, near.tolist(), strict=True)
    ]
