"""Tracks to beams: who gets one, where it points, and the weights of all of them together."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from companion.beams import steering
from companion.beams.arrays import Array
from companion.beams.precoding import Precoder, gain_db, precode
from companion.values import (
    Beam,
    BeamSet,
    Carrier,
    ComplexArray,
    FloatArray,
    LeftOut,
    Method,
    Normalisation,
    Track,
    TrackState,
)

AIMABLE: Final = (TrackState.LIVE, TrackState.COASTING)
NEAREST_M: Final = 1.0
"""Closer than this a direction means nothing: the far field is tens of metres away."""


def aim(
    now_ns: int,
    valid_at_ns: int,
    tracks: Sequence[Track],
    carrier: Carrier | None,
    array: Array,
    precoder: Precoder,
) -> BeamSet:
    """One beam on every track that can be aimed at, nulls on the others; who is left out, and why.

    Columns of the weights come in the order of ``tracks``.
    """
    refused = {track.uav: _refusal(track, carrier) for track in tracks}
    left_out = tuple(LeftOut(uav, why) for uav, why in refused.items() if why is not None)
    aimed = [track for track in tracks if refused[track.uav] is None]
    if carrier is None or not aimed:
        nothing: ComplexArray = np.empty((array.size, 0), dtype=complex)
        return BeamSet(
            now_ns,
            valid_at_ns,
            (),
            nothing,
            Method.ZERO_FORCING,
            Normalisation.UNIT_RESPONSE,
            None,
            left_out,
        )
    ranges_m, directions = _directions(aimed, carrier, array)
    matrix = steering.steering_matrix(array, directions)
    made = precode(matrix, precoder)
    azimuths, elevations = steering.angles_rad(directions)
    gains = gain_db(matrix, made.weights)
    alone = gain_db(matrix, matrix.conj())
    rates = _rates(aimed, carrier, array, ranges_m, directions)
    beams = tuple(
        Beam(
            uav=track.uav,
            azimuth_rad=float(azimuths[i]),
            elevation_rad=float(elevations[i]),
            range_m=float(ranges_m[i]),
            azimuth_rate_radps=rates[i][0],
            elevation_rate_radps=rates[i][1],
            range_rate_mps=rates[i][2],
            pointing_bound_rad=_pointing_bound_rad(track, carrier, float(ranges_m[i])),
            gain_db=float(gains[i]),
            loss_db=float(alone[i] - gains[i]),
        )
        for i, track in enumerate(aimed)
    )
    return BeamSet(
        now_ns,
        valid_at_ns,
        beams,
        made.weights,
        made.method,
        Normalisation.UNIT_RESPONSE,
        made.condition_number,
        left_out,
    )


def _pointing_bound_rad(track: Track, carrier: Carrier, range_m: float) -> float | None:
    """Both positions' errors seen from the array, and the attitude's; None: any direction."""
    seen = steering.pointing_bound_rad(track.bound_m + carrier.bound_m, range_m)
    return None if seen is None else min(seen + carrier.attitude_bound_rad, math.pi)


Rates = tuple[float | None, float | None, float | None]


def _rates(
    tracks: Sequence[Track],
    carrier: Carrier,
    array: Array,
    ranges_m: FloatArray,
    directions: FloatArray,
) -> list[Rates]:
    """Rates of azimuth, elevation (rad/s) and range (m/s) of unit directions in the array frame.

    None without a velocity; straight up and straight down the azimuth has no rate.
    """
    unknown: Rates = (None, None, None)
    moved = carrier.velocity_ned_mps
    if moved is None:
        return [unknown] * len(tracks)
    known = [track.velocity_ned_mps is not None for track in tracks]
    velocities = [moved if v is None else v for v in (t.velocity_ned_mps for t in tracks)]
    array_from_local = array.array_from_body @ carrier.body_from_local
    moving = (np.array(velocities) - moved) @ array_from_local.T
    range_rates = np.einsum("nk,nk->n", moving, directions)
    across = (moving - range_rates[:, np.newaxis] * directions) / ranges_m[:, np.newaxis]
    w1, w2, w3 = (array.array_from_body @ carrier.body_rates_radps).tolist()
    found: list[Rates] = []
    for i, (x, y, z) in enumerate(directions.tolist()):
        x_rate, y_rate, z_rate = across[i].tolist()
        x_rate, y_rate, z_rate = (
            x_rate - (w2 * z - w3 * y),
            y_rate - (w3 * x - w1 * z),
            z_rate - (w1 * y - w2 * x),
        )
        level = x * x + y * y
        if not known[i]:
            found.append(unknown)
        elif level < 1e-12:
            found.append((None, None, float(range_rates[i])))
        else:
            azimuth = (x * y_rate - y * x_rate) / level
            found.append((azimuth, -z_rate / math.sqrt(level), float(range_rates[i])))
    return found


def _refusal(track: Track, carrier: Carrier | None) -> str | None:
    """Why a track gets no beam; None if it does."""
    if carrier is None:
        return "the carrier is not known"
    if track.state not in AIMABLE:
        return f"its reports are {track.state}"
    offset_m = track.position_ned_m - carrier.position_ned_m
    if offset_m @ offset_m < NEAREST_M**2:
        return f"it is within {NEAREST_M:g} m of the array"
    return None


def _directions(
    tracks: Sequence[Track], carrier: Carrier, array: Array
) -> tuple[FloatArray, FloatArray]:
    """Ranges (N,) and unit directions in the array frame (N, 3)."""
    offsets_m = np.array([track.position_ned_m for track in tracks]) - carrier.position_ned_m
    ranges_m = np.sqrt(np.einsum("nk,nk->n", offsets_m, offsets_m))
    array_from_local = array.array_from_body @ carrier.body_from_local
    return ranges_m, (offsets_m / ranges_m[:, np.newaxis]) @ array_from_local.T
