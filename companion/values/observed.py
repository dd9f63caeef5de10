"""Measurements of the array's own receiver: the direction of a UAV, or powers through beams."""

import math
from dataclasses import dataclass
from typing import Annotated, Final

from companion.values.described import Meaning
from companion.values.errors import shown
from companion.values.names import UAV_FORMS, is_uav_id

READINGS_MIN: Final = 2  # least powers of one observation: only their differences are used
READINGS_MAX: Final = 256  # most powers of one observation
TIME_BOUND_MAX_NS: Final = 10_000_000_000
POWER_MAX_DB: Final = 300.0  # largest power, and the least with the sign changed
POWER_BOUND_MAX_DB: Final = 60.0
BEAMS_MAX: Final = 1 << 16  # indices of beams are below this
UPDATES_MAX: Final = 1 << 32  # numbers of updates are below this: ten a second for 13 years
_LATEST_NS: Final = 1 << 62
"""Latest time, the year 2116: results computed from times fit into 63 bits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """Event: what the array's receiver measured of one UAV.

    Either a direction (``azimuth_rad``, ``elevation_rad``, ``bound_rad``) or powers (``beams``,
    ``powers_db``, ``power_bound_db``) is given. Angles are in the array frame. ``powers_db`` are
    relative: only their differences are used, so that transmit power, range and gain of the
    receiver do not matter. The true measurement time is within ``time_bound_ns`` of
    ``measured_ns``.
    """

    t_ns: Annotated[int, Meaning("when the measurement arrived", 1)]
    measured_ns: Annotated[int, Meaning("when it was made", 2)]
    time_bound_ns: Annotated[
        int, Meaning("largest error of the time at which it was made", 3, wire="uint64")
    ] = 0
    uav: Annotated[str, Meaning("UAV that was measured", 4, label="UAV", example="3:1")]
    azimuth_rad: Annotated[
        float | None, Meaning("direction in the array's frame, right of boresight positive", 5)
    ] = None
    elevation_rad: Annotated[
        float | None, Meaning("direction in the array's frame, above boresight positive", 6)
    ] = None
    bound_rad: Annotated[
        float | None, Meaning("largest angle between the measured and the true direction", 7)
    ] = None
    update: Annotated[
        int | None,
        Meaning(
            "number of the update whose weights were used; null: beams of the codebook were used", 8
        ),
    ] = None
    beams: Annotated[
        tuple[int, ...],
        Meaning("beams through which power was measured: indices of columns, from 0", 9),
    ] = ()
    powers_db: Annotated[
        tuple[float, ...], Meaning("power through each of these beams, on any common scale", 10)
    ] = ()
    power_bound_db: Annotated[float | None, Meaning("largest error of each power", 11)] = None

    @property
    def is_direction(self) -> bool:
        """Whether a direction was measured, not powers."""
        return self.azimuth_rad is not None


def reason_invalid(observation: Observation) -> str | None:
    """Return why an observation is invalid, in one line; None: it is valid.

    Every way in uses these rules: HTTP, UDP and recordings.
    """
    if not is_uav_id(observation.uav):
        return f"uav: {shown(observation.uav)} is not {UAV_FORMS}"
    for name, t_ns in (("arrival", observation.t_ns), ("measured_at", observation.measured_ns)):
        if not 0 <= t_ns < _LATEST_NS:
            return f"{name}: time is before 1970 or after 2116"
    if not 0 <= observation.time_bound_ns <= TIME_BOUND_MAX_NS:
        return f"time_bound: is not within 0 and {TIME_BOUND_MAX_NS / 1e9:g} s"
    angles = (observation.azimuth_rad, observation.elevation_rad, observation.bound_rad)
    has_powers = bool(observation.beams or observation.powers_db)
    if angles == (None, None, None):
        if not has_powers:
            return "neither a direction nor powers are given; give one of them"
        return _reason_invalid_powers(observation)
    if has_powers or observation.power_bound_db is not None or observation.update is not None:
        return "both a direction and powers are given; give one of them"
    return _reason_invalid_direction(*angles)


def _reason_invalid_direction(
    azimuth_rad: float | None, elevation_rad: float | None, bound_rad: float | None
) -> str | None:
    if azimuth_rad is None or elevation_rad is None or bound_rad is None:
        return "direction is incomplete; give azimuth, elevation and bound"
    if not abs(azimuth_rad) <= math.pi:
        return "azimuth: is not within -180 and 180 degrees"
    if not abs(elevation_rad) <= math.pi / 2:
        return "elevation: is not within -90 and 90 degrees"
    if not 0 < bound_rad <= math.pi:
        return "bound: is not above 0 and at most 180 degrees"
    return None


def _reason_invalid_powers(observation: Observation) -> str | None:
    beams, powers_db = observation.beams, observation.powers_db
    if len(beams) != len(powers_db):
        return f"beams: {len(beams)} beams and {len(powers_db)} powers; give one power for each"
    if not READINGS_MIN <= len(powers_db) <= READINGS_MAX:
        return f"powers_db: {len(powers_db)} powers; give {READINGS_MIN} to {READINGS_MAX}"
    if not all(0 <= beam < BEAMS_MAX for beam in beams):
        return f"beams: an index is not within 0 and {BEAMS_MAX - 1}"
    if len(set(beams)) < len(beams):
        return "beams: a beam is named twice; give one power for each"
    if not all(abs(power_db) <= POWER_MAX_DB for power_db in powers_db):  # nor NaN
        return f"powers_db: a power is not within -{POWER_MAX_DB:g} and {POWER_MAX_DB:g} dB"
    bound_db = observation.power_bound_db
    if bound_db is None:
        return "power_bound_db: is missing; give the largest error of each power"
    if not 0 <= bound_db <= POWER_BOUND_MAX_DB:
        return f"power_bound_db: is not within 0 and {POWER_BOUND_MAX_DB:g} dB"
    if observation.update is not None and not 0 <= observation.update < UPDATES_MAX:
        return f"update: is not within 0 and {UPDATES_MAX - 1}"
    return None
