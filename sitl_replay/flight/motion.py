"""Motion of vehicles: positions, velocities and attitudes as functions of time.

Time ``t_s`` is seconds since the start of the scenario. Positions are north-east-down metres from
the carrier, the hovering vehicle with the antenna array. Attitudes are roll, pitch, yaw from NED to
body (forward-right-down), rotated in the order yaw, pitch, roll, as in MAVLink. The velocity of a
trajectory is the exact derivative of its position, as GLOBAL_POSITION_INT requires.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

Vector = tuple[float, float, float]

GRAVITY_MPS2: Final = 9.80665

PAPER_GUST = 0.2
GUST_RATE_RATIO = 10.0


class Motion(NamedTuple):
    """Motion of a vehicle: position in NED metres from the carrier, velocity in NED m/s."""

    position_ned_m: Vector
    velocity_ned_mps: Vector


class Kinematics(NamedTuple):
    """Point of a path with its derivatives, and the heading.

    Values are NED from the carrier: metres, m/s, m/s², m/s³; heading clockwise from north, radians.
    """

    position_ned_m: Vector
    velocity_ned_mps: Vector
    acceleration_ned_mps2: Vector
    jerk_ned_mps3: Vector
    heading_rad: float
    heading_rate_radps: float


Path = Callable[[float], Kinematics]


class Pose(NamedTuple):
    """Pose of a vehicle: attitude in rad, body rates (about forward, right, down) in rad/s."""

    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    rollspeed_radps: float
    pitchspeed_radps: float
    yawspeed_radps: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Circle:
    """Path of the paper (docs/math.md 8.2): a clockwise circle around the carrier, with gusts.

    Velocity is v + d, v = Rω[cos(ωt+φ), −sin(ωt+φ)] and d = gust·Rω[cos(10ωt+φ), −sin(10ωt+φ)]
    (north, east); the position is its exact integral, centred on the carrier. ``height_m`` is above
    the carrier.
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
    """Motion at a fixed point, NED metres from the carrier."""

    position_ned_m: Vector

    def __call__(self, t_s: float) -> Motion:
        return Motion(self.position_ned_m, (0.0, 0.0, 0.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Sway:
    """Attitude that is level with slow oscillations, at a constant or steadily turning heading.

    Roll and pitch oscillate by ``amplitude_rad``, yaw by half of that, at three frequencies whose
    common period is long. ``phase_rad`` makes vehicles differ.
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
        p, q, r = body_rates(roll, pitch, (roll_rate, pitch_rate, yaw_rate))
        return Pose(
            roll_rad=roll,
            pitch_rad=pitch,
            yaw_rad=math.remainder(yaw, math.tau),
            rollspeed_radps=p,
            pitchspeed_radps=q,
            yawspeed_radps=r,
        )

    def _swing(self, t_s: float, amplitude_rad: float, frequency_hz: float) -> tuple[float, float]:
        omega_radps = math.tau * frequency_hz
        angle_rad = omega_radps * t_s + self.phase_rad
        return (
            amplitude_rad * math.sin(angle_rad),
            amplitude_rad * omega_radps * math.cos(angle_rad),
        )


@dataclass(frozen=True, slots=True)
class Flight:
    """Path as flown, with the displacement by gusts, if any."""

    path: Path
    displacement: Callable[[float], Motion] | None = None

    def __call__(self, t_s: float) -> Motion:
        """Return position, and velocity as its derivative."""
        on_path = self.path(t_s)
        position_ned_m, velocity_ned_mps = on_path.position_ned_m, on_path.velocity_ned_mps
        if self.displacement is None:
            return Motion(position_ned_m, velocity_ned_mps)
        moved_m, moving_mps = self.displacement(t_s)
        return Motion(plus(position_ned_m, moved_m), plus(velocity_ned_mps, moving_mps))


def plus(a: Vector, b: Vector) -> Vector:
    """Return the sum of two vectors."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def body_rates(roll_rad: float, pitch_rad: float, euler_rates_radps: Vector) -> Vector:
    """Return body rates (p, q, r) about forward, right, down from rates of roll, pitch, yaw.

    All rates are in rad/s. Source: the kinematic equation of the yaw-pitch-roll sequence, e.g.
    Stevens, Lewis and Johnson, Aircraft Control and Simulation, eq. 1.4-3.
    """
    roll_rate, pitch_rate, yaw_rate = euler_rates_radps
    sin_roll, cos_roll = math.sin(roll_rad), math.cos(roll_rad)
    sin_pitch, cos_pitch = math.sin(pitch_rad), math.cos(pitch_rad)
    return (
        roll_rate - yaw_rate * sin_pitch,
        pitch_rate * cos_roll + yaw_rate * sin_roll * cos_pitch,
        -pitch_rate * sin_roll + yaw_rate * cos_roll * cos_pitch,
    )
