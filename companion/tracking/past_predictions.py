"""Errors of past predictions, as later reports reveal them.

Every report reveals the errors of earlier predictions for its time. For each UAV they select the
acceleration model that would have predicted its own recent reports best, or none: a model that
helps in a steady turn is harmful with sparse or noisy velocities. They also select whether
positions are used as reported, or smoothed along the reported velocities. Finally they give the
usual error at a given age, as a quantile of recent errors: no error distribution is assumed, only
that the near future resembles the recent past.

Over 300 lines: the errors, what is chosen by them and what they tell are one subject.
"""

import math
from array import array
from bisect import bisect_left, bisect_right, insort
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final, NamedTuple

from companion.values import Fix, Vector
from companion.values.newest import append_number


@dataclass(frozen=True, slots=True, kw_only=True)
class AccelerationModel:
    """Model of an acceleration that is fed forward in predictions.

    turns     coordinated turn: the lateral acceleration rotates with the velocity and does not
              decay; the longitudinal part is dropped
    """

    window_s: float  # time over which the slope of the reported velocities is taken; 0: no model
    min_velocities: int  # least number of velocities
    decay_s: float  # time constant with which the acceleration decays
    turns: bool = False


CONSTANT_VELOCITY: Final = AccelerationModel(window_s=0.0, min_velocities=0, decay_s=1.0)
ACCELERATION_MODELS: Final = (
    CONSTANT_VELOCITY,
    AccelerationModel(window_s=1.0, min_velocities=3, decay_s=3.0),
    AccelerationModel(window_s=1.0, min_velocities=3, decay_s=10.0),
    AccelerationModel(window_s=2.5, min_velocities=3, decay_s=10.0),
    AccelerationModel(window_s=5.0, min_velocities=5, decay_s=3.0),
    AccelerationModel(window_s=1.0, min_velocities=3, decay_s=3.0, turns=True),
    AccelerationModel(window_s=2.5, min_velocities=3, decay_s=3.0, turns=True),
    AccelerationModel(window_s=5.0, min_velocities=5, decay_s=3.0, turns=True),
)
"""No model; quick turns, short and long; a sustained turn; a slow, noisy one; circles."""
WINDOWS: Final = sorted(
    {(model.window_s, model.min_velocities) for model in ACCELERATION_MODELS if model.window_s}
)
"""Distinct windows of the acceleration models, each with the velocities needed, ascending."""
_DECAYS_S: Final = frozenset(model.decay_s for model in ACCELERATION_MODELS if model.window_s)
TURNING_MPS: Final = 1.0  # horizontal speed below which the course is undefined
SMOOTHING_SHARE: Final = 0.35  # share of the newest report in a smoothed position
SMOOTHING_GAP_S: Final = 5.0  # gap between reports over which positions are not smoothed
ZERO: Final = (0.0, 0.0, 0.0)
COMPARED_AGES_S: Final = (1.0, 2.0)
"""Least ages of predictions by which models are compared: short, and over a slow radio."""
MEMORY_S: Final = 20.0  # time constant with which squared errors decay
SWITCH_RATIO: Final = 0.9
"""Ratio of mean square errors below which another acceleration model replaces the present one."""
SWITCH_AFTER: Final = 4  # comparisons before a model other than constant velocity is selected
AGES_S: Final = (0.25, 1.0, 2.5)
"""Least ages of the predictions whose errors are kept, to estimate the usual error."""
ERRORS_KEPT: Final = 200
QUANTILE: Final = 0.95
"""Quantile of past errors that is the usual error: of n, the ceil((n + 1) QUANTILE)-th."""
ERRORS_LEAST: Final = 20
SPACING_S: Final = 0.3  # least time between evaluated reports; more would add no information
_KEPT_NS: Final = round((2.0 * AGES_S[-1] + 2.0) * 1e9)
"""Age beyond which a state is not used: see ``PastPredictions._older``."""

