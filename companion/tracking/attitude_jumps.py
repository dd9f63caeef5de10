"""Jumps of a carrier's reported attitude, and the doubt that they leave (docs/math.md 5.3).

Of two attitudes that contradict each other at least one is wrong: a reset by the estimator, or a
forged one. If the next attitude follows from the one before the jump, that in between was wrong.
Otherwise the estimator has another opinion from now on, and either may be right: both stay in the
bound for ``DOUBT_S``, and a notice says so.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

from companion.tracking.carrier import APART_MAX_S, AttitudeBounds, Contradiction, contradiction
from companion.values import Attitude

DOUBT_S: Final = 10.0
"""Time after a jump for which the attitude before it may be the right one, seconds."""
SETTLED_S: Final = APART_MAX_S  # time without a return after which a jump is announced, seconds


@dataclass(frozen=True, slots=True, kw_only=True)
class _Jump:
    """Jump at a sender time, from the attitude ``left``; ``apart_rad`` includes earlier jumps."""

    at_ns: int
    left_ns: int
    left: Attitude
    apart_rad: float
    is_announced: bool = False


class AttitudeJumps:
    """Contradictions between successive attitudes of a carrier.

    ``newest`` is the contradiction between the newest attitude and the previous one, if any.
    """

    def __init__(self) -> None:
        self.newest: Contradiction | None = None
        self._jump: _Jump | None = None

    @property
    def against(self) -> Contradiction | None:
        """What stands against the newest attitude: the previous one, or that before a jump."""
        if self._jump is None:
            return self.newest
        newest = self.newest or Contradiction(0.0, math.inf)
        return Contradiction(max(newest.apart_rad, self._jump.apart_rad), newest.apart_s)

    def look(
        self,
        before: tuple[int, Attitude] | None,
        after: tuple[int, Attitude],
        bounds: AttitudeBounds,
    ) -> float | None:
        """Compare an attitude with the previous one; return the angle of a jump to be announced.

        Both with their sender times. The angle is in rad; None: there is nothing to announce.
        """
        self.newest = None if before is None else _between(before, after, bounds)
        jump = self._jump
        if self.newest is not None and before is not None:
            if jump is not None and _returns(jump, after, bounds):
                self._jump = None
                return None
            apart_rad = self.newest.apart_rad
            if jump is not None:
                apart_rad = min(math.pi, apart_rad + jump.apart_rad)
            self._jump = _Jump(
                at_ns=after[0], left_ns=before[0], left=before[1], apart_rad=apart_rad
            )
            return None
        if jump is None:
            return None
        since_s = (after[0] - jump.at_ns) * 1e-9
        if since_s > DOUBT_S:
            self._jump = None
        elif since_s > SETTLED_S and not jump.is_announced:
            self._jump = replace(jump, is_announced=True)
            return jump.apart_rad
        return None


def _between(
    before: tuple[int, Attitude], after: tuple[int, Attitude], bounds: AttitudeBounds
) -> Contradiction | None:
    return contradiction(before[1], after[1], (after[0] - before[0]) * 1e-9, bounds)


def _returns(jump: _Jump, after: tuple[int, Attitude], bounds: AttitudeBounds) -> bool:
    """Return whether an attitude follows from the one before a jump."""
    is_near = after[0] - jump.left_ns <= APART_MAX_S * 1e9
    return is_near and _between((jump.left_ns, jump.left), after, bounds) is None
