"""Check for receivers that are worse than stated: positions deviate from dead reckoning.

A receiver states the radius that holds two of three of its positions, and the bound on a report's
error rests on it. Velocities are measured independently of positions, by Doppler. Within a few
seconds two positions of a receiver have nearly the same error. If they deviate from dead reckoning
by more than two independent errors of the stated size would, the statement is rejected. Between two
reports the velocity is assumed to change linearly, with an allowance for other manoeuvres. This is
no proof, for velocities may also be wrong for long; so no report is rejected by it. The bound
becomes that of a receiver without a stated accuracy, or more if the deviation was larger.

Only horizontal positions are checked: heights come from a barometer.
"""

import math
from typing import Final

from companion.tracking.noise import NoiseSettings
from companion.values import Fix, Refuted, ReportNoise

WITHIN_NS: Final = 5_000_000_000  # time within which positions are compared
APART_NS: Final = 500_000_000
"""Longest time between two reports over which dead reckoning by their velocities is valid."""
GOOD_DEVIATION_M: Final = 0.4
"""Deviation of a good receiver's positions, whatever it states, as velocities have errors."""
UNSEEN_FACTOR: Final = 0.5
"""Multiple of the root sum square of the displacement that is possible unseen between reports.

An aircraft's displacement hardly ever reaches the largest possible value.
"""
COMMON_ERROR: Final = 0.07
"""Usual share of the noise bound that all reports have in common, so that none reveals it."""
COMMON_ERROR_REFUTED: Final = 0.82
"""The same for a receiver that deviates: 95 % of plane errors are within 2.45 of the bound's 3
deviations."""
NOTICE_RATIO: Final = 1.25  # increase after which a deviation is reported again


class ReceiverCheck:
    """Check of one UAV's positions by its velocities. ``look`` takes the newest report.

    ``settings`` are those from which the bounds on their noise were derived.
    """

    def __init__(self, settings: NoiseSettings) -> None:
        self._settings = settings
        # Sender time, deviation north and east in m, sum of squares of the unseen displacements.
        self._seen: list[tuple[int, float, float, float]] = []
        self._newest: Fix | None = None
        self._deviation_m = 0.0

    def look(self, fix: Fix, acceleration_mps2: float) -> Refuted | None:
        """Check a report. Return the refutation of the receiver's accuracy, if it is new.

        ``acceleration_mps2`` is the aircraft's largest acceleration.
        """
        factor, before = self._settings.factor, self._newest
        velocity = fix.velocity_ned_mps
        is_stated = fix.noise.horizontal_m < self._settings.default.horizontal_m
        if factor is None or velocity is None or not is_stated:
            return None
        if before is not None and fix.sender_ns <= before.sender_ns:
            return None
        self._newest = fix
        if before is None or fix.sender_ns - before.sender_ns > APART_NS:
            self._begin(fix)
            return None
        stated_m = fix.noise.horizontal_m / factor
        lag_m = 2.0 * fix.noise.time_s * math.hypot(*velocity)
        north_m, east_m, _, unseen_m = step_deviation(before, fix, acceleration_mps2)
        if math.hypot(north_m, east_m) > 2.0 * fix.noise.horizontal_m + lag_m + unseen_m:
            self._begin(fix)  # a jump, which the gate handles
            return None
        strayed_m, unseen_m = self._deviation(fix.sender_ns, north_m, east_m, unseen_m)
        if (
            strayed_m
            <= max(GOOD_DEVIATION_M, math.sqrt(2.0) * stated_m) + lag_m + UNSEEN_FACTOR * unseen_m
        ):
            return None
        if strayed_m <= NOTICE_RATIO * self._deviation_m:
            return None
        self._deviation_m = strayed_m
        to_m = self.noise(fix.noise).horizontal_m
        name = "observer.follow_accuracy"
        return Refuted(
            t_ns=fix.arrival_ns,
            uav=fix.uav,
            setting=name,
            limit=stated_m,
            proven=strayed_m,
            raised_to=to_m,
        )

    def _begin(self, fix: Fix) -> None:
        self._seen.clear()
        self._seen.append((fix.sender_ns, 0.0, 0.0, 0.0))

    def _deviation(
        self, sender_ns: int, north_m: float, east_m: float, unseen_m: float
    ) -> tuple[float, float]:
        """Return the deviation over the last seconds, and the possible unseen displacement; metres.

        The arguments are the results of ``step_deviation`` for the newest report.
        """
        seen = self._seen
        _, north, east, unseen_m2 = seen[-1]
        seen.append((sender_ns, north + north_m, east + east_m, unseen_m2 + unseen_m**2))
        while sender_ns - seen[0][0] > WITHIN_NS:
            del seen[0]
        (_, north_0, east_0, before_m2), (_, north, east, unseen_m2) = seen[0], seen[-1]
        return math.hypot(north - north_0, east - east_0), math.sqrt(unseen_m2 - before_m2)

    def noise(self, stated: ReportNoise) -> ReportNoise:
        """Return the bounds on a report's noise, by its stated accuracy and past deviations."""
        factor = self._settings.factor
        if not self._deviation_m or factor is None:
            return stated
        level_m = max(self._settings.default.horizontal_m, factor * self._deviation_m)
        if level_m <= stated.horizontal_m:
            return stated
        return stated._replace(
            horizontal_m=level_m, position_m=math.hypot(level_m, stated.vertical_m)
        )

    def common_error_m(self, noise: ReportNoise) -> float:
        """Return the usual common error of positions, which reports do not reveal."""
        if self._deviation_m:
            return COMMON_ERROR_REFUTED * noise.horizontal_m
        return min(noise.apart_m, noise.vertical_m) or COMMON_ERROR * noise.position_m


def step_deviation(
    before: Fix, fix: Fix, acceleration_mps2: float
) -> tuple[float, float, float, float]:
    """Return the deviation of a position from dead reckoning, north, east and down, metres.

    The last value bounds the possible unseen displacement between the two reports.
    """
    assert before.velocity_ned_mps is not None and fix.velocity_ned_mps is not None
    half_s = (fix.sender_ns - before.sender_ns) * 0.5e-9
    north, east, down = fix.position_ned_m
    from_north, from_east, from_down = before.position_ned_m
    v_north, v_east, v_down = fix.velocity_ned_mps
    was_north, was_east, was_down = before.velocity_ned_mps
    return (
        north - from_north - half_s * (v_north + was_north),
        east - from_east - half_s * (v_east + was_east),
        down - from_down - half_s * (v_down + was_down),
        acceleration_mps2 * half_s**2,  # out and back at full acceleration
    )
