"""Observer on the kinematic model: position and velocity measured, acceleration unknown.

Per axis, over an interval T from one report to the next,

    x = [p; v],   x+ = A(T) x + B(T) a,   y = x + noise,   A(T) = [1 T; 0 1]
    x^+ = A x^ + L(T) (y - x^)
    |p error|+ <= |a11 - l11| |e_p| + |a12 - l12| |e_v| + |l11| N_p + |l12| N_v + A T^2 / 2
    |v error|+ <= |a21 - l21| |e_p| + |a22 - l22| |e_v| + |l21| N_p + |l22| N_v + A T

The last two lines are the running bound, where A bounds the acceleration and N_p, N_v the report's
noise. The gain is the same for every axis, so the norms of the horizontal pair, of the height and
of all three obey it, each with its own noise. Gains come from a design with one Lyapunov function
over a range of T (``gain_table.KinematicDesign``); the bound holds for any gains.

The same step predicts, with T the time since the report; backwards too, with |T| in the last terms.
The largest speed ``speed_max_mps`` limits the bound over long gaps. See docs/math.md 4; the step
is paper eq. (8) with A(T) - L for Q.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

from companion.tracking.design.gain_table import KinematicDesign, correction
from companion.tracking.observers.estimates import Prediction
from companion.values import Fix, Vector

Gain = tuple[float, float, float, float]  # l row by row: l11 (1), l12 (s), l21 (1/s), l22 (1)
GainSchedule = Callable[[float], Gain]  # function from an interval in seconds to the gain


VELOCITY_SHARE = 0.5
"""Weight of a velocity derived from positions, if no velocity is reported.

