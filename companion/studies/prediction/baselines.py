"""Baselines for the observer: hold, dead reckoning and Kalman filters.

All are asked alike: at ``now_ns``, knowing only what has arrived by then, where is the UAV at
``at_ns``? They differ in what they make of a report's time:

* ``Hold`` and ``DeadReckoningOnArrival`` know only when it arrived, and trust the last to arrive;
* ``DeadReckoning`` and ``Kalman`` know when it was made (the sender's clock), so that a late or
  overtaken report is worth what it is worth. They keep to the sender's own timeline, and convert
  the time they are asked for by what the last report to arrive says of the clock.

Kalman's model, per axis, all axes alike: x = [p v] or [p v a], driven by white noise of spectral
density q in the derivative after the last. With k the number of derivatives,

    F(T)_ij = T^(j-i) / (j-i)!                                       (j >= i)
    Q(T)_ij = q T^(2k+1-i-j) / ((2k+1-i-j) (k-i)! (k-j)!)            (i, j = 0 .. k)

Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation
(2001), sections 6.2.2 and 6.2.3.
"""

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

import numpy as np

from companion.values import FloatArray, GnssStatus

TRACKER_TIMEOUT_NS: Final = 5_000_000_000
"""Silence after which AntennaTracker takes a vehicle for lost."""
HISTORY: Final = 64
"""Reports that a Kalman filter keeps, so that a late one can be put in its place."""
_S_PER_NS: Final = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """A report as it reaches a predictor.

        arrival_ns        when it arrived, node time
        sent_ns           when it was made, node time, by the best clock known on arrival
        sender_ns         when it was made, on the sender's timeline
        position_ned_m    (3,), local frame
        velocity_ned_mps  (3,), local frame; None if not reported
        clock_bound_s     bound on the error of ``sent_ns``
        gnss              what the sender last said of its receiver

    The baselines do not use the last two.
    """

    arrival_ns: int
    sent_ns: int
    sender_ns: int
    position_ned_m: FloatArray
    velocity_ned_mps: FloatArray | None
    clock_bound_s: float = 0.0
    gnss: GnssStatus | None = None


class Predicted(NamedTuple):
    """A predicted position and velocity, (3,), local frame.

    ``bound_m`` is None where none is given.

    A tuple rather than a dataclass, because a study makes millions.
    """

    position_ned_m: FloatArray
    velocity_ned_mps: FloatArray | None
    bound_m: float | None


class Predictor(Protocol):
    """One UAV's predictor. Reports come in the order in which they arrive."""

    def report(self, report: Observed) -> None:
        """Take in a report that has just arrived."""

    def predict(self, now_ns: int, at_ns: int) -> Predicted | None:
        """The state at ``at_ns`` from what has arrived by ``now_ns``; None if nothing has."""


class Hold:
    """Holds the last report to arrive."""

    def __init__(self) -> None:
        self._last: Observed | None = None

    def report(self, report: Observed) -> None:
        """Replace the report that is held."""
        self._last = report

    def predict(self, now_ns: int, at_ns: int) -> Predicted | None:
        """The position of the report that is held, whatever the time."""
        if self._last is None:
            return None
        return Predicted(self._last.position_ned_m, None, None)


class DeadReckoningOnArrival:
    """Straight on from the last report, as if made on arrival: as ArduPilot's AntennaTracker does.

    If nothing arrived for 5 s the estimate is no longer moved, and stays where it was then. One
    thing is kinder than the original: that adds vz, which is positive down, to the altitude; here
    the vertical has its sign. A lead, which the original has not, is extrapolated as well. Source:
    ArduPilot, AntennaTracker/tracking.cpp, ``update_vehicle_pos_estimate``.
    """

    def __init__(self) -> None:
        self._last: Observed | None = None

    def report(self, report: Observed) -> None:
        """Keep the newest report by arrival, however old it was when it came."""
        self._last = report

    def predict(self, now_ns: int, at_ns: int) -> Predicted | None:
        """Position plus velocity times the time since arrival, and the lead."""
        last = self._last
        if last is None:
            return None
        age_ns = min(now_ns - last.arrival_ns, TRACKER_TIMEOUT_NS)
        return _straight_on(last, age_ns + at_ns - now_ns)


class DeadReckoning:
    """Straight on from the report that was made last, by the sender's clock."""

    def __init__(self) -> None:
        self._newest: Observed | None = None
        self._offset_ns = 0

    def report(self, report: Observed) -> None:
        """Keep the newest report; one that was overtaken on its way only updates the clock."""
        self._offset_ns = report.sent_ns - report.sender_ns
        if self._newest is None or report.sender_ns > self._newest.sender_ns:
            self._newest = report

    def predict(self, now_ns: int, at_ns: int) -> Predicted | None:
        """Position plus velocity times the time since the report was made."""
        newest = self._newest
        if newest is None:
            return None
        return _straight_on(newest, at_ns - self._offset_ns - newest.sender_ns)


