"""Unknown input observer on the position model, with gains scheduled by the actual interval.

Per axis, over an interval b from one report to the next,

    x+ = x + b w,     y = x + d w + noise,     w the mean velocity over the interval, unknown
    x^+ = q x^ + l y,   q = 1 - l,   l = l*(b, d)          (``closed_form.gain``)
    |e+| <= |1 - l| |e| + |l d - b| W + |l| N       the running bound, exact for given W and N

where W bounds the speed and N the report's noise. The same step predicts, with b the time since the
report: the estimate at t is the observer's if its next report came at t. The gain is the same for
all axes, so norms of 3-vectors obey the same bound. The model is docs/math.md 1, paper eq. (6), the
step docs/math.md 2, paper eq. (8), the bound docs/math.md 2.4.

A sender whose reports lead by d has mean velocities over d and over b that differ by at most
A |b - d| / 2, with A a bound on acceleration; d times that is added to N.

If a sender also reports velocity, the feedthrough can be chosen: y = p + d v leads the position by
d, with noise  N = N_p + d (N_v + A b / 2), since the mean velocity of the interval differs from
v by at most A b / 2. With d >= b the unknown velocity is decoupled completely (l d = b), and only
noise and acceleration remain: x^+ = x^ + b v + (b / d)(p - x^). Here d =
max(``velocity_lead_s``, b). See docs/math.md 2.6.

Time is an argument, on the sender's own timeline; states are frozen values.
"""

from dataclasses import dataclass

from companion.tracking.design import closed_form
from companion.tracking.observers.estimates import Prediction
from companion.values import Fix, Vector


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionModel:
    """Settings of the position observer.

    Speed and acceleration are norms of 3-vectors that are never exceeded.

        alpha            decay in (0, 1); None: the best at each interval
        feedthrough_s    lead of the *sender's* reports (negative: lag); 0 if the time of a report
                         is known
        velocity_lead_s  least lead computed from a reported velocity; a longer one smooths more
    """

    speed_max_mps: float
    acceleration_max_mps2: float
    alpha: float | None = None
    feedthrough_s: float = 0.0
    velocity_lead_s: float = 0.2


@dataclass(frozen=True, slots=True)
class PositionState:
    """Estimate at a report's time before the report is used, its bound, and the report."""

    fix: Fix
    estimate_ned_m: Vector
    bound_m: float


class PositionObserver:
    """Observer on the position model; see ``estimates.Observer``."""

    def __init__(self, model: PositionModel) -> None:
        self.model = model

    def begin(self, fix: Fix) -> PositionState:
        """Return the state of a track that has one report, whose position is the estimate."""
        lead_m = abs(self.model.feedthrough_s) * (fix.limits or self.model).speed_max_mps
        return PositionState(fix, fix.position_ned_m, fix.noise.position_m + lead_m)

    def predict(self, state: PositionState, sender_ns: int) -> Prediction:
        """Predict the position with its bound.

        Before the report's own time only the bound grows.
        """
        model, fix = self.model, state.fix
        limits = fix.limits or model
        b = (sender_ns - fix.sender_ns) * 1e-9
        if b <= 0:
            bound_m = state.bound_m - b * limits.speed_max_mps
            return self._prediction(state, state.estimate_ned_m, bound_m, b, 0.0)
        d, noise_m, lead_s = model.feedthrough_s, fix.noise.position_m, 0.0
        # The mean velocity over the sender's lead differs from that over the interval.
        noise_m += abs(d) * limits.acceleration_max_mps2 * abs(b - d) / 2
        if fix.velocity_ned_mps is not None:
            lead_s = max(model.velocity_lead_s, b)
            d += lead_s
            noise_m += lead_s * (fix.noise.velocity_mps + limits.acceleration_max_mps2 * b / 2)
        alpha = closed_form.best_alpha(b, d) if model.alpha is None else model.alpha
        gain = closed_form.gain(b, d, alpha)
        bound_m = (
            abs(1 - gain) * state.bound_m
            + abs(gain * d - b) * limits.speed_max_mps
            + abs(gain) * noise_m
        )
        estimate = _corrected(state, lead_s, gain)
        return self._prediction(state, estimate, bound_m, b, closed_form.mu_star(b, d, alpha))

    def carry(self, _state: PositionState, _sender_ns: int) -> tuple[Vector, Vector] | None:
        """Return None: ``reach.py`` does not bound this observer's predictions."""
        return None

    def after(self, _state: PositionState, predicted: Prediction, fix: Fix) -> PositionState:
        """Return the observer's state at a report.

        The observer is delayed: the estimate at a report does not use that report yet.
        """
        return PositionState(fix, predicted.position_ned_m, predicted.bound_m)

    def _prediction(
        self, state: PositionState, estimate: Vector, bound_m: float, b: float, mu_s2: float
    ) -> Prediction:
        """Return a prediction with the reported velocity, whose bound grows with time."""
        fix = state.fix
        changed_mps = fix.noise.velocity_mps + (
            fix.limits or self.model
        ).acceleration_max_mps2 * abs(b)
        velocity_bound_mps = None if fix.velocity_ned_mps is None else changed_mps
        return Prediction(
            position_ned_m=estimate,
            velocity_ned_mps=fix.velocity_ned_mps,
            bound_m=bound_m,
            horizontal_m=bound_m,
            vertical_m=bound_m,
            velocity_bound_mps=velocity_bound_mps,
            mu_s2=mu_s2,
        )


def _corrected(state: PositionState, lead_s: float, gain: float) -> Vector:
    """Return the estimate corrected by the gain towards the report, which is led forward."""
    x1, x2, x3 = state.estimate_ned_m
    y1, y2, y3 = state.fix.position_ned_m
    v1, v2, v3 = state.fix.velocity_ned_mps or (0.0, 0.0, 0.0)
    return (
        x1 + gain * (y1 + lead_s * v1 - x1),
        x2 + gain * (y2 + lead_s * v2 - x2),
        x3 + gain * (y3 + lead_s * v3 - x3),
    )
