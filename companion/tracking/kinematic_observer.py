"""The observer on the kinematic model: position and velocity measured, acceleration unknown.

Per axis, over an interval T from one report to the next,

    x = [p; v],   x+ = A(T) x + B(T) a,   y = x + noise,   A(T) = [1 T; 0 1]
    x^+ = A x^ + L(T) (y - x^)
    |p error|+ <= |a11 - l11| |e_p| + |a12 - l12| |e_v| + |l11| N_p + |l12| N_v + A T^2 / 2
    |v error|+ <= |a21 - l21| |e_p| + |a22 - l22| |e_v| + |l21| N_p + |l22| N_v + A T

the running bound, where A bounds the acceleration and N_p, N_v the report's noise. The gain is the
same for every axis, so the norms of the horizontal pair, of the height and of all three obey it,
each with its own noise. Gains come from a design with one Lyapunov function over a range of T
(``kinematic.KinematicDesign``); the bound holds whatever they are.

The same step with T = the time since the report predicts, backwards too. A UAV never moves
faster than ``speed_mps``, which limits the bound over long gaps.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

from companion.tracking.estimates import Prediction
from companion.tracking.kinematic import KinematicDesign, correction
from companion.values import Fix, FloatArray

Gain = tuple[float, float, float, float]
"""L row by row: l11 (1), l12 (s), l21 (1/s), l22 (1)."""
GainSchedule = Callable[[float], Gain]
"""The gain for an interval in seconds."""


VELOCITY_SHARE = 0.5
"""Without a reported velocity: how much of what a report shows of it is believed. The error then
has the eigenvalues 0 and 1 - share over equal intervals."""


def deadbeat(interval_s: float) -> Gain:
    """L = A(T): the report alone, carried on at its velocity; what the worst case asks for."""
    return 1.0, interval_s, 0.0, 1.0


def scheduled(design: KinematicDesign) -> GainSchedule:
    """L = A(T) M(T) with the design's M, at the ends of its range beyond it."""

    def gain(interval_s: float) -> Gain:
        m11, m12, m21, m22 = correction(design, interval_s)
        return m11 + interval_s * m21, m12 + interval_s * m22, m21, m22

    return gain


@dataclass(frozen=True, slots=True)
class KinematicModel:
    """What is taken for granted: norms of 3-vectors that are never exceeded, and the gains."""

    speed_mps: float
    acceleration_mps2: float
    gain: GainSchedule = deadbeat


@dataclass(frozen=True, slots=True)
class KinematicState:
    """The estimate at a report's time, made before that report, its bounds, and the report."""

    fix: Fix
    position_ned_m: FloatArray
    velocity_ned_mps: FloatArray
    horizontal_m: float
    vertical_m: float
    position_m: float
    velocity_mps: float
    interval_s: float | None


