"""Check of reported velocities: over seconds, positions must move by their integral.

Let two positions of a UAV be off by at most h each, horizontally or vertically, the velocities
between them by at most n, and let the velocity change by at most a per second. Then the positions'
difference deviates from the integral of the velocities (trapezoids) by at most

    2 h + sum of (n dt + a dt²/4)

over the intervals dt between the reports, and the distance flown within the errors of both times.
Whatever exceeds that proves a larger n (or h), also where each single step is within the noise: a
sender that reports a velocity of zero in flight, or one in another frame. The bound on the
velocities of that UAV is raised, and decays over minutes.
"""

import math
from array import array
from typing import Final

from companion.tracking.limits import RaisedLimit
from companion.tracking.receiver_check import step_deviation
from companion.values import Fix, Refuted, ReportNoise

WITHIN_NS: Final = 5_000_000_000  # time over which velocities are summed
LEAST_NS: Final = 1_000_000_000  # least such time
APART_NS: Final = 2_000_000_000  # longest interval between two reports
SPACING_NS: Final = 250_000_000  # least time between two sums that are kept
STAMP_S: Final = 1e-3  # stamps are whole milliseconds
SETTING: Final = "observer.velocity_noise_mps"
_NUMBERS: Final = 5  # kept of a sum: sender time, deviation north, east and down, allowance
_NONE: Final = (0.0, 0.0, 0.0, 0.0)


class VelocityCheck:
    """Check of one UAV's velocities by its positions.

    ``look`` takes reports that were accepted, or are unreachable by the reported velocities.
    """

    def __init__(self) -> None:
        self._raised = RaisedLimit()
        self._newest: Fix | None = None
        self._sums = _NONE  # deviation north, east and down, and its allowance; metres
        self._kept = array("d")  # earlier sums, oldest first

    def noise(self, stated: ReportNoise, sender_ns: int) -> ReportNoise:
        """Return the bounds on a report's noise, raised as far as earlier reports require it."""
        if self._raised.to <= stated.velocity_mps:
            return stated
        return stated._replace(velocity_mps=self._raised.at(stated.velocity_mps, sender_ns))

    def look(self, fix: Fix, acceleration_mps2: float) -> Refuted | None:
        """Check a report; return the refutation of the velocities' bound, if it is exceeded.

        ``acceleration_mps2`` is the aircraft's largest acceleration.
        """
        before = self._newest
        if before is not None and fix.sender_ns <= before.sender_ns:
            return None
        self._newest = None if fix.velocity_ned_mps is None else fix
        if self._newest is None:
            return None
        if before is None or fix.sender_ns - before.sender_ns > APART_NS:
            del self._kept[:]
            self._sums = _NONE
        else:
            self._add(before, fix, acceleration_mps2)
        excess_mps = self._excess_mps(fix)
        if not self._kept or fix.sender_ns - self._kept[-_NUMBERS] >= SPACING_NS:
            self._keep(fix.sender_ns)
        if excess_mps <= 0.0:
            return None
        limit_mps = fix.noise.velocity_mps
        proven_mps = limit_mps + excess_mps
        return Refuted(
            t_ns=fix.arrival_ns,
            uav=fix.uav,
            setting=SETTING,
            limit=limit_mps,
            proven=proven_mps,
            raised_to=self._raised.raise_above(proven_mps, fix.sender_ns),
        )

    def _add(self, before: Fix, fix: Fix, acceleration_mps2: float) -> None:
        """Add the deviation between two reports, and what is allowed for it, to the sums."""
        north_m, east_m, down_m, unseen_m = step_deviation(before, fix, acceleration_mps2)
        noise_mps = max(before.noise.velocity_mps, fix.noise.velocity_mps)
        north, east, down, allowed = self._sums
        step_m = noise_mps * (fix.sender_ns - before.sender_ns) * 1e-9 + unseen_m
        self._sums = (north + north_m, east + east_m, down + down_m, allowed + step_m)

    def _keep(self, sender_ns: int) -> None:
        kept = self._kept
        kept.extend((sender_ns, *self._sums))
        while sender_ns - kept[0] > WITHIN_NS:
            del kept[:_NUMBERS]

    def _excess_mps(self, fix: Fix) -> float:
        """Return by how much the mean deviation over the last seconds exceeds its allowance.

        A single jump of the position is no error of the velocities: the largest step is left out.
        """
        kept = self._kept
        if not kept or fix.sender_ns - kept[0] < LEAST_NS:
            return 0.0
        north, east, down, allowed = self._sums
        then_ns, north_0, east_0, down_0, allowed_0 = kept[:_NUMBERS]
        flown_m = math.hypot(*fix.velocity_ned_mps or ()) * (fix.noise.time_s + STAMP_S)
        allowed_m = 2.0 * flown_m + allowed - allowed_0
        horizontal_m = math.hypot(north - north_0, east - east_0)
        horizontal_m -= allowed_m + 2.0 * fix.noise.horizontal_m
        vertical_m = down - down_0 if down > down_0 else down_0 - down
        vertical_m -= allowed_m + 2.0 * fix.noise.vertical_m
        if horizontal_m <= 0.0 and vertical_m <= 0.0:  # nearly always
            return 0.0
        if horizontal_m > 0.0:
            norths, easts = kept[1::_NUMBERS], kept[2::_NUMBERS]
            horizontal_m -= _largest_step_m([*zip(norths, easts, strict=True), (north, east)])
        if vertical_m > 0.0:
            vertical_m -= _largest_step_m([*zip(kept[3::_NUMBERS], strict=True), (down,)])
        return max(0.0, horizontal_m, vertical_m) / ((fix.sender_ns - then_ns) * 1e-9)


def _largest_step_m(places: list[tuple[float, ...]]) -> float:
    return max(map(math.dist, places, places[1:]))
