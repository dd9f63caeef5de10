"""Reachable set of a UAV, from its newest report and its limits.

At a time s after a report of position p and velocity v, with noise n_p and n_v and an acceleration
of at most a, the UAV is within

    R(s) = n_p + |s| n_v + a s^2 / 2    of    p + v s

If s is only known to lie between two times, all of these balls are possible. |q - (p + v s)| and
R(s) are both convex in s, so for every position q their sum is largest at one of the two ends: the
bound about a prediction q is the larger of the two, and exact. Older reports add nothing to the
worst case. See docs/math.md 5.1.
"""

import math
from typing import NamedTuple

from companion.values import Fix, Limits, SenderTime, Vector


class Reach(NamedTuple):
    """Bounds about a prediction, and the smallest ball around the reachable set."""

    bound_m: float  # bound on the norm of the prediction's error
    horizontal_m: float  # bound on its part in the plane
    vertical_m: float  # bound on its height
    center_ned_m: Vector  # centre of the ball
    radius_m: float  # radius of the ball


def reach(fix: Fix, limits: Limits, predicted_ned_m: Vector, at: SenderTime) -> Reach:
    """Return the reachable set at a time, and bounds about a prediction for that time.

    fix              the newest report, with a velocity
    limits           the aircraft's limits
    predicted_ned_m  the prediction
    at               the time, on the sender's timeline
    """
    assert fix.velocity_ned_mps is not None
    noise = fix.noise
    age_s = (at.sender_ns - fix.sender_ns) * 1e-9
    ends = (age_s - at.before_s, age_s + at.after_s)
    (to_n, to_e, to_d), (from_n, from_e, from_d) = predicted_ned_m, fix.position_ned_m
    north, east, down = to_n - from_n, to_e - from_e, to_d - from_d
    v_north, v_east, v_down = fix.velocity_ned_mps
    bound = horizontal = vertical = 0.0
    radii = []
    for s in ends:
        grown = abs(s) * noise.velocity_mps + limits.acceleration_max_mps2 * s * s / 2.0
        n, e, d = north - v_north * s, east - v_east * s, down - v_down * s
        flat = n * n + e * e
        radii.append(noise.position_m + grown)
        off = math.sqrt(flat + d * d) + noise.position_m + grown
        aside = math.sqrt(flat) + noise.horizontal_m + grown
        above = abs(d) + noise.vertical_m + grown
        # Conditional expressions, because ``max`` costs more than the arithmetic.
        bound = off if off > bound else bound
        horizontal = aside if aside > horizontal else horizontal
        vertical = above if above > vertical else vertical
    # Over long gaps the largest speed gives the tighter bound.
    way = max(abs(ends[0]), abs(ends[1])) * limits.speed_max_mps
    flat = north * north + east * east
    bound = min(bound, math.sqrt(flat + down * down) + noise.position_m + way)
    horizontal = min(horizontal, math.sqrt(flat) + noise.horizontal_m + way)
    vertical = min(vertical, abs(down) + noise.vertical_m + way)
    center, radius = _ball(fix, ends, radii)
    if noise.position_m + way < radius:
        center, radius = fix.position_ned_m, noise.position_m + way
    return Reach(
        bound_m=min(bound, math.hypot(horizontal, vertical)),
        horizontal_m=horizontal,
        vertical_m=vertical,
        center_ned_m=center,
        radius_m=radius,
    )


def _ball(fix: Fix, ends: tuple[float, float], radii: list[float]) -> tuple[Vector, float]:
    """Return the smallest ball around the balls at both ends, and so around all between them."""
    assert fix.velocity_ned_mps is not None
    (n, e, d), (v_n, v_e, v_d) = fix.position_ned_m, fix.velocity_ned_mps
    apart = math.sqrt(v_n * v_n + v_e * v_e + v_d * v_d) * (ends[1] - ends[0])
    radius = max(radii[0], radii[1], (radii[0] + radii[1] + apart) / 2.0)
    if apart == 0.0:
        share = 0.0
    else:
        share = min(1.0, max(0.0, (radius - radii[0]) / apart))
        if radius == radii[1]:
            share = 1.0
    s = ends[0] + share * (ends[1] - ends[0])
    return (n + s * v_n, e + s * v_e, d + s * v_d), radius
