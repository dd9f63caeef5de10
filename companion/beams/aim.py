"""Tracks to beams: which UAVs get one, where it points, and the weights of all of them together."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from companion.beams import line_of_sight
from companion.beams.array import steering
from companion.beams.array.coverage import EVERYWHERE, Coverage, refusals
from companion.beams.array.elements import Pattern
from companion.beams.array.geometry import Array
from companion.beams.weights import widening
from companion.beams.weights.precoding import Precoder, Precoding, gain_db, precode
from companion.values import (
    Beam,
    BeamSet,
    Carrier,
    FloatArray,
    LeftOut,
    Track,
    TrackState,
)

AIMABLE: Final = (TrackState.LIVE, TrackState.COASTING)
"""States of a track that gets a beam."""
NEAREST_M: Final = 1.0
"""Distance from the array below which a direction means nothing.

The far field is tens of metres away.
"""
DARK: Final = 1e-3
"""Element amplitude below which there is no beam: 60 dB below an isotropic element."""


def aim(
    now_ns: int,
    valid_at_ns: int,
    tracks: Sequence[Track],
    carrier: Carrier | None,
    array: Array,
    precoder: Precoder,
    coverage: Coverage = EVERYWHERE,
) -> BeamSet:
    """Make one beam on every track that can be aimed at, with nulls on the others.

        now_ns       when the beams are made, node time
        valid_at_ns  when they are applied, node time
        tracks       UAVs predicted to ``valid_at_ns``
        carrier      where the array is then; None: not known, and no beams
        array        the array on its mount
        precoder     how weights are made
        coverage     directions in which beams may point

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
        hidden = _out_of_reach(directions, array, coverage)
        refused |= {track.uav: why for track, why in zip(seen, hidden, strict=True)}
        inside = [i for i, why in enumerate(hidden) if why is None]
        if inside:
            aimed = _Aimed([seen[i] for i in inside], ranges_m[inside], directions[inside])
            beams, made, dropped = _beams(aimed, carrier, array, precoder)
            refused |= dropped
    if made is None:
        made = precode(np.empty((array.size, 0), dtype=complex), precoder)
    left_out = tuple(LeftOut(uav, why) for uav, why in refused.items() if why is not None)
    return BeamSet(
        now_ns,
        valid_at_ns,
        beams,
        made.weights,
        made.method,
        made.normalisation,
        made.condition_number,
        left_out,
    )


def directions(beam_set: BeamSet) -> FloatArray:
    """Unit directions (N, 3) of the beams in the array frame."""
    azimuths = np.array([beam.azimuth_rad for beam in beam_set.beams])
    elevations = np.array([beam.elevation_rad for beam in beam_set.beams])
    return steering.unit_directions(azimuths, elevations)


class _Aimed(NamedTuple):
    """Tracks that get beams, with ranges (N,) and unit directions (N, 3) in the array frame."""

    tracks: list[Track]
    ranges_m: FloatArray
    directions: FloatArray


def _beams(
    aimed: _Aimed, carrier: Carrier, array: Array, precoder: Precoder
) -> tuple[tuple[Beam, ...], Precoding, dict[str, str]]:
    """The beams, their weights, and the UAVs that the policy left out with the reason."""
    tracks, ranges_m, directions = aimed
    bounds = [
        _pointing_bound_rad(track, carrier, array, range_m)
        for track, range_m in zip(tracks, ranges_m.tolist(), strict=True)
    ]
    spread = None
    if precoder.widen:
        widths = np.array([np.inf if bound is None else bound for bound in bounds])
        spread = widening.spread(array, directions, widths)
    matrix = steering.steering_matrix(array, directions) if spread is None else spread.centres
    made = precode(matrix, precoder, spread, _priorities(tracks, precoder.priority))
    azimuths, elevations = steering.angles_rad(directions)
    served = matrix[:, made.served]
    gains = gain_db(served, made.weights).tolist()
    power = np.einsum("mn,mn->n", served, served.conj()).real
    alone = (10 * np.log10(power)).tolist()
    rates = line_of_sight.rates(tracks, carrier, array, ranges_m, directions)
    beams = tuple(
        Beam(
            uav=tracks[i].uav,
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
        )
        for column, i in enumerate(made.served.tolist())
    )
    return beams, made, {tracks[user].uav: why for user, why in made.dropped.items()}


def _priorities(tracks: Sequence[Track], priority: Sequence[str]) -> list[int]:
    """Indices of the tracks by descending priority: those named first, then the others."""
    ranks = {uav: rank for rank, uav in enumerate(priority)}
    return sorted(range(len(tracks)), key=lambda i: ranks.get(tracks[i].uav, len(ranks)))


def _out_of_reach(directions: FloatArray, array: Array, coverage: Coverage) -> list[str | None]:
    """For each direction the reason why no beam can point there; None if one can."""
    reasons: list[str | None] = [None] * len(directions)
    if coverage != EVERYWHERE:
        reasons = refusals(coverage, directions, directions @ array.array_from_body)
    if array.element.pattern is not Pattern.ISOTROPIC:
        dark = steering.amplitudes(array, directions).max(axis=0) < DARK
        reasons = [
            why or ("its elements radiate nothing there" if none else None)
            for why, none in zip(reasons, dark.tolist(), strict=True)
        ]
    return reasons


def _pointing_bound_rad(
    track: Track, carrier: Carrier, array: Array, range_m: float
) -> float | None:
    """Bound on the angle between predicted and true direction; None: any direction is possible.

    Both positions' errors as seen from the array, the way that its attitude's error moves an array
    that stands off the carrier's reported point, and that error itself (docs/math.md 5.3).
    """
    swing = 2.0 * math.sin(min(carrier.attitude_bound_rad, math.pi) / 2.0)
    swung_m = swing * float(np.linalg.norm(array.lever_arm_m))
    seen = steering.pointing_bound_rad(track.bound_m + carrier.bound_m + swung_m, range_m)
    return None if seen is None else min(seen + carrier.attitude_bound_rad, math.pi)


def _refusal(track: Track, place_ned_m: FloatArray | None) -> str | None:
    """Why a track gets no beam from an array at this place; None if it gets one."""
    if place_ned_m is None:
        return "the carrier is not known"
    if track.state not in AIMABLE:
        return f"its reports are {track.state}"
    offset_m = track.position_ned_m - place_ned_m
    if offset_m @ offset_m < NEAREST_M**2:
        return f"it is within {NEAREST_M:g} m of the array"
    return None