class KinematicObserver:
    """See ``estimates.Observer``. Reports without velocity let it be estimated from positions."""

    def __init__(self, model: KinematicModel) -> None:
        self.model = model

    def begin(self, fix: Fix) -> KinematicState:
        """A track of one report: the report is the estimate; without velocity it is at rest,
        and may be at full speed."""
        velocity = fix.velocity_ned_mps
        return KinematicState(
            fix,
            fix.position_ned_m,
            fix.position_ned_m * 0.0 if velocity is None else velocity,
            fix.noise.horizontal_m,
            fix.noise.vertical_m,
            fix.noise.position_m,
            self.model.speed_mps if velocity is None else fix.noise.velocity_mps,
            None,
        )

    def predict(self, state: KinematicState, sender_ns: int) -> Prediction:
        """Where the UAV is, and how fast it goes."""
        fix, noise, model = state.fix, state.fix.noise, self.model
        t = (sender_ns - fix.sender_ns) * 1e-9
        age = abs(t)
        l11, l12, l21, l22 = self._gain(state, t)
        measured = state.velocity_ned_mps if fix.velocity_ned_mps is None else fix.velocity_ned_mps
        m11, m12, m22 = 1.0 - l11, t - l12, 1.0 - l22
        position = (
            m11 * state.position_ned_m
            + m12 * state.velocity_ned_mps
            + l11 * fix.position_ned_m
            + l12 * measured
        )
        velocity = m22 * state.velocity_ned_mps + l22 * measured
        if l21:
            velocity = velocity + l21 * (fix.position_ned_m - state.position_ned_m)
        drift_m = (
            abs(m12) * state.velocity_mps
            + abs(l12) * noise.velocity_mps
            + model.acceleration_mps2 * age * age / 2
        )
        horizontal_m = abs(m11) * state.horizontal_m + abs(l11) * noise.horizontal_m + drift_m
        vertical_m = abs(m11) * state.vertical_m + abs(l11) * noise.vertical_m + drift_m
        bound_m = abs(m11) * state.position_m + abs(l11) * noise.position_m + drift_m
        velocity_mps = (
            abs(l21) * (state.position_m + noise.position_m)
            + abs(m22) * state.velocity_mps
            + abs(l22) * noise.velocity_mps
            + model.acceleration_mps2 * age
        )
        bound_m = min(bound_m, math.hypot(horizontal_m, vertical_m))
        found = Prediction(
            position, velocity, bound_m, horizontal_m, vertical_m, velocity_mps, None
        )
        reach_m = age * model.speed_mps
        if (
            velocity_mps <= model.speed_mps
            and horizontal_m <= noise.horizontal_m + reach_m
            and vertical_m <= noise.vertical_m + reach_m
            and bound_m <= noise.position_m + reach_m
        ):
            return found  # the greatest speed says no more
        return self._limited(fix, reach_m, found)

    def _gain(self, state: KinematicState, t: float) -> Gain:
        """The scheduled gain; without a reported velocity, A(t) [1; share / interval before]."""
        if state.fix.velocity_ned_mps is not None:
            return self.model.gain(t)
        if state.interval_s is None:
            return 1.0, 0.0, 0.0, 0.0
        rate = VELOCITY_SHARE / state.interval_s
        return 1.0 + rate * t, 0.0, rate, 0.0

    def after(self, state: KinematicState, predicted: Prediction, fix: Fix) -> KinematicState:
        """The state at a report: the delayed observer's estimate there does not use it yet."""
        velocity, bound_mps = predicted.velocity_ned_mps, predicted.velocity_bound_mps
        assert velocity is not None
        assert bound_mps is not None
        return KinematicState(
            fix,
            predicted.position_ned_m,
            velocity,
            predicted.horizontal_m,
            predicted.vertical_m,
            predicted.bound_m,
            bound_mps,
            (fix.sender_ns - state.fix.sender_ns) * 1e-9,
        )

    def _limited(self, fix: Fix, reach_m: float, found: Prediction) -> Prediction:
        """The bounds where the greatest speed says more than the acceleration."""
        assert found.velocity_ned_mps is not None
        assert found.velocity_bound_mps is not None
        horizontal_m, vertical_m = found.horizontal_m, found.vertical_m
        north, east, down = (found.position_ned_m - fix.position_ned_m).tolist()
        horizontal_m = min(horizontal_m, fix.noise.horizontal_m + reach_m + math.hypot(north, east))
        vertical_m = min(vertical_m, fix.noise.vertical_m + reach_m + abs(down))
        moved_m = math.hypot(north, east, down)
        bound_m = min(found.bound_m, fix.noise.position_m + reach_m + moved_m)
        fastest_mps = self.model.speed_mps + math.hypot(*found.velocity_ned_mps.tolist())
        return Prediction(
            found.position_ned_m,
            found.velocity_ned_mps,
            min(bound_m, math.hypot(horizontal_m, vertical_m)),
            horizontal_m,
            vertical_m,
            min(found.velocity_bound_mps, fastest_mps),
            None,
        )
