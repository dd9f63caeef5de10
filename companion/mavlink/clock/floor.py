"""Floor of (arrival - stamp): the bound on a clock offset from one-way frames alone.

Observed of a sender is

    y = arrival - boot = offset + latency,     latency >= its least value >= 0

No frame arrives before it was sent, so the offset is nowhere above any y. Since it changes by no
more than the largest drift D, every y bounds it at all times:

    offset(x) <= min over all stamps of  y_k + D |x - x_k|     (``upper_bound``, docs/math.md 6)

This bound is one number, aged by D: no useful evidence is discarded, and the bound does not jump
at the end of a window.

A clock that stalls for a moment and a link that becomes slower look alike: every y is higher. They
cannot be distinguished, so both are kept. ``upper_bound`` holds if the clock did not stall.
``line`` restarts where all frames have been above it for long, far beyond their usual spread
(``lateness.py``). The same holds if frames arrive steadily later for a whole window: the clock is
slow, or a queue fills. The line follows the slope, and a level floor is kept beside it until no
queue can be that long. Before that, the least height of the last few frames is assumed possible:
the offset is below it regardless of earlier clock changes.

Over 300 lines: one state, from which each stamp moves all heights together.
"""

import math
from collections import deque
from typing import Final, NamedTuple

from companion.mavlink.clock.latencies import RESOLUTION_NS, Latencies
from companion.mavlink.clock.lateness import CHANGE, LEAST_CHANGE_NS, LateSpell, SenderLateness

LIKELY_DRIFT: Final = 50e-6
"""Drift of an ordinary crystal, by which the most likely line rises while no frame touches it."""
FEWEST, RECENT = 3, 8
"""Number of last frames whose least height bounds the offset, regardless of earlier clock changes.

``RECENT`` always; ``FEWEST`` if their lateness exceeds the spread.
"""
WORST_LATENCY_NS: Final = 5e9
"""Greatest latency of a frame; radios have delivered up to 4.8 s late."""
START_NS: Final = 250_000_000
"""Time that counts as one frame at the start, as the first few frames may all be slow together."""
_RARE: Final = 7.0
"""Once in 1000 the least of n exponential latencies exceeds the true minimum by 7/n of a mean."""


class Heights(NamedTuple):
    """Bounds on a clock offset by its floor at one sender time, ns."""

    upper_bound: int  # upper bound of the offset if the clock stayed within its drift
    highest: int  # upper bound of the offset even if the clock changed before the last frames
    line: int  # most likely height of the floor
    least: int  # least possible height of the frame nearest to the offset


class _Level:
    """Level floor under steadily rising stamps, valid if a queue, not drift, caused the rise.

    upper_bound offset bound if a queue caused it, at the newest stamp, relative to the level base
    bound_set_ns  sender time of the stamp that set it
    """

    __slots__ = ("bound_set_ns", "upper_bound")

    def __init__(self, bound_set_ns: int) -> None:
        self.upper_bound = 0.0
        self.bound_set_ns = bound_set_ns

    def add(self, x_ns: int, height: float, ahead_ns: int, drift_max: float) -> None:
        """Add a stamp that is ``ahead_ns`` ahead of the newest one."""
        self.upper_bound += drift_max * max(0, ahead_ns)
        as_of_now = height + drift_max * max(0, -ahead_ns)
        if as_of_now <= self.upper_bound:
            self.upper_bound, self.bound_set_ns = as_of_now, x_ns


