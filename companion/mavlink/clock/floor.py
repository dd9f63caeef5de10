"""The floor under (arrival - stamp): what frames that only come, and never answer, show of a clock.

What is seen of a sender is

    y = arrival - boot = offset + latency,     latency >= its least value >= 0

No frame arrives before it was sent, so the offset is nowhere above any y; and since it changes by
no more than the greatest drift D, a y once seen limits it for ever:

    offset(x) <= min over all stamps of  y_k + D |x - x_k|     (``upper_bound``, docs/math.md 6)

That limit is one number, aged by D: nothing that still proves something is forgotten, and there is
no cliff at the end of a window.

A clock that stands still for a moment and a link that is slower from now on look alike: every y is
higher. They cannot be distinguished, so both are kept: ``upper_bound`` holds if the clock ran on,
``line`` begins again where all frames have lain above it for long, far beyond what their spread
explains (``lateness.py``). Likewise where frames come steadily later for a whole window: a clock
that is slow, or a queue that fills. The line follows it, and a level floor is kept beside it until
no queue can be that long. Before that, the least of the last few frames is taken for possible: the
offset is below it whatever the clock did before them.
"""

from collections import deque
from typing import Final, NamedTuple

import numpy as np

from companion.mavlink.clock.latencies import RESOLUTION_NS, Latencies
from companion.mavlink.clock.lateness import CHANGE, LEAST_CHANGE_NS, LateSpell, SenderLateness

LIKELY_DRIFT: Final = 50e-6
"""Drift of an ordinary crystal, by which the most likely line rises while no frame touches it."""
FEWEST, RECENT = 3, 8
"""Frames the least of which limits the offset whatever the clock did before.

So many always; so few where their lateness is no part of the spread.
"""
WORST_LATENCY_NS: Final = 5e9
"""Greatest latency of a frame; radios have been seen to deliver 4.8 s late."""
START_NS: Final = 250_000_000
"""Time that counts as one frame at the start, where the first few may all be slow together."""
_RARE: Final = 7.0
"""Once in 1000 the least of n exponential latencies exceeds the true minimum by 7/n of a mean."""


class Heights(NamedTuple):
    """Heights of a floor at one sender time, ns."""

    upper_bound: int  # above the offset if the clock ran within its drift
    highest: int  # above the offset, even if the clock changed before the last frames
    line: int  # the most likely height of the floor
    least: int  # the least height that the frame nearest to the offset can have


class _Level:
    """The floor under stamps that lie along a slope, if the clock ran within its drift after all.

    upper_bound height above the offset then, at the newest stamp, above the level base
    touched_ns  sender time of the stamp that it comes from
    """

    __slots__ = ("touched_ns", "upper_bound")

    def __init__(self, touched_ns: int) -> None:
        self.upper_bound = 0.0
        self.touched_ns = touched_ns

    def add(self, x_ns: int, height: float, ahead_ns: int, drift_max: float) -> None:
        """Take in a stamp that is so much ahead of the newest."""
        self.upper_bound += drift_max * max(0, ahead_ns)
        as_of_now = height + drift_max * max(0, -ahead_ns)
        if as_of_now <= self.upper_bound:
            self.upper_bound, self.touched_ns = as_of_now, x_ns


