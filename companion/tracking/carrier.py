"""Position and attitude of the array's carrier at the time of use.

Rotations are named by frames: ``body_from_ned @ v_ned`` is v in body axes (FRD).
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.tracking.geodesy import LocalFrame
from companion.tracking.limits import MAX_PLAUSIBLE_RATIO, RaisedLimit
from companion.tracking.rotations import rotation, rotation_angle_rad
from companion.values import Attitude, Carrier, EstimatorStatus, Fix, FloatArray, Refuted, Track


def body_from_ned(roll_rad: float, pitch_rad: float, yaw_rad: float) -> FloatArray:
    """Return the rotation (3, 3) from north-east-down to body axes for roll, pitch, yaw, rad.

    Angles are MAVLink's: yaw rotates about z, then pitch about y, then roll about x. Source: the
    aerospace sequence 3-2-1, e.g. Groves, Principles of GNSS (2013), eq. 2.22.
    """
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    cy, sy = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array(
        [
            [cp * cy, cp * sy, -sp],
            [sr * sp * cy - cr * sy, sr * sp * sy + cr * cy, sr * cp],
            [cr * sp * cy + sr * sy, cr * sp * sy - sr * cy, cr * cp],
        ]
    )


def later_body_from_body(body_rates_radps: FloatArray, interval_s: float) -> FloatArray:
    """Return the rotation (3, 3) from body axes now to body axes ``interval_s`` later.

    ``body_rates_radps`` (3,) are constant rates about the body axes. Rodrigues' formula for the
    rotation vector -rates * interval; the sign is negative because coordinates rotate opposite to
    the body.
    """
    return rotation(-interval_s * body_rates_radps)


USUAL_ATTITUDE: Final = 0.45
"""Ratio of the 95th percentile of attitude errors to their bound.

Simulated copters had 1.3 degrees, mostly a constant compass error, at a bound of 3.
"""


def fixed(
    valid_at_ns: int, local: LocalFrame, place: tuple[float, float, float], heading_rad: float
) -> Carrier:
    """Return the carrier of a fixed, level station.

    ``place`` is the position: latitude and longitude in degrees and height in metres;
    ``heading_rad`` is clockwise from true north.
    """
    body_from_local = body_from_ned(0.0, 0.0, heading_rad) @ local.local_from_ned(*place[:2]).T
    still = np.zeros(3)
    return Carrier(
        valid_at_ns=valid_at_ns,
        position_ned_m=local.position_ned_m(*place),
        velocity_ned_mps=still,
        body_from_local=body_from_local,
        body_rates_radps=still,
        bound_m=0.0,
        attitude_bound_rad=0.0,
        age_s=None,
        error_p95_m=0.0,
        attitude_p95_rad=0.0,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class AttitudeParts:
    """Parts of the bound on the carrier's attitude by their causes, rad; their sum is the bound."""

    error_rad: float = 0.0  # error of the reported attitude
    age_rad: float = 0.0  # extrapolation over its age, without the wait for this machine
    waiting_rad: float = 0.0  # extrapolation over the wait for this machine
    clock_rad: float = 0.0  # uncertainty of its age
    conflict_rad: float = 0.0  # contradiction with the previous attitude


@dataclass(frozen=True, slots=True)
class AttitudeBounds:
    """Bounds on the error of an attitude that is extrapolated at its rates."""

    attitude_rad: float  # bound on the reported attitude, as an angle
    acceleration_radps2: float  # greatest angular acceleration

    def at(self, rate_radps: float, age_s: float, doubt_s: float) -> float:
        """Return the bound after ``age_s`` (known to ``doubt_s``) at an angular rate (norm), rad.

        See docs/math.md 5.3.
        """
        furthest_s = abs(age_s) + doubt_s
        turned = self.acceleration_radps2 * furthest_s * furthest_s / 2.0
        return min(math.pi, self.attitude_rad + rate_radps * doubt_s + turned)

    def parts(
        self,
        rate_radps: float,
        age_s: float,
        doubt_s: float,
        *,
        waited_s: float,
        conflict_rad: float,
    ) -> AttitudeParts:
        """Return the parts of the bound ``at``; frames waited ``waited_s`` for this machine."""
        aged = self.at(rate_radps, age_s, 0.0)
        fresh = self.at(rate_radps, max(abs(age_s) - waited_s, 0.0), 0.0)
        return AttitudeParts(
            error_rad=self.attitude_rad,
            age_rad=fresh - self.attitude_rad,
            waiting_rad=aged - fresh,
            clock_rad=self.at(rate_radps, age_s, doubt_s) - aged,
            conflict_rad=conflict_rad,
        )


