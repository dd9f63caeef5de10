"""Baselines for the observer: hold and dead reckoning. The Kalman filters are in ``kalman``.

All answer the same question: at ``now_ns``, from what has arrived by then, where is the UAV at
``at_ns``? They differ in their use of a report's time:

* ``Hold`` and ``DeadReckoningOnArrival`` use only its arrival, and use the last report to arrive;
* ``DeadReckoning`` and the Kalman filters use the time when it was made (the sender's clock), so
  that they handle late and overtaken reports correctly. They stay on the sender's own timeline, and
  convert the requested time by the clock offset of the last report to arrive.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

from companion.values import FloatArray, GnssStatus

TRACKER_TIMEOUT_NS: Final = 5_000_000_000
"""Silence after which ArduPilot's AntennaTracker considers a vehicle lost."""
_S_PER_NS: Final = 1e-9


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ObservedReport:
    """Report as a predictor receives it.

    The baselines do not use ``clock_bound_s`` and ``gnss``.
    """

    arrival_ns: int  # when it arrived, node time
    sent_ns: int  # when it was made, node time, by the best clock estimate on arrival
    sender_ns: int  # when it was made, on the sender's timeline
    position_ned_m: FloatArray  # (3,), local frame
    velocity_ned_mps: FloatArray | None  # (3,), local frame; None if not reported
    clock_bound_s: float = 0.0  # bound on the error of sent_ns
    gnss: GnssStatus | None = None  # the sender's last receiver status


class Predicted(NamedTuple):
    """Predicted position and velocity, (3,), local frame.

    ``bound_m`` and ``usual_m``, the bound on its error and its 95th percentile, are None if the
    predictor has none. A tuple rather than a dataclass, because a study creates millions.
    """

    position_ned_m: FloatArray
    velocity_ned_mps: FloatArray | None = None
    bound_m: float | None = None
    usual_m: float | None = None


class Predictor(Protocol):
    """Predictor of one UAV. Reports come in the order of arrival."""

    def report(self, report: ObservedReport) -> None:
        """Add a report that has just arrived."""

    def predict(self, now_ns: int, at_ns: int) -> Predicted | None:
        """Return the state at ``at_ns`` from reports that arrived by ``now_ns``.

        None without reports.
        """


class Hold:
    """Predictor that holds the last report to arrive."""

    def __init__(self) -> None:
        self._last: ObservedReport | None = None

    def report(self, report: ObservedReport) -> None:
        """Replace the held report by a new one."""
        self._last = report

    def predict(self, now_ns: int, at_ns: int) -> Predicted | None:
        """Return the position of the held report, at any time."""
        if self._last is None:
            return None
        return Predicted(position_ned_m=self._last.position_ned_m)


class DeadReckoningOnArrival(Hold):
    """Dead reckoning from the last report as if it was made on arrival: AntennaTracker's method.

    If nothing arrived for 5 s the estimate stops moving. One fault of the original is corrected: it
    adds vz, which is positive down, to the altitude. A lead, which the original does not have, is
    extrapolated as well. Source: ArduPilot, AntennaTracker/tracking.cpp,
    ``update_vehicle_pos_estimate``.
    """

    def predict(self, now_ns: int, at_ns: int) -> Predicted | None:
        """Return position plus velocity times the time since arrival plus the lead."""
        last = self._last
        if last is None:
            return None
        age_ns = min(now_ns - last.arrival_ns, TRACKER_TIMEOUT_NS)
        return _straight_on(last, age_ns + at_ns - now_ns)


class DeadReckoning:
    """Dead reckoning from the newest report by the sender's clock."""

    def __init__(self) -> None:
        self._newest: ObservedReport | None = None
        self._offset_ns = 0

    def report(self, report: ObservedReport) -> None:
        """Keep the newest report; an overtaken one only updates the clock."""
        self._offset_ns = report.sent_ns - report.sender_ns
        if self._newest is None or report.sender_ns > self._newest.sender_ns:
            self._newest = report

    def predict(self, now_ns: int, at_ns: int) -> Predicted | None:
        """Return position plus velocity times the time since the report was made."""
        newest = self._newest
        if newest is None:
            return None
        return _straight_on(newest, at_ns - self._offset_ns - newest.sender_ns)


def _straight_on(report: ObservedReport, interval_ns: int) -> Predicted:
    """Extrapolate at constant velocity; without a reported velocity, hold the position."""
    velocity = report.velocity_ned_mps
    if velocity is None:
        return Predicted(position_ned_m=report.position_ned_m)
    position = report.position_ned_m + velocity * (interval_ns * _S_PER_NS)
    return Predicted(position_ned_m=position, velocity_ned_mps=velocity)