Over equal intervals the error then has the eigenvalues 0 and 1 - share.
"""
GAINS_KEPT = 1024  # newest gains that are kept, by their interval
MIN_DIFFERENCE_S = 0.1
"""Least interval for a velocity from positions, whose noise would mean km/s below it."""


def deadbeat(interval_s: float) -> Gain:
    """Return L = A(T): the report alone, extrapolated at its velocity; worst-case optimal."""
    return 1.0, interval_s, 0.0, 1.0


def scheduled(design: KinematicDesign) -> GainSchedule:
    """Return L = A(T) M(T) with the design's M, held constant outside the design's range."""

    def gain(interval_s: float) -> Gain:
        m11, m12, m21, m22 = correction(design, interval_s)
        return m11 + interval_s * m21, m12 + interval_s * m22, m21, m22

    return gain


@dataclass(frozen=True, slots=True)
class KinematicModel:
    """Settings of the kinematic observer: bounds on speed and acceleration (norms), and gains.

    The bounds apply to reports that have no ``limits`` of their own.
    """

    speed_max_mps: float
    acceleration_max_mps2: float
    gain: GainSchedule = deadbeat


class KinematicState(NamedTuple):
    """Estimate at a report's time before the report is used, its bounds, and the report.

    The class is a tuple for speed.

    position_ned_m, velocity_ned_mps
                  the estimate, local frame
    """

    fix: Fix
    position_ned_m: Vector
    velocity_ned_mps: Vector
    horizontal_m: float  # bound on the position error in the plane
    vertical_m: float  # bound on the error in height
    position_m: float  # bound on the norm of the position error
    velocity_mps: float  # bound on the norm of the velocity error
    interval_s: float | None  # interval since the previous report; None for the first


class KinematicObserver:
    """Observer on the kinematic model; see ``estimates.Observer``.

    If reports have no velocity, it is estimated from the positions.
    """

    def __init__(self, model: KinematicModel) -> None:
        self.model = model
        # Stamps are whole milliseconds, so that intervals between reports recur.
        self._gain_over = lru_cache(GAINS_KEPT)(model.gain)

    def begin(self, fix: Fix) -> KinematicState:
        """Return the state of a track that has one report, whose values are the estimate.

        Without a reported velocity the estimate is at rest, with the largest speed as its bound.
        """
        velocity, fastest_mps = fix.velocity_ned_mps, (fix.limits or self.model).speed_max_mps
        return KinematicState(
            fix=fix,
            position_ned_m=fix.position_ned_m,
            velocity_ned_mps=(0.0, 0.0, 0.0) if velocity is None else velocity,
            horizontal_m=fix.noise.horizontal_m,
            vertical_m=fix.noise.vertical_m,
            position_m=fix.noise.position_m,
            velocity_mps=fastest_mps if velocity is None else fix.noise.velocity_mps,
            interval_s=None,
        )

    def predict(self, state: KinematicState, sender_ns: int) -> Prediction:
        """Predict position and velocity to a time, with their bounds."""
        fix = state.fix
        t = (sender_ns - fix.sender_ns) * 1e-9
        gain = self._gain(state, t)
        position, velocity = _propagated(state, t, gain)
        return self._bounded(state, t, gain, position, velocity)

    def carry(self, state: KinematicState, sender_ns: int) -> tuple[Vector, Vector] | None:
        """Return position and velocity as ``predict``; None if no velocity is reported."""
        if state.fix.velocity_ned_mps is None:
            return None
        t = (sender_ns - state.fix.sender_ns) * 1e-9
        return _propagated(state, t, self.model.gain(t))

    def _bounded(
        self, state: KinematicState, t: float, gain: Gain, position: Vector, velocity: Vector
    ) -> Prediction:
        fix, noise = state.fix, state.fix.noise
        model = fix.limits or self.model
        l11, l12, l21, l22 = gain
        age, kept, taken = abs(t), abs(1.0 - l11), abs(l11)
        drift_m = (
            abs(t - l12) * state.velocity_mps
            + abs(l12) * noise.velocity_mps
            + model.acceleration_max_mps2 * age * age / 2
        )
        horizontal_m = kept * state.horizontal_m + taken * noise.horizontal_m + drift_m
        vertical_m = kept * state.vertical_m + taken * noise.vertical_m + drift_m
        bound_m = kept * state.position_m + taken * noise.position_m + drift_m
        velocity_mps = (
            abs(l21) * (state.position_m + noise.position_m)
            + abs(1.0 - l22) * state.velocity_mps
            + abs(l22) * noise.velocity_mps
            + model.acceleration_max_mps2 * age
        )
        bound_m = min(bound_m, math.hypot(horizontal_m, vertical_m))
        found = Prediction(
            position_ned_m=position,
            velocity_ned_mps=velocity,
            bound_m=bound_m,
            horizontal_m=horizontal_m,
            vertical_m=vertical_m,
            velocity_bound_mps=velocity_mps,
            mu_s2=None,
        )
        reach_m = age * model.speed_max_mps
        if (
            velocity_mps <= model.speed_max_mps
            and horizontal_m <= noise.horizontal_m + reach_m
            and vertical_m <= noise.vertical_m + reach_m
            and bound_m <= noise.position_m + reach_m
        ):
            return found  # the largest speed gives no tighter bound
        return self._limited(fix, reach_m, found, model.speed_max_mps)

    def _gain(self, state: KinematicState, t: float) -> Gain:
        """Return the scheduled gain; without velocity, A(t) [1; share / previous interval]."""
        if state.fix.velocity_ned_mps is not None:
            return self._gain_over(t)
        if state.interval_s is None:
            return 1.0, 0.0, 0.0, 0.0
        rate = VELOCITY_SHARE / max(state.interval_s, MIN_DIFFERENCE_S)
        return 1.0 + rate * t, 0.0, rate, 0.0

    def after(self, state: KinematicState, predicted: Prediction, fix: Fix) -> KinematicState:
        """Return the observer's state at a report.

        The observer is delayed: the estimate at a report does not use that report yet.
        """
        velocity, bound_mps = predicted.velocity_ned_mps, predicted.velocity_bound_mps
        assert velocity is not None
        assert bound_mps is not None
        return KinematicState(
            fix=fix,
            position_ned_m=predicted.position_ned_m,
            velocity_ned_mps=velocity,
            horizontal_m=predicted.horizontal_m,
            vertical_m=predicted.vertical_m,
            position_m=predicted.bound_m,
            velocity_mps=bound_mps,
            interval_s=(fix.sender_ns - state.fix.sender_ns) * 1e-9,
        )

    def _limited(self, fix: Fix, reach_m: float, found: Prediction, speed_mps: float) -> Prediction:
        """Limit the bounds of a prediction by the largest speed."""
        assert found.velocity_ned_mps is not None
        assert found.velocity_bound_mps is not None
        horizontal_m, vertical_m = found.horizontal_m, found.vertical_m
        (n, e, d), (there_n, there_e, there_d) = fix.position_ned_m, found.position_ned_m
        north, east, down = there_n - n, there_e - e, there_d - d
        horizontal_m = min(horizontal_m, fix.noise.horizontal_m + reach_m + math.hypot(north, east))
        vertical_m = min(vertical_m, fix.noise.vertical_m + reach_m + abs(down))
        moved_m = math.hypot(north, east, down)
        bound_m = min(found.bound_m, fix.noise.position_m + reach_m + moved_m)
        fastest_mps = speed_mps + math.hypot(*found.velocity_ned_mps)
        return Prediction(
            position_ned_m=found.position_ned_m,
            velocity_ned_mps=found.velocity_ned_mps,
            bound_m=min(bound_m, math.hypot(horizontal_m, vertical_m)),
            horizontal_m=horizontal_m,
            vertical_m=vertical_m,
            velocity_bound_mps=min(found.velocity_bound_mps, fastest_mps),
            mu_s2=None,
        )


def _propagated(state: KinematicState, t: float, gain: Gain) -> tuple[Vector, Vector]:
    """Return position and velocity at a time after the state's report, by that time's gain."""
    fix = state.fix
    l11, l12, l21, l22 = gain
    m11, m12, m22 = 1.0 - l11, t - l12, 1.0 - l22
    p1, p2, p3 = state.position_ned_m
    v1, v2, v3 = state.velocity_ned_mps
    y1, y2, y3 = fix.position_ned_m
    w1, w2, w3 = fix.velocity_ned_mps or state.velocity_ned_mps
    position = (
        m11 * p1 + m12 * v1 + l11 * y1 + l12 * w1,
        m11 * p2 + m12 * v2 + l11 * y2 + l12 * w2,
        m11 * p3 + m12 * v3 + l11 * y3 + l12 * w3,
    )
    velocity = (
        m22 * v1 + l22 * w1 + l21 * (y1 - p1),
        m22 * v2 + l22 * w2 + l21 * (y2 - p2),
        m22 * v3 + l22 * w3 + l21 * (y3 - p3),
    )
    return position, velocity
