"""World for tests of what the array sees: UAVs, a carrier and a receiver at the edge of all bounds.

The truth obeys the limits (acceleration, angular acceleration, drift of the attitude's error), and
every report and every measurement is wrong by as much as it may be, in directions that a random
generator chooses, often the same one for a long time.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from companion.settings.observations import ObservationSettings
from companion.tracking.carrier import later_body_from_body
from companion.tracking.extrapolated import ExtrapolatedAttitude
from companion.tracking.relative import Relative, ReportedVelocity
from companion.tracking.rotations import rotation
from companion.values import Cap, FloatArray, Vector, angle_rad

STEP_S = 0.005


def direction(rng: np.random.Generator) -> FloatArray:
    """Return a random unit vector (3,)."""
    found = rng.standard_normal(3)
    return np.asarray(found / np.linalg.norm(found))


def tilted(rng: np.random.Generator, towards: FloatArray, by_rad: float) -> FloatArray:
    """Return a unit vector at an angle from another."""
    aside = np.cross(towards, direction(rng))
    aside /= np.linalg.norm(aside)
    return np.asarray(math.cos(by_rad) * towards + math.sin(by_rad) * aside)


@dataclass(kw_only=True, eq=False)
class Body:
    """Vehicle whose acceleration is limited: position and velocity, (3,), local frame."""

    position_m: FloatArray
    velocity_mps: FloatArray
    acceleration_max_mps2: float
    bound_m: float
    noise_mps: float
    false_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    offset: FloatArray = field(default_factory=lambda: np.zeros(3))
    reported: ReportedVelocity | None = None
    changes: float = 0.05
    bias: FloatArray = field(default_factory=lambda: np.zeros(3))
    _acceleration: FloatArray = field(default_factory=lambda: np.zeros(3))

    def step(self, rng: np.random.Generator) -> None:
        if rng.random() < self.changes or not self._acceleration.any():
            self._acceleration = direction(rng) * self.acceleration_max_mps2
        if rng.random() < self.changes or not self.offset.any():
            self.offset = direction(rng) * self.bound_m
        if rng.random() < self.changes or not self.bias.any():
            self.bias = direction(rng) * self.noise_mps
        self.position_m = self.position_m + (
            self.velocity_mps * STEP_S + self._acceleration * STEP_S**2 / 2
        )
        self.velocity_mps = self.velocity_mps + self._acceleration * STEP_S

    def report(self, t_ns: int) -> None:
        velocity = self.velocity_mps + self.bias
        self.reported = ReportedVelocity(
            t_ns=t_ns,
            velocity_ned_mps=vector(velocity),
            noise_mps=self.noise_mps,
            acceleration_max_mps2=self.acceleration_max_mps2,
            time_bound_s=0.0,
        )


@dataclass(kw_only=True, eq=False)
class World:
    """UAVs and the carrier of the array, with everything that is reported of them.

    body_from_local  true attitude, (3, 3)
    local_error      error of the compass, a rotation vector (3,) in the local frame
    mount_error      error of the mount, (3,) in the body frame
    """

    rng: np.random.Generator
    settings: ObservationSettings
    uavs: dict[str, Body]
    carrier: Body
    body_from_local: FloatArray
    rates_radps: FloatArray
    alpha_radps2: float
    mount_error: FloatArray
    local_error: FloatArray
    error_max_rad: float
    bound_rad: float
    t_ns: int = 1_000_000_000_000
    attitudes: list[tuple[int, FloatArray, FloatArray]] = field(default_factory=list)
    _alpha: FloatArray = field(default_factory=lambda: np.zeros(3))
    _drift: FloatArray = field(default_factory=lambda: np.zeros(3))

    def step(self) -> None:
        """Advance the truth by ``STEP_S``."""
        rng = self.rng
        self.t_ns += round(STEP_S * 1e9)
        for body in (*self.uavs.values(), self.carrier):
            body.step(rng)
        if rng.random() < self.carrier.changes or not self._alpha.any():
            self._alpha = direction(rng) * self.alpha_radps2
        if self.rates_radps @ self.rates_radps > 1.57**2:  # 90 degrees a second
            slower = -self.rates_radps / np.linalg.norm(self.rates_radps)
            self._alpha = slower * self.alpha_radps2
        middle = self.rates_radps + self._alpha * STEP_S / 2
        self.body_from_local = later_body_from_body(middle, STEP_S) @ self.body_from_local
        self.rates_radps = self.rates_radps + self._alpha * STEP_S
        if rng.random() < self.carrier.changes / 2 or not self._drift.any():
            self._drift = direction(rng) * math.radians(self.settings.drift_max_degps)
        after = self.local_error + self._drift * (STEP_S * 0.98)
        if np.linalg.norm(after) + np.linalg.norm(self.mount_error) <= self.error_max_rad:
            self.local_error = after

    # The reported attitude B' and the true one of the array: A = exp([mount]) B' exp([local]).

    @property
    def reported_attitude(self) -> FloatArray:
        """The attitude that the carrier would report now."""
        return rotation(self.mount_error).T @ self.body_from_local @ rotation(self.local_error).T

    @property
    def error(self) -> FloatArray:
        """Error of the reported attitude, W = B'^T B, (3, 3), local frame."""
        return self.reported_attitude.T @ self.body_from_local

    def report_attitude(self) -> None:
        """Report attitude and rates."""
        reported = self.reported_attitude
        rates = rotation(self.mount_error).T @ self.rates_radps
        self.attitudes = [*self.attitudes[-1:], (self.t_ns, reported, rates)]

    def pose(self, t_ns: int, *, nearest: bool) -> ExtrapolatedAttitude | None:
        """Return the attitude at a time, extrapolated from a report."""
        if not self.attitudes:
            return None
        made_ns, attitude, rates = self.attitudes[-1]
        if nearest:
            made_ns, attitude, rates = min(self.attitudes, key=lambda one: abs(one[0] - t_ns))
        age_s = (t_ns - made_ns) * 1e-9
        return ExtrapolatedAttitude(
            body_from_local=later_body_from_body(rates, age_s) @ attitude,
            age_s=age_s,
            doubt_s=0.0,
            extrapolation_rad=self.alpha_radps2 * age_s**2 / 2,
            acceleration_radps2=self.alpha_radps2,
        )

    def true_direction(self, uav: str) -> FloatArray:
        """Return the direction of a UAV in the array frame, which is the body frame."""
        offset = self.uavs[uav].position_m - self.carrier.position_m
        seen = self.body_from_local @ offset
        return np.asarray(seen / np.linalg.norm(seen))

    def measure(self, uav: str) -> FloatArray:
        """Measure a UAV's direction, wrong by up to the bound."""
        share = 1.0 if self.rng.random() < 0.5 else self.rng.random()
        return tilted(self.rng, self.true_direction(uav), 0.999 * share * self.bound_rad)

    def relative(self, uav: str, t_ns: int) -> Relative | None:
        """Return what is reported of a UAV's position relative to the array, now."""
        body, carrier = self.uavs[uav], self.carrier
        if body.reported is None or carrier.reported is None or not self.attitudes:
            return None
        elapsed_s = (t_ns - self.t_ns) * 1e-9
        reported = (
            body.position_m + body.false_m + body.offset - carrier.position_m - carrier.offset
        )
        reported = reported + (body.velocity_mps - carrier.velocity_mps) * elapsed_s
        slack_m = (body.acceleration_max_mps2 + carrier.acceleration_max_mps2) * elapsed_s**2
        _, _, rates = self.attitudes[-1]
        aged_s = abs(t_ns - self.attitudes[-1][0]) * 1e-9
        return Relative(
            t_ns=t_ns,
            offset_ned_m=reported,
            error_m=body.bound_m + carrier.bound_m + slack_m,
            uav=body.reported,
            carrier=carrier.reported,
            turn_radps=float(np.linalg.norm(rates)) + self.alpha_radps2 * aged_s,
            turn_acceleration_radps2=self.alpha_radps2,
            lever_arm_m=0.0,
        )


