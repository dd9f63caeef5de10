"""Evidence for the constant part of the latency: intervals that certainly hold the offset.

A TIMESYNC round trip, sent and received on the node's clock and answered at ``remote`` on the
sender's, proves that

    sent - remote  <=  offset  <=  received - remote

however long the two ways took: the midpoint is within half the round trip (RFC 5905, section 8). A
slow round trip proves little, but nothing false. GNSS time at both ends proves an interval as wide
as both ends' errors. All of these hold at once, and the offset is nowhere above the lower envelope,
since no frame arrives before it was sent. The intervals, widened by the drift's error times their
age, are therefore intersected with one another and with what lies below the envelope (docs/math.md
6).
"""

from collections import deque
from typing import Final, NamedTuple

from companion.mavlink.clock.envelope import Envelope

KEPT: Final = 64
"""Intervals kept of each kind."""
CONTRADICTIONS: Final = 3
"""Intervals in a row that must contradict the older ones before they replace them."""


class Interval(NamedTuple):
    """Bounds [low, high] on the offset (node time less sender time) at ``x_ns``, ns."""

    x_ns: int
    low_ns: int
    high_ns: int


class Depth(NamedTuple):
    """Distance of the offset below the envelope: ``depth_ns`` ± ``error_ns`` at sender time
    ``x_ns``.

    ``depth_ns`` is at least 0.
    """

    depth_ns: int
    error_ns: float
    x_ns: int


class Evidence:
    """The newest intervals of one kind, and the depth below the envelope on which they agree.

    deepest_ns   greatest depth accepted: no link's least latency is longer, so an interval
                 below that is about another clock
    lifetime_ns  age in sender time beyond which an interval no longer counts
    """

    def __init__(self, deepest_ns: int, lifetime_ns: int) -> None:
        self._deepest_ns = deepest_ns
        self._lifetime_ns = lifetime_ns
        self._intervals: deque[Interval] = deque(maxlen=KEPT)
        self._contradictions = 0
        self._known: Depth | None = None
        self._known_at = -1

    def clear(self) -> None:
        """Forget all intervals, because the sender's clock has a new offset."""
        self._intervals.clear()
        self._contradictions = 0
        self._known_at = -1

    def add(self, new: Interval, envelope: Envelope) -> str | None:
        """Take in an interval. Returns None, or the reason for which it was not used."""
        slack_ns = envelope.drift_error * abs(new.x_ns - envelope.newest_ns) + 1e6
        low, high = _depths(new, envelope, slack_ns)
        if high < 0:
            return f"frames would have come {-high / 1e9:.3f} s before they were sent"
        if low > self._deepest_ns:
            return f"the best frame would have taken {low / 1e9:.3f} s: it is another clock"
        known = self.depth(envelope)
        if known is not None:
            aged_ns = known.error_ns + envelope.drift_error * abs(new.x_ns - known.x_ns)
            if low > known.depth_ns + aged_ns or high < known.depth_ns - aged_ns:
                self._contradictions += 1
                if self._contradictions < CONTRADICTIONS:
                    return "it contradicts those before it"
                self.clear()
        self._contradictions = 0
        self._intervals.append(new)
        self._known_at = -1
        return None

    def depth(self, envelope: Envelope) -> Depth | None:
        """The depth on which the intervals agree, as of the newest of them; None without any."""
        if self._known_at != envelope.fits:
            self._known = self._intersect(envelope)
            self._known_at = envelope.fits
        if self._known is None or envelope.newest_ns - self._known.x_ns > self._lifetime_ns:
            return None
        return self._known

    def _intersect(self, envelope: Envelope) -> Depth | None:
        """Intersect the intervals from the newest backwards, without those that contradict it."""
        if not self._intervals:
            return None
        x_ns = self._intervals[-1].x_ns
        low, high = 0.0, float(self._deepest_ns)
        for interval in reversed(self._intervals):
            age_ns = abs(x_ns - interval.x_ns)
            if age_ns > self._lifetime_ns:
                break
            lowest, highest = _depths(interval, envelope, envelope.drift_error * age_ns)
            if max(low, lowest) <= min(high, highest):
                low, high = max(low, lowest), min(high, highest)
        return Depth(round((low + high) / 2.0), (high - low) / 2.0, x_ns)


def _depths(interval: Interval, envelope: Envelope, slack_ns: float) -> tuple[float, float]:
    """Least and greatest depth (ns) that an interval allows, widened by ``slack_ns``."""
    line_ns = envelope.at(interval.x_ns)
    return line_ns - interval.high_ns - slack_ns, line_ns - interval.low_ns + slack_ns
