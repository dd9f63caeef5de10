"""Jumps of a carrier's reported attitude, and the doubt that they leave (docs/math.md 5.3).

Of two attitudes that contradict each other at least one is wrong: a reset by the estimator, or a
forged one. If the attitudes return within a second to what they were before, what was between was
wrong, unless that happens again and again. Otherwise the estimator has another opinion from now on,
and either may be right: both stay in the bound for ``DOUBT_S``, and a notice says so.

Two opinions of one estimator turn alike: they follow the same gyroscopes. So the rotation between
them, about fixed axes, stays what it was when one took the place of the other, and those of several
jumps are multiplied: an opinion that returns is no new one.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from companion.tracking.carrier import (
    APART_MAX_S,
    AttitudeBounds,
    Contradiction,
    agreement_rad,
    body_from_ned,
    body_rates,
    contradiction,
    later_body_from_body,
)
from companion.tracking.rotations import angle_between_rad
from companion.values import Attitude, FloatArray

DOUBT_S: Final = 10.0
"""Time after a jump for which the attitude before it may be the right one, seconds."""
SETTLED_S: Final = APART_MAX_S  # time without a return after which a jump is announced, seconds
ANNOUNCED_EVERY_S: Final = 60.0  # least time between two announcements of like jumps, seconds
OPINIONS_MAX: Final = 12
"""Opinions that are remembered. An estimator that has more within ``DOUBT_S`` knows nothing."""
_FIRST: Final = np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class _Opinion:
    """Attitudes of an estimator from one jump to the next.

    ``rotation`` is the rotation to it from the first opinion, (3, 3), about axes in NED: the
    product of those of the jumps. They are known to ``unsure_rad`` in all.
    """

    rotation: FloatArray
    unsure_rad: float = 0.0

    def apart_rad(self, other: "_Opinion") -> float:
        """Return the largest angle that may be between attitudes of two opinions."""
        unsure_rad = abs(other.unsure_rad - self.unsure_rad)
        return min(math.pi, angle_between_rad(self.rotation, other.rotation) + unsure_rad)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Left:
    """Opinion that was left by jumps, the newest at ``jump_ns``, with its last attitude then.

    If it returned, and was left again within ``DOUBT_S`` of ``first_ns``, it was within
    ``spread_rad`` of what it was at the first jump.
    """

    first_ns: int
    jump_ns: int
    opinion: _Opinion
    last: tuple[int, Attitude]
    spread_rad: float = 0.0

    def apart_rad(self, newest: _Opinion) -> float:
        return min(math.pi, self.opinion.apart_rad(newest) + self.spread_rad)


class AttitudeJumps:
    """Contradictions between successive attitudes of a carrier.

    ``newest`` is how the newest attitude contradicts the previous one, None if it agrees;
    ``against`` is what stands against the newest one: that, or the opinions before jumps.
    """

    def __init__(self) -> None:
        self.newest: Contradiction | None = None
        self.against: Contradiction | None = None
        self._opinion = _Opinion(_FIRST)
        self._left: list[_Left] = []  # the oldest first
        self._unknown_ns: int | None = None  # jump of the newest opinion that was not remembered
        self._returned_ns: int | None = None
        self._announced: tuple[int, float] | None = None  # time, angle in rad

    def look(
        self,
        before: tuple[int, Attitude] | None,
        after: tuple[int, Attitude],
        bounds: AttitudeBounds,
    ) -> float | None:
        """Compare a new attitude with the previous one; return the angle of a jump to announce.

        Both with their sender times. The angle is in rad; None: there is nothing to announce.
        """
        now_ns = after[0]
        self.newest = None
        if before is not None:
            apart_s = (now_ns - before[0]) * 1e-9
            self.newest = contradiction(before[1], after[1], apart_s, bounds)
            if self.newest is not None and not self._returns(after, bounds):
                self._jump(before, after, bounds)
        self._forget(now_ns)
        apart_rad = self._apart_rad(now_ns, 0.0)
        self.against = self.newest
        if apart_rad:
            newest = self.newest or Contradiction(0.0, math.inf)
            self.against = Contradiction(max(newest.apart_rad, apart_rad), newest.apart_s)
        return self._to_announce(now_ns, bounds.attitude_rad) if apart_rad else None

    def _returns(self, after: tuple[int, Attitude], bounds: AttitudeBounds) -> bool:
        """Return whether an attitude follows from the one before the first jump, shortly before.

        What was between is forgotten then, once in ``DOUBT_S``: who goes back and forth has two
        opinions.
        """
        now_ns = after[0]
        if not self._left or any(now_ns - one.first_ns > APART_MAX_S * 1e9 for one in self._left):
            return False
        if self._returned_ns is not None and now_ns - self._returned_ns <= DOUBT_S * 1e9:
            return False
        first_ns, first = self._left[0].last
        apart_s = (now_ns - first_ns) * 1e-9
        if apart_s > APART_MAX_S or contradiction(first, after[1], apart_s, bounds):
            return False
        self._left.clear()
        self._returned_ns = now_ns
        return True

    def _jump(
        self, before: tuple[int, Attitude], after: tuple[int, Attitude], bounds: AttitudeBounds
    ) -> None:
        """Remember the opinion that is left; one that returned and is left again, once.

        Each attitude is extrapolated to the other's time at its own rates. If one has a wrong rate,
        the rotations differ, and either may be that of the jump.
        """
        apart_s = (after[0] - before[0]) * 1e-9
        first, second = (
            body_from_ned(one.roll_rad, one.pitch_rad, one.yaw_rad) for one in (before[1], after[1])
        )
        forward = (later_body_from_body(body_rates(before[1]), apart_s) @ first).T @ second
        back = first.T @ later_body_from_body(body_rates(after[1]), -apart_s) @ second
        left = self._opinion
        self._leave(left, before, after[0], agreement_rad(apart_s, bounds))
        self._opinion = _Opinion(
            rotation=left.rotation @ forward,
            unsure_rad=left.unsure_rad + angle_between_rad(forward, back),
        )

    def _leave(
        self, opinion: _Opinion, last: tuple[int, Attitude], now_ns: int, limit_rad: float
    ) -> None:
        for number, one in enumerate(self._left):
            apart_rad = one.opinion.apart_rad(opinion)
            if apart_rad <= limit_rad and now_ns - one.first_ns <= DOUBT_S * 1e9:
                del self._left[number]
                spread_rad = max(one.spread_rad, apart_rad)
                again = replace(one, jump_ns=now_ns, last=last, spread_rad=spread_rad)
                self._left.append(again)
                return
        self._left.append(_Left(first_ns=now_ns, jump_ns=now_ns, opinion=opinion, last=last))
        if len(self._left) > OPINIONS_MAX:
            self._unknown_ns = self._left.pop(0).jump_ns

    def _forget(self, now_ns: int) -> None:
        """Forget the opinions that were left long ago."""
        since_ns = now_ns - round(DOUBT_S * 1e9)
        while self._left and self._left[0].jump_ns < since_ns:
            del self._left[0]
        if self._unknown_ns is not None and self._unknown_ns < since_ns:
            self._unknown_ns = None
        if not self._left:
            self._opinion = _Opinion(_FIRST)

    def _apart_rad(self, now_ns: int, least_s: float) -> float:
        """Return the angle to the furthest opinion that was left so long ago; 0 without one."""
        until_ns = now_ns - round(least_s * 1e9)
        if self._unknown_ns is not None and self._unknown_ns <= until_ns:
            return math.pi
        left = [one for one in self._left if one.first_ns <= until_ns]
        return max((one.apart_rad(self._opinion) for one in left), default=0.0)

    def _to_announce(self, now_ns: int, noise_rad: float) -> float | None:
        """Return the largest angle that has lasted, unless a like one was announced lately."""
        apart_rad = self._apart_rad(now_ns, SETTLED_S)
        if apart_rad <= 2.0 * noise_rad:
            return None  # it is back where it was
        is_recent = (
            self._announced is not None
            and now_ns - self._announced[0] < ANNOUNCED_EVERY_S * 1e9
            and apart_rad <= 1.5 * self._announced[1]
        )
        if is_recent:
            return None
        self._announced = now_ns, apart_rad
        return apart_rad
