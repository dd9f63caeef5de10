"""Bounds on the errors of a report: from the autopilot's own accuracy, or for what is relayed."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.values import FloatArray, GnssStatus, ReportNoise

QUANTISATION: Final = 0.02
"""m, m/s: what GLOBAL_POSITION_INT's own steps (1.1 cm, 1 cm/s) can be off, whatever is claimed."""
ADSB_TIME_BOUND_S: Final = 1.0
"""``tslc`` is in whole seconds."""
ADSB_NOISE_M: Final = 100.0
"""Above what most transponders vouch for (NACp 8: 93 m), and pressure altitude's steps."""
ADSB_VELOCITY_NOISE_MPS: Final = 10.0
"""NACv 1."""


@dataclass(frozen=True, slots=True)
class NoiseSettings:
    """``default`` holds where nothing better is known; ``factor`` times a reported accuracy (a
    standard deviation or a 68 % radius, as receivers have it) is taken for a bound; None ignores
    what is reported."""

    default: ReportNoise
    factor: float | None


def reported(status: GnssStatus, settings: NoiseSettings) -> ReportNoise:
    """The bounds by GPS_RAW_INT, field by field where it is sent."""
    default, factor = settings.default, settings.factor
    if factor is None:
        return default
    horizontal_m = _bound(status.h_acc_m, factor, default.horizontal_m)
    vertical_m = _bound(status.v_acc_m, factor, default.vertical_m)
    return ReportNoise(
        horizontal_m,
        vertical_m,
        math.hypot(horizontal_m, vertical_m),
        _bound(status.vel_acc_mps, factor, default.velocity_mps),
    )


def _bound(accuracy: float | None, factor: float, default: float) -> float:
    return default if accuracy is None else max(QUANTISATION, factor * accuracy)


def relayed(
    velocity_ned_mps: FloatArray | None, alt_age_s: float, speed_max_mps: float
) -> ReportNoise:
    """Of an ADS-B report: a time in whole seconds is worth the way flown in one, and an altitude
    that was true at another time what can be climbed between."""
    if velocity_ned_mps is None:
        way_m = ADSB_TIME_BOUND_S * speed_max_mps
    else:
        way_m = ADSB_TIME_BOUND_S * float(np.sqrt(velocity_ned_mps @ velocity_ned_mps))
    off_m = ADSB_NOISE_M + way_m
    vertical_m = off_m + alt_age_s * speed_max_mps
    return ReportNoise(off_m, vertical_m, math.hypot(off_m, vertical_m), ADSB_VELOCITY_NOISE_MPS)
