"""Attitude of the carrier at a time, extrapolated from a report, with the bound that this adds."""

import math
from dataclasses import dataclass

from companion.tracking.carrier import (
    AttitudeBounds,
    Contradiction,
    body_from_ned,
    body_rates,
    later_body_from_body,
)
from companion.tracking.rotations import angle_between_rad
from companion.values import Attitude, FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExtrapolatedAttitude:
    """Attitude at a time, extrapolated from one report.

    body_from_local      (3, 3) rotation matrix
    age_s                time since the report; negative: it is a later one
    doubt_s              bound on the error of that age
    extrapolation_rad    bound on the error that the extrapolation adds to that of the report
    acceleration_radps2  greatest angular acceleration
    """

    body_from_local: FloatArray
    age_s: float
    doubt_s: float
    extrapolation_rad: float
    acceleration_radps2: float

    def turned_from(self, other: "ExtrapolatedAttitude") -> float:
        """Return a bound on the rotation between two poses."""
        angle = angle_between_rad(self.body_from_local, other.body_from_local)
        return angle + self.extrapolation_rad + other.extrapolation_rad

    def extrapolated_since(self, earlier: "ExtrapolatedAttitude") -> float:
        """Return the bound on the error that the extrapolation adds since an earlier pose.

        Both are from the same report, whose rates may be wrong by the acceleration since then.
        """
        elapsed_s = abs(self.age_s - earlier.age_s)
        from_s = min(abs(self.age_s), abs(earlier.age_s)) + self.doubt_s
        return self.acceleration_radps2 * (from_s + elapsed_s / 2.0) * elapsed_s


def of_station(body_from_local: FloatArray) -> ExtrapolatedAttitude:
    """Return the pose of a fixed station."""
    return ExtrapolatedAttitude(
        body_from_local=body_from_local,
        age_s=0.0,
        doubt_s=0.0,
        extrapolation_rad=0.0,
        acceleration_radps2=0.0,
    )


def extrapolated(
    attitude: Attitude,
    *,
    age_s: float,
    doubt_s: float,
    bounds: AttitudeBounds,
    contradicted: Contradiction | None,
    local_from_ned: FloatArray,
) -> ExtrapolatedAttitude:
    """Return an attitude extrapolated at its body rates over its age, known to ``doubt_s``.

    bounds          bounds on the attitude and on its acceleration
    contradicted    contradiction with the previous attitude, if any
    local_from_ned  rotation from north-east-down at the carrier to the local frame
    """
    rates = body_rates(attitude)
    rate_radps = math.hypot(*rates.tolist())
    extrapolation = bounds.at(rate_radps, age_s, doubt_s) - bounds.attitude_rad
    if contradicted is not None:
        extrapolation += contradicted.at(abs(age_s) + doubt_s)
    then = body_from_ned(attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad)
    return ExtrapolatedAttitude(
        body_from_local=later_body_from_body(rates, age_s) @ then @ local_from_ned.T,
        age_s=age_s,
        doubt_s=doubt_s,
        extrapolation_rad=extrapolation,
        acceleration_radps2=bounds.acceleration_radps2,
    )
