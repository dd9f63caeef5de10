"""Parts of the bound on a beam's direction, by the input that causes each of them.

The bound is the sum of the carrier's attitude error and of both position errors as seen from the
array (docs/math.md 5.3). Each part is what would be gained if one input were ideal and all others
stayed as they are.
"""

import math
from collections.abc import Mapping
from enum import Enum, auto
from typing import Final

from companion.tracking.carrier import AttitudeParts
from companion.values import Beam, Carrier, Track

GROWN: Final = 0.1
"""Share of the bound by which a part must have grown to be what changed since the link was good."""


class ErrorSource(Enum):
    """Input that causes a part of a pointing bound."""

    MACHINE = auto()  # time for which frames waited for this machine
    ATTITUDE = auto()  # error of the carrier's attitude when it was measured
    ATTITUDE_AGE = auto()  # age of that attitude, without the wait for this machine
    ATTITUDE_CLOCK = auto()  # uncertainty of the carrier's clock
    ATTITUDE_CONFLICT = auto()  # contradiction between two attitudes
    CARRIER_POSITION = auto()  # error of the carrier's position
    AGE = auto()  # age of the UAV's report, without the wait for this machine
    CLOCK = auto()  # uncertainty of the UAV's clock
    POSITION = auto()  # error of the reported position, and the rest


AngleParts = Mapping[ErrorSource, float]
"""Parts of a pointing bound, rad; their sum is about the bound."""


def grown(parts: AngleParts, when_good: AngleParts) -> ErrorSource | None:
    """Return the part that grew most since the link was good; None if none grew.

    What has grown is what made the link worse, even if another part is larger.
    """
    growth = {part: parts[part] - when_good[part] for part in ErrorSource}
    most = max(growth, key=growth.__getitem__)
    return most if growth[most] > GROWN * sum(parts.values()) else None


def largest(parts: AngleParts) -> ErrorSource:
    """Return the largest part."""
    return max(parts, key=parts.__getitem__)


def angle_parts(
    beam: Beam, track: Track, carrier: Carrier, attitude: AttitudeParts, waited_s: float
) -> AngleParts:
    """Return the parts of a beam's pointing bound.

    attitude  parts of the bound on the carrier's attitude
    waited_s  time for which frames may have waited for this machine
    """
    aged_s = track.age_s
    fresh_s = max(aged_s - waited_s, 0.0)
    growth_m, fresh_m = _growth_m(track, aged_s), _growth_m(track, fresh_s)
    doubted_m = _growth_m(track, aged_s + track.clock_bound_s) - growth_m
    if track.velocity_ned_mps is not None:
        doubted_m += math.hypot(*track.velocity_ned_mps) * track.clock_bound_s
    growth_m = min(growth_m, track.bound_m)
    doubted_m = min(doubted_m, track.bound_m - growth_m)
    rad_per_m = 1.0 / max(beam.range_m, track.bound_m + carrier.bound_m, 1e-9)
    return {
        ErrorSource.MACHINE: attitude.waiting_rad + max(growth_m - fresh_m, 0.0) * rad_per_m,
        ErrorSource.ATTITUDE: attitude.error_rad,
        ErrorSource.ATTITUDE_AGE: attitude.age_rad,
        ErrorSource.ATTITUDE_CLOCK: attitude.clock_rad,
        ErrorSource.ATTITUDE_CONFLICT: attitude.conflict_rad,
        ErrorSource.CARRIER_POSITION: carrier.bound_m * rad_per_m,
        ErrorSource.AGE: min(fresh_m, growth_m) * rad_per_m,
        ErrorSource.CLOCK: doubted_m * rad_per_m,
        ErrorSource.POSITION: (track.bound_m - growth_m - doubted_m) * rad_per_m,
    }


def _growth_m(track: Track, seconds: float) -> float:
    """Return how far a UAV can deviate within a time from the prediction of its last report."""
    way_m = track.limits.speed_max_mps * seconds
    if track.velocity_ned_mps is None:
        return way_m
    return min(track.limits.acceleration_max_mps2 * seconds**2 / 2, way_m)
