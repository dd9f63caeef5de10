"""Faults of one link: frames lost, delayed, duplicated, reordered, corrupted. Pure.

Each fault has its own random stream: its effect does not depend on other faults. With a larger
share, a fault affects the same frames as with a smaller one, and more.
"""

import math
import random
from bisect import bisect_right
from typing import Final

from sitl_replay.faults.asked import Sender

WITHIN_S: Final = 0.2
"""Maximum delay of a duplicate or of a reordered frame."""
JITTER_MAX: Final = 10.0
"""Limit of exponential draws, as a multiple of the mean (1 in 22 000 exceeds it)."""
GARBAGE_MAX_BYTES: Final = 64
_NEVER: Final = 1 << 60


class Loss:
    """Fault that loses a frame with probability ``share``."""

    def __init__(self, rng: random.Random, share: float) -> None:
        self._rng = rng
        self._share = share

    def loses(self) -> bool:
        """Return whether the next frame is lost."""
        return self._rng.random() < self._share


class Duplication:
    """Fault that duplicates a frame with probability ``share``; the copy is 0 to 0.2 s late."""

    def __init__(self, rng: random.Random, share: float) -> None:
        self._rng = rng
        self._share = share

    def lag_s(self) -> float | None:
        """Return the delay of the next frame's copy, seconds; None: no copy."""
        chance, lag_s = self._rng.random(), self._rng.uniform(0.0, WITHIN_S)
        return lag_s if chance < self._share else None


class Delay:
    """Fault that delays every frame by ``delay_s``."""

    def __init__(self, delay_s: float) -> None:
        self._delay_s = delay_s

    def release_s(self, now_s: float, t_s: float, sender: Sender) -> float:
        """Return when a frame leaves that enters the link at ``now_s``, this stage at ``t_s``."""
        return t_s + self._delay_s


class Jitter:
    """Fault that delays every frame by a random time, exponential with mean ``mean_s``.

    The frames of one sender stay in order: a frame waits for a delayed one before it. If a sender's
    frames are closer than ``mean_s``, most are therefore delayed by more than that: at r frames per
    second the median is about mean_s·ln(r·mean_s / ln 2), with the same spread.
    """

    def __init__(self, rng: random.Random, mean_s: float) -> None:
        self._rng = rng
        self._mean_s = mean_s
        self._last_s: dict[Sender, float] = {}

    def release_s(self, now_s: float, t_s: float, sender: Sender) -> float:
        """Return when a frame leaves that enters the link at ``now_s``, this stage at ``t_s``."""
        late_s = self._mean_s * min(self._rng.expovariate(1.0), JITTER_MAX)
        released_s = max(t_s + late_s, self._last_s.get(sender, t_s))
        self._last_s[sender] = released_s
        return released_s


class Burst:
    """Fault that blocks the link for ``shut_s`` at a time, on average for a ``share`` of the time.

    The link starts open, and is open for exponentially distributed times. Frames of a blocked time
    arrive together at its end, in order. ``t_s`` may decrease, but not below ``now_s``.
    """

    def __init__(self, rng: random.Random, share: float, shut_s: float) -> None:
        self._rng = rng
        self._blocked_s = shut_s
        self._open_s = shut_s * (1.0 - share) / share if share else math.inf
        self._block_starts_s: list[float] = []
        self._next_s = self._opening_s()

    def release_s(self, now_s: float, t_s: float, sender: Sender) -> float:
        """Return when a frame leaves that enters the link at ``now_s``, this stage at ``t_s``."""
        while self._block_starts_s and self._block_starts_s[0] + self._blocked_s <= now_s:
            del self._block_starts_s[0]
        while self._next_s <= t_s:
            self._block_starts_s.append(self._next_s)
            self._next_s += self._blocked_s + self._opening_s()
        at = bisect_right(self._block_starts_s, t_s) - 1
        return t_s if at < 0 else max(t_s, self._block_starts_s[at] + self._blocked_s)

    def _opening_s(self) -> float:
        return self._open_s * self._rng.expovariate(1.0) if self._open_s < math.inf else math.inf


class Reordering:
    """Fault that holds a frame for 0 to 0.2 s with probability ``share``: others overtake it."""

    def __init__(self, rng: random.Random, share: float) -> None:
        self._rng = rng
        self._share = share

    def release_s(self, now_s: float, t_s: float, sender: Sender) -> float:
        """Return when a frame leaves that enters the link at ``now_s``, this stage at ``t_s``."""
        chance, held_s = self._rng.random(), self._rng.uniform(0.0, WITHIN_S)
        return t_s + held_s if chance < self._share else t_s


class BitErrors:
    """Fault that inverts every bit with probability ``rate``, independently."""

    def __init__(self, rng: random.Random, rate: float) -> None:
        self._rng = rng
        self._rate = rate
        self._good_bits = self._run()

    def damaged(self, raw: bytes) -> bytes:
        """Return the bytes of a frame as they arrive."""
        bits = 8 * len(raw)
        if self._good_bits >= bits:
            self._good_bits -= bits
            return raw
        out, at = bytearray(raw), self._good_bits
        while at < bits:
            out[at // 8] ^= 1 << at % 8
            at += 1 + self._run()
        self._good_bits = at - bits
        return bytes(out)

    def _run(self) -> int:
        """Return the number of good bits before the next bad bit, drawn geometrically."""
        if self._rate == 0.0:
            return _NEVER
        bits = math.log(1.0 - self._rng.random()) / math.log1p(-self._rate)
        return math.floor(min(bits, _NEVER))


class Truncation:
    """Fault that truncates a frame with probability ``share``, keeping at least 1 byte."""

    def __init__(self, rng: random.Random, share: float) -> None:
        self._rng = rng
        self._share = share

    def damaged(self, raw: bytes) -> bytes:
        """Return the bytes of a frame as they arrive."""
        chance, place = self._rng.random(), self._rng.random()
        return raw[: 1 + int(place * (len(raw) - 1))] if chance < self._share else raw


class Garbage:
    """Fault that inserts 1 to 64 random bytes before a frame with probability ``share``."""

    def __init__(self, rng: random.Random, share: float) -> None:
        self._rng = rng
        self._share = share

    def noise(self) -> bytes:
        """Return the bytes to insert before the next frame; may be empty."""
        chance, key = self._rng.random(), self._rng.random()
        if chance >= self._share:
            return b""
        noise = random.Random(key)
        return noise.randbytes(noise.randint(1, GARBAGE_MAX_BYTES))


Timing = Delay | Jitter | Burst | Reordering
Damage = BitErrors | Truncation
LinkFault = Loss | Duplication | Timing | Damage | Garbage