@dataclass(frozen=True, slots=True)
class Contradiction:
    """Two attitudes of which at least one is wrong: neither follows from the other at its rates."""

    apart_rad: float  # unexplained rotation, as an angle
    apart_s: float  # time between them

    def at(self, age_s: float) -> float:
        """Return the bound on the newer attitude after a time, whichever is right; rad.

        A wrong angular rate causes ``apart_rad`` in ``apart_s``.
        """
        return min(math.pi, self.apart_rad * (1.0 + abs(age_s) / self.apart_s))


APART_MAX_S: Final = 1.0  # longest time between two attitudes that are compared


def contradiction(
    before: Attitude, after: Attitude, apart_s: float, bounds: AttitudeBounds
) -> Contradiction | None:
    """Return how an attitude contradicts the previous one beyond both errors; else None.

    Each is extrapolated to the other's time at its own rates: forward reveals a wrong angle,
    backward a wrong rate. ``apart_s`` is positive.
    """
    if apart_s > APART_MAX_S:
        return None
    limit_rad = agreement_rad(apart_s, bounds)
    if _most_apart_rad(before, after, apart_s) <= limit_rad:
        return None  # nearly always, without a matrix
    first = body_from_ned(before.roll_rad, before.pitch_rad, before.yaw_rad)
    second = body_from_ned(after.roll_rad, after.pitch_rad, after.yaw_rad)
    forward = later_body_from_body(body_rates(before), apart_s) @ first @ second.T
    back = later_body_from_body(body_rates(after), -apart_s) @ second @ first.T
    apart_rad = max(rotation_angle_rad(forward), rotation_angle_rad(back))
    return Contradiction(apart_rad, apart_s) if apart_rad > limit_rad else None


def agreement_rad(apart_s: float, bounds: AttitudeBounds) -> float:
    """Return how far apart two right attitudes may be, extrapolated over the time between them."""
    return bounds.at(0.0, apart_s, STAMP_S) + bounds.attitude_rad


def _most_apart_rad(before: Attitude, after: Attitude, apart_s: float) -> float:
    """Return an upper bound on the rotation between two attitudes that their rates leave open.

    A rotation is at most the sum of the three successive ones that make it up, and of the two
    between which it is a difference.
    """
    steps_rad = (
        abs(math.remainder(after.roll_rad - before.roll_rad, math.tau))
        + abs(math.remainder(after.pitch_rad - before.pitch_rad, math.tau))
        + abs(math.remainder(after.yaw_rad - before.yaw_rad, math.tau))
    )
    fastest_radps = max(
        math.hypot(one.rollspeed_radps, one.pitchspeed_radps, one.yawspeed_radps)
        for one in (before, after)
    )
    return steps_rad + fastest_radps * apart_s


def body_rates(attitude: Attitude) -> FloatArray:
    """Return the angular rates of an attitude about the body axes, rad/s."""
    return np.array([attitude.rollspeed_radps, attitude.pitchspeed_radps, attitude.yawspeed_radps])


STAMP_S: Final = 1e-3  # largest error of a stamp in whole milliseconds
COMPASS_RAD: Final = 0.6
"""Angle between compass and attitude at a compass ratio of 1.

ArduPilot accepts 3 deviations of 0.05 gauss; the Earth's field is 0.25 horizontally (0.15 to 0.4).
"""


