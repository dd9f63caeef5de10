"""Which reports can be true, and when a track must be begun again because it is itself wrong.

A report is refused when the UAV cannot have got there: it lies outside the bound of what was
predicted from the last *accepted* report, given the bounds on acceleration, speed and noise, plus
its own noise. Refused reports never move the gate; they are set aside. Once enough of them agree
with one another for long enough, with none accepted meanwhile, the track is begun again from them.
See docs/math.md 5.2.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Generic

import numpy as np

from companion.tracking.observers.estimates import Observer, Prediction, State
from companion.values import Fix, Reason

FROZEN_SPEED_MPS = 1.0
"""Least reported speed at which an unchanged position counts as frozen."""
FROZEN_TRAVEL_M = 0.3
"""Least distance that this speed must have covered while the position stayed the same."""


@dataclass(frozen=True, slots=True)
class GateSettings:
    """When refused reports become the track.

    reacquire_reports  refused reports that must agree
    reacquire_s        seconds over which they must agree
    forget_s           seconds without another one after which they are forgotten
    lead_m             how far a report may be ahead of the position or behind it, beside its
                       noise (a feedthrough)
    """

    reacquire_reports: int = 3
    reacquire_s: float = 3.0
    forget_s: float = 10.0
    lead_m: float = 0.0


def refusal(predicted: Prediction, fix: Fix, lead_m: float = 0.0) -> tuple[Reason, str] | None:
    """Why a report cannot be true, given the prediction for its time; None if it can."""
    north, east, down = (fix.position_ned_m - predicted.position_ned_m).tolist()
    horizontal_m = math.hypot(north, east)
    limit_m = predicted.horizontal_m + fix.noise.horizontal_m + lead_m
    if horizontal_m > limit_m:
        return Reason.UNREACHABLE, f"{horizontal_m:.1f} m off, at most {limit_m:.1f} m possible"
    limit_m = predicted.vertical_m + fix.noise.vertical_m + lead_m
    if abs(down) > limit_m:
        return Reason.ALTITUDE_JUMP, f"{-down:+.1f} m of height, at most {limit_m:.1f} m possible"
    return None


def is_frozen(before: Fix, fix: Fix) -> bool:
    """Whether a position was sent again under a fresh stamp, though its velocity says it moved."""
    velocity = fix.velocity_ned_mps
    if velocity is None or not np.array_equal(before.position_ned_m, fix.position_ned_m):
        return False
    speed_mps = math.sqrt(velocity @ velocity)
    travel_m = speed_mps * (fix.sender_ns - before.sender_ns) * 1e-9
    return speed_mps > FROZEN_SPEED_MPS and travel_m > FROZEN_TRAVEL_M


class Suspects(Generic[State]):
    """Refused reports of one UAV that agree with one another, newest last."""

    def __init__(self, observer: Observer[State], settings: GateSettings) -> None:
        self._observer = observer
        self._settings = settings
        self._run: deque[Fix] = deque(maxlen=64)
        self._begun_ns = 0

    def add(self, fix: Fix) -> None:
        """Set a refused report aside: it continues the run, or begins another."""
        if self._run:
            last = self._run[-1]
            predicted = self._observer.predict(self._observer.begin(last), fix.sender_ns)
            old = fix.sender_ns - last.sender_ns > self._settings.forget_s * 1e9
            if fix.sender_ns <= last.sender_ns:
                return
            if old or refusal(predicted, fix, self._settings.lead_m) is not None:
                self._run.clear()
        if not self._run:
            self._begun_ns = fix.sender_ns
        self._run.append(fix)

    def agree(self) -> bool:
        """Whether the run is long enough, in reports and in seconds, to be believed."""
        if len(self._run) < self._settings.reacquire_reports:
            return False
        lasted_ns = self._run[-1].sender_ns - self._begun_ns
        return lasted_ns >= self._settings.reacquire_s * 1e9

    def goes_on(self, sender_ns: int) -> bool:
        """Whether the run is to be believed and was added to within the last ``forget_s``."""
        return self.agree() and sender_ns - self._run[-1].sender_ns < self._settings.forget_s * 1e9

    def take(self) -> list[Fix]:
        """Take the run out."""
        run = list(self._run)
        self._run.clear()
        return run
