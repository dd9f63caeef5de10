"""Difference between the positions of an autopilot and of its GNSS receiver.

The receiver's error is bounded by its stated accuracy. The autopilot's is not: its barometer
drifts, and its estimator may reject the receiver. The autopilot's position is therefore off by at
most the receiver's error and this difference (docs/math.md 4).
"""

import math
from dataclasses import dataclass, field
from typing import Final

from companion.mavlink.wire.stamps import step_ms
from companion.values import FIX_3D, GnssStatus, Report

NEAR_M: Final = 50.0
"""Largest difference with which a drift begins; a larger one shows that a position is invalid.

Before an autopilot's height is valid it may be off by hundreds of metres (docs/field-notes.md 1).
"""
RESOLUTION_M: Final = 0.05
"""Difference by the resolution of positions, 11 mm each, and of stamps, 1 ms."""
LAGGING_M: Final = 1.0
"""Largest difference that a lag may explain in part; of a larger one, no part is."""
NOTICE_M: Final = 3.0  # least difference that is announced
NOTICE_RATIO: Final = 2.0  # increase after which it is announced again
LAG_S: Final = 0.5
"""Largest age of a receiver's position at the stamp of its status.

In eight logs of real and simulated vehicles 98 % were -0.05 to 0.56 s (docs/field-notes.md 1).
"""
ARRIVAL_LAG_S: Final = 1.0  # the same at the arrival, if only that is known
GROWTH_MPS: Final = 5.0
"""Fastest growth of a difference that the bound follows.

A report that jumps is rejected instead, or restarts the track with a notice.
"""
HELD_NS: Final = 5_000_000_000
"""Time for which a difference is held at least: less of it shows at another course or climb."""
SAME_CLOCK_S: Final = 10.0  # longest time between two stamps of one clock
APART_S: Final = 3.0  # longest time between a status and a report that are compared
_METRES_PER_DEGREE: Final = 111_195.0


@dataclass(slots=True, kw_only=True)
class Difference:
    """Difference of the altitudes or horizontal positions, and what follows from it.

    apart_m    newest difference
    covered_m  part of the position bound that it needs: the largest of the last ``HELD_NS``
    noticed_m  difference that was announced last
    """

    what: str
    apart_m: float = 0.0
    covered_m: float = 0.0
    noticed_m: float = NOTICE_M
    _noted_ns: int | None = None
    _since_ns: int = 0
    _largest_m: tuple[float, float] = 0.0, 0.0  # before that time, for ``HELD_NS``, and since

    def note(self, apart_m: float, most_m: float, t_ns: int) -> None:
        """Note a new difference, and the largest one that the unknown lag allows."""
        is_drift = apart_m < NEAR_M or self.covered_m > NEAR_M / 2
        covered_m = (apart_m if apart_m < LAGGING_M else most_m) - RESOLUTION_M
        if self._noted_ns is not None:
            grown_m = GROWTH_MPS * (t_ns - self._noted_ns) * 1e-9
            covered_m = min(covered_m, self.covered_m + grown_m)
        self._noted_ns = t_ns
        before_m, since_m = self._largest_m
        if t_ns - self._since_ns > HELD_NS:
            self._since_ns, before_m, since_m = t_ns, since_m, 0.0
        self._largest_m = before_m, max(since_m, covered_m if is_drift else 0.0)
        self.apart_m, self.covered_m = apart_m, max(self._largest_m)

    @property
    def is_news(self) -> bool:
        """Whether it must be announced."""
        return self.apart_m > self.noticed_m

    def text(self, metres: str) -> str:
        """Return the difference in words."""
        return f"its {self.what} differs by {metres} m from its GNSS receiver's"

    def announce(self) -> str:
        """Return what must be announced, and note that it is."""
        self.noticed_m = NOTICE_RATIO * self.apart_m
        covered = "the position bound covers the difference"
        is_covered = self.covered_m >= self.apart_m
        then = covered if is_covered else "one of the two is invalid"
        return f"{self.text(f'{self.apart_m:.0f}')}; {then}"


@dataclass(slots=True, kw_only=True)
class ReceiverDifference:
    """Difference of an autopilot's reports from its receiver, compared once for each status.

    ``compared`` is the status that was compared last.
    """

    compared: GnssStatus | None = None
    height: Difference = field(default_factory=lambda: Difference(what="altitude"))
    horizontal: Difference = field(default_factory=lambda: Difference(what="position"))
    is_news: bool = False  # whether one of them must be announced

    def compare(self, status: GnssStatus, report: Report, late_s: float) -> None:
        """Compare a status with the first report after it, which is at most ``late_s`` late."""
        self.compared = status
        if status.fix_type < FIX_3D:
            return
        elapsed_s = _between_stamps_s(status, report)
        least_s, most_s = 0.0, LAG_S
        if elapsed_s is None:
            elapsed_s = (report.t_ns - status.t_ns) * 1e-9
            least_s, most_s = -late_s, late_s + ARRIVAL_LAG_S
        if abs(elapsed_s) > APART_S:  # a vehicle that manoeuvres is elsewhere by then
            return
        if report.velocity_down_mps is not None:
            descended_m = report.velocity_down_mps * elapsed_s
            apart_m = abs(report.alt_m - status.alt_m + descended_m)
            self.height.note(apart_m, apart_m, report.t_ns)
        if status.position_deg is not None and report.velocity_ne_mps is not None:
            lat_deg, lon_deg = status.position_deg
            north_m = (report.lat_deg - lat_deg) * _METRES_PER_DEGREE
            across = _METRES_PER_DEGREE * math.cos(math.radians(lat_deg))
            east_m = math.remainder(report.lon_deg - lon_deg, 360.0) * across
            seconds = elapsed_s + least_s, elapsed_s + most_s
            least_m, most_m = _off_path_m((north_m, east_m), report.velocity_ne_mps, seconds)
            self.horizontal.note(least_m, most_m, report.t_ns)
        self.is_news = self.height.is_news or self.horizontal.is_news

    @property
    def larger(self) -> Difference:
        """The difference that needs the larger part of the bound."""
        is_height = self.height.covered_m >= self.horizontal.covered_m
        return self.height if is_height else self.horizontal

    def announce(self) -> list[str]:
        """Return what must be announced, and note that it is."""
        self.is_news = False
        return [one.announce() for one in (self.height, self.horizontal) if one.is_news]


def _between_stamps_s(status: GnssStatus, report: Report) -> float | None:
    """Return the time from a status to a report by their stamps; None if these are of two clocks.

    Either may have overtaken the other on the link. Some receivers count from 1970.
    """
    if report.boot_ms is None or not status.time_us:
        return None
    elapsed_s = step_ms(report.boot_ms, status.time_us // 1000 & 0xFFFF_FFFF) * 1e-3
    return elapsed_s if abs(elapsed_s) <= SAME_CLOCK_S else None


def _off_path_m(
    offset_m: tuple[float, float], velocity_mps: tuple[float, float], seconds: tuple[float, float]
) -> tuple[float, float]:
    """Return the least and largest distance of an offset from a path at a velocity.

    ``seconds`` are the times at which the path begins and ends.
    """
    (north_m, east_m), (north_mps, east_mps) = offset_m, velocity_mps
    speed2 = north_mps * north_mps + east_mps * east_mps
    along_s = (north_m * north_mps + east_m * east_mps) / speed2 if speed2 else 0.0
    at_s = min(max(along_s, seconds[0]), seconds[1])
    least_m, *ends_m = (
        math.hypot(north_m - north_mps * t_s, east_m - east_mps * t_s) for t_s in (at_s, *seconds)
    )
    return least_m, max(ends_m)
