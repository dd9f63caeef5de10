"""Spells in which all frames come late: told soon, and followed when they have lasted.

A clock that stood still and a link that got slower look alike: every frame lies higher above the
line. Links do that all day; boot clocks hardly ever do, but those of simulators. So the later the
frames are, the longer they must be late before the line follows them: a queue that holds frames
back for half a second lasts for many times that. But where they come again as before one quick
spell, that spell was the exception: some logs put frames down before they can have come.
"""

import math
from collections import deque
from typing import Final, NamedTuple

CHANGE: Final = 20.0
"""Negative logarithm of the probability below which frames that are all late are a change.

By exponential latencies n frames are all later than r with exp(-n r / mean).
"""
CHANGE_NS: Final = 750_000_000
"""Least time over which all frames must be late to be a change: a busy host is late for less."""
LEAST_CHANGE_NS: Final = 5e6
"""Least change that is looked for: some milliseconds are the stamps' own steps."""
FEWEST: Final = 8  # least number of frames that make a change
FOLLOWED: Final = 40.0
"""Multiple of their lateness for which all frames must be late before the line follows them."""
FOLLOWED_NS: Final = 20_000_000_000  # time after which it does so in any case
_BLOCK_NS: Final = 250_000_000
_BLOCKS: Final = 240
_BLOCK_COUNT: Final = 4  # frames of a block that count as independent


class LateSpell(NamedTuple):
    """A spell in which all frames are late."""

    height: float  # least height of the late frames, aged to the newest, ns
    since_ns: int  # sender time of the first of them
    is_news: bool  # whether it was not told before
    followed: bool  # whether it has lasted for so long that the line is to begin again there


class _Block:
    """Stamps of a quarter of a second: how many, and the least height above the line."""

    __slots__ = ("count", "first_ns", "gap_ns", "height", "index", "x_ns")

    def __init__(self, index: int, x_ns: int) -> None:
        self.index = index
        self.first_ns = self.x_ns = x_ns
        self.count = 0
        self.gap_ns = self.height = math.inf


class SenderLateness:
    """How far the frames of one sender lie above its line. ``add`` takes the newest ones.

    ``height`` is that of the spell that goes on, -inf without one.
    """

    def __init__(self, drift_max: float) -> None:
        self._drift_max = drift_max
        self._blocks: deque[_Block] = deque(maxlen=_BLOCKS)
        self.height = -math.inf
        self._before = math.inf  # height of the line before one quick spell
        self._dropped_ns = 0  # sender time of that

    def clear(self) -> None:
        """Begin again, as the line does."""
        self._blocks.clear()
        self.height = -math.inf

    def add(self, x_ns: int, height: float, gap: float, spread: float) -> LateSpell | None:
        """Take in the newest frame: its height, and how far it is above the line before it.

        ``spread`` is what is usual of that. As a block ends, returns the spell that goes on then.
        """
        if gap < -LEAST_CHANGE_NS:
            self._before, self._dropped_ns = height - gap, x_ns
        elif gap < LEAST_CHANGE_NS and x_ns - self._dropped_ns > _BLOCK_NS:
            self._before = math.inf  # more than one
        if gap <= 0.0:
            self.clear()
            return None
        blocks, index, found = self._blocks, x_ns // _BLOCK_NS, None
        if not blocks or blocks[-1].index != index:
            found = self._spell(x_ns, spread) if blocks else None
            if found is not None and found.followed:
                self.clear()
            blocks.append(_Block(index, x_ns))
        block = blocks[-1]
        block.count += 1
        if gap < block.gap_ns:
            block.gap_ns, block.height, block.x_ns = gap, height, x_ns
        return found

    def _spell(self, x_ns: int, spread: float) -> LateSpell | None:
        count, least, height, found = 0, math.inf, math.inf, None
        for block in reversed(self._blocks):
            count += min(block.count, _BLOCK_COUNT)
            least = min(least, block.gap_ns)
            height = min(height, block.height + self._drift_max * (x_ns - block.x_ns))
            lasted_ns = self._blocks[-1].x_ns - block.first_ns
            if least < LEAST_CHANGE_NS:
                break
            if lasted_ns < CHANGE_NS or count < FEWEST or count * least <= CHANGE * spread:
                continue
            as_before = abs(height - self._before) < LEAST_CHANGE_NS
            followed = as_before or lasted_ns >= min(FOLLOWED * least, FOLLOWED_NS)
            if found is None or followed:
                found = LateSpell(
                    height=height,
                    since_ns=block.first_ns,
                    is_news=self.height == -math.inf,
                    followed=followed,
                )
            if followed:
                break
        self.height = self.height if found is None else found.height
        return found
