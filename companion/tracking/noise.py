"""Bounds on the errors of a report, by the autopilot's stated accuracy or for ADS-B."""

import math
from dataclasses import dataclass
from typing import Final

from companion.values import GnssStatus, ReportNoise, Vector

QUANTISATION: Final = 0.02
"""Least noise bound, m and m/s, whatever accuracy is stated.

GLOBAL_POSITION_INT has steps of 1.1 cm and 1 cm/s.
"""
ADSB_TIME_BOUND_S: Final = 1.0
"""Uncertainty of the time of an ADS-B report: ``tslc`` is in whole seconds."""
ADSB_NOISE_M: Final = 100.0
"""Bound on the position error of an ADS-B report.

It is above what most transponders vouch for (NACp 8: 93 m) and above the steps of pressure
altitude.
"""
ADSB_VELOCITY_NOISE_MPS: Final = 10.0
"""Bound on the velocity error of an ADS-B report (NACv 1)."""


@dataclass(frozen=True, slots=True)
class NoiseSettings:
    """How noise bounds are found.

    default  bounds where nothing better is known
    factor   multiple of a stated accuracy (a standard deviation or 68 % radius, as receivers
             have it) that is taken as a bound; None: stated accuracies are ignored
    """

    default: ReportNoise
    factor: float | None


def reported(status: GnssStatus, settings: NoiseSettings) -> ReportNoise:
    """The noise bounds by GPS_RAW_INT, field by field where it is sent."""
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


def relayed(velocity_ned_mps: Vector | None, alt_age_s: float, speed_max_mps: float) -> ReportNoise:
    """The noise bounds of an ADS-B report.

    The uncertainty of its time adds the distance flown in it, and an altitude that was true
    ``alt_age_s`` apart adds what can be climbed in that time.
    """
    if velocity_ned_mps is None:
        way_m = ADSB_TIME_BOUND_S * speed_max_mps
    else:
        way_m = ADSB_TIME_BOUND_S * math.hypot(*velocity_ned_mps)
    off_m = ADSB_NOISE_M + way_m
    vertical_m = off_m + alt_age_s * speed_max_mps
    return ReportNoise(off_m, vertical_m, math.hypot(off_m, vertical_m), ADSB_VELOCITY_NOISE_MPS)
