"""Two-sided evidence of a sender's offset: round trips, and GNSS time at both ends.

A TIMESYNC round trip, sent and received on the node's clock and answered at ``remote`` on the
sender's, proves that

    sent - remote  <=  offset  <=  received - remote

for any split of the delay between the two directions: the midpoint is within half the round trip
(RFC 5905, section 8). A slow round trip gives a wide interval, but never a false one. GNSS time at
both ends gives an interval as wide as the errors of both ends.

All intervals hold at once. Their intersection is widened with time by the largest drift assumed.
Evidence outside it refutes that drift: the clock stepped, or ran faster or slower. The newest
evidence then counts, and the doubt interval contains both until they agree (docs/math.md 6).
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

AGREE: Final = 3  # pieces of evidence in a row after a contradiction that end the doubt
STEP: Final = 0.02
"""Least drift, a ratio, that counts as a step: no clock sustains such a rate error."""
RAISE_FACTOR: Final = 1.5  # multiple of the proven drift that is assumed from then on
DECAY_NS: Final = 60e9  # time constant with which a raised drift decays


class Interval(NamedTuple):
    """Bounds [low, high] on the offset (node time less sender time) at ``x_ns``, ns."""

    x_ns: int
    low_ns: float
    high_ns: float


@dataclass(frozen=True, slots=True)
class DriftProven:
    """Proof that a clock drifts more than assumed: ``drift``, a ratio; inf for a sudden step.

    ``step_ns`` is the distance of the offset from the interval expected.
    """

    drift: float
    step_ns: float


class OffsetEvidence:
    """Interval of a clock offset from all evidence of one kind.

    drift_max    largest drift assumed, a ratio
    """

    def __init__(self, drift_max: float) -> None:
        self._drift_max = drift_max
        self._raised = 0.0
        self._raised_ns = 0
        self._known: Interval | None = None
        self._doubt: Interval | None = None
        self._agreed = 0

    def clear(self) -> None:
        """Discard all evidence, because the sender's clock has a new offset."""
        self._known = self._doubt = None

    def drift_at(self, x_ns: int) -> float:
        """Return the largest drift assumed at a sender time, a ratio."""
        if not self._raised:
            return self._drift_max
        faded = self._raised * math.exp(-max(0, x_ns - self._raised_ns) / DECAY_NS)
        return max(self._drift_max, faded)

    def add(self, new: Interval) -> DriftProven | None:
        """Add evidence. Return the drift it proves; None if it agrees with earlier evidence."""
        before = self._known
        if before is None:
            self._known = new
            return None
        known = self._aged(before, new.x_ns)
        low_ns, high_ns = max(known.low_ns, new.low_ns), min(known.high_ns, new.high_ns)
        if low_ns <= high_ns:
            self._known = Interval(new.x_ns, low_ns, high_ns)
            if self._doubt is not None:
                self._agreed += 1
                if self._agreed >= AGREE:
                    self._doubt = None
            return None
        return self._contradicted(before, known, new)

    def _contradicted(self, before: Interval, known: Interval, new: Interval) -> DriftProven:
        since_ns = abs(new.x_ns - before.x_ns)
        apart_ns = max(new.low_ns - known.high_ns, known.low_ns - new.high_ns)
        moved_ns = apart_ns + self.drift_at(before.x_ns) * since_ns
        drift = moved_ns / since_ns if since_ns else math.inf
        if drift < STEP:
            self._raised, self._raised_ns = RAISE_FACTOR * drift, new.x_ns
        doubt = known if self._doubt is None else _hull(known, self._aged(self._doubt, new.x_ns))
        self._known, self._doubt, self._agreed = new, doubt, 0
        return DriftProven(drift if drift < STEP else math.inf, apart_ns)

    def _aged(self, one: Interval, x_ns: int) -> Interval:
        slack = self.drift_at(one.x_ns) * abs(x_ns - one.x_ns)
        return Interval(x_ns, one.low_ns - slack, one.high_ns + slack)

    def newest(self, x_ns: int) -> Interval:
        """Return the offset's interval at a sender time, by evidence since the last contradiction.

        Some evidence must exist.
        """
        assert self._known is not None
        return self._aged(self._known, x_ns)

    def at(self, x_ns: int) -> Interval | None:
        """Return the offset's interval at a sender time, doubt included; None without evidence."""
        if self._known is None:
            return None
        known = self._aged(self._known, x_ns)
        return known if self._doubt is None else _hull(known, self._aged(self._doubt, x_ns))


def _hull(one: Interval, other: Interval) -> Interval:
    return Interval(one.x_ns, min(one.low_ns, other.low_ns), max(one.high_ns, other.high_ns))