UsualErrors = tuple[tuple[float, float], ...]
"""Ages of past predictions, s, each with the 95th percentile of their errors, m."""


class _PastPrediction(NamedTuple):
    """State at a past report, from which all models' predictions can be repeated."""

    sender_ns: int
    position: Vector
    velocity: Vector
    accelerations: tuple[Vector | None, ...]
    smoothing_offset: Vector  # of the smoothed position from the reported one

    def error_m(self, model: int, there: Vector, ahead_s: float) -> float:
        """Return the distance of a model's prediction from a position reported later.

        Models are numbered as in ``ACCELERATION_MODELS``, then once more over smoothed positions.
        """
        number = model % len(ACCELERATION_MODELS)
        offset = ZERO if model == number else self.smoothing_offset
        (n, e, d), (vn, ve, vd), (tn, te, td) = self.position, self.velocity, there
        n, e, d = n + vn * ahead_s - tn, e + ve * ahead_s - te, d + vd * ahead_s - td
        given = self.accelerations[number]
        if given is not None:
            way = fed_forward(ACCELERATION_MODELS[number], given, self.velocity, ahead_s)[0]
            n, e, d = n + way[0], e + way[1], d + way[2]
        n, e, d = n + offset[0], e + offset[1], d + offset[2]
        return math.sqrt(n * n + e * e + d * d)

    def square_errors_m2(self, there: Vector, ahead_s: float) -> list[float]:
        """Return the squares of ``error_m`` for all models, in one pass.

        Models differ in few numbers: what several of them need is computed once.
        """
        (n, e, d), (vn, ve, vd), (tn, te, td) = self.position, self.velocity, there
        n, e, d = n + vn * ahead_s - tn, e + ve * ahead_s - te, d + vd * ahead_s - td
        aside_n, aside_e, aside_d = self.smoothing_offset
        level = vn * vn + ve * ve
        ways_s2 = {s: fading_response(ahead_s, s)[0] for s in _DECAYS_S}
        reported, smoothed = [], []
        for model, given in zip(ACCELERATION_MODELS, self.accelerations, strict=True):
            north, east, down = n, e, d
            if given is not None:
                a, b, c = given
                way_s2 = ways_s2[model.decay_s]
                if model.turns and level >= TURNING_MPS**2:
                    less, aside = _turned((vn * b - ve * a) / level * ahead_s, ahead_s)
                    north += less * vn - aside * ve
                    east += less * ve + aside * vn
                else:
                    north += way_s2 * a
                    east += way_s2 * b
                down += way_s2 * c
            reported.append(north * north + east * east + down * down)
            north, east, down = north + aside_n, east + aside_e, down + aside_d
            smoothed.append(north * north + east * east + down * down)
        return reported + smoothed


@dataclass(slots=True, kw_only=True)
class _Errors:
    """Newest errors of predictions that were about equally old."""

    in_order: "array[float]" = field(default_factory=lambda: array("d"))
    sorted_m: "array[float]" = field(default_factory=lambda: array("d"))
    age_s: float = 0.0
    judged_ns: int = 0
    error_p95_m: float | None = None

    def add(self, error_m: float, age_s: float) -> None:
        if len(self.in_order) == ERRORS_KEPT:
            del self.sorted_m[bisect_left(self.sorted_m, self.in_order[0])]
        append_number(self.in_order, error_m, ERRORS_KEPT)
        insort(self.sorted_m, error_m)
        n = len(self.sorted_m)
        self.age_s += (age_s - self.age_s) / min(n, 20)
        if n >= ERRORS_LEAST:  # split-conformal
            self.error_p95_m = self.sorted_m[min(math.ceil((n + 1) * QUANTILE), n) - 1]