def vector(values: FloatArray) -> Vector:
    """Return an array (3,) as a vector."""
    x, y, z = values.tolist()
    return x, y, z


def is_within(cap: Cap, towards: FloatArray) -> bool:
    """Return whether a direction is in a cap, but for rounding."""
    return angle_rad(cap.center, towards) <= cap.radius_rad + 1e-9


def make(
    seed: int, *, uavs: int | None = None, settings: ObservationSettings | None = None
) -> World:
    """Return a random world."""
    rng = np.random.default_rng(seed)
    settings = settings or ObservationSettings(drift_max_degps=float(rng.choice([0.0, 0.3, 2.0])))
    far_m = float(rng.choice([30.0, 100.0, 1000.0]))

    def body(position: FloatArray, copter: bool) -> Body:
        return Body(
            position_m=position,
            velocity_mps=direction(rng) * float(rng.uniform(0, 5 if copter else 30)),
            acceleration_max_mps2=4.0 if copter else 16.0,
            bound_m=float(rng.choice([0.05, 1.5, 5.0])),
            noise_mps=float(rng.choice([0.05, 0.5, 3.0])),
            changes=float(rng.choice([0.0, 0.05])),
        )

    names = [f"{i}:1" for i in range(1, (uavs or int(rng.integers(1, 7))) + 1)]
    error_max = math.radians(float(rng.choice([0.5, 3.0, 10.0])))
    mount = direction(rng) * error_max * float(rng.uniform(0, 1))
    local = direction(rng) * (error_max - float(np.linalg.norm(mount))) * 0.999
    return World(
        rng=rng,
        settings=settings,
        uavs={
            name: body(direction(rng) * far_m * float(rng.uniform(1, 2)), bool(rng.random() < 0.5))
            for name in names
        },
        carrier=body(np.zeros(3), True),
        body_from_local=rotation(direction(rng) * float(rng.uniform(0, 1))),
        rates_radps=direction(rng) * float(rng.uniform(0, 1.5)),
        alpha_radps2=math.radians(float(rng.choice([20.0, 180.0, 400.0]))),
        mount_error=mount,
        local_error=local,
        error_max_rad=error_max,
        bound_rad=math.radians(float(rng.choice([0.02, 0.1, 0.5, 5.0]))),
    )