def reported_bound_rad(status: EstimatorStatus | None, least_rad: float) -> float:
    """Return the bound on reported attitudes, given the autopilot's estimator status.

    A ratio shows the difference between compass and gyroscopes, not their common error, so it never
    reduces the bound (docs/math.md 5.3).
    """
    if status is None:
        return least_rad
    if not status.knows_attitude:
        return math.pi
    return min(math.pi, max(least_rad, COMPASS_RAD * status.compass_ratio))


RATES_APART_S: Final = 0.05
"""Least time between two angular rates that are compared, since stamps are whole milliseconds."""
RATE_NOISE_DEGPS: Final = 2.0  # bound on the error of a reported angular rate


class AngularAcceleration:
    """Limit of a carrier's angular acceleration, raised by what reported rates prove."""

    def __init__(self) -> None:
        self._raised = RaisedLimit()
        self._newest: tuple[int, float, float, float] | None = None

    def limit_degps2(self, base_degps2: float, sender_ns: int) -> float:
        """Return the limit of angular acceleration at a sender time."""
        return self._raised.at(base_degps2, sender_ns)

    def look(self, attitude: Attitude, sender_ns: int, base_degps2: float) -> Refuted | None:
        """Check an attitude. Return the refutation of the limit, which is then raised, if any."""
        rates = (attitude.rollspeed_radps, attitude.pitchspeed_radps, attitude.yawspeed_radps)
        before = self._newest
        if before is not None and sender_ns - before[0] < RATES_APART_S * 1e9:
            return None
        self._newest = (sender_ns, *rates)
        if before is None:
            return None
        apart_s = (sender_ns - before[0]) * 1e-9 + STAMP_S
        changed_degps = math.degrees(math.dist(rates, before[1:]))
        proven = (changed_degps - 2 * RATE_NOISE_DEGPS) / apart_s
        limit = self._raised.at(base_degps2, sender_ns)
        if not limit < proven < MAX_PLAUSIBLE_RATIO * base_degps2:
            return None
        to = self._raised.raise_above(proven, sender_ns)
        return Refuted(
            t_ns=attitude.t_ns,
            uav=str(attitude.source),
            setting="center.turn_acceleration_max_degps2",
            limit=limit,
            proven=proven,
            raised_to=to,
        )


def moving(
    local: LocalFrame,
    track: Track,
    newest: Fix,
    *,
    attitude: Attitude,
    since_ns: int,
    doubt_s: float,
    bounds: AttitudeBounds,
    contradicted: Contradiction | None,
) -> Carrier:
    """Return the carrier aboard a vehicle, at the time of its track.

    track         the vehicle's track: position, velocity and bound
    newest        its newest report; its north and down are used, a few metres away
    attitude      its newest attitude, extrapolated at its body rates
    since_ns      age of that attitude at the track's time
    doubt_s       bound on the error of that age
    bounds        bounds on the attitude and on its acceleration
    contradicted  contradiction with the previous attitude, if any
    """
    rates = body_rates(attitude)
    age_s = since_ns * 1e-9
    bound_rad = bounds.at(math.hypot(*rates.tolist()), age_s, doubt_s)
    if contradicted is not None:
        bound_rad = min(math.pi, bound_rad + contradicted.at(abs(age_s) + doubt_s))
    then = body_from_ned(attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad)
    local_from_ned = local.local_from_ned(newest.report.lat_deg, newest.report.lon_deg)
    return Carrier(
        valid_at_ns=track.valid_at_ns,
        position_ned_m=track.position_ned_m,
        velocity_ned_mps=track.velocity_ned_mps,
        body_from_local=later_body_from_body(rates, age_s) @ then @ local_from_ned.T,
        body_rates_radps=rates,
        bound_m=track.bound_m,
        attitude_bound_rad=bound_rad,
        age_s=track.age_s,
        error_p95_m=track.error_p95_m,
        attitude_p95_rad=USUAL_ATTITUDE * bounds.attitude_rad,
        extrapolation_rad=max(bound_rad - bounds.attitude_rad, 0.0),
    )
