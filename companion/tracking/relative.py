"""Position and motion of a UAV relative to the array, with bounds on both."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from companion.tracking.moved_caps import Motion
from companion.values import Cap, Carrier, Fix, FloatArray, Track, Vector


class ErrorBounds(NamedTuple):
    """Bounds on the error W of reported attitudes.

    largest_rad  largest angle of W
    turning_rad  largest part of it that turns with the carrier, as does the error of a mount
    """

    largest_rad: float
    turning_rad: float


class ReportedVelocity(NamedTuple):
    """Velocity at ``t_ns`` as a vehicle reported it, local frame, with what it may differ by.

    noise_mps              bound on its error
    acceleration_max_mps2  largest acceleration before and after
    time_bound_s           bound on the error of its time
    """

    t_ns: int
    velocity_ned_mps: Vector
    noise_mps: float
    acceleration_max_mps2: float
    time_bound_s: float

    def error_m(self, from_ns: int, to_ns: int) -> float:
        """Return the bound on the displacement between two times less that at this velocity."""
        first_s, last_s = (from_ns - self.t_ns) * 1e-9, (to_ns - self.t_ns) * 1e-9
        length_s = abs(last_s - first_s)
        squares = last_s * abs(last_s) - first_s * abs(first_s)  # twice the integral of |s|
        gained = abs(squares) / 2.0 + self.time_bound_s * length_s
        return self.noise_mps * length_s + self.acceleration_max_mps2 * gained


def reported_velocity(fix: Fix, track: Track) -> ReportedVelocity | None:
    """Return the velocity of a report, with the limits of its track; None if it has none."""
    if fix.velocity_ned_mps is None:
        return None
    return ReportedVelocity(
        t_ns=fix.t_ns,
        velocity_ned_mps=fix.velocity_ned_mps,
        noise_mps=fix.noise.velocity_mps,
        acceleration_max_mps2=track.limits.acceleration_max_mps2,
        time_bound_s=track.clock_bound_s,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Relative:
    """Position of a UAV relative to the array at ``t_ns``, and both their motions.

    offset_ned_m              position, (3,), local frame
    error_m                   bound on its error
    uav, carrier              reported velocities; None for a fixed station
    turn_radps                angular rate of the carrier
    turn_acceleration_radps2  its largest angular acceleration
    lever_arm_m               distance of the array from the carrier's reported point
    """

    t_ns: int
    offset_ned_m: FloatArray
    error_m: float
    uav: ReportedVelocity
    carrier: ReportedVelocity | None
    turn_radps: float
    turn_acceleration_radps2: float
    lever_arm_m: float

    @property
    def reported(self) -> Cap:
        """Directions in which the UAV may be, local frame."""
        range_m = math.sqrt(self.offset_ned_m @ self.offset_ned_m)
        if range_m <= self.error_m:
            return Cap(np.array([1.0, 0.0, 0.0]), math.pi)
        return Cap(self.offset_ned_m / range_m, math.asin(self.error_m / range_m))

    def turned_rad(self, elapsed_s: float) -> float:
        """Return the largest rotation of the carrier before or after this time."""
        return (self.turn_radps + self.turn_acceleration_radps2 * elapsed_s / 2.0) * elapsed_s

    def swept_rad(self, elapsed_s: float) -> float:
        """Return the largest rotation of the UAV's direction, in the array's frame, in a time."""
        if elapsed_s == 0.0:
            return 0.0
        moved_m, error_m = self._moved(self.t_ns, self.t_ns + round(elapsed_s * 1e9))
        range_m = math.sqrt(self.offset_ned_m @ self.offset_ned_m) - self.error_m
        way_m = math.sqrt(moved_m @ moved_m) + error_m
        if way_m >= range_m:
            return math.pi
        return math.asin(way_m / range_m) + self.turned_rad(elapsed_s)

    def _moved(self, from_ns: int, to_ns: int) -> tuple[FloatArray, float]:
        elapsed_s = (to_ns - from_ns) * 1e-9
        velocity, error_m = np.array(self.uav.velocity_ned_mps), self.uav.error_m(from_ns, to_ns)
        if self.carrier is not None:
            velocity = velocity - self.carrier.velocity_ned_mps
            error_m += self.carrier.error_m(from_ns, to_ns)
        return velocity * elapsed_s, error_m

    def motion(
        self,
        *,
        from_ns: int,
        to_ns: int,
        turned_rad: float,
        misaligned: ErrorBounds,
        drifted_rad: float,
    ) -> Motion:
        """Return the motion between two times, of which this is one.

            turned_rad        bound on the rotation of the carrier between them
            misaligned        bounds on the error of the reported attitude
            drifted_rad       bound on the change of that error

        An error that is constant in the body frame turns with the carrier in the local frame.
        """
        moved_m, error_m = self._moved(from_ns, to_ns)
        turned_rad = min(turned_rad, 2.0)
        error_m += turned_rad * self.lever_arm_m
        before_m = self.offset_ned_m if from_ns == self.t_ns else self.offset_ned_m - moved_m
        return Motion(
            moved_ned_m=moved_m,
            error_m=error_m,
            range_m=math.sqrt(before_m @ before_m),
            range_error_m=self.error_m + error_m,
            misalignment_rad=misaligned.largest_rad,
            turned_rad=drifted_rad + turned_rad * misaligned.turning_rad,
        )


def relative(
    track: Track,
    fix: Fix,
    *,
    carrier: Carrier,
    carrier_track: Track | None,
    carrier_fix: Fix | None,
    lever_ned_m: FloatArray,
    turn_acceleration_radps2: float,
) -> Relative | None:
    """Return a UAV's position relative to the array; None without velocities.

    track, fix         the UAV's track at a time, and its newest report
    carrier            the array's pose at that time
    carrier_track, carrier_fix
                       those of the vehicle that carries the array; None for a station
    lever_ned_m        position of the array relative to the carrier's reported point
    """
    moving, own = reported_velocity(fix, track), None
    if carrier_track is not None and carrier_fix is not None:
        own = reported_velocity(carrier_fix, carrier_track)
        if own is None:
            return None
    if moving is None:
        return None
    lever_m = math.sqrt(lever_ned_m @ lever_ned_m)
    rates = carrier.body_rates_radps
    swung_m = 2.0 * math.sin(min(carrier.attitude_bound_rad, math.pi) / 2.0) * lever_m
    return Relative(
        t_ns=track.valid_at_ns,
        offset_ned_m=track.position_ned_m - carrier.position_ned_m - lever_ned_m,
        error_m=track.bound_m + carrier.bound_m + swung_m,
        uav=moving,
        carrier=own,
        turn_radps=math.sqrt(rates @ rates),
        turn_acceleration_radps2=turn_acceleration_radps2,
        lever_arm_m=lever_m,
    )