class Floor:
    """Floor of one line of stamps. ``add`` takes placed stamps in order of arrival.

    Arguments:

        window_ns   time over which latencies are sampled and a steady drift is detected
        drift_max   largest drift assumed, a ratio
        before_ns   largest visible latency of the line before this one; 0 without one

    Attributes:

        newest_ns   newest sender time; 0 before the first stamp
        drift       detected steady drift, a ratio; 0 unless it exceeds ``drift_max``
        count       stamps so far
        rise_ns     rise of the line at the newest stamp beyond ``drift_max``; 0 unless it restarted
        jump_ns     rise that no latency explains, at the newest stamp; 0 unless it was found there
    """

    def __init__(self, window_ns: int, drift_max: float, before_ns: float = 0.0) -> None:
        self._window_ns = window_ns
        self._drift_max = drift_max
        self._before_ns = before_ns
        self._likely_drift = min(LIKELY_DRIFT, drift_max)
        self.drift = 0.0
        self.count = 0
        self.newest_ns = 0
        self.rise_ns = self.jump_ns = 0.0
        self._first_arrival_ns = self._newest_arrival_ns = 0
        self._base = (0, 0)  # x, y: heights are relative to base y + drift * (x - base x)
        self._upper_bound = self._line = 0.0  # heights at newest_ns
        self._level: _Level | None = None  # floor if the apparent drift is a queue
        self._bound_set_ns = 0  # x of the stamp that set ``upper_bound``
        self._since_ns = 0  # x of the line's last restart
        self._risen = -math.inf  # height of the last few frames, if they are suspiciously late
        self._recent: deque[tuple[int, float]] = deque(maxlen=RECENT)
        self._lateness = SenderLateness(drift_max)
        self._visible = Latencies(window_ns, drift_max)
        self._measured_count = 0

    def __bool__(self) -> bool:
        return self.count > 0

    # --- input ------------------------------------------------------------------------------

    def add(self, x_ns: int, y_ns: int) -> None:
        """Add a stamp: its sender time, and its arrival less its sender time."""
        self.rise_ns = self.jump_ns = 0.0
        self._newest_arrival_ns = x_ns + y_ns
        if not self.count:
            self._base = (x_ns, y_ns)
            self._since_ns = self._bound_set_ns = x_ns
            self.newest_ns, self._first_arrival_ns = x_ns, x_ns + y_ns
        self.count += 1
        base_x_ns, base_y_ns = self._base
        height = y_ns - base_y_ns - self.drift * (x_ns - base_x_ns)
        ahead_ns, level = x_ns - self.newest_ns, self._level
        if level is not None:
            level.add(x_ns, y_ns - base_y_ns, ahead_ns, self._drift_max)
        if ahead_ns > 0:
            self.newest_ns = x_ns
            self._upper_bound += self._drift_max * ahead_ns
            self._line += self._likely_drift * ahead_ns
            as_of_now = height
        else:
            as_of_now = height - self._drift_max * ahead_ns
        if as_of_now <= self._upper_bound:
            self._upper_bound, self._bound_set_ns = as_of_now, x_ns
        gap = as_of_now - self._line
        if gap < 0.0:
            self._line = as_of_now
        self._recent.append((x_ns, height))
        # Usual height of a frame above the line.
        spread = self._visible.median_ns + RESOLUTION_NS
        late = gap > LEAST_CHANGE_NS and gap > CHANGE / RECENT * spread
        self._risen = self._late_height(spread) if late else -math.inf
        self._visible.add(x_ns, height)
        if ahead_ns > 0:
            late_spell = self._lateness.add(x_ns, height, gap, spread)
            if late_spell is not None:
                self._all_late(late_spell)
        if self._line - self._upper_bound > WORST_LATENCY_NS:
            # No frame is that late: the clock changed.
            self.jump_ns = self._line - self._upper_bound
            self._upper_bound, self._bound_set_ns = self._line, x_ns
        if level is not None and self._tilted(self._line) - level.upper_bound > WORST_LATENCY_NS:
            self._level = None  # no queue is that long: the clock drifts
        if (
            self.count < 4 * RECENT
            or self.count - self._measured_count >= 64
            or gap < -RESOLUTION_NS
        ):
            self._measure()

    def _late_height(self, spread: float) -> float:
        """Return the least height of the last few frames if all are improbably late; else -inf."""
        heights = [
            height + self._drift_max * (self.newest_ns - at_ns) for at_ns, height in self._recent
        ]
        for count in range(FEWEST, len(heights) + 1):
            least = min(heights[-count:])
            if (
                count * (least - self._line) > CHANGE * spread
                and least - self._line > LEAST_CHANGE_NS
            ):
                return least
        return -math.inf

    def _all_late(self, spell: LateSpell) -> None:
        """Report a spell of late frames once; restart the line at their height if it lasts."""
        if spell.is_news:
            rise_ns = spell.height - max(self._line, self._upper_bound)
            self.rise_ns = rise_ns if rise_ns > LEAST_CHANGE_NS else 0.0
        if spell.followed:
            self._line, self._since_ns = spell.height, spell.since_ns
            self._visible.keep_median()

    def _measure(self) -> None:
        """Measure the visible latencies again, and follow a steady drift if there is one."""
        self._measured_count = self.count
        self._visible.measure(self.newest_ns, self._since_ns)
        if not self.drift:
            self.drift = self._visible.steady_drift(self.newest_ns)
            if self.drift:
                self._drifts()

    def _drifts(self) -> None:
        """Restart the floor along the drift, through the least heights of the window."""
        newest_ns, level = self.newest_ns, self._upper_bound
        self._level = _Level(self._bound_set_ns)
        self._base = (newest_ns, self._base[1] + round(level))
        points = self._visible.tilt(self.drift, newest_ns, level)
        self._upper_bound = self._line = min(
            height + self._drift_max * (newest_ns - at_ns) for at_ns, height in points
        )
        self._since_ns = self._bound_set_ns = points[0][0]
        self._lateness.clear()
        self._recent.clear()

    # --- estimates --------------------------------------------------------------------------

    def at(self, x_ns: int) -> int:
        """Return the most likely height of the floor at a sender time, ns."""
        return self._base[1] + round(self._line + self.drift * (x_ns - self._base[0]))

    def heights(self, x_ns: int) -> Heights:
        """Return the bounds on the clock offset at a sender time."""
        drift_max, newest_ns = self._drift_max, self.newest_ns
        base_x_ns, base_ns = self._base
        sure, line, recent = self._upper_bound, self._line, self._risen
        slack = drift_max * abs(x_ns - newest_ns)
        moved = self.drift * (x_ns - base_x_ns)
        if len(self._recent) == RECENT:
            least = min([h + drift_max * (newest_ns - at_ns) for at_ns, h in self._recent])
            recent = max(recent, least)
        aged = 2.0 * drift_max * (newest_ns - self._bound_set_ns)
        highest, least = max(sure, line, recent) + moved, sure - aged + moved
        sure += moved
        if self._level is not None:
            level = self._level.upper_bound
            aged = 2.0 * drift_max * (newest_ns - self._level.bound_set_ns)
            sure, highest = min(sure, level), max(highest, level)
            least = min(least, level - aged)
        return Heights(
            upper_bound=base_ns + round(sure + slack),
            highest=base_ns + round(highest + slack),
            line=base_ns + round(line + moved),
            least=base_ns + round(least - slack),
        )

    def _tilted(self, height: float) -> float:
        """Convert a height at the newest stamp to a height above the level base."""
        return height + self.drift * (self.newest_ns - self._base[0])

    @property
    def largest_ns(self) -> float:
        """Largest visible latency of a window, or that assumed after the line before, ns.

        Above the lowest explanation of all stamps; no stamp of the window is left out.
        """
        if not self.count:
            return 0.0
        lowest = self._upper_bound
        if self._level is not None:
            lowest = min(lowest, self._level.upper_bound - self._tilted(0.0))
        return max(self._visible.greatest(self.newest_ns) - lowest, self._assumed_ns)

    @property
    def _assumed_ns(self) -> float:
        """Largest visible latency of the line before, for a window; then 0."""
        return self._before_ns if self._heard_ns <= self._window_ns else 0.0

    def note_latency_before(self, latency_ns: float) -> None:
        """Note the visible latency of a frame of the line before, which arrived after this one."""
        self._before_ns = max(self._before_ns, latency_ns)

    @property
    def median_ns(self) -> float:
        """Median of the visible part of the latency, over an even sample of the window."""
        return self._visible.median_ns

    @property
    def late_ns(self) -> float:
        """Present lateness of all frames, due to clock or link, ns; 0 if they are on time."""
        return max(0.0, self._lateness.height - self._line)

    def residual_ns(self) -> float:
        """Return how late the fastest frame so far may have been, as few frames were observed.

        The least of n exponential latencies is above their minimum by up to 7 means / n; and the
        first frames may all have been slow. On a line that follows another, frames are assumed to
        be no later than they were before, for a window (docs/math.md 6).
        """
        spells = max(1.0, self._heard_ns / START_NS)
        n = min(self.count, spells)
        slow = WORST_LATENCY_NS / (spells * spells) + WORST_LATENCY_NS / self.count**1.5
        few = float(_RARE * self._visible.mean_ns / n + slow)
        return max(few, self._assumed_ns - self._visible.largest_ns)

    @property
    def _heard_ns(self) -> int:
        return self._newest_arrival_ns - self._first_arrival_ns

    def drifted_ns(self, x_ns: int) -> int:
        """Return the change of the floor from its newest stamp by the detected drift, ns."""
        return round(self.drift * (x_ns - self.newest_ns))

    @property
    def may_be_queue(self) -> bool:
        """Whether the detected drift may be a queue that fills."""
        return self._level is not None

    def restart_at(self, height_ns: int, x_ns: int) -> None:
        """Restart at a height that was measured at a sender time, because the clock changed."""
        base_x_ns, base_y_ns = self._base
        measured = height_ns - base_y_ns - self.drift * (x_ns - base_x_ns)
        measured += self._drift_max * abs(self.newest_ns - x_ns)
        self._visible.raise_greatest(measured - self._upper_bound)
        self._upper_bound = self._line = measured
        self._level = None
        self._since_ns = self._bound_set_ns = x_ns
        self._risen = -math.inf
        self._lateness.clear()
        self._recent.clear()
