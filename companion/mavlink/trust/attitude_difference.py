"""Attitudes of one vehicle over two peers, and whether both can be right.

Positions that agree prove nothing about attitudes: a stranger may repeat the first, and turn the
second. Both peers deliver messages of one estimator, so they differ by what the vehicle turns
between their stamps.
"""

import math
from typing import Final

from companion.mavlink.wire.decode import decode
from companion.mavlink.wire.stamps import stamp_step
from companion.values import Attitude, Frame

APART_MS: Final = 150  # longest time between two stamps that are compared
SLACK_RAD: Final = math.radians(5.0)
TURN_RADPS2: Final = math.radians(360.0)  # largest angular acceleration, of a small copter


def contradict(one: Frame, other: Frame) -> bool:
    """Return whether two ATTITUDE messages differ by more than a vehicle turns in between."""
    first, second = decode(one), decode(other)
    if not isinstance(first, Attitude) or not isinstance(second, Attitude):
        return False
    apart_ms = abs(stamp_step(first.boot_ms, second.boot_ms))
    if apart_ms > APART_MS:
        return False
    apart_s = apart_ms * 1e-3
    turned_rad = max(_rate_radps(first), _rate_radps(second)) * apart_s
    turned_rad += TURN_RADPS2 * apart_s**2 / 2
    return _between_rad(first, second) > SLACK_RAD + turned_rad


def _rate_radps(attitude: Attitude) -> float:
    return math.hypot(attitude.rollspeed_radps, attitude.pitchspeed_radps, attitude.yawspeed_radps)


def _between_rad(one: Attitude, other: Attitude) -> float:
    """Return the angle of the rotation between two attitudes."""
    pairs = zip(_quaternion(one), _quaternion(other), strict=True)
    return 2.0 * math.acos(min(1.0, abs(sum(a * b for a, b in pairs))))


def _quaternion(attitude: Attitude) -> tuple[float, float, float, float]:
    """Return the unit quaternion (w, x, y, z) of roll, pitch and yaw."""
    angles = attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad
    (a, b), (c, d), (e, f) = ((math.cos(one / 2), math.sin(one / 2)) for one in angles)
    return (
        a * c * e + b * d * f,
        b * c * e - a * d * f,
        a * d * e + b * c * f,
        a * c * f - b * d * e,
    )
