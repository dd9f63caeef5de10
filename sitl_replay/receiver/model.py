"""Receiver of an antenna array: measured directions of a scenario's UAVs, with errors. Pure.

Directions are in the array frame (docs/glossary.md): x along boresight, y right, z down; azimuth is
positive to the right, elevation above. The array is at the carrier's position. Its mount is that of
the settings (``[array] mount_*_deg``) followed by the mount error, which the settings do not have.
"""

import heapq
import itertools
import math
import random
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from companion.values import FloatArray, Observation
from companion.values.numbers import vector
from sitl_replay.flight.fleet import Scenario, Vehicle
from sitl_replay.flight.motion import Vector

OUTLIER_REACH_RAD: Final = math.radians(60.0)  # largest angle between an outlier and the truth
TIME_BOUND_NS: Final = 1_000_000  # stated with each measurement; its time is exact


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceiverModel:
    """Errors and timing of a receiver. Angles in radians, shares from 0 to 1.

    mount_rad        roll, pitch and yaw of the array on the carrier, as in the settings
    mount_error_rad  further rotation of the true array, unknown to the settings
    bound_rad        stated bound on the error of a direction
    bias_rad         constant part of the error: a rotation by this angle; at most ``bound_rad``
    outliers         share of reflected signals, from anywhere within ``OUTLIER_REACH_RAD``
    swapped          share of measurements under the name of another UAV
    lost             share of measurements that are not sent
    silent_s         intervals (begin, duration) without measurements
    latency_s        time from a measurement to its sending
    jitter_s         largest additional time, uniformly distributed
    rate_hz          measurements of each UAV per second

    The rest of the error, up to ``bound_rad``, is random and uniform over the solid angle.
    """

    mount_rad: Vector = (0.0, 0.0, 0.0)
    mount_error_rad: Vector = (0.0, 0.0, 0.0)
    bound_rad: float = math.radians(2.0)
    bias_rad: float = 0.0
    outliers: float = 0.0
    swapped: float = 0.0
    lost: float = 0.0
    silent_s: tuple[tuple[float, float], ...] = ()
    latency_s: float = 0.02
    jitter_s: float = 0.0
    rate_hz: float = 10.0

    def is_silent(self, t_s: float) -> bool:
        """Return whether nothing is measured at a time."""
        return any(begin_s <= t_s < begin_s + lasts_s for begin_s, lasts_s in self.silent_s)


class Measured(NamedTuple):
    """Measurement as it is sent, with the truth.

    t_s          time of sending, seconds since the start
    observation  what is sent; times are Unix time
    truth        unit vector of the true direction in the true array's frame
    is_outlier   whether the direction is that of a reflection
    measured     UAV that was measured, which ``observation`` may call by another name
    """

    t_s: float
    observation: Observation
    truth: FloatArray
    is_outlier: bool
    measured: str


def measurements(
    scenario: Scenario,
    model: ReceiverModel,
    seed: int = 0,
    *,
    epoch_ns: int = 0,
    duration_s: float | None = None,
) -> Iterator[Measured]:
    """Yield the measurements of a scenario's UAVs in order of sending.

    ``epoch_ns`` is the Unix time at the start. Endless if ``duration_s`` is None, else the last one
    is sent before it. The same arguments give the same measurements. Times of measurement and
    noise do not depend on the shares, so that runs with other shares can be compared.
    """
    timers = heapq.merge(
        *(_instants(vehicle, model, seed) for vehicle in scenario.uavs), key=lambda one: one[0]
    )
    receivers = {
        one.name: _Receiver(scenario=scenario, vehicle=one, model=model, seed=seed)
        for one in scenario.uavs
    }
    count = itertools.count()
    waiting: list[tuple[float, int, Measured]] = []
    for t_s, vehicle in timers:
        while waiting and waiting[0][0] <= t_s + model.latency_s:
            yield heapq.heappop(waiting)[2]
        if duration_s is not None and t_s + model.latency_s >= duration_s:
            break
        made = receivers[vehicle.name].measure(t_s, epoch_ns)
        if made is not None and (duration_s is None or made.t_s < duration_s):
            heapq.heappush(waiting, (made.t_s, next(count), made))
    while waiting:
        yield heapq.heappop(waiting)[2]


def _instants(vehicle: Vehicle, model: ReceiverModel, seed: int) -> Iterator[tuple[float, Vehicle]]:
    """Yield the times of a UAV's measurements, in whole milliseconds."""
    interval_s = 1.0 / model.rate_hz
    phase_s = random.Random(f"{seed} receiver phase {vehicle.name}").uniform(0.0, interval_s)
    for number in itertools.count():
        yield round(phase_s + number * interval_s, 3), vehicle


