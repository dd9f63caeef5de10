"""Difference between the positions of an autopilot and of its GNSS receiver.

The receiver's error is bounded by its stated accuracy. The autopilot's is not: its barometer
drifts, and its estimator may reject the receiver. The autopilot's position is therefore off by at
most the receiver's error and this difference (docs/math.md 4).
"""

import math
from dataclasses import dataclass, field
from typing import Final

from companion.values import FIX_3D, GnssStatus, Report, ReportNoise, Severity

NEAR_M: Final = 50.0
"""Largest difference of heights that may be a drift; if it begins larger, a height is invalid.

Before an autopilot's height is valid it may be off by hundreds of metres (docs/field-notes.md 1).
"""
RESOLUTION_M: Final = 0.05
"""Difference by the resolution of positions, 11 mm each, and of stamps, 1 ms."""
NOTICE_M: Final = 3.0  # least difference that is announced
NOTICE_RATIO: Final = 2.0  # increase after which it is announced again
LEAST_ANNOUNCED_M: Final = NOTICE_M / NOTICE_RATIO
ANNOUNCED_NS: Final = 60_000_000_000
"""Time after which a notice is forgotten, if the difference has fallen to a quarter of it.

Then, a difference that is not covered is announced again.
"""
LAG_S: Final = 0.5
"""Largest age of a receiver's position at the stamp of its status.

In six logs of real and simulated vehicles 98 % were 0 to 0.46 s (docs/field-notes.md 1).
"""
ARRIVAL_LAG_S: Final = 1.0  # the same at the arrival, if only that is known
GROWTH_MPS: Final = 5.0
"""Fastest growth of a difference that the bound follows.

A report that jumps is rejected instead, or restarts the track with a notice.
"""
HELD_NS: Final = 5_000_000_000
"""Time for which a difference is held at least: less of it shows at another course.

A climb in which a lag may hide more of it than the receiver's error does not count.
"""
LATE_S: Final = 1.0  # largest lateness of a report that is compared by arrivals
APART_S: Final = 3.0  # longest time between a status and a report that are compared
APART_US: Final = round(APART_S * 1e6)  # the same between two stamps of one clock
TURN_MS: Final = 1500  # longest time between two reports whose velocities give an acceleration
_METRES_PER_DEGREE: Final = 111_195.0
SCALED_DEG: Final = 0.01  # change of latitude after which degrees of longitude are scaled anew

Pair = tuple[float, float]


@dataclass(slots=True, kw_only=True)
class Difference:
    """Difference of the altitudes or horizontal positions, and what follows from it.

    what         "altitude" or "position"
    apart_m      newest difference
    noted_ns     arrival of the report that showed it; None: none was compared
    covered_m    part of the position bound that it needs, held for ``HELD_NS`` at least
    largest_m    largest such part since ``since_ns``, and in the ``HELD_NS`` before that
    has_datum    whether it may be that of two datums, as of heights
    is_invalid   then, whether it has not been less than ``NEAR_M`` yet
    announced_m  difference that was announced last, at ``announced_ns``
    news_m       difference above which it must be announced again
    says_covered whether that notice said that the bound covers it
    """

    what: str
    apart_m: float = 0.0
    noted_ns: int | None = None
    covered_m: float = 0.0
    largest_m: tuple[float, float] = 0.0, 0.0
    since_ns: int = 0
    has_datum: bool = False
    is_invalid: bool = False
    announced_m: float = LEAST_ANNOUNCED_M
    announced_ns: int = 0
    news_m: float = NOTICE_M
    says_covered: bool = False

    def note(self, apart_m: float, most_m: float, t_ns: int, *, ages: bool) -> None:
        """Note a new difference; ``most_m`` is the largest that the unknown lag allows.

        If the largest one ``ages``, it is held for another ``HELD_NS``, then forgotten.
        """
        covered_m = most_m - RESOLUTION_M
        if self.noted_ns is not None:
            followed_m = self.covered_m + GROWTH_MPS * (t_ns - self.noted_ns) * 1e-9
            covered_m = covered_m if covered_m < followed_m else followed_m
        is_far = self.has_datum and apart_m >= NEAR_M
        self.is_invalid = is_far and (self.is_invalid or self.noted_ns is None)
        if self.is_invalid:
            covered_m = 0.0
        if apart_m < self.announced_m / NOTICE_RATIO**2 and t_ns - self.announced_ns > ANNOUNCED_NS:
            self.announced_m = LEAST_ANNOUNCED_M
        if ages:
            self.since_ns, self.largest_m = t_ns, (0.0, self.largest_m[0])
        since_m, before_m = self.largest_m
        self.largest_m = max(since_m, covered_m), before_m
        self.apart_m, self.noted_ns, self.covered_m = apart_m, t_ns, max(self.largest_m)
        self._set_news(t_ns)

    def _set_news(self, t_ns: int) -> None:
        """Set ``news_m``: twice what was announced, or less if more is not covered now."""
        self.news_m = NOTICE_RATIO * self.announced_m
        if self.says_covered or t_ns - self.announced_ns > ANNOUNCED_NS:
            uncovered_m = LEAST_ANNOUNCED_M + max(self.covered_m, LEAST_ANNOUNCED_M)
            self.news_m = uncovered_m if uncovered_m < self.news_m else self.news_m

    @property
    def is_news(self) -> bool:
        """Whether it must be announced."""
        return self.apart_m > self.news_m

    def text(self, metres: str) -> str:
        """Return the difference in words."""
        return f"its {self.what} differs by {metres} m from its GNSS receiver's"

    def announce(self, t_ns: int) -> tuple[Severity, str]:
        """Return what must be announced, and note that it is."""
        self.announced_m, self.announced_ns = self.apart_m, t_ns
        covered = "the position bound covers the difference"
        self.says_covered = self.covered_m >= self.apart_m - RESOLUTION_M
        self._set_news(t_ns)
        then = covered if self.says_covered else "one of the two is invalid"
        severity = Severity.INFO if self.says_covered else Severity.WARNING
        return severity, f"{self.text(f'{self.apart_m:.0f}')}; {then}"


