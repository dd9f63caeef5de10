"""Attitudes along a path: the tilt of a multirotor, the bank of a fixed wing."""

import math
from dataclasses import dataclass

from sitl_replay.flight.motion import GRAVITY_MPS2, Path, Pose, body_rates


@dataclass(frozen=True, slots=True)
class Leaning:
    """Attitude of a multirotor, whose acceleration comes from thrust along its vertical axis.

    Thrust per mass is a − g; drag is neglected. Source: R. Mahony, V. Kumar, P. Corke, "Multirotor
    aerial vehicles", IEEE Robotics & Automation Magazine 19(3), 2012 (differential flatness).
    """

    path: Path

    def __call__(self, t_s: float) -> Pose:
        """Return roll and pitch by the thrust, and yaw by the heading of the path."""
        now = self.path(t_s)
        north, east, down = now.acceleration_ned_mps2
        north_rate, east_rate, down_rate = now.jerk_ned_mps3
        yaw, yaw_rate = now.heading_rad, now.heading_rate_radps
        cosine, sine = math.cos(yaw), math.sin(yaw)
        # Thrust and its derivative in the level frame that rotates with the heading.
        ahead, right, below = (
            north * cosine + east * sine, east * cosine - north * sine, down - GRAVITY_MPS2
        )  # fmt: skip
        ahead_rate = north_rate * cosine + east_rate * sine + yaw_rate * right
        right_rate = east_rate * cosine - north_rate * sine - yaw_rate * ahead
        upright = math.hypot(ahead, below)
        upright_rate = (ahead * ahead_rate + below * down_rate) / upright
        roll, pitch = math.atan2(right, upright), math.atan2(-ahead, -below)
        roll_rate = (upright * right_rate - right * upright_rate) / (upright**2 + right**2)
        pitch_rate = (below * ahead_rate - ahead * down_rate) / upright**2
        p, q, r = body_rates(roll, pitch, (roll_rate, pitch_rate, yaw_rate))
        return Pose(
            roll_rad=roll,
            pitch_rad=pitch,
            yaw_rad=math.remainder(yaw, math.tau),
            rollspeed_radps=p,
            pitchspeed_radps=q,
            yawspeed_radps=r,
        )


@dataclass(frozen=True, slots=True)
class Banked:
    """Attitude of a fixed wing in level, coordinated flight: tan(bank) = airspeed · turn rate / g.

    Yaw is the direction of the velocity through the air: the path's velocity minus the mean wind
    (m/s north and east, the direction the wind blows to). The turn rate is the yaw rate.
    ``pitch_rad`` is the angle of attack. Source: the coordinated turn, e.g. R. Beard, T. McLain,
    Small Unmanned Aircraft, section 5.2.
    """

    path: Path
    wind_ne_mps: tuple[float, float]
    pitch_rad: float

    def __call__(self, t_s: float) -> Pose:
        """Return roll by the turn rate, and yaw by the velocity through the air."""
        now = self.path(t_s)
        north = now.velocity_ned_mps[0] - self.wind_ne_mps[0]
        east = now.velocity_ned_mps[1] - self.wind_ne_mps[1]
        a_north, a_east, _ = now.acceleration_ned_mps2
        j_north, j_east, _ = now.jerk_ned_mps3
        airspeed = math.hypot(north, east)
        sideways = (north * a_east - east * a_north) / airspeed
        ahead = (north * a_north + east * a_east) / airspeed
        sideways_rate = (north * j_east - east * j_north - sideways * ahead) / airspeed
        roll = math.atan2(sideways, GRAVITY_MPS2)
        roll_rate = sideways_rate * GRAVITY_MPS2 / (GRAVITY_MPS2**2 + sideways**2)
        yaw = math.atan2(east, north)
        p, q, r = body_rates(roll, self.pitch_rad, (roll_rate, 0.0, sideways / airspeed))
        return Pose(
            roll_rad=roll,
            pitch_rad=self.pitch_rad,
            yaw_rad=yaw,
            rollspeed_radps=p,
            pitchspeed_radps=q,
            yawspeed_radps=r,
        )
