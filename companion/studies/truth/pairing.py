"""When the simulator's words were made, which carry no time: by their order in the stream.

An autopilot sends its messages in order: a truth message was made between the stamps of the stamped
messages before and after it in its vehicle's stream, however late and however bunched they arrive.
Often the two stamps are equal or 2 ms apart. Else the track itself decides: the way between two
truth messages over the speed is the time between them, to a millisecond or two, so that all of a
stretch of flight move together, and what is known of some holds for the others: a narrow bracket; a
stamped message that arrived in the same moment, where the arrivals keep the sender's pace; else the
shares of these arrivals. Where nothing of that is near, the earliest time that all brackets near by
allow is taken: a truth message is now and then sent in one go with the message before it.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.studies.truth.hindsight import least
from companion.studies.truth.trajectory import GAP_NS, Times
from companion.values import FloatArray, IntArray

NEAR_NS: Final = (1_000_000_000, 10_000_000_000)
"""How far off, in the track's own time, a known moment counts; where there is none, farther.

The farther, the more do velocities that are a little wrong add up.
"""
NARROW_NS: Final = 5_000_000  # width of a bracket within which its middle is as good as any
TOGETHER_NS: Final = 7_000_000
"""Messages of one go have been seen to arrive this far apart, where the link holds nothing back."""
ROUNDED_NS: Final = 2_000_000
"""How far stamps of whole milliseconds and turns of a loop may put a message beyond its bracket."""
SLOWEST_MPS: Final = 0.5
"""Speed below which the way between two points does not tell the time between them."""
PACE: Final = (0.5, 2.0)
"""Arrivals keep the sender's pace if the gap between two is that of their stamps times 0.5 to 2."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Brackets:
    """Truth messages (N,) in the order of their stream, and the stamped messages around each."""

    arrival_ns: Times  # when the truth message arrived
    before_ns: Times  # boot time of the stamped message before it
    after_ns: Times  # that of the one after it
    before_arrival_ns: Times  # when the one before arrived
    after_arrival_ns: Times  # when the one after arrived
    life: IntArray  # how often the boot clock had been restarted

    def rows(self, chosen: NDArray[np.bool_]) -> "Brackets":
        """Some of the messages."""
        return Brackets(
            arrival_ns=self.arrival_ns[chosen],
            before_ns=self.before_ns[chosen],
            after_ns=self.after_ns[chosen],
            before_arrival_ns=self.before_arrival_ns[chosen],
            after_arrival_ns=self.after_arrival_ns[chosen],
            life=self.life[chosen],
        )


def boot_times_ns(
    brackets: Brackets, position_ned_m: FloatArray, velocity_ned_mps: FloatArray
) -> Times:
    """When truth messages with these positions and velocities, (N, 3), were made, boot time (N,).

    NaN is allowed where a velocity is not known.
    """
    paced, pins = _by_pace(brackets), _pins(brackets)
    alone = np.where(np.isnan(pins), np.where(np.isnan(paced), brackets.before_ns, paced), pins)
    found = np.round(alone).astype(np.int64)
    way_s = _times_between_s(position_ned_m, velocity_ned_mps)
    whole = np.diff(brackets.life) == 0
    whole &= np.abs(np.diff(brackets.before_ns)) <= GAP_NS
    together = whole & ~np.isnan(way_s)
    starts = np.flatnonzero(np.diff(together.astype(np.int8), prepend=0) == 1)
    stops = np.flatnonzero(np.diff(together.astype(np.int8), append=0) == -1) + 2
    for start, stop in zip(starts.tolist(), stops.tolist(), strict=True):
        rows = np.zeros(len(found), dtype=bool)
        rows[start:stop] = True
        own_s = np.concatenate([[0.0], np.cumsum(way_s[start : stop - 1])])
        own_ns = found[start] + np.round(own_s * 1e9).astype(np.int64)
        found[rows] = _moved_together(own_ns, brackets.rows(rows), paced[rows], pins[rows])
    return found


def _keeps_pace(brackets: Brackets) -> NDArray[np.bool_]:
    """Whether the messages around each came as far apart as they were sent."""
    gap_ns = brackets.after_arrival_ns - brackets.before_arrival_ns
    span_ns = brackets.after_ns - brackets.before_ns
    kept: NDArray[np.bool_] = (gap_ns >= PACE[0] * span_ns) & (gap_ns <= PACE[1] * span_ns)
    return kept & (gap_ns > 0)