class Floor:
    """The floor of one line of stamps. ``add`` takes placed stamps in order of arrival.

    Arguments:

        window_ns   time over which latencies are sampled and a steady drift is looked for
        drift_max   greatest drift taken for possible, a ratio

    Attributes:

        newest_ns   newest sender time; 0 without any
        drift       drift that a steady rise or fall has shown, a ratio; 0 unless it is beyond
                    ``drift_max``
        count       stamps so far
        rose_ns     by how much the line was begun higher at the newest stamp than the greatest
                    drift explains; 0 unless it was
    """

    def __init__(self, window_ns: int, drift_max: float) -> None:
        self._drift_max = drift_max
        self._likely_drift = min(LIKELY_DRIFT, drift_max)
        self.drift = 0.0
        self.count = 0
        self.newest_ns = 0
        self.rose_ns = 0.0
        self._first_arrival_ns = self._newest_arrival_ns = 0
        self._base = (0, 0)  # x, y: heights below are above base y + drift * (x - base x)
        self._upper_bound = self._line = 0.0  # heights at newest_ns
        self._level: _Level | None = None  # the floor, if what looks like a drift is a queue
        self._touched_ns = 0  # x of the stamp that ``upper_bound`` comes from
        self._since_ns = 0  # x from which the line is what it is
        self._risen = -np.inf  # height of the last few frames, where they are suspiciously late
        self._recent: deque[tuple[int, float]] = deque(maxlen=RECENT)
        self._lateness = SenderLateness(drift_max)
        self._visible = Latencies(window_ns, drift_max)
        self._looked = 0

    def __bool__(self) -> bool:
        return self.count > 0

    # --- stamps in --------------------------------------------------------------------------

    def add(self, x_ns: int, y_ns: int) -> None:
        """Take in a stamp: its sender time, and its arrival less that time."""
        self.rose_ns = 0.0
        self._newest_arrival_ns = x_ns + y_ns
        if not self.count:
            self._base = (x_ns, y_ns)
            self._since_ns = self._touched_ns = x_ns
            self.newest_ns, self._first_arrival_ns = x_ns, x_ns + y_ns
        self.count += 1
        height = self._height(x_ns, y_ns)
        ahead_ns = x_ns - self.newest_ns
        if self._level is not None:
            self._level.add(x_ns, y_ns - self._base[1], ahead_ns, self._drift_max)
        if ahead_ns > 0:
            self.newest_ns = x_ns
            self._upper_bound += self._drift_max * ahead_ns
            self._line += self._likely_drift * ahead_ns
            as_of_now = height
        else:
            as_of_now = height - self._drift_max * ahead_ns
        if as_of_now <= self._upper_bound:
            self._upper_bound, self._touched_ns = as_of_now, x_ns
        gap = as_of_now - self._line
        self._line = min(self._line, as_of_now)
        self._recent.append((x_ns, height))
        late = gap > LEAST_CHANGE_NS and gap > CHANGE / RECENT * self._spread
        self._risen = self._suspicious() if late else -np.inf
        self._visible.add(x_ns, height)
        if ahead_ns > 0:
            late_spell = self._lateness.add(x_ns, height, gap, self._spread)
            if late_spell is not None:
                self._all_late(late_spell)
        if self._line - self._upper_bound > WORST_LATENCY_NS:
            # No frame is as late as that: the clock did change.
            self._upper_bound, self._touched_ns = self._line, x_ns
        level = self._level
        if level is not None and self._tilted(self._line) - level.upper_bound > WORST_LATENCY_NS:
            self._level = None  # no queue is as long as that: the clock does drift
        if self.count < 4 * RECENT or self.count - self._looked >= 64 or gap < -RESOLUTION_NS:
            self._measure()

    @property
    def _spread(self) -> float:
        """What is usual of a frame's height above the line, ns."""
        return self._visible.median_ns + RESOLUTION_NS

    def _height(self, x_ns: int, y_ns: int) -> float:
        x0_ns, y0_ns = self._base
        return y_ns - y0_ns - self.drift * (x_ns - x0_ns)

    def _suspicious(self) -> float:
        """The least height of the last few frames, if that they are all so late is no chance."""
        heights = [
            height + self._drift_max * (self.newest_ns - at_ns) for at_ns, height in self._recent
        ]
        for count in range(FEWEST, len(heights) + 1):
            least = min(heights[-count:])
            if (
                count * (least - self._line) > CHANGE * self._spread
                and least - self._line > LEAST_CHANGE_NS
            ):
                return least
        return -np.inf

    def _all_late(self, spell: LateSpell) -> None:
        """Tell that all frames are late, once; begin the line again there in time."""
        if spell.is_news:
            rose_ns = spell.height - max(self._line, self._upper_bound)
            self.rose_ns = rose_ns if rose_ns > LEAST_CHANGE_NS else 0.0
        if spell.followed:
            self._line, self._since_ns = spell.height, spell.since_ns
            self._visible.keep_median()

    def _measure(self) -> None:
        """Measure the visible latencies anew, and follow a steady drift if they show one."""
        self._looked = self.count
        self._visible.measure(self.newest_ns, self._since_ns)
        if not self.drift:
            self.drift = self._visible.steady_drift(self.newest_ns)
            if self.drift:
                self._drifts()

    def _drifts(self) -> None:
        """Lay the floor anew along the drift, on the least heights of the window."""
        newest_ns, level = self.newest_ns, self._upper_bound
        self._level = _Level(self._touched_ns)
        self._base = (newest_ns, self._base[1] + round(level))
        points = self._visible.tilt(self.drift, newest_ns, level)
        self._upper_bound = self._line = min(
            height + self._drift_max * (newest_ns - at_ns) for at_ns, height in points
        )
        self._since_ns = self._touched_ns = points[0][0]
        self._lateness.clear()
        self._recent.clear()

    # --- what they show ---------------------------------------------------------------------

    def at(self, x_ns: int) -> int:
        """The most likely height of the floor at a sender time, ns."""
        return self._base[1] + round(self._line + self.drift * (x_ns - self._base[0]))

    def heights(self, x_ns: int) -> Heights:
        """What the floor says of the offset at a sender time."""
        drift_max, newest_ns = self._drift_max, self.newest_ns
        base_ns = self._base[1]
        sure, line, recent = self._upper_bound, self._line, self._risen
        slack = drift_max * abs(x_ns - newest_ns)
        moved = self.drift * (x_ns - self._base[0])
        if len(self._recent) == RECENT:
            least = min([h + drift_max * (newest_ns - at_ns) for at_ns, h in self._recent])
            recent = max(recent, least)
        aged = 2.0 * drift_max * (newest_ns - self._touched_ns)
        highest, least = max(sure, line, recent) + moved, sure - aged + moved
        sure += moved
        if self._level is not None:
            level = self._level.upper_bound
            aged = 2.0 * drift_max * (newest_ns - self._level.touched_ns)
            sure, highest = min(sure, level), max(highest, level)
            least = min(least, level - aged)
        return Heights(
            upper_bound=base_ns + round(sure + slack),
            highest=base_ns + round(highest + slack),
            line=base_ns + round(line + moved),
            least=base_ns + round(least - slack),
        )

    def _tilted(self, height: float) -> float:
        """A height at the newest stamp above the level base."""
        return height + self.drift * (self.newest_ns - self._base[0])

    @property
    def median_ns(self) -> float:
        """Median of the visible part of the latency, over an even sample of the window."""
        return self._visible.median_ns

    @property
    def late_ns(self) -> float:
        """By how much all frames are late now, by the clock or by the link; 0 if they are not."""
        return max(0.0, self._lateness.height - self._line)

    def residual_ns(self) -> float:
        """What a short time of listening may have missed of the fastest frame.

        The least of n exponential latencies is above their minimum by up to 7 means / n; and the
        first frames may all have been slow.
        """
        heard_ns = self._newest_arrival_ns - self._first_arrival_ns
        spells = max(1.0, heard_ns / START_NS)
        n = min(self.count, spells)
        slow = WORST_LATENCY_NS / (spells * spells) + WORST_LATENCY_NS / self.count**1.5
        return float(_RARE * self._visible.mean_ns / n + slow)

    def drifted_ns(self, x_ns: int) -> int:
        """By how much the drift that has shown itself moves the floor from its newest stamp, ns."""
        return round(self.drift * (x_ns - self.newest_ns))

    def may_drift_ns(self, x_ns: int) -> tuple[int, int]:
        """The least and the greatest that the offset may have drifted since the newest stamp, ns.

        Beside what ``drift_max`` explains. While a queue may be what looks like a drift, none.
        """
        drifted_ns = self.drifted_ns(x_ns)
        if self._level is None:
            return drifted_ns, drifted_ns
        return min(0, drifted_ns), max(0, drifted_ns)

    def begin_again(self, height_ns: int, x_ns: int) -> None:
        """Begin again at a height that was measured at a sender time: the clock did change."""
        measured = self._height(x_ns, height_ns)
        self._upper_bound = self._line = measured + self._drift_max * abs(self.newest_ns - x_ns)
        self._level = None
        self._since_ns = self._touched_ns = x_ns
        self._risen = -np.inf
        self._lateness.clear()
        self._recent.clear()
