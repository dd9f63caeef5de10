"""Immutable snapshot of one track, from which any thread may predict."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from companion.tracking.observers.estimates import Observer, Prediction
from companion.tracking.past_predictions import (
    AccelerationModel,
    UsualErrors,
    fed_forward,
    usual_error_m,
)
from companion.tracking.reach import Reach, reach
from companion.values import (
    Estimate,
    Fix,
    FloatArray,
    Limits,
    SenderTime,
    Track,
    TrackState,
    Vector,
)


@dataclass(frozen=True, slots=True)
class Ages:
    """Ages of a track's newest report above which the track changes state, seconds.

    ``coasting_s`` is a minimum: it is longer on a slow link (``pace.py``).
    """

    coasting_s: float = 2.0
    stale_s: float = 15.0
    lost_s: float = 60.0

    def state(self, age_s: float, coasting_s: float) -> TrackState:
        """Return the state of a track by the age of its newest report; it coasts from an age on."""
        if age_s > self.lost_s:
            return TrackState.LOST
        if age_s > self.stale_s:
            return TrackState.STALE
        return TrackState.COASTING if age_s > coasting_s else TrackState.LIVE


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackSnapshot:
    """Track of one UAV after all reports so far.

    fix, state        the newest report in the sender's time, and the observer's state at it
    last              the newest estimate
    coasting_s        age of the newest report from which the track coasts
    common_error_m    usual error that all its reports have in common
    usual_errors      ages of past predictions with their usual errors
    smoothing_offset  offset of the used position from the newest reported one
    """

    observer: Observer[Any]
    ages: Ages
    limits: Limits
    fix: Fix
    state: Any
    last: Estimate
    coasting_s: float
    reports: int
    unknown_input: Vector | None
    mu_max_s2: float | None
    acceleration: Vector | None
    model: AccelerationModel
    smoothing_offset: Vector
    usual_errors: UsualErrors
    common_error_m: float

    def at(self, now_ns: int, at: SenderTime) -> Track:
        """Predict the UAV to ``at.node_ns``; its state is that at ``now_ns``."""
        fix = self.fix
        now = at.sender_ns - (at.node_ns - now_ns)
        position, velocity, possible = self._predict(at)
        return Track(
            uav=fix.uav,
            state=self.ages.state((now - fix.sender_ns) * 1e-9, self.coasting_s),
            valid_at_ns=at.node_ns,
            age_s=self._age_s(at),
            position_ned_m=np.array(position),
            velocity_ned_mps=_array(velocity),
            unknown_input_mps=_array(self.unknown_input),
            acceleration_ned_mps2=_array(self.acceleration),
            bound_m=possible.bound_m,
            horizontal_bound_m=possible.horizontal_m,
            vertical_bound_m=possible.vertical_m,
            set_center_ned_m=np.array(possible.center_ned_m),
            set_radius_m=possible.radius_m,
            limits=self.limits,
            error_p95_m=self._error_p95_m(velocity, at, possible.bound_m),
            clock_bound_s=at.bound_s,
            dt_s=self.last.dt_s,
            latency_s=(fix.arrival_ns - fix.t_ns) * 1e-9,
            gamma=None if self.mu_max_s2 is None else math.sqrt(self.mu_max_s2),
            innovation_m=self.last.innovation_m,
            reports=self.reports,
        )

    def _age_s(self, at: SenderTime) -> float:
        return (at.sender_ns - self.fix.sender_ns) * 1e-9

    def _predict(self, at: SenderTime) -> tuple[Vector, Vector | None, Reach]:
        """Return position and velocity, including feed-forward, and the reachable set.

        See docs/math.md 5.1.
        """
        velocity: Vector | None
        carried = self.observer.carry(self.state, at.sender_ns)
        if carried is not None:
            position, velocity = self._with_feed_forward(at, *carried)
            return position, velocity, reach(self.fix, self.limits, position, at)
        found: Prediction = self.observer.predict(self.state, at.sender_ns)
        position, velocity = found.position_ned_m, found.velocity_ned_mps
        if velocity is not None:
            position, velocity = self._with_feed_forward(at, position, velocity)
        fastest_mps = _fastest_mps(velocity, found.velocity_bound_mps, self.limits, at.bound_s)
        widened_m = at.bound_s * fastest_mps
        bound_m = found.bound_m + widened_m
        horizontal_m, vertical_m = found.horizontal_m + widened_m, found.vertical_m + widened_m
        return (
            position,
            velocity,
            Reach(
                bound_m=bound_m,
                horizontal_m=horizontal_m,
                vertical_m=vertical_m,
                center_ned_m=position,
                radius_m=bound_m,
            ),
        )

    def _with_feed_forward(
        self, at: SenderTime, position: Vector, velocity: Vector
    ) -> tuple[Vector, Vector]:
        """Add feed-forward and smoothing to a predicted position and velocity."""
        ahead_s = self._age_s(at)
        position = _sum(position, self.smoothing_offset)
        if self.acceleration is None or ahead_s <= 0:
            return position, velocity
        moved, gained = fed_forward(self.model, self.acceleration, velocity, ahead_s)
        return _sum(position, moved), _sum(velocity, gained)

    def _error_p95_m(self, velocity: Vector | None, at: SenderTime, bound_m: float) -> float | None:
        """Return the usual error, from past errors, the receiver's common error and the clock.

        Past errors may exceed the present bound, which limits the result.
        """
        seen_m = usual_error_m(self.usual_errors, self._age_s(at))
        if seen_m is None:
            return None
        if velocity is not None:
            seen_m = math.hypot(seen_m, self.common_error_m, math.hypot(*velocity) * at.usual_s)
        return min(seen_m, bound_m)


def _fastest_mps(
    velocity: Vector | None, bound_mps: float | None, limits: Limits, within_s: float
) -> float:
    """Return the largest speed within a time of the prediction's instant."""
    if velocity is None or bound_mps is None:
        return limits.speed_max_mps
    gained_mps = limits.acceleration_max_mps2 * within_s
    return min(limits.speed_max_mps, math.hypot(*velocity) + bound_mps + gained_mps)


def _array(vector: Vector | None) -> FloatArray | None:
    return None if vector is None else np.array(vector)


def _sum(one: Vector, other: Vector) -> Vector:
    (x, y, z), (a, b, c) = one, other
    return x + a, y + b, z + c
