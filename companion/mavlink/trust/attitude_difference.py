"""Attitudes of one vehicle over two peers, and whether both can be right.

Positions that agree prove nothing about attitudes: a stranger may repeat the first, and turn the
second. Both peers deliver messages of one estimator, so they differ by what the vehicle turns
between their stamps.
"""

import math
import struct
from typing import Final

from companion.mavlink.wire.payload import unpack
from companion.mavlink.wire.stamps import step_ms
from companion.values import Frame

APART_MS: Final = 150  # longest time between two stamps that are compared
SLACK_RAD: Final = math.radians(5.0)
TURN_RADPS2: Final = math.radians(360.0)  # largest angular acceleration, of a small copter
_FIELDS: Final = struct.Struct("<Iffffff")


def contradict(one: Frame, other: Frame) -> bool:
    """Return whether two ATTITUDE messages differ by more than a vehicle turns in between."""
    boot_ms, *angles = unpack(one, _FIELDS)
    other_boot_ms, *other_angles = unpack(other, _FIELDS)
    apart_ms = abs(step_ms(boot_ms, other_boot_ms))
    if apart_ms > APART_MS or not all(map(math.isfinite, (*angles, *other_angles))):
        return False
    apart_s = apart_ms * 1e-3
    fastest_radps = max(math.hypot(*angles[3:]), math.hypot(*other_angles[3:]))
    turned_rad = fastest_radps * apart_s + TURN_RADPS2 * apart_s**2 / 2
    return _between_rad(angles[:3], other_angles[:3]) > SLACK_RAD + turned_rad


def _between_rad(one: list[float], other: list[float]) -> float:
    """Return the angle of the rotation between two attitudes, each roll, pitch and yaw."""
    cosine = abs(sum(a * b for a, b in zip(_quaternion(*one), _quaternion(*other), strict=True)))
    return 2.0 * math.acos(min(1.0, cosine))


def _quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    (a, b), (c, d), (e, f) = ((math.cos(one / 2), math.sin(one / 2)) for one in (roll, pitch, yaw))
    return (
        a * c * e + b * d * f,
        b * c * e - a * d * f,
        a * d * e + b * c * f,
        a * c * f - b * d * e,
    )
