"""Timing of a UAV's reports, and the longest silence that is still normal.

A link that delivers a report every 0.8 s with a latency up to a second does not lose its UAV
between reports. A track coasts only after a silence longer than three of its own intervals plus the
spread of latencies, and longer than recent silences.
"""

from array import array
from typing import Final

from companion.values import Fix
from companion.values.newest import append_number

KEPT: Final = 16  # reports from which the timing is measured
INTERVALS: Final = 3.0
SILENCES: Final = 1.25
"""Multiple of the second longest recent silence that is normal; the longest may be an outlier."""


class ReportTiming:
    """Intervals, latencies and silences of a UAV's reports. ``add`` takes accepted reports."""

    def __init__(self) -> None:
        self._intervals_s = array("d")
        self._latencies_s = array("d")
        self._ages_s = array("d")
        self._newest_ns: int | None = None

    def add(self, fix: Fix) -> None:
        """Add an accepted report, in order of arrival."""
        latency_s = (fix.arrival_ns - fix.t_ns) * 1e-9
        append_number(self._latencies_s, latency_s, KEPT)
        newest_ns = self._newest_ns
        if newest_ns is not None:
            if fix.sender_ns <= newest_ns:
                return
            interval_s = (fix.sender_ns - newest_ns) * 1e-9
            append_number(self._intervals_s, interval_s, KEPT)
            # Age of the previous report when this one arrived.
            append_number(self._ages_s, interval_s + latency_s, KEPT)
        self._newest_ns = fix.sender_ns

    def silence_s(self, least_s: float, most_s: float) -> float:
        """Return the age of the newest report above which a track coasts, seconds; limited."""
        intervals_s, ages_s = self._intervals_s, self._ages_s
        if len(intervals_s) < 3:
            return min(least_s, most_s)
        spread_s = max(self._latencies_s) - min(self._latencies_s)
        # On most links even the longest interval and silence are short: nothing is sorted then.
        if max(INTERVALS * max(intervals_s) + spread_s, SILENCES * max(ages_s)) <= least_s:
            return min(least_s, most_s)
        in_order = sorted(intervals_s)
        n = len(in_order)
        median_s = (in_order[(n - 1) // 2] + in_order[n // 2]) / 2.0
        usual_s = INTERVALS * median_s + spread_s
        return min(max(least_s, usual_s, SILENCES * sorted(ages_s)[-2]), most_s)
