"""The lag of a mount, from where it was told to point and where it says that it points."""

from collections import deque
from typing import Final

import numpy as np

from companion.values import FloatArray

MOST_S: Final = 2.0  # greatest lag that is looked for
STEP_S: Final = 0.01
FEWEST: Final = 20  # least number of reports for an estimate
LEAST_RAD: Final = np.radians(2.0)
"""Movement over the time that is kept, below which the lag stays what it was."""
MOST_LEFT: Final = 0.2
"""Share of the movement that no lag explains, above which none is found: a mount at its limit."""
KEPT: Final = 100


class MountLag:
    """Estimates the lag of a mount from the times of commands and of reports."""

    def __init__(self) -> None:
        self.lag_s = 0.0
        self._commands: deque[tuple[float, float]] = deque(maxlen=2 * KEPT)
        self._reports: deque[tuple[float, float]] = deque(maxlen=KEPT)

    def note_command(self, at_ns: int, azimuth_rad: float) -> None:
        """Note a command; azimuths do not leap by whole turns."""
        self._commands.append((at_ns * 1e-9, azimuth_rad))

    def note_report(self, at_ns: int, azimuth_rad: float) -> None:
        """Note where the mount is, and estimate the lag again."""
        self._reports.append((at_ns * 1e-9, azimuth_rad))
        if len(self._reports) >= FEWEST:
            self._estimate(np.array(self._commands).T, np.array(self._reports).T)

    def _estimate(self, told: FloatArray, seen: FloatArray) -> None:
        """The lag at which commands and reports differ least."""
        late = seen[:, seen[0] >= told[0, 0] + MOST_S]
        if late.shape[1] < FEWEST // 2 or np.ptp(late[1]) < LEAST_RAD:
            return
        lags = np.arange(0.0, MOST_S, STEP_S)
        then = np.interp(late[0] - lags[:, np.newaxis], *told)
        off = late[1] - then
        off -= 2 * np.pi * np.round(np.median(off, axis=1, keepdims=True) / (2 * np.pi))
        left = np.sqrt(np.mean(off**2, axis=1))
        best = int(np.argmin(left))
        if left[best] <= MOST_LEFT * np.std(late[1]):
            self.lag_s = float(lags[best])
