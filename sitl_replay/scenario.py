"""Scenarios: who flies where, as pure functions of time.

Time ``t_s`` is seconds since the start of the scenario. Positions are north-east-down metres from
the carrier, the hovering vehicle that has the antenna array. Attitudes are roll, pitch, yaw of
the body (forward-right-down) from NED, rotated in the order yaw, pitch, roll, as MAVLink has them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from companion.values import Source

Vector = tuple[float, float, float]

MAX_UAVS = 200

# The paper's angular rate, and the speed of its fastest UAV. Rings beyond the paper's four turn
# slower, at that speed: at 0.5 rad/s the tenth would leave the range of GLOBAL_POSITION_INT's
# velocity (327 m/s).
PAPER_RATE_RADPS = 0.5
PAPER_TOP_SPEED_MPS = 125.0
PAPER_GUST = 0.2
GUST_RATE_RATIO = 10.0

REPORT_INTERVALS_S = (0.10, 0.15, 0.20, 0.25)
HEIGHTS_M = (0.0, 10.0, 20.0, 30.0)


class Motion(NamedTuple):
    """Where a vehicle is and how it moves: NED metres from the carrier, NED m/s."""

    position_ned_m: Vector
    velocity_ned_mps: Vector


class Pose(NamedTuple):
    """Attitude in radians and body rates (about forward, right, down) in rad/s."""

    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    rollspeed_radps: float
    pitchspeed_radps: float
    yawspeed_radps: float


class Place(NamedTuple):
    """A point on Earth: WGS84 degrees, metres above mean sea level."""

    lat_deg: float
    lon_deg: float
    alt_m: float


@dataclass(frozen=True, slots=True)
class Circle:
    """The paper's flight (MATH.md 8): a circle about the carrier, flown clockwise, with gusts.

    Velocity is v + d, v = Rω[cos(ωt+φ), −sin(ωt+φ)] and d = gust·Rω[cos(10ωt+φ), −sin(10ωt+φ)]
    (north, east); the position is its exact integral, centred on the carrier. ``height_m`` is
    above the carrier.
    """

    radius_m: float
    rate_radps: float
    phase_rad: float
    height_m: float
    gust: float = PAPER_GUST

    def __call__(self, t_s: float) -> Motion:
        turn_rad = self.rate_radps * t_s + self.phase_rad
        gust_rad = GUST_RATE_RATIO * self.rate_radps * t_s + self.phase_rad
        speed_mps = self.radius_m * self.rate_radps
        reach = self.gust / GUST_RATE_RATIO
        north_m = self.radius_m * (math.sin(turn_rad) + reach * math.sin(gust_rad))
        east_m = self.radius_m * (math.cos(turn_rad) + reach * math.cos(gust_rad))
        north_mps = speed_mps * (math.cos(turn_rad) + self.gust * math.cos(gust_rad))
        east_mps = -speed_mps * (math.sin(turn_rad) + self.gust * math.sin(gust_rad))
        return Motion((north_m, east_m, -self.height_m), (north_mps, east_mps, 0.0))


@dataclass(frozen=True, slots=True)
class Hover:
    """Standing still at a point, NED metres from the carrier."""

    position_ned_m: Vector

    def __call__(self, t_s: float) -> Motion:
        return Motion(self.position_ned_m, (0.0, 0.0, 0.0))


@dataclass(frozen=True, slots=True)
class Sway:
    """Level but for a slow sway, about a heading that is constant or turns steadily.

    Roll and pitch sway by ``amplitude_rad``, yaw by half of it; three frequencies without a
    common period, so that no attitude repeats soon. ``phase_rad`` keeps vehicles out of step.
    """

    heading_rad: float = 0.0
    turn_rate_radps: float = 0.0
    phase_rad: float = 0.0
    amplitude_rad: float = math.radians(1.0)

    def __call__(self, t_s: float) -> Pose:
        roll, roll_rate = self._swing(t_s, self.amplitude_rad, 0.31)
        pitch, pitch_rate = self._swing(t_s, self.amplitude_rad, 0.23)
        yaw, yaw_rate = self._swing(t_s, self.amplitude_rad / 2, 0.11)
        yaw += self.heading_rad + self.turn_rate_radps * t_s
        yaw_rate += self.turn_rate_radps
        rates = body_rates(roll, pitch, (roll_rate, pitch_rate, yaw_rate))
        return Pose(roll, pitch, math.remainder(yaw, math.tau), *rates)

    def _swing(self, t_s: float, amplitude_rad: float, frequency_hz: float) -> tuple[float, float]:
        """Angle and its derivative."""
        omega_radps = math.tau * frequency_hz
        angle_rad = omega_radps * t_s + self.phase_rad
        return (
            amplitude_rad * math.sin(angle_rad),
            amplitude_rad * omega_radps * math.cos(angle_rad),
        )


def body_rates(roll_rad: float, pitch_rad: float, euler_rates_radps: Vector) -> Vector:
    """Body rates (p, q, r) about forward, right, down from the rates of roll, pitch and yaw.

    All in rad/s. Source: the kinematic equation of the yaw-pitch-roll sequence, e.g. Stevens,
    Lewis and Johnson, Aircraft Control and Simulation, eq. 1.4-3.
    """
    roll_rate, pitch_rate, yaw_rate = euler_rates_radps
    sin_roll, cos_roll = math.sin(roll_rad), math.cos(roll_rad)
    sin_pitch, cos_pitch = math.sin(pitch_rad), math.cos(pitch_rad)
    return (
        roll_rate - yaw_rate * sin_pitch,
        pitch_rate * cos_roll + yaw_rate * sin_roll * cos_pitch,
        -pitch_rate * sin_roll + yaw_rate * cos_roll * cos_pitch,
    )


@dataclass(frozen=True, slots=True)
class Vehicle:
    """One vehicle: who it is, how it moves, and how often it says so.

    ``report_interval_s`` is that of GLOBAL_POSITION_INT, ``attitude_interval_s`` that of
    ATTITUDE. ``uptime_ms`` is its boot clock when the scenario starts.
    """

    source: Source
    trajectory: Callable[[float], Motion]
    attitude: Callable[[float], Pose]
    report_interval_s: float
    attitude_interval_s: float
    uptime_ms: int


@dataclass(frozen=True, slots=True)
class Scenario:
    """A carrier at ``origin`` and the UAVs about it. ``home_alt_m``: what heights are told from."""

    name: str
    description: str
    origin: Place
    home_alt_m: float
    carrier: Vehicle
    uavs: tuple[Vehicle, ...]

    @property
    def vehicles(self) -> tuple[Vehicle, ...]:
        """The carrier first, then the UAVs."""
        return (self.carrier, *self.uavs)


ORIGIN = Place(47.3977419, 8.5455938, 513.0)
HOME_ALT_M = ORIGIN.alt_m - 25.0

CARRIER = Vehicle(
    source=Source(5, 1),
    trajectory=Hover((0.0, 0.0, 0.0)),
    attitude=Sway(),
    report_interval_s=0.1,
    attitude_interval_s=0.05,
    uptime_ms=754_321,
)


def paper(uavs: int = 4, gust: float = PAPER_GUST) -> Scenario:
    """The paper's UAVs on circles of 100, 150, 200, 250 m and so on about the carrier.

    Each a quarter turn from the one before, at 0.5 rad/s (more than four: see
    ``PAPER_TOP_SPEED_MPS``). ``ValueError`` where ``uavs`` is not 1 to ``MAX_UAVS``.
    """
    return _around_carrier(
        "paper",
        "the paper's UAVs circling the carrier at up to 125 m/s, with gusts",
        tuple(_circling(index, gust) for index in range(_checked(uavs))),
    )


def hover(uavs: int = 4) -> Scenario:
    """UAVs standing still within 60° of north, where a broadside array tells them apart.

    ``ValueError`` where ``uavs`` is not 1 to ``MAX_UAVS``.
    """
    step_deg = 120.0 / max(1, uavs - 1)
    first_deg = -60.0 if uavs > 1 else 0.0
    return _around_carrier(
        "hover",
        "UAVs hovering 150 to 225 m away, spread within 60 degrees of north",
        tuple(
            _hovering(index, math.radians(first_deg + step_deg * index))
            for index in range(_checked(uavs))
        ),
    )


BUILDERS: dict[str, Callable[[int], Scenario]] = {"paper": paper, "hover": hover}


def _checked(uavs: int) -> int:
    if not 1 <= uavs <= MAX_UAVS:
        raise ValueError(f"{uavs} UAVs: 1 to {MAX_UAVS} can fly")
    return uavs


def _around_carrier(name: str, description: str, uavs: tuple[Vehicle, ...]) -> Scenario:
    return Scenario(name, description, ORIGIN, HOME_ALT_M, CARRIER, uavs)


def _circling(index: int, gust: float) -> Vehicle:
    radius_m = 100.0 + 50.0 * index
    rate_radps = min(PAPER_RATE_RADPS, PAPER_TOP_SPEED_MPS / radius_m)
    phase_rad = index * math.pi / 2
    circle = Circle(radius_m, rate_radps, phase_rad, HEIGHTS_M[index % len(HEIGHTS_M)], gust)
    # The nose follows the nominal velocity, whose course is −(ωt+φ).
    return _uav(index, circle, Sway(-phase_rad, -rate_radps, phase_rad=float(index + 1)))


def _hovering(index: int, azimuth_rad: float) -> Vehicle:
    range_m = 150.0 + 25.0 * (index % 4)
    position_ned_m = (
        range_m * math.cos(azimuth_rad),
        range_m * math.sin(azimuth_rad),
        -HEIGHTS_M[index % len(HEIGHTS_M)],
    )
    return _uav(index, Hover(position_ned_m), Sway(azimuth_rad, phase_rad=float(index + 1)))


def _uav(index: int, trajectory: Callable[[float], Motion], attitude: Sway) -> Vehicle:
    sysid = index + 1 if index + 1 < CARRIER.source.sysid else index + 2
    return Vehicle(
        source=Source(sysid, 1),
        trajectory=trajectory,
        attitude=attitude,
        report_interval_s=REPORT_INTERVALS_S[index % len(REPORT_INTERVALS_S)],
        attitude_interval_s=0.2,
        uptime_ms=61_007 + 37_219 * index,
    )
