"""Paths: tours of waypoints, racetracks, orbits, and swings in bearing around the carrier.

Each path gives position, velocity, acceleration and jerk in closed form (the start of a racetrack's
turn by a quadrature exact to rounding), from which attitudes and their rates follow exactly.

Over 300 lines: a list of paths, a class each.
"""

import math
from bisect import bisect_right
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Final, NamedTuple, Self

import numpy as np

from sitl_replay.flight.motion import Kinematics, Vector

MAX_RAMP_SLOPE: Final = 1.875
"""Largest slope of ``Ramp.value``: a ramp to v in T needs an acceleration of 1.875 v / T."""

_nodes, _weights = np.polynomial.legendre.leggauss(8)
# Gauss–Legendre on 0 to 1, exact to degree 15; the course changes by about half a radian.
_QUADRATURE: Final = tuple(
    (float(node + 1.0) / 2.0, float(weight) / 2.0)
    for node, weight in zip(_nodes, _weights, strict=True)
)


class Ramp(NamedTuple):
    """Smooth step from 0 to 1 over x from 0 to 1, with its integral and two derivatives.

    The minimum-jerk polynomial 10x³ − 15x⁴ + 6x⁵ (T. Flash, N. Hogan, J. Neurosci. 5, 1985), used
    here for a speed or a turn rate.
    """

    integral: float
    value: float
    slope: float
    curvature: float

    @classmethod
    def at(cls, x: float) -> Self:
        """Return the smooth step at ``x``, which is 0 to 1."""
        cubed = x * x * x
        return cls(
            integral=cubed * x * (2.5 - 3.0 * x + x * x),
            value=cubed * (10.0 - 15.0 * x + 6.0 * x * x),
            slope=30.0 * (x * (1.0 - x)) ** 2,
            curvature=60.0 * x * (1.0 - x) * (1.0 - 2.0 * x),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Leg:
    """Straight path between two stops, then a stop in which the heading turns to the next leg.

    Speed ramps up to ``speed_mps`` within ``ramp_s``, is constant, and ramps down.
    """

    start_ned_m: Vector
    direction: Vector
    length_m: float
    speed_mps: float
    ramp_s: float
    heading_rad: float
    turn_rad: float
    stand_s: float

    @property
    def moving_s(self) -> float:
        return self.length_m / self.speed_mps + self.ramp_s

    @property
    def duration_s(self) -> float:
        return self.moving_s + self.stand_s

    def at(self, t_s: float) -> Kinematics:
        """Return the point ``t_s`` seconds after the start of the leg."""
        along, speed, acceleration, jerk = self._progress(min(t_s, self.moving_s))
        turned = Ramp.at(max(0.0, t_s - self.moving_s) / self.stand_s)
        north, east, down = self.direction
        start = self.start_ned_m
        return Kinematics(
            position_ned_m=(
                start[0] + north * along,
                start[1] + east * along,
                start[2] + down * along,
            ),
            velocity_ned_mps=(north * speed, east * speed, down * speed),
            acceleration_ned_mps2=(north * acceleration, east * acceleration, down * acceleration),
            jerk_ned_mps3=(north * jerk, east * jerk, down * jerk),
            heading_rad=self.heading_rad + self.turn_rad * turned.value,
            heading_rate_radps=self.turn_rad * turned.slope / self.stand_s,
        )

    def _progress(self, t_s: float) -> tuple[float, float, float, float]:
        """Return metres along the leg and three derivatives. The end mirrors the start in time."""
        if t_s > self.moving_s / 2.0:
            left, speed, acceleration, jerk = self._progress(self.moving_s - t_s)
            return self.length_m - left, speed, -acceleration, jerk
        speed, ramp_s = self.speed_mps, self.ramp_s
        if t_s >= ramp_s:
            return speed * (t_s - ramp_s / 2.0), speed, 0.0, 0.0
        ramp = Ramp.at(t_s / ramp_s)
        return (
            speed * ramp_s * ramp.integral,
            speed * ramp.value,
            speed * ramp.slope / ramp_s,
            speed * ramp.curvature / ramp_s**2,
        )


class Limits(NamedTuple):
    """Limits of a multirotor: speed along a leg, climb, acceleration."""

    speed_mps: float
    climb_mps: float
    acceleration_mps2: float


@dataclass(frozen=True, slots=True)
class Tour:
    """Closed tour of waypoints, with a stop at each. ``ends_s``: end time of each leg."""

    legs: tuple[Leg, ...]
    ends_s: tuple[float, ...]
    offset_s: float

    @classmethod
    def over(
        cls, waypoints: tuple[Vector, ...], limits: Limits, stand_s: float, offset_s: float
    ) -> Self:
        """Return a tour of ``waypoints`` (NED metres, none vertically above the next) and back.

        ``offset_s`` is the time into the tour at time 0.
        """
        after = (*waypoints[1:], waypoints[0])
        hops = [
            tuple(b - a for a, b in zip(here, there, strict=True))
            for here, there in zip(waypoints, after, strict=True)
        ]
        headings_rad = [math.atan2(hop[1], hop[0]) for hop in hops]
        legs = []
        for index, (start, (north, east, down)) in enumerate(zip(waypoints, hops, strict=True)):
            length_m = math.hypot(north, east, down)
            speed_mps = min(
                limits.speed_mps,
                limits.climb_mps * length_m / max(abs(down), 1e-9),
                # The speed at which the two ramps fill the leg.
                math.sqrt(length_m * limits.acceleration_mps2 / MAX_RAMP_SLOPE),
            )
            next_rad = headings_rad[(index + 1) % len(hops)]
            legs.append(
                Leg(
                    start_ned_m=start,
                    direction=(north / length_m, east / length_m, down / length_m),
                    length_m=length_m,
                    speed_mps=speed_mps,
                    ramp_s=MAX_RAMP_SLOPE * speed_mps / limits.acceleration_mps2,
                    heading_rad=headings_rad[index],
                    turn_rad=math.remainder(next_rad - headings_rad[index], math.tau),
                    stand_s=stand_s,
                )
            )
        return cls(tuple(legs), tuple(accumulate(leg.duration_s for leg in legs)), offset_s)

    def __call__(self, t_s: float) -> Kinematics:
        """Return the point at a time of the scenario; the tour repeats."""
        into_s = (t_s + self.offset_s) % self.ends_s[-1]
        index = min(bisect_right(self.ends_s, into_s), len(self.legs) - 1)
        leg = self.legs[index]
        return leg.at(into_s - (self.ends_s[index] - leg.duration_s))


@dataclass(frozen=True, slots=True, kw_only=True)
class Racetrack:
    """Stadium at constant height and ground speed: two straights, two half turns clockwise.

    The turn rate ramps up to speed / radius within ``roll_s``, and down again, as an aircraft
    rolls.
    """

    centre_ned_m: Vector
    axis_rad: float  # course of the first straight
    straight_m: float
    speed_mps: float
    radius_m: float
    roll_s: float
    offset_s: float  # time into the lap at time 0
    across_m: float = field(init=False)  # computed: distance between the straights

    def __post_init__(self) -> None:
        # Twice the distance across of half a turn.
        _, across = self._rolled_in(self.roll_s)
        course = self.speed_mps / self.radius_m * self.roll_s / 2.0
        object.__setattr__(self, "across_m", 2.0 * (across + self.radius_m * math.cos(course)))

    @property
    def turn_s(self) -> float:
        """Duration of a half turn, including rolling in and out, seconds."""
        return math.pi * self.radius_m / self.speed_mps + self.roll_s

    @property
    def lap_s(self) -> float:
        return 2.0 * (self.straight_m / self.speed_mps + self.turn_s)

    def __call__(self, t_s: float) -> Kinematics:
        """Return the point at a time of the scenario.

        The second half of a lap is the first mirrored in the centre.
        """
        into_s = (t_s + self.offset_s) % self.lap_s
        back = into_s >= self.lap_s / 2.0
        into_s -= self.lap_s / 2.0 if back else 0.0
        turning_s = into_s - self.straight_m / self.speed_mps
        along, across, course, rate, growth = self.speed_mps * into_s, 0.0, 0.0, 0.0, 0.0
        if turning_s >= 0.0:
            along, across, course, rate, growth = self._turn(turning_s)
            along += self.straight_m
        along -= self.straight_m / 2.0
        across -= self.across_m / 2.0
        axis = self.axis_rad + (math.pi if back else 0.0)
        cosine, sine = math.cos(axis), math.sin(axis)
        north, east, down = self.centre_ned_m
        position = (
            north + along * cosine - across * sine,
            east + along * sine + across * cosine,
            down,
        )
        return _steered(position, self.speed_mps, axis + course, rate, growth)

    def _turn(self, t_s: float) -> tuple[float, float, float, float, float]:
        """Return metres along and across since the start of the turn; course, two derivatives.

        The second half of a turn is the first one mirrored and in reverse.
        """
        if t_s > self.turn_s / 2.0:
            along, across, course, rate, growth = self._turn(max(0.0, self.turn_s - t_s))
            return along, self.across_m - across, math.pi - course, rate, -growth
        full_radps = self.speed_mps / self.radius_m
        ramp = Ramp.at(min(t_s / self.roll_s, 1.0))
        along, across = self._rolled_in(min(t_s, self.roll_s))
        course = full_radps * self.roll_s * ramp.integral
        if t_s < self.roll_s:
            growth = full_radps * ramp.slope / self.roll_s
            return along, across, course, full_radps * ramp.value, growth
        turned = course + full_radps * (t_s - self.roll_s)
        along += self.radius_m * (math.sin(turned) - math.sin(course))
        across += self.radius_m * (math.cos(course) - math.cos(turned))
        return along, across, turned, full_radps, 0.0

    def _rolled_in(self, t_s: float) -> tuple[float, float]:
        reach_rad = self.speed_mps / self.radius_m * self.roll_s
        along = across = 0.0
        for node, weight in _QUADRATURE:
            course = reach_rad * Ramp.at(node * t_s / self.roll_s).integral
            along += weight * math.cos(course)
            across += weight * math.sin(course)
        return self.speed_mps * t_s * along, self.speed_mps * t_s * across


@dataclass(frozen=True, slots=True, kw_only=True)
class Orbit:
    """Circle around a point at constant height, with the heading along the course.

    Positive rates turn clockwise, negative ones counter-clockwise. ``phase_rad`` is the bearing
    from the centre at time 0.
    """

    centre_ned_m: Vector
    radius_m: float
    rate_radps: float
    phase_rad: float

    def __call__(self, t_s: float) -> Kinematics:
        """Return the point at a time of the scenario."""
        bearing = self.phase_rad + self.rate_radps * t_s
        north, east, down = self.centre_ned_m
        position = (
            north + self.radius_m * math.cos(bearing),
            east + self.radius_m * math.sin(bearing),
            down,
        )
        course = bearing + math.copysign(math.pi / 2.0, self.rate_radps)
        return _steered(
            position, self.radius_m * abs(self.rate_radps), course, self.rate_radps, 0.0
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Swing:
    """Swing on an arc around the carrier: azimuth + amplitude sin(ωt + φ), radians from north.

    The range is horizontal. The heading points away from the carrier at the middle of the arc.
    """

    range_m: float
    height_m: float
    azimuth_rad: float
    amplitude_rad: float
    omega_radps: float
    phase_rad: float

    def __call__(self, t_s: float) -> Kinematics:
        """Return the point at a time of the scenario."""
        angle = self.omega_radps * t_s + self.phase_rad
        swing, omega = self.amplitude_rad, self.omega_radps
        azimuth = self.azimuth_rad + swing * math.sin(angle)
        rate = swing * omega * math.cos(angle)
        growth = -swing * omega**2 * math.sin(angle)
        third = -swing * omega**3 * math.cos(angle)
        cosine, sine, range_m = math.cos(azimuth), math.sin(azimuth), self.range_m

        def turned(outward: float, clockwise: float) -> Vector:
            return (
                range_m * (outward * cosine - clockwise * sine),
                range_m * (outward * sine + clockwise * cosine),
                0.0,
            )

        return Kinematics(
            position_ned_m=(range_m * cosine, range_m * sine, -self.height_m),
            velocity_ned_mps=turned(0.0, rate),
            acceleration_ned_mps2=turned(-(rate**2), growth),
            jerk_ned_mps3=turned(-3.0 * rate * growth, third - rate**3),
            heading_rad=self.azimuth_rad,
            heading_rate_radps=0.0,
        )


def _steered(
    position: Vector, speed: float, course: float, rate: float, growth: float
) -> Kinematics:
    """Return level flight at constant speed along ``course``; ``growth`` is d(``rate``)/dt."""
    cosine, sine = speed * math.cos(course), speed * math.sin(course)
    return Kinematics(
        position_ned_m=position,
        velocity_ned_mps=(cosine, sine, 0.0),
        acceleration_ned_mps2=(-rate * sine, rate * cosine, 0.0),
        jerk_ned_mps3=(-growth * sine - rate**2 * cosine, growth * cosine - rate**2 * sine, 0.0),
        heading_rad=course,
        heading_rate_radps=rate,
    )
