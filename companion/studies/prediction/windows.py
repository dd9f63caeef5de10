"""Input of a learned predictor: the last reports, scaled and relative to the newest position.

Each report gives seven numbers: its time before the newest report; its position relative to that;
its velocity. All are rotated about the vertical so that the newest velocity points along x: no
direction is preferred. Reports are ordered by the sender's clock, at any intervals; an overtaken
one is sorted in.
"""

import math
from bisect import bisect_right
from typing import Final, NamedTuple

import numpy as np

from companion.studies.prediction.baselines import ObservedReport
from companion.values import FloatArray

REPORTS: Final = 10  # K: number of last reports used
FORGOTTEN_NS: Final = 20_000_000_000
"""Age relative to the newest report above which a report is not used."""
FEATURES: Final = 7
TIME_UNIT_S: Final = 1.0
WAY_UNIT_M: Final = 20.0
SPEED_UNIT_MPS: Final = 10.0


class Window(NamedTuple):
    """Input of the network, with the newest report."""

    sender_ns: int  # when it was made, sender's timeline
    position_ned_m: FloatArray  # (3,), its position
    velocity_ned_mps: FloatArray  # (3,), its velocity
    seen: FloatArray  # (n, 7), the input, oldest report first
    local_from_seen: FloatArray  # (3, 3), rotation from the input's frame to the local frame


class RecentReports:
    """Last reports of one UAV, in the order of the sender's clock."""

    def __init__(self) -> None:
        self._reports: list[ObservedReport] = []
        self.offset_ns = 0

    def add(self, report: ObservedReport) -> bool:
        """Add a report; return whether the window changed. A late report only updates the clock."""
        self.offset_ns = report.sent_ns - report.sender_ns
        reports = self._reports
        at = bisect_right(reports, report.sender_ns, key=lambda each: each.sender_ns)
        if at and reports[at - 1].sender_ns == report.sender_ns:
            return False
        if at == 0 and len(reports) == REPORTS:
            return False
        reports.insert(at, report)
        oldest_ns = reports[-1].sender_ns - FORGOTTEN_NS
        self._reports = [each for each in reports[-REPORTS:] if each.sender_ns >= oldest_ns]
        return True

    def window(self) -> Window:
        """Return the present window; needs at least one report."""
        reports = self._reports
        newest = reports[-1]
        ago_s = np.array([each.sender_ns - newest.sender_ns for each in reports]) * 1e-9
        places = np.array([each.position_ned_m for each in reports])
        speeds = _velocities(reports, ago_s, places)
        turned = _about_vertical(speeds[-1])
        seen = np.column_stack(
            [
                ago_s / TIME_UNIT_S,
                (places - places[-1]) @ turned / WAY_UNIT_M,
                speeds @ turned / SPEED_UNIT_MPS,
            ]
        )
        return Window(
            sender_ns=newest.sender_ns,
            position_ned_m=places[-1],
            velocity_ned_mps=speeds[-1],
            seen=seen,
            local_from_seen=turned,
        )


def _velocities(reports: list[ObservedReport], ago_s: FloatArray, places: FloatArray) -> FloatArray:
    """Return reported velocities; if missing, the mean velocity since the previous report.

    The first report gets the mean velocity to the next one; a single report is at rest.
    """
    speeds = np.zeros_like(places)
    if len(reports) > 1:
        speeds[1:] = np.diff(places, axis=0) / np.diff(ago_s)[:, None]
        speeds[0] = speeds[1]
    for row, each in enumerate(reports):
        if each.velocity_ned_mps is not None:
            speeds[row] = each.velocity_ned_mps
    return speeds


def _about_vertical(velocity: FloatArray) -> FloatArray:
    """Return the rotation (3, 3), local from window; x is a velocity's horizontal direction."""
    course = math.atan2(velocity[1], velocity[0])
    c, s = math.cos(course), math.sin(course)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
