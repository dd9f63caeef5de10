"""Ranges, directions, and their rates of change, from the array to the UAVs.

Directions are unit vectors in the array frame.
"""

import math
from collections.abc import Sequence

import numpy as np

from companion.beams.array.geometry import Array
from companion.values import Carrier, FloatArray, Track


def place_ned_m(carrier: Carrier, array: Array) -> FloatArray:
    """Return the array's position, (3,), local frame: the carrier's position plus the lever arm."""
    if not array.lever_m:
        return carrier.position_ned_m
    place: FloatArray = carrier.position_ned_m + carrier.body_from_local.T @ array.lever_arm_m
    return place


def directions(
    tracks: Sequence[Track], carrier: Carrier, array: Array
) -> tuple[FloatArray, FloatArray]:
    """Return ranges (N,), metres, and unit directions (N, 3), array frame, from array to UAVs."""
    return directions_of(offsets_ned_m(tracks, carrier, array), carrier, array)


def offsets_ned_m(tracks: Sequence[Track], carrier: Carrier, array: Array) -> FloatArray:
    """Return the UAVs' positions from the array, (N, 3), local frame."""
    places = np.array([track.position_ned_m for track in tracks])
    return np.asarray(places.reshape(-1, 3) - place_ned_m(carrier, array))


def directions_of(
    offsets_ned_m: FloatArray, carrier: Carrier, array: Array
) -> tuple[FloatArray, FloatArray]:
    """Return ranges (N,), metres, and unit directions (N, 3), array frame, of offsets (N, 3)."""
    ranges_m = np.sqrt(np.vecdot(offsets_ned_m, offsets_ned_m))
    array_from_local = array.array_from_body @ carrier.body_from_local
    return ranges_m, (offsets_ned_m / ranges_m[:, np.newaxis]) @ array_from_local.T


LineOfSightRates = tuple[float | None, float | None, float | None]
"""Rates of change from array to UAV: azimuth and elevation in rad/s, range in m/s."""


def rates(
    tracks: Sequence[Track],
    carrier: Carrier,
    array: Array,
    ranges_m: FloatArray,
    directions: FloatArray,
) -> list[LineOfSightRates]:
    """Return rates of azimuth, elevation (rad/s) and range (m/s) of directions in the array frame.

    None without a velocity; straight up and straight down the azimuth has no rate.
    """
    unknown: LineOfSightRates = (None, None, None)
    moved = carrier.velocity_ned_mps
    if moved is None:
        return [unknown] * len(tracks)
    velocities = [track.velocity_ned_mps for track in tracks]
    known = [velocity is not None for velocity in velocities]
    moving_ned_mps = np.array([moved if v is None else v for v in velocities])
    array_from_local = array.array_from_body @ carrier.body_from_local
    if array.lever_m:
        swung = np.cross(carrier.body_rates_radps, array.lever_arm_m)
        moved = moved + swung @ carrier.body_from_local
    moving = (moving_ned_mps - moved) @ array_from_local.T
    range_rates = np.vecdot(moving, directions)
    across = (moving - range_rates[:, np.newaxis] * directions) / ranges_m[:, np.newaxis]
    w1, w2, w3 = (array.array_from_body @ carrier.body_rates_radps).tolist()
    rows = zip(known, directions.tolist(), across.tolist(), range_rates.tolist(), strict=True)
    found: list[LineOfSightRates] = []
    for is_known, (x, y, z), (x_moves, y_moves, z_moves), range_rate in rows:
        x_rate = x_moves - (w2 * z - w3 * y)
        y_rate = y_moves - (w3 * x - w1 * z)
        z_rate = z_moves - (w1 * y - w2 * x)
        level = x * x + y * y
        if not is_known:
            found.append(unknown)
        elif level < 1e-12:
            found.append((None, None, range_rate))
        else:
            azimuth = (x * y_rate - y * x_rate) / level
            found.append((azimuth, -z_rate / math.sqrt(level), range_rate))
    return found


def directions_ahead(
    track: Track, carrier: Carrier, array: Array, times_s: FloatArray
) -> FloatArray | None:
    """Return unit directions (T, 3) of a UAV at times after the track's own; None without velocity.

    Track and carrier are extrapolated at their velocities, the track also with its acceleration,
    and the carrier at its body rates. The result is valid while these motions continue. Boresight
    is returned where the UAV would be at the array itself.
    """
    velocity, own = track.velocity_ned_mps, carrier.velocity_ned_mps
    if velocity is None or own is None:
        return None
    t = times_s[:, np.newaxis]
    ahead_m = track.position_ned_m - carrier.position_ned_m + (velocity - own) * t
    if track.acceleration_ned_mps2 is not None:
        ahead_m += 0.5 * track.acceleration_ned_mps2 * t**2
    seen_m = ahead_m @ carrier.body_from_local.T
    turn = math.sqrt(carrier.body_rates_radps @ carrier.body_rates_radps)
    if turn > 0:
        # Rodrigues' formula; coordinates rotate opposite to the body.
        axis, angle = carrier.body_rates_radps / turn, -turn * t
        along = (seen_m @ axis)[:, np.newaxis] * axis
        seen_m = along + (seen_m - along) * np.cos(angle) + np.cross(axis, seen_m) * np.sin(angle)
    seen_m = (seen_m - array.lever_arm_m) @ array.array_from_body.T
    ranges_m = np.linalg.norm(seen_m, axis=1)
    here = (ranges_m < 1e-9)[:, np.newaxis]
    found: FloatArray = np.where(here, [1.0, 0.0, 0.0], seen_m) / np.where(
        here, 1.0, ranges_m[:, np.newaxis]
    )
    return found