@dataclass(slots=True, kw_only=True)
class ReceiverDifference:
    """Difference of an autopilot's reports from its receiver, compared once for each status.

    ``compared`` is the status that was compared last.
    """

    compared: GnssStatus | None = None
    height: Difference = field(default_factory=lambda: Difference(what="altitude", has_datum=True))
    horizontal: Difference = field(default_factory=lambda: Difference(what="position"))
    is_news: bool = False  # whether one of them must be announced
    before: Report | None = None  # the report before, compared or not
    _turn_mps2: Pair = 0.0, 0.0  # acceleration by the newest two reports, north and east
    _climb_mps2: float = 0.0  # the same, down
    _scaled_deg: float = math.inf  # latitude at which a degree of longitude has ``_east_m``
    _east_m: float = 0.0

    def compare(
        self, status: GnssStatus, report: Report, late_s: float, receiver: ReportNoise
    ) -> None:
        """Compare a status with the first report after it, which is at most ``late_s`` late.

        ``receiver`` bounds the receiver's errors. A difference up to these, and to what the
        vehicle's acceleration explains, counts at the most favourable lag, a larger one at the
        least.

        Stamps are compared, as either may have overtaken the other; arrivals if the stamps are of
        two clocks, as of receivers that count from 1970, or if one has wrapped around.

        Short expressions stand for calls, because this runs for most reports.
        """
        self.compared = status
        velocity_mps, t_ns = report.velocity_ne_mps, report.t_ns
        boot_ms, down_mps = report.boot_ms, report.velocity_down_mps or 0.0
        if status.fix_type < FIX_3D or velocity_mps is None or boot_ms is None:
            return
        before = self.before
        if before is not None and before.velocity_ne_mps is not None and before.boot_ms is not None:
            elapsed_ms, before_mps = boot_ms - before.boot_ms, before.velocity_ne_mps
            if 0 < elapsed_ms <= TURN_MS:
                per_s = 1000.0 / elapsed_ms
                north_mps2 = (velocity_mps[0] - before_mps[0]) * per_s
                self._turn_mps2 = north_mps2, (velocity_mps[1] - before_mps[1]) * per_s
                self._climb_mps2 = (down_mps - (before.velocity_down_mps or 0.0)) * per_s
        stamp_us = status.time_us
        elapsed_us = boot_ms * 1000 - stamp_us if stamp_us and boot_ms else None
        if elapsed_us is not None and -APART_US <= elapsed_us <= APART_US:
            elapsed_s = elapsed_us * 1e-6
            least_s, most_s = elapsed_s, elapsed_s + LAG_S
        else:
            elapsed_s = (t_ns - status.t_ns) * 1e-9
            if elapsed_s > APART_S or late_s > LATE_S:  # it may have turned, or is anywhere
                return
            least_s, most_s = elapsed_s - late_s, elapsed_s + late_s + ARRIVAL_LAG_S
        seconds = least_s, most_s
        if report.velocity_down_mps is not None:
            self._compare_height(report.alt_m - status.alt_m, report, seconds, receiver.vertical_m)
        if status.position_deg is not None:
            receiver_m = receiver.horizontal_m
            self._compare_position(status.position_deg, report, velocity_mps, seconds, receiver_m)
        height, horizontal = self.height, self.horizontal
        self.is_news = height.apart_m > height.news_m or horizontal.apart_m > horizontal.news_m

    def _compare_height(
        self, above_m: float, report: Report, seconds: Pair, receiver_m: float
    ) -> None:
        """Compare a report with the receiver's height, which begins and ends at two times."""
        (least_s, most_s), down_mps, t_ns = seconds, report.velocity_down_mps or 0.0, report.t_ns
        longest_s = most_s if most_s > -least_s else -least_s
        climb_mps2 = self._climb_mps2 if self._climb_mps2 > 0.0 else -self._climb_mps2
        explained_m = receiver_m + RESOLUTION_M + climb_mps2 / 2 * longest_s * longest_s
        first_m, last_m = above_m + down_mps * least_s, above_m + down_mps * most_s
        low_m, high_m = (first_m, last_m) if first_m < last_m else (last_m, first_m)
        least_m = low_m if low_m > 0.0 else -high_m if high_m < 0.0 else 0.0
        most_m = high_m if high_m > -low_m else -low_m
        one, is_small = self.height, least_m < explained_m
        is_covered = least_m <= one.largest_m[0] + RESOLUTION_M and is_small
        is_hidden = high_m - low_m > explained_m  # in a climb
        ages = t_ns - one.since_ns > HELD_NS and not is_hidden
        if is_covered and not ages:  # nearly always
            one.apart_m, one.noted_ns = least_m, t_ns
        else:
            one.note(least_m, least_m if is_small else most_m, t_ns, ages=ages)

    def _compare_position(
        self,
        of_receiver_deg: Pair,
        report: Report,
        velocity_mps: Pair,
        seconds: Pair,
        receiver_m: float,
    ) -> None:
        """Compare a report with the receiver's path, which begins and ends at two times."""
        (lat_deg, lon_deg), (north_mps, east_mps), t_ns = of_receiver_deg, velocity_mps, report.t_ns
        if not -SCALED_DEG < lat_deg - self._scaled_deg < SCALED_DEG:
            self._scaled_deg = lat_deg
            self._east_m = _METRES_PER_DEGREE * math.cos(math.radians(lat_deg))
        east_deg = report.lon_deg - lon_deg
        if not -180.0 <= east_deg <= 180.0:
            east_deg -= math.copysign(360.0, east_deg)
        north_m, east_m = (report.lat_deg - lat_deg) * _METRES_PER_DEGREE, east_deg * self._east_m
        speed2 = north_mps * north_mps + east_mps * east_mps
        at_s = (north_m * north_mps + east_m * east_mps) / speed2 if speed2 else 0.0
        at_s = seconds[0] if at_s < seconds[0] else seconds[1] if at_s > seconds[1] else at_s
        (turn_north_mps2, turn_east_mps2), half_s2 = self._turn_mps2, at_s * at_s / 2
        off_north_m = north_m - north_mps * at_s + turn_north_mps2 * half_s2
        off_east_m = east_m - east_mps * at_s + turn_east_mps2 * half_s2
        apart_m: float = (off_north_m * off_north_m + off_east_m * off_east_m) ** 0.5
        one = self.horizontal
        longest_s = seconds[1] if seconds[1] > -seconds[0] else -seconds[0]
        turn_mps2 = (turn_north_mps2 * turn_north_mps2 + turn_east_mps2 * turn_east_mps2) ** 0.5
        is_small = apart_m < receiver_m + RESOLUTION_M + turn_mps2 / 2 * longest_s * longest_s
        is_covered = apart_m <= one.largest_m[0] + RESOLUTION_M and is_small
        ages = t_ns - one.since_ns > HELD_NS
        if is_covered and not ages:  # nearly always
            one.apart_m, one.noted_ns = apart_m, t_ns
            return
        ends_m = (math.hypot(north_m - north_mps * s, east_m - east_mps * s) for s in seconds)
        one.note(apart_m, apart_m if is_small else max(ends_m), t_ns, ages=ages)

    @property
    def larger(self) -> Difference:
        """The difference that needs the larger part of the bound."""
        is_height = self.height.covered_m >= self.horizontal.covered_m
        return self.height if is_height else self.horizontal

    def announce(self, t_ns: int) -> list[tuple[Severity, str]]:
        """Return what must be announced, and note that it is."""
        self.is_news = False
        return [one.announce(t_ns) for one in (self.height, self.horizontal) if one.is_news]