def _by_pace(brackets: Brackets) -> FloatArray:
    """Times (N,) by the share of the arrivals' gap; NaN where those do not keep the pace."""
    gap_ns = np.maximum(brackets.after_arrival_ns - brackets.before_arrival_ns, 1)
    share = np.clip((brackets.arrival_ns - brackets.before_arrival_ns) / gap_ns, 0.0, 1.0)
    by_share = brackets.before_ns + share * (brackets.after_ns - brackets.before_ns)
    return np.where(_keeps_pace(brackets), by_share, np.nan)


def _times_between_s(position_ned_m: FloatArray, velocity_ned_mps: FloatArray) -> FloatArray:
    """Times (N - 1,) from each point to the next, by the way along the mean velocity.

    NaN where it is too slow for that. In a turn by an angle x the chord over the mean velocity is
    too long by x²/12.
    """
    mean = (velocity_ned_mps[1:] + velocity_ned_mps[:-1]) / 2
    speed2 = np.sum(mean * mean, axis=1)
    fast = np.nan_to_num(speed2) >= SLOWEST_MPS**2
    speed2 = np.where(fast, speed2, 1.0)
    gained = np.diff(velocity_ned_mps, axis=0)
    along2 = np.sum(gained * mean, axis=1) ** 2 / speed2
    turned2 = np.clip((np.sum(gained * gained, axis=1) - along2) / speed2, 0.0, 1.0)
    way = np.sum(np.diff(position_ned_m, axis=0) * mean, axis=1)
    found: FloatArray = np.where(fast, way / speed2 / (1 + turned2 / 12), np.nan)
    return found


def _pins(brackets: Brackets) -> FloatArray:
    """Times (N,) of those that their bracket or their arrival pins to a moment; NaN for others."""
    narrow = brackets.after_ns - brackets.before_ns <= NARROW_NS
    steady = _keeps_pace(brackets)
    with_before = steady & (brackets.arrival_ns - brackets.before_arrival_ns <= TOGETHER_NS)
    with_after = steady & (brackets.after_arrival_ns - brackets.arrival_ns <= TOGETHER_NS)
    middle = (brackets.before_ns + brackets.after_ns) / 2
    neither = np.where(with_after, brackets.after_ns, np.nan)
    return np.where(narrow, middle, np.where(with_before, brackets.before_ns, neither))


def _moved_together(
    own_ns: Times, brackets: Brackets, paced: FloatArray, pins: FloatArray
) -> Times:
    """Boot times (N,) of points whose times on the track are ``own_ns`` but for a shift."""
    ordered = np.maximum.accumulate(own_ns)
    nearest, (starts, stops) = (
        (
            np.searchsorted(ordered, ordered - within_ns, side="left"),
            np.searchsorted(ordered, ordered + within_ns, side="right"),
        )
        for within_ns in NEAR_NS
    )
    lowest = -least(own_ns - brackets.before_ns, starts, stops)
    highest = np.maximum(least(brackets.after_ns - own_ns, starts, stops), lowest)
    shift = np.clip(_typical(paced - own_ns, starts, stops), lowest, highest)
    shift = np.where(np.isnan(shift), lowest, shift)
    for among in ((starts, stops), nearest):
        pinned = _typical(pins - own_ns, *among)
        shift = np.where(np.isnan(pinned), shift, pinned)
    found: Times = own_ns + np.round(shift).astype(np.int64)
    return np.clip(found, brackets.before_ns - ROUNDED_NS, brackets.after_ns + ROUNDED_NS)


def _typical(values: FloatArray, starts: IntArray, stops: IntArray) -> FloatArray:
    """The median of what is known of ``values[start:stop]``, (K,); NaN where nothing is."""
    at = np.flatnonzero(~np.isnan(values))
    first, last = np.searchsorted(at, starts), np.searchsorted(at, stops)
    known = values[at]
    return np.array(
        [
            np.median(known[a:b]) if b > a else np.nan
            for a, b in zip(first.tolist(), last.tolist(), strict=True)
        ]
    )
