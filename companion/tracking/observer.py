"""The unknown input observer on the position model, with gains scheduled by the real interval.

Per axis, over an interval b from one report to the next,

    x+ = x + b w,     y = x + d w + noise,     w the mean velocity over the interval, unknown

    x^+ = x^ + l (y - x^),   l = l*(b, d)          (``design.gain``)
    |e+| <= |1 - l| |e| + |l d - b| W + |l| N       the running bound, exact for given W and N

where W bounds the speed and N the report's noise. The same step with b = the time since the
report, whatever it is, predicts: the estimate at t is what the observer would hold if its next
report came at t. The gain is the same for all axes, so norms of 3-vectors obey the same bound.

Where it is the sender that leads, by d, the mean velocities over d and over b differ by at most
A |b - d| / 2, A a bound on acceleration, and N has d times that besides.

A sender that also reports velocity lets us choose the feedthrough: y = p + d v leads the
position by d, with noise  N = N_p + d (N_v + A b / 2)  since the mean velocity of the interval
differs from v by at most A b / 2. With d >= b the unknown velocity is
decoupled altogether (l d = b), and what is left is noise and acceleration:
x^+ = x^ + b v + (b / d)(p - x^). Here d = max(``velocity_lead_s``, b).

Time is an argument, on the sender's own timeline; states are frozen values.
"""

from dataclasses import dataclass

import numpy as np

from companion.tracking import design
from companion.values import Fix, FloatArray


@dataclass(frozen=True, slots=True)
class Bounds:
    """What is taken for granted, and all that is: norms of 3-vectors that are never exceeded."""

    speed_mps: float
    acceleration_mps2: float
    position_noise_m: float
    velocity_noise_mps: float


@dataclass(frozen=True, slots=True)
class PositionModel:
    """Settings of the observer. ``alpha=None`` takes the best one at each interval.

    ``feedthrough_s``: by how much the *sender* makes its reports lead (negative: lag); 0 where
    the time of a report is known. ``velocity_lead_s``: the least lead that is made of a reported
    velocity; more smooths more.
    """

    bounds: Bounds
    alpha: float | None = None
    feedthrough_s: float = 0.0
    velocity_lead_s: float = 0.2


@dataclass(frozen=True, slots=True)
class PositionState:
    """The estimate at a report's time, made before that report, and the report itself."""

    t_ns: int
    estimate_ned_m: FloatArray
    bound_m: float
    position_ned_m: FloatArray
    velocity_ned_mps: FloatArray | None


@dataclass(frozen=True, slots=True)
class Prediction:
    """Position and its bound at an asked time; ``mu`` is the design's figure for that interval."""

    position_ned_m: FloatArray
    bound_m: float
    mu_s2: float


def begin(fix: Fix, model: PositionModel) -> PositionState:
    """A track of one report: the report is the estimate."""
    bounds = model.bounds
    bound_m = bounds.position_noise_m + abs(model.feedthrough_s) * bounds.speed_mps
    return PositionState(
        fix.sender_ns, fix.position_ned_m, bound_m, fix.position_ned_m, fix.velocity_ned_mps
    )


def predict(state: PositionState, t_ns: int, model: PositionModel) -> Prediction:
    """Where the UAV is at ``t_ns``. Before the report's own time nothing is extrapolated."""
    bounds = model.bounds
    b = (t_ns - state.t_ns) * 1e-9
    if b <= 0:
        return Prediction(state.estimate_ned_m, state.bound_m - b * bounds.speed_mps, 0.0)
    d, y = model.feedthrough_s, state.position_ned_m
    # The mean velocity of the sender's lead is not quite that of the interval.
    noise_m = bounds.position_noise_m + abs(d) * bounds.acceleration_mps2 * abs(b - d) / 2
    if state.velocity_ned_mps is not None:
        lead_s = max(model.velocity_lead_s, b)
        d += lead_s
        y = y + lead_s * state.velocity_ned_mps
        noise_m += lead_s * (bounds.velocity_noise_mps + bounds.acceleration_mps2 * b / 2)
    alpha = design.best_alpha(b, d) if model.alpha is None else model.alpha
    gain = design.gain(b, d, alpha)
    bound_m = (
        abs(1 - gain) * state.bound_m + abs(gain * d - b) * bounds.speed_mps + abs(gain) * noise_m
    )
    estimate = state.estimate_ned_m + gain * (y - state.estimate_ned_m)
    return Prediction(estimate, bound_m, design.mu_star(b, d, alpha))


def update(
    state: PositionState, fix: Fix, model: PositionModel
) -> tuple[PositionState, Prediction, FloatArray]:
    """The state at a newer report, the prediction made for it, and the unknown-input estimate.

    The last is W^ = (x^+ - x^) / b, shape (3,), m/s: the velocity that the estimate needed.
    Raises ``ValueError`` for a report that is not newer than the state.
    """
    if fix.sender_ns <= state.t_ns:
        raise ValueError("a report must be newer than the one before it")
    predicted = predict(state, fix.sender_ns, model)
    interval_s = (fix.sender_ns - state.t_ns) * 1e-9
    unknown_input = (predicted.position_ned_m - state.estimate_ned_m) / interval_s
    after = PositionState(
        fix.sender_ns,
        predicted.position_ned_m,
        predicted.bound_m,
        fix.position_ned_m,
        fix.velocity_ned_mps,
    )
    return after, predicted, unknown_input


def velocity_ned_mps(state: PositionState, unknown_input: FloatArray | None) -> FloatArray | None:
    """The best known velocity: the reported one, else the unknown-input estimate."""
    return state.velocity_ned_mps if state.velocity_ned_mps is not None else unknown_input


def norm_m(vector: FloatArray) -> float:
    """Euclidean norm of a 3-vector."""
    return float(np.sqrt(vector @ vector))
