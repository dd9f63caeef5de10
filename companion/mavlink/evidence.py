"""What tells the constant part of the latency: intervals in which the offset lies for certain.

A TIMESYNC round trip, sent and received on the node's clock and answered at ``remote`` on the
sender's, proves that

    sent - remote  <=  offset  <=  received - remote

whatever the two ways took: the midpoint is within half the round trip (RFC 5905, section 8). A
slow round trip proves little, but nothing false. Times of GNSS at both ends prove an interval as
wide as both ends' errors. All that they prove holds at once, and the offset is nowhere above the
lower envelope, for no frame arrives before it was sent: so the intervals, aged by the drift's
error, are intersected with one another and with what lies below the envelope.
"""

from collections import deque
from typing import Final, NamedTuple

from companion.mavlink.envelope import Envelope

KEPT: Final = 64
CONTRADICTIONS: Final = 3
"""So many intervals in a row that contradict the older ones are believed, and the older not."""


class Interval(NamedTuple):
    """At sender time ``x_ns`` the offset, node time less sender time, is in [low, high]; ns."""

    x_ns: int
    low_ns: int
    high_ns: int


class Depth(NamedTuple):
    """How far below the envelope the offset lies: ``depth_ns``, at least 0, give or take
    ``error_ns`` at sender time ``x_ns``."""

    depth_ns: int
    error_ns: float
    x_ns: int


class Evidence:
    """The newest intervals of one kind, and the depth below the envelope that they agree on.

    ``deepest_ns``: no link's best latency is longer; what says so is about another clock.
    ``lifetime_ns``: what is older, in sender time, no longer counts.
    """

    def __init__(self, deepest_ns: int, lifetime_ns: int) -> None:
        self._deepest_ns = deepest_ns
        self._lifetime_ns = lifetime_ns
        self._intervals: deque[Interval] = deque(maxlen=KEPT)
        self._contradictions = 0
        self._known: Depth | None = None
        self._known_at = -1

    def clear(self) -> None:
        """Forget all: the sender's clock has another offset now."""
        self._intervals.clear()
        self._contradictions = 0
        self._known_at = -1

    def add(self, new: Interval, envelope: Envelope) -> str | None:
        """Take in an interval, or say why not."""
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
        """What the intervals agree on, as of the newest of them; None without any."""
        if self._known_at != envelope.fits:
            self._known = self._intersect(envelope)
            self._known_at = envelope.fits
        if self._known is None or envelope.newest_ns - self._known.x_ns > self._lifetime_ns:
            return None
        return self._known

    def _intersect(self, envelope: Envelope) -> Depth | None:
        """From the newest backwards; what contradicts newer ones is left out."""
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
    line_ns = envelope.at(interval.x_ns)
    return line_ns - interval.high_ns - slack_ns, line_ns - interval.low_ns + slack_ns
