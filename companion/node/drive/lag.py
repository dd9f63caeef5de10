"""Lag of a mount, estimated from commanded and reported directions."""

from collections import deque
from typing import Final

import numpy as np

from companion.values import FloatArray

MOST_S: Final = 2.0  # largest lag considered
STEP_S: Final = 0.01
SAMPLES_MIN: Final = 20  # least number of reports for an estimate
LEAST_RAD: Final = np.radians(2.0)
"""Movement within the stored reports, radians, below which the lag estimate is kept."""
RESIDUAL_MAX: Final = 0.2
"""Largest fraction of the movement that the lag may leave unexplained."""
KEPT: Final = 100


class MountLag:
    """Estimate of the lag of a mount from the times of commands and reports."""

    def __init__(self) -> None:
        self._lag_s = 0.0
        self._has_new = False  # whether reports have come since the last estimate
        self._commands: deque[tuple[float, float]] = deque(maxlen=2 * KEPT)
        self._reports: deque[tuple[float, float]] = deque(maxlen=KEPT)

    def note_command(self, at_ns: int, azimuth_rad: float) -> None:
        """Note a command; azimuths must not jump by full turns."""
        self._commands.append((at_ns * 1e-9, azimuth_rad))

    def note_report(self, at_ns: int, azimuth_rad: float) -> None:
        """Note a reported direction."""
        self._reports.append((at_ns * 1e-9, azimuth_rad))
        self._has_new = True

    @property
    def lag_s(self) -> float:
        """Lag by the reports so far, estimated when it is read: that takes milliseconds."""
        if self._has_new and self._commands and len(self._reports) >= SAMPLES_MIN:
            self._has_new = False
            self._estimate(np.array(self._commands).T, np.array(self._reports).T)
        return self._lag_s

    def _estimate(self, told: FloatArray, seen: FloatArray) -> None:
        late = seen[:, seen[0] >= told[0, 0] + MOST_S]
        if late.shape[1] < SAMPLES_MIN // 2 or np.ptp(late[1]) < LEAST_RAD:
            return
        lags = np.arange(0.0, MOST_S, STEP_S)
        then = np.interp(late[0] - lags[:, np.newaxis], *told)
        off = late[1] - then
        off -= 2 * np.pi * np.round(np.median(off, axis=1, keepdims=True) / (2 * np.pi))
        left = np.sqrt(np.mean(off**2, axis=1))
        best = int(np.argmin(left))
        if left[best] <= RESIDUAL_MAX * np.std(late[1]):
            self._lag_s = float(lags[best])
