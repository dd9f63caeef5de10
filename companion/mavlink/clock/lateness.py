"""Spells in which all frames arrive late: reported soon, followed when they have lasted.

A stalled clock and a slower link look alike: every frame lies higher above the line. Links slow
down often; boot clocks hardly ever stall, except those of simulators. So the later the frames are,
the longer they must be late before the line follows them: a queue that delays frames by half a
second lasts for many times that. One case is followed at once: a single quick block of frames
lowered the line, and later frames return to its earlier height. Then that block was the exception,
since some logs stamp frames before they can have arrived.
"""

import math
from collections import deque
from typing import Final, NamedTuple

CHANGE: Final = 20.0
"""Negative logarithm of the probability below which a spell of late frames counts as a change.

If latencies are exponential, n frames are all later than r with probability exp(-n r / mean).
"""
CHANGE_NS: Final = 750_000_000
"""Shortest spell of late frames that counts as a change; a busy host delays frames for less."""
LEAST_CHANGE_NS: Final = 5e6
"""Smallest change that is detected: stamps have a resolution of some milliseconds."""
FEWEST: Final = 8  # fewest frames of a change
FOLLOWED: Final = 40.0
"""How long frames must be late before the line follows them, as a multiple of their lateness."""
FOLLOWED_NS: Final = 20_000_000_000  # time after which the line follows in any case
_BLOCK_NS: Final = 250_000_000
_BLOCKS: Final = 240
_BLOCK_COUNT: Final = 4  # frames of a block that count as independent


class LateSpell(NamedTuple):
    """Spell in which all frames of a sender are late."""

    height: float  # least height of the late frames, aged to the newest, ns
    since_ns: int  # sender time of the first of them
    is_news: bool  # whether it is reported for the first time
    followed: bool  # whether it has lasted so long that the line must restart there


class _Block:
    """Stamps of a quarter of a second: how many, and their least height above the line."""

    __slots__ = ("count", "first_ns", "gap_ns", "height", "index", "x_ns")

    def __init__(self, index: int, x_ns: int) -> None:
        self.index = index
        self.first_ns = self.x_ns = x_ns
        self.count = 0
        self.gap_ns = self.height = math.inf


class SenderLateness:
    """Heights of one sender's frames above its line. ``add`` takes the newest ones.

    ``height`` is the height of the current spell, -inf without a spell.
    """

    def __init__(self, drift_max: float) -> None:
        self._drift_max = drift_max
        self._blocks: deque[_Block] = deque(maxlen=_BLOCKS)
        self.height = -math.inf
        self._before = math.inf  # height of the line before a single quick block
        self._dropped_ns = 0  # sender time of that block

    def clear(self) -> None:
        """Restart the measurement, because the line restarted."""
        self._blocks.clear()
        self.height = -math.inf

    def add(self, x_ns: int, height: float, gap: float, spread: float) -> LateSpell | None:
        """Add the newest frame: its height, and its gap above the line before it.

        ``spread`` is the usual gap. At the end of a block, returns the spell in progress.
        """
        if gap < -LEAST_CHANGE_NS:
            self._before, self._dropped_ns = height - gap, x_ns
        elif gap < LEAST_CHANGE_NS and x_ns - self._dropped_ns > _BLOCK_NS:
            self._before = math.inf  # quick frames lasted longer than one block
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
