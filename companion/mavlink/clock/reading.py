"""Immutable reading of one sender's clock, which any thread may convert times with."""

import math
from typing import Final, NamedTuple

from companion.mavlink.clock.estimates import ClockEstimate, ClockKind, Guarantee

NS_PER_MS: Final = 1_000_000


class ClockReading(NamedTuple):
    """Clock of one sender as all stamps and answers so far show it; sender times count from boot.

    newest_ns         sender time of the newest stamp, at which the interval below holds
    offset_ns         node time less sender time: least, greatest and most likely, ns
    assumed_drift     drift by which the interval widens with time, a ratio
    drift             detected steady drift, a ratio
    may_be_queue      whether that drift may be a queue that fills
    usual_s           usual error if frames alone are the evidence
    floor_ns          height of the floor at the newest stamp
    latency_s         latency of the newest stamp
    """

    kind: ClockKind
    offset_ns: tuple[int, int, int]
    newest_ns: int
    assumed_drift: float
    drift: float
    may_be_queue: bool
    usual_s: float
    floor_ns: int
    latency_s: float

    def sender_ns(self, node_ns: int) -> int:
        """Convert a node time to sender time, ns."""
        ahead_ns = node_ns - self.newest_ns - self.offset_ns[2]
        return self.newest_ns + round(ahead_ns / (1.0 + self.drift))

    def interval(self, x_ns: int) -> tuple[int, int, int]:
        """Return the offset aged to a sender time: least, greatest and most likely, ns."""
        low_ns, high_ns, likely_ns = self.offset_ns
        slack_ns = math.ceil(self.assumed_drift * abs(x_ns - self.newest_ns))
        drifted_ns = round(self.drift * (x_ns - self.newest_ns))
        least_ns = min(0, drifted_ns) if self.may_be_queue else drifted_ns
        most_ns = max(0, drifted_ns) if self.may_be_queue else drifted_ns
        return low_ns - slack_ns + least_ns, high_ns + slack_ns + most_ns, likely_ns + drifted_ns

    def time(self, node_ns: int) -> tuple[int, float, float, float]:
        """Return the clock at a node time.

        Returns the offset (node time less sender time), ns; then, in seconds, how much larger and
        how much smaller the offset may be, and its usual error.
        """
        low_ns, high_ns, likely_ns = self.interval(self.sender_ns(node_ns))
        usual_s = self.usual_s
        if self.kind is not ClockKind.ENVELOPE:
            usual_s = (high_ns - low_ns) / 4 * 1e-9
        before_s = (high_ns - likely_ns + NS_PER_MS) * 1e-9
        return likely_ns, before_s, (likely_ns - low_ns + NS_PER_MS) * 1e-9, usual_s

    def estimate(self, x_ns: int | None = None, floor_ns: int | None = None) -> ClockEstimate:
        """Return the clock at a sender time and the floor's height there; default: newest stamp."""
        x_ns = self.newest_ns if x_ns is None else x_ns
        floor_ns = self.floor_ns if floor_ns is None else floor_ns
        low_ns, high_ns, likely_ns = self.interval(x_ns)
        is_assumed = self.kind is ClockKind.ENVELOPE
        return ClockEstimate(
            kind=self.kind,
            guarantee=Guarantee.ASSUMED if is_assumed else Guarantee.MEASURED,
            offset_ns=likely_ns,
            before_s=(high_ns - likely_ns + NS_PER_MS) * 1e-9,
            after_s=(likely_ns - low_ns + NS_PER_MS) * 1e-9,
            drift_ppm=self.drift * 1e6,
            constant_delay_s=(floor_ns - likely_ns) * 1e-9,
            latency_s=self.latency_s,
        )