def _straight_on(report: Observed, interval_ns: int) -> Predicted:
    """Constant velocity for an interval; without a reported velocity the position is held."""
    velocity = report.velocity_ned_mps
    if velocity is None:
        return Predicted(report.position_ned_m, None, None)
    return Predicted(report.position_ned_m + velocity * (interval_ns * _S_PER_NS), velocity, None)


@dataclass(frozen=True, slots=True)
class Tuning:
    """Noise assumed by a Kalman filter, the same on each axis.

    ``process_density`` is the spectral density of the white noise in the last derivative's rate,
    m²/s³ for two states (acceleration), m²/s⁵ for three (jerk). The others are standard deviations;
    ``start_*`` are those of what the first report does not say.
    """

    process_density: float
    position_noise_m: float = 0.3
    velocity_noise_mps: float = 0.1
    start_velocity_mps: float = 30.0
    start_acceleration_mps2: float = 5.0


class _Filtered(NamedTuple):
    """A report and the state after it: mean (n, 3), covariance (n, n) common to the axes."""

    report: Observed
    mean: FloatArray
    covariance: FloatArray


class Kalman:
    """Kalman filter on the sender's clock: 2 states per axis (``cv``) or 3 (``ca``).

    A report that was overtaken is put in its place and what came after it is filtered again, as
    long as it is among the last ``HISTORY``; an older one is dropped.
    """

    def __init__(self, states: int, tuning: Tuning) -> None:
        if states not in (2, 3):
            raise ValueError(f"a filter has 2 or 3 states an axis, not {states}")
        self._states = states
        self._tuning = tuning
        self._history: list[_Filtered] = []
        self._offset_ns = 0

    def report(self, report: Observed) -> None:
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
        """The mean, carried on from the newest report."""
        if not self._history:
            return None
        newest = self._history[-1]
        interval_s = (at_ns - self._offset_ns - newest.report.sender_ns) * _S_PER_NS
        position, velocity, *rest = newest.mean
        position = position + velocity * interval_s
        if rest:
            position = position + rest[0] * (interval_s * interval_s / 2)
            velocity = velocity + rest[0] * interval_s
        return Predicted(position, velocity, None)

    def _after(self, before: _Filtered | None, report: Observed) -> _Filtered:
        tuning = self._tuning
        if before is None:
            mean, covariance = self._start(report)
        else:
            interval_s = (report.sender_ns - before.report.sender_ns) * _S_PER_NS
            move = transition(self._states, interval_s)
            added = process_noise(self._states, interval_s, tuning.process_density)
            mean, covariance = _conditioned(
                move @ before.mean,
                move @ before.covariance @ move.T + added,
                0,
                report.position_ned_m,
                tuning.position_noise_m,
            )
        if report.velocity_ned_mps is not None:
            mean, covariance = _conditioned(
                mean, covariance, 1, report.velocity_ned_mps, tuning.velocity_noise_mps
            )
        return _Filtered(report, mean, covariance)

    def _start(self, report: Observed) -> tuple[FloatArray, FloatArray]:
        """The first position as reported; unknown states are 0 with large deviations."""
        tuning = self._tuning
        deviations = (
            tuning.position_noise_m,
            tuning.start_velocity_mps,
            tuning.start_acceleration_mps2,
        )
        mean = np.zeros((self._states, 3))
        mean[0] = report.position_ned_m
        return mean, np.diag(np.square(deviations[: self._states]))


def _conditioned(
    mean: FloatArray, covariance: FloatArray, state: int, measured: FloatArray, noise: float
) -> tuple[FloatArray, FloatArray]:
    """Mean (n, 3) and covariance (n, n) given a measurement (3,) of one state on each axis."""
    column = covariance[:, state]
    gain = column / (column[state] + noise * noise)
    after: FloatArray = mean + gain[:, None] * (measured - mean[state])
    remaining: FloatArray = covariance - gain[:, None] * column
    return after, remaining


def transition(states: int, interval_s: float) -> FloatArray:
    """F, (n, n): one axis over an interval with its last derivative constant."""
    t = interval_s
    if states == 2:
        return np.array([[1.0, t], [0.0, 1.0]])
    return np.array([[1.0, t, t * t / 2], [0.0, 1.0, t], [0.0, 0.0, 1.0]])


def process_noise(states: int, interval_s: float, density: float) -> FloatArray:
    """Q, (n, n): covariance added over an interval by white noise in the last derivative's rate."""
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