class PastPredictions:
    """Past predictions of one UAV. ``add`` takes reports in order of the sender's time.

    ``usual_errors``: see ``UsualErrors``; ages ascending.
    """

    def __init__(self) -> None:
        self.usual_errors: UsualErrors = ()
        self._states: list[_PastPrediction] = []  # oldest first, of the last ``_KEPT_NS``
        self._times_ns: list[int] = []  # of these states
        self._costs = [0.0] * (2 * len(ACCELERATION_MODELS))
        self._comparisons = 0
        self._compared_ns = 0
        self._model = 0
        self._errors: dict[
            float, _Errors
        ] = {}  # by least age, from the first prediction of that age
        self._smoothed: tuple[int, Vector, Vector] | None = None  # time, position, velocity
        self._smoothing_offset: Vector = ZERO

    @property
    def model(self) -> AccelerationModel:
        """Acceleration model in use for the UAV."""
        return ACCELERATION_MODELS[self._model % len(ACCELERATION_MODELS)]

    @property
    def smoothing_offset(self) -> Vector:
        """Offset of the used position from the newest reported position; m, local frame."""
        return self._smoothing_offset if self._model >= len(ACCELERATION_MODELS) else ZERO

    def smooth(self, fix: Fix) -> None:
        """Update the smoothed position by the newest report; call it for all, before ``add``."""
        before, velocity = self._smoothed, fix.velocity_ned_mps
        self._smoothed, self._smoothing_offset = None, ZERO
        if velocity is None:
            return
        place = fix.position_ned_m
        if before is not None:
            then_ns, (n, e, d), (v_n, v_e, v_d) = before
            dt_s = (fix.sender_ns - then_ns) * 1e-9
            if 0 < dt_s <= SMOOTHING_GAP_S:
                (z_n, z_e, z_d), (w_n, w_e, w_d) = place, velocity
                half, rest = dt_s / 2.0, 1.0 - SMOOTHING_SHARE
                self._smoothing_offset = (
                    rest * (n + half * (v_n + w_n) - z_n),
                    rest * (e + half * (v_e + w_e) - z_e),
                    rest * (d + half * (v_d + w_d) - z_d),
                )
                aside = self._smoothing_offset
                place = (z_n + aside[0], z_e + aside[1], z_d + aside[2])
        self._smoothed = (fix.sender_ns, place, velocity)

    def is_due(self, sender_ns: int) -> bool:
        """Return whether a report at this time must be added."""
        return not self._times_ns or sender_ns - self._times_ns[-1] >= SPACING_S * 1e9

    def add(self, fix: Fix, accelerations: tuple[Vector | None, ...]) -> None:
        """Evaluate earlier predictions by a report; store the state to predict from it.

        ``accelerations``: what each model would feed forward from this report, m/s².
        """
        there = fix.position_ned_m
        self._compare(fix.sender_ns, there)
        for least_s in AGES_S:
            made = self._older(fix.sender_ns, least_s)
            if made is None:
                continue
            errors = self._errors.get(least_s)
            if errors is None:
                errors = self._errors[least_s] = _Errors()
            if made.sender_ns > errors.judged_ns:
                errors.judged_ns = made.sender_ns
                age_s = (fix.sender_ns - made.sender_ns) * 1e-9
                errors.add(made.error_m(self._model, there, age_s), age_s)
        self.usual_errors = tuple(
            [
                (one.age_s, one.error_p95_m)
                for one in map(self._errors.get, AGES_S)
                if one is not None and one.error_p95_m is not None
            ]
        )
        if fix.velocity_ned_mps is not None:
            self._times_ns.append(fix.sender_ns)
            velocity, aside = fix.velocity_ned_mps, self._smoothing_offset
            self._states.append(
                _PastPrediction(
                    sender_ns=fix.sender_ns,
                    position=there,
                    velocity=velocity,
                    accelerations=accelerations,
                    smoothing_offset=aside,
                )
            )
            unused = bisect_left(self._times_ns, fix.sender_ns - _KEPT_NS)
            if unused:
                del self._times_ns[:unused], self._states[:unused]

    def _older(self, sender_ns: int, least_s: float) -> _PastPrediction | None:
        """Return the newest stored state at least this old; None beyond 2 s + twice that age."""
        at = bisect_right(self._times_ns, sender_ns - round(least_s * 1e9)) - 1
        if at < 0 or (sender_ns - self._times_ns[at]) * 1e-9 >= 2.0 * least_s + 2.0:
            return None
        return self._states[at]

    def _compare(self, sender_ns: int, there: Vector) -> None:
        made = self._older(sender_ns, COMPARED_AGES_S[0])
        if made is None or made.sender_ns <= self._compared_ns:
            return
        memory = math.exp(-(made.sender_ns - self._compared_ns) * 1e-9 / MEMORY_S)
        self._compared_ns = made.sender_ns
        costs = [memory * cost for cost in self._costs]
        for one in (made, self._older(sender_ns, COMPARED_AGES_S[1])):
            if one is not None:
                squares_m2 = one.square_errors_m2(there, (sender_ns - one.sender_ns) * 1e-9)
                costs = [c + m2 for c, m2 in zip(costs, squares_m2, strict=True)]
        self._costs = costs
        self._comparisons += 1
        if self._comparisons < SWITCH_AFTER:
            return
        least = min(costs)
        if least < SWITCH_RATIO * costs[self._model]:
            self._model = costs.index(least)