class _Receiver:
    """Receiver for one UAV. Each kind of error has random numbers of its own."""

    def __init__(
        self, *, scenario: Scenario, vehicle: Vehicle, model: ReceiverModel, seed: int
    ) -> None:
        self._carrier = scenario.carrier
        self._vehicle = vehicle
        self._model = model
        self._uav = str(vehicle.source)
        self._others = sorted({str(one.source) for one in scenario.uavs} - {self._uav})
        self._array_from_body = rotation(*model.mount_error_rad) @ rotation(*model.mount_rad)
        axis = _anywhere(random.Random(f"{seed} receiver bias"))  # one for all UAVs
        self._bias = about(axis, model.bias_rad)
        self._noise, self._delay, self._outlier, self._swap, self._loss = (
            random.Random(f"{seed} receiver {kind} {vehicle.name}")
            for kind in ("noise", "delay", "outlier", "swap", "loss")
        )

    def measure(self, t_s: float, epoch_ns: int) -> Measured | None:
        """Measure the UAV at a time; None if the measurement is not sent."""
        model = self._model
        truth = true_direction(self._carrier, self._vehicle, t_s, self._array_from_body)
        seen = within(self._noise, self._bias @ truth, model.bound_rad - model.bias_rad)
        reflected = within(self._outlier, truth, OUTLIER_REACH_RAD)
        is_outlier = self._outlier.random() < model.outliers
        other = self._swap.choice(self._others) if self._others else self._uav
        is_swapped = self._swap.random() < model.swapped
        sent_s = t_s + model.latency_s + model.jitter_s * self._delay.random()
        if self._loss.random() < model.lost or model.is_silent(t_s):
            return None
        x, y, z = vector(reflected if is_outlier else seen)
        observation = Observation(
            t_ns=epoch_ns + round(sent_s * 1e9),
            measured_ns=epoch_ns + round(t_s * 1e9),
            time_bound_ns=TIME_BOUND_NS,
            uav=other if is_swapped else self._uav,
            azimuth_rad=math.atan2(y, x),
            elevation_rad=math.atan2(-z, math.hypot(x, y)),
            bound_rad=model.bound_rad,
        )
        return Measured(
            t_s=sent_s,
            observation=observation,
            truth=truth,
            is_outlier=is_outlier,
            measured=self._uav,
        )


def true_direction(
    carrier: Vehicle, vehicle: Vehicle, t_s: float, array_from_body: FloatArray
) -> FloatArray:
    """Return the unit vector (3,) from carrier to vehicle at a time, in the array's frame."""
    pose = carrier.attitude(t_s)
    body_from_ned = rotation(pose.roll_rad, pose.pitch_rad, pose.yaw_rad)
    here, there = carrier.trajectory(t_s).position_ned_m, vehicle.trajectory(t_s).position_ned_m
    seen = array_from_body @ body_from_ned @ (np.array(there) - np.array(here))
    return np.asarray(seen / np.linalg.norm(seen))


def rotation(roll_rad: float, pitch_rad: float, yaw_rad: float) -> FloatArray:
    """Return the matrix (3, 3) to a frame that was rotated by yaw, then pitch, then roll."""
    x, y, z = np.eye(3)
    return about(x, -roll_rad) @ about(y, -pitch_rad) @ about(z, -yaw_rad)


def about(axis: FloatArray, angle_rad: float) -> FloatArray:
    """Return the matrix (3, 3) that rotates vectors about a unit axis; Rodrigues' formula."""
    x, y, z = vector(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(
        np.eye(3) + math.sin(angle_rad) * cross + (1.0 - math.cos(angle_rad)) * cross @ cross
    )


def within(rng: random.Random, direction: FloatArray, reach_rad: float) -> FloatArray:
    """Return a random unit vector within an angle of a direction, uniform over the solid angle."""
    off = 2.0 * math.sin(reach_rad / 2.0) ** 2 * rng.random()  # 1 - cos of the angle
    sine, around_rad = math.sqrt(off * (2.0 - off)), rng.uniform(0.0, math.tau)
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    side = np.cross(direction, helper)
    side /= np.linalg.norm(side)
    other = np.cross(direction, side)
    found = (1.0 - off) * direction + sine * (
        math.cos(around_rad) * side + math.sin(around_rad) * other
    )
    return np.asarray(found / np.linalg.norm(found))


def _anywhere(rng: random.Random) -> FloatArray:
    return within(rng, np.array([1.0, 0.0, 0.0]), math.pi)
