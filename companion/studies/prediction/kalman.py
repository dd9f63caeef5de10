"""Kalman filters on the sender's clock, with two or three states per axis.

The model, per axis, all axes alike: x = [p v] or [p v a], driven by white noise of spectral
density q in the derivative after the last. With k the number of derivatives,

    F(T)_ij = T^(j-i) / (j-i)!                                       (j >= i)
    Q(T)_ij = q T^(2k+1-i-j) / ((2k+1-i-j) (k-i)! (k-j)!)            (i, j = 0 .. k)

Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation
(2001), sections 6.2.2 and 6.2.3.
"""

import math
from bisect import bisect_right
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from companion.studies.prediction.baselines import ObservedReport, Predicted
from companion.values import FloatArray

HISTORY: Final = 64
"""Number of reports that a Kalman filter keeps, so that a late one can be sorted in."""
_S_PER_NS: Final = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Tuning:
    """Noise that a Kalman filter assumes, the same on each axis.

    ``process_density`` is the spectral density of the white noise in the last derivative's rate,
    m²/s³ for two states (acceleration), m²/s⁵ for three (jerk). The other values are standard
    deviations; ``start_*`` are those of states that the first report does not contain.
    """

    process_density: float
    position_noise_m: float = 0.3
    velocity_noise_mps: float = 0.1
    start_velocity_mps: float = 30.0
    start_acceleration_mps2: float = 5.0


class _Filtered(NamedTuple):
    """Report and filter state after it: mean (n, 3), covariance (n, n) common to the axes."""

    report: ObservedReport
    mean: FloatArray
    covariance: FloatArray


class Kalman:
    """Kalman filter on the sender's clock: 2 states per axis (``cv``) or 3 (``ca``).

    An overtaken report is sorted in and later ones are filtered again, if it is among the last
    ``HISTORY``; an older one is dropped.

    Several tunings are as many filters at once, and all results have a first axis for them.
    """

    def __init__(self, states: int, tuning: Tuning, *others: Tuning) -> None:
        if states not in (2, 3):
            raise ValueError(f"filter has {states} states per axis, allowed: 2 or 3")
        self._states = states
        rows = np.array([_numbers(each) for each in (tuning, *others)])
        numbers = rows.T if others else rows[0]
        self._density, self._position_noise, self._velocity_noise = numbers[:3]
        self._deviations = np.moveaxis(numbers[[1, 3, 4]], 0, -1)[..., :states]
        self._history: list[_Filtered] = []
        self._offset_ns = 0

    def report(self, report: ObservedReport) -> None:
        """Filter a report, in the order in which the reports were made."""
        self._offset_ns = report.sent_ns - report.sender_ns
        history = self._history
        at = bisect_right(history, report.sender_ns, key=lambda entry: entry.report.sender_ns)
        if at == 0 and len(history) == HISTORY:
            return
        again = [entry.report for entry in history[at:]]
        del history[at:]
        for each in (report, *again):
            history.append(self._after(history[-1] if history else None, each))
        if len(history) > HISTORY:
            del history[0]

    def predict(self, now_ns: int, at_ns: int) -> Predicted | None:
        """Return the mean, extrapolated from the newest report."""
        if not self._history:
            return None
        newest = self._history[-1]
        interval_s = (at_ns - self._offset_ns - newest.report.sender_ns) * _S_PER_NS
        mean = newest.mean
        velocity = mean[..., 1, :]
        position = mean[..., 0, :] + velocity * interval_s
        if self._states == 3:
            acceleration = mean[..., 2, :]
            position = position + acceleration * (interval_s * interval_s / 2)
            velocity = velocity + acceleration * interval_s
        return Predicted(position_ned_m=position, velocity_ned_mps=velocity)

    def _after(self, before: _Filtered | None, report: ObservedReport) -> _Filtered:
        if before is None:
            mean, covariance = self._start(report)
        else:
            interval_s = (report.sender_ns - before.report.sender_ns) * _S_PER_NS
            move = transition(self._states, interval_s)
            added = process_noise(self._states, interval_s, 1.0) * self._density[..., None, None]
            mean, covariance = _conditioned(
                move @ before.mean,
                move @ before.covariance @ move.T + added,
                0,
                report.position_ned_m,
                self._position_noise,
            )
        if report.velocity_ned_mps is not None:
            mean, covariance = _conditioned(
                mean, covariance, 1, report.velocity_ned_mps, self._velocity_noise
            )
        return _Filtered(report, mean, covariance)

    def _start(self, report: ObservedReport) -> tuple[FloatArray, FloatArray]:
        """Return the first position as reported; unknown states are 0 with large deviations."""
        deviations = self._deviations
        mean = np.zeros((*deviations.shape, 3))
        mean[..., 0, :] = report.position_ned_m
        return mean, np.square(deviations)[..., None] * np.eye(self._states)


def _numbers(tuning: Tuning) -> tuple[float, ...]:
    return (
        tuning.process_density,
        tuning.position_noise_m,
        tuning.velocity_noise_mps,
        tuning.start_velocity_mps,
        tuning.start_acceleration_mps2,
    )


def _conditioned(
    mean: FloatArray, covariance: FloatArray, state: int, measured: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Condition mean (..., n, 3), covariance (..., n, n) on a state measured per axis (3,).

    The measurement's noise has the shape (...).
    """
    column = covariance[..., state]
    gain = (column / (column[..., state] + noise * noise)[..., None])[..., None]
    after: FloatArray = mean + gain * (measured - mean[..., state, :])[..., None, :]
    remaining: FloatArray = covariance - gain * column[..., None, :]
    return after, remaining


@lru_cache(maxsize=1024)
def transition(states: int, interval_s: float) -> FloatArray:
    """Return F, (n, n): one axis over an interval with its last derivative constant."""
    t = interval_s
    if states == 2:
        return np.array([[1.0, t], [0.0, 1.0]])
    return np.array([[1.0, t, t * t / 2], [0.0, 1.0, t], [0.0, 0.0, 1.0]])


@lru_cache(maxsize=1024)
def process_noise(states: int, interval_s: float, density: float) -> FloatArray:
    """Return Q, (n, n): covariance that white noise in the last derivative's rate adds."""
    k = states - 1
    return np.array(
        [
            [
                density
                * interval_s ** (2 * k + 1 - i - j)
                / ((2 * k + 1 - i - j) * math.factorial(k - i) * math.factorial(k - j))
                for j in range(states)
            ]
            for i in range(states)
        ]
    )