def usual_error_m(known: UsualErrors, age_s: float) -> float | None:
    """Return the 95th percentile of recent errors at an age; None with too few errors.

    The percentile is interpolated between the observed ages, and extrapolated with the square of
    the age.
    """
    if not known:
        return None
    first_s, first_m = known[0]
    if age_s <= first_s:
        return first_m
    for (a_s, a_m), (b_s, b_m) in pairwise(known):
        if age_s <= b_s:
            return a_m + (b_m - a_m) * (age_s - a_s) / (b_s - a_s)
    last_s, last_m = known[-1]
    return last_m * (age_s / last_s) ** 2


def fed_forward(
    model: AccelerationModel, acceleration: Vector, velocity: Vector, ahead_s: float
) -> tuple[Vector, Vector]:
    """Return displacement (m) and change of velocity (m/s) by an acceleration within a time.

    A turn in the plane at the rate w = (v x a) / v^2 rotates the velocity by w t, and the
    displacement is the integral of that (docs/math.md 5.1).
    """
    displacement_s2, gain_s = fading_response(ahead_s, model.decay_s)
    (a, b, c), (north, east, _) = acceleration, velocity
    level = north * north + east * east
    if not model.turns or level < TURNING_MPS**2:
        return (displacement_s2 * a, displacement_s2 * b, displacement_s2 * c), (
            gain_s * a,
            gain_s * b,
            gain_s * c,
        )
    angle = min(max((north * b - east * a) / level * ahead_s, -math.pi), math.pi)
    less, aside = _turned(angle, ahead_s)
    along, across = math.sin(angle), 1.0 - math.cos(angle)
    return (
        (less * north - aside * east, less * east + aside * north, displacement_s2 * c),
        (-across * north - along * east, -across * east + along * north, gain_s * c),
    )


def _turned(angle: float, ahead_s: float) -> tuple[float, float]:
    """Return the displacement by a turn of an angle, along and across a unit velocity; seconds."""
    angle = min(max(angle, -math.pi), math.pi)
    if abs(angle) > 1e-3:
        return ahead_s * (math.sin(angle) / angle - 1.0), ahead_s * (
            (1.0 - math.cos(angle)) / angle
        )
    # Series for small angles: (sin x / x - 1) t and (1 - cos x) / x t.
    return ahead_s * (-angle * angle / 6.0), ahead_s * (angle / 2.0)


def fading_response(ahead_s: float, decay_s: float) -> tuple[float, float]:
    """Return displacement (s²) and gain in speed (s) by a decaying unit acceleration.

    These are s(τ) of docs/math.md 5.1, and its derivative.
    """
    shrink = math.exp(-ahead_s / decay_s)
    return decay_s * decay_s * (shrink - 1.0 + ahead_s / decay_s), decay_s * (1.0 - shrink)
