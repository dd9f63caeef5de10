"""Jumps of a carrier's reported attitude, and the doubt that they leave (docs/math.md 5.3).

Of two attitudes that contradict each other at least one is wrong: a reset by the estimator, or a
forged one. If the attitudes return within a second to what they were before, what was between was
wrong. Otherwise the estimator has another opinion from now on, and either may be right: both stay
in the bound for ``DOUBT_S``, and a notice says so.

Two opinions of one estimator turn alike: they follow the same gyroscopes. So the rotation between
them, about fixed axes, stays what it was when one took the place of the other, and those of several
jumps are multiplied: an opinion that returns is no new one.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

from companion.tracking.carrier import (
    APART_MAX_S,
    STAMP_S,
    AttitudeBounds,
    Contradiction,
    body_from_ned,
    body_rates,
    contradiction,
    later_body_from_body,
)
from companion.tracking.rotations import rotation_angle_rad
from companion.values import Attitude, FloatArray

DOUBT_S: Final = 10.0
"""Time after a jump for which the attitude before it may be the right one, seconds."""
SETTLED_S: Final = APART_MAX_S  # time without a return after which a jump is announced, seconds
ANNOUNCED_EVERY_S: Final = 60.0  # least time between two announcements of like jumps, seconds


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Opinion:
    """Attitude that was left by a jump; ``from_newest`` rotates the newest one to it, NED."""

    left_ns: int  # when the jump was reported
    from_newest: FloatArray

    @property
    def apart_rad(self) -> float:
        return rotation_angle_rad(self.from_newest)


class AttitudeJumps:
    """Contradictions between successive attitudes of a carrier.

    ``newest`` is the contradiction between the newest attitude and the previous one, if any.
    """

    def __init__(self) -> None:
        self.newest: Contradiction | None = None
        self._left: list[_Opinion] = []  # the oldest first
        self._announced: tuple[int, float] | None = None  # time, angle in rad

    @property
    def against(self) -> Contradiction | None:
        """What stands against the newest attitude: the previous one, or those before jumps."""
        if not self._left:
            return self.newest
        apart_rad = max(one.apart_rad for one in self._left)
        newest = self.newest or Contradiction(0.0, math.inf)
        return Contradiction(max(newest.apart_rad, apart_rad), newest.apart_s)

    def look(
        self,
        before: tuple[int, Attitude] | None,
        after: tuple[int, Attitude],
        bounds: AttitudeBounds,
    ) -> float | None:
        """Compare an attitude with the previous one; return the angle of a jump to be announced.

        Both with their sender times. The angle is in rad; None: there is nothing to announce.
        """
        now_ns = after[0]
        self.newest = None
        if before is not None:
            apart_s = (now_ns - before[0]) * 1e-9
            self.newest = contradiction(before[1], after[1], apart_s, bounds)
            if self.newest is not None:
                self._jumped(before, after, bounds)
        self._left = [one for one in self._left if now_ns - one.left_ns <= DOUBT_S * 1e9]
        return self._to_announce(now_ns, bounds.attitude_rad)

    def _jumped(
        self, before: tuple[int, Attitude], after: tuple[int, Attitude], bounds: AttitudeBounds
    ) -> None:
        """Add what was left, unless the newest attitude returns to what was left before."""
        apart_s = (after[0] - before[0]) * 1e-9
        limit_rad = bounds.at(0.0, apart_s, STAMP_S) + bounds.attitude_rad
        rotation = _rotation(before[1], after[1], apart_s)
        opinions = [
            *(replace(one, from_newest=one.from_newest @ rotation) for one in self._left),
            _Opinion(left_ns=after[0], from_newest=rotation),
        ]
        for number, one in enumerate(opinions):
            is_brief = after[0] - one.left_ns <= APART_MAX_S * 1e9
            if is_brief and one.apart_rad <= limit_rad:
                opinions = opinions[:number]  # what came after it was wrong
                break
        self._left = opinions

    def _to_announce(self, now_ns: int, noise_rad: float) -> float | None:
        """Return the largest angle that has lasted, unless a like one was announced lately."""
        apart_rad = max(
            (one.apart_rad for one in self._left if now_ns - one.left_ns >= SETTLED_S * 1e9),
            default=0.0,
        )
        is_recent = (
            self._announced is not None
            and now_ns - self._announced[0] < ANNOUNCED_EVERY_S * 1e9
            and apart_rad <= self._announced[1] + noise_rad
        )
        if not apart_rad or is_recent:
            return None
        self._announced = now_ns, apart_rad
        return apart_rad


def _rotation(before: Attitude, after: Attitude, apart_s: float) -> FloatArray:
    """Return the rotation from an attitude to the previous one, about axes in NED.

    Either is extrapolated to the other's time at its own rates. The smaller rotation counts: a
    wrong rate leaves the angle right.
    """
    first = body_from_ned(before.roll_rad, before.pitch_rad, before.yaw_rad)
    second = body_from_ned(after.roll_rad, after.pitch_rad, after.yaw_rad)
    forward = (later_body_from_body(body_rates(before), apart_s) @ first).T @ second
    back = first.T @ later_body_from_body(body_rates(after), -apart_s) @ second
    return min(forward, back, key=rotation_angle_rad)
