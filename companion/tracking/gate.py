"""Gate: which reports can be true, and when a track must be restarted because it is wrong.

A report is rejected if the UAV cannot have reached it: it lies outside the bound of the prediction
from the last *accepted* report, given the bounds on acceleration, speed and noise, plus its own
noise. Rejected reports never move the gate; they are kept apart. Once enough of them agree with one
another for long enough, and none was accepted meanwhile, the track is restarted from them. See
docs/math.md 5.2.
"""

import math
from dataclasses import dataclass
from typing import Final, Generic

from companion.tracking.observers.estimates import Observer, Prediction, State
from companion.values import Fix, Reason
from companion.values.newest import Newest

FROZEN_SPEED_MPS = 1.0  # least reported speed at which an unchanged position counts as frozen
FROZEN_TRAVEL_M = 0.3
"""Least distance travelled by the reported speed for an unchanged position to count as frozen."""

ALTERNATIONS: Final = 3
"""Alternations of rejected and possible reports that prove two vehicles."""
SHARED_S: Final = 3.0  # seconds over which they must alternate


@dataclass(frozen=True, slots=True, kw_only=True)
class GateSettings:
    """Conditions under which rejected reports replace a track.

    lead_m             how far a report may be ahead of or behind the position, beyond its noise (a
                       feedthrough)
    """

    reacquire_reports: int = 3  # rejected reports that must agree
    reacquire_s: float = 1.0  # seconds over which they must agree
    forget_s: float = 10.0  # seconds without another one after which they are forgotten
    lead_m: float = 0.0
    drift_max: float = 250e-6  # largest drift of a sender's clock, a ratio

    def slack_m(self, before: Fix, fix: Fix) -> float:
        """Return the distance between two reports of one UAV that errors of their times explain.

        Stamps are whole milliseconds, the clock between them may drift, and the lag of either
        position may differ from the one subtracted. Each time error costs the distance flown in it.
        """
        apart_s = abs(fix.sender_ns - before.sender_ns) * 1e-9
        drifted_s = 1e-3 + self.drift_max * apart_s
        lagged_m = _flown_distance_m(before, before.noise.time_s)
        return self.lead_m + lagged_m + _flown_distance_m(fix, fix.noise.time_s + drifted_s)


def _flown_distance_m(fix: Fix, within_s: float) -> float:
    """Return the largest distance flown within a time of a report, m; 0 without velocity."""
    velocity = fix.velocity_ned_mps
    if velocity is None:
        return 0.0
    gained_mps = within_s * (0.0 if fix.limits is None else fix.limits.acceleration_max_mps2)
    north, east, down = velocity
    speed_mps = math.sqrt(north * north + east * east + down * down)
    return within_s * (speed_mps + fix.noise.velocity_mps + gained_mps)


def refusal(predicted: Prediction, fix: Fix, lead_m: float = 0.0) -> tuple[Reason, str] | None:
    """Return why a report cannot be true, given the prediction for its time; None if possible."""
    (n, e, d), (there_n, there_e, there_d) = predicted.position_ned_m, fix.position_ned_m
    down = there_d - d
    horizontal_m = math.hypot(there_n - n, there_e - e)
    limit_m = predicted.horizontal_m + fix.noise.horizontal_m + lead_m
    if horizontal_m > limit_m:
        return (
            Reason.UNREACHABLE,
            f"{horizontal_m:.1f} m from the prediction, at most {limit_m:.1f} m possible",
        )
    limit_m = predicted.vertical_m + fix.noise.vertical_m + lead_m
    if abs(down) > limit_m:
        return (
            Reason.ALTITUDE_JUMP,
            f"{abs(down):.1f} m {'above' if down < 0 else 'below'} the prediction,"
            f" at most {limit_m:.1f} m possible",
        )
    return None


def is_frozen(before: Fix, fix: Fix) -> bool:
    """Return whether a position was resent under a new stamp although the UAV moves."""
    velocity = fix.velocity_ned_mps
    if velocity is None or before.position_ned_m != fix.position_ned_m:
        return False
    speed_mps = math.hypot(*velocity)
    travel_m = speed_mps * (fix.sender_ns - before.sender_ns) * 1e-9
    return speed_mps > FROZEN_SPEED_MPS and travel_m > FROZEN_TRAVEL_M


class Suspects(Generic[State]):
    """Rejected reports of one UAV that agree with one another, newest last."""

    def __init__(self, observer: Observer[State], settings: GateSettings) -> None:
        self._observer = observer
        self._settings = settings
        self._run: Newest[Fix] = Newest(64)
        self._begun_ns = 0
        self._alternations = 0
        self._interrupted = False

    def add(self, fix: Fix) -> None:
        """Add a rejected report: it continues the run, or starts a new run."""
        if self._run:
            last = self._run[-1]
            predicted = self._observer.predict(self._observer.begin(last), fix.sender_ns)
            old = fix.sender_ns - last.sender_ns > self._settings.forget_s * 1e9
            if fix.sender_ns <= last.sender_ns:
                return
            slack_m = self._settings.slack_m(last, fix)
            if old or refusal(predicted, fix, slack_m) is not None:
                self._run.clear()
        if not self._run:
            self._begun_ns, self._alternations, self._interrupted = fix.sender_ns, 0, False
        self._alternations += self._interrupted
        self._interrupted = False
        self._run.append(fix)

    def interrupt(self) -> None:
        """Record that a report was possible: the run may be another vehicle's, or may be over."""
        self._interrupted = True

    def agree(self) -> bool:
        """Return whether the run is long enough, by number of reports and by seconds."""
        if len(self._run) < self._settings.reacquire_reports:
            return False
        lasted_ns = self._run[-1].sender_ns - self._begun_ns
        return lasted_ns >= self._settings.reacquire_s * 1e9

    @property
    def silence_s(self) -> float:
        """Time without a possible report after which the run replaces the track, seconds.

        The time is longer if possible reports came in between: the run may be another vehicle's.
        """
        least_s = self._settings.reacquire_s
        return max(least_s, SHARED_S) if self._alternations else least_s

    def is_second_vehicle(self, sender_ns: int) -> bool:
        """Return whether the run is a second vehicle's: possible reports alternate with it."""
        if len(self._run) < self._settings.reacquire_reports or self._alternations < ALTERNATIONS:
            return False
        if self._run[-1].sender_ns - self._begun_ns < SHARED_S * 1e9:
            return False
        return sender_ns - self._run[-1].sender_ns < self._settings.forget_s * 1e9

    def take(self) -> list[Fix]:
        """Remove and return the run of rejected reports."""
        run = list(self._run)
        self._run.clear()
        return run
