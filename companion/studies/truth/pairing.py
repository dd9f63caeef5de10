"""Creation times of the simulator's unstamped truth messages, by their stream order.

An autopilot sends messages in order: a truth message was created between the stamps of the stamped
messages before and after it in its vehicle's stream, whatever their delays. These two stamps are
often equal or 2 ms apart. Otherwise the track constrains the times: distance over speed gives the
time between two truth messages, to a millisecond or two. All messages of a stretch of flight
therefore share one time shift, which the best evidence nearby sets:

1. a narrow bracket, or a stamped message that arrived at the same moment while arrivals keep the
   sender's pace;
2. the relative positions between these arrivals;
3. without either, the earliest shift that satisfies all brackets nearby, because an autopilot
   sometimes sends a truth message together with the message before it.
"""

from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.studies.truth.hindsight import least
from companion.studies.truth.trajectory import GAP_NS, Times
from companion.values import FloatArray, IntArray

NEIGHBOURHOODS_NS: Final = (1_000_000_000, 10_000_000_000)
"""Ranges of track time within which a known time counts; the second is the fallback.

Errors of velocity accumulate with distance.
"""
NARROW_BRACKET_NS: Final = 5_000_000  # a narrower bracket determines the time: its middle
SIMULTANEOUS_NS: Final = 7_000_000
"""Largest spread of arrivals of messages sent together, on a link without queues."""
BRACKET_ERROR_NS: Final = 2_000_000
"""Largest error of a bracket: stamps are whole milliseconds, and loops have a period."""
MIN_SPEED_MPS: Final = 0.5
"""Speed below which distance does not determine the time between two points."""
PACE_RATIOS: Final = (0.5, 2.0)
"""Limits of the ratio of an arrival gap to a stamp gap at which arrivals keep the pace."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Brackets:
    """Truth messages (N,) in stream order, with the stamped messages before and after each."""

    arrival_ns: Times  # arrival of the truth message
    before_ns: Times  # boot time of the stamped message before it
    after_ns: Times  # boot time of the stamped message after it
    before_arrival_ns: Times  # arrival of the message before
    after_arrival_ns: Times  # arrival of the message after
    life: IntArray  # number of restarts of the boot clock

    def rows(self, chosen: NDArray[np.bool_]) -> "Brackets":
        """Return the brackets of selected messages."""
        return Brackets(**{one.name: getattr(self, one.name)[chosen] for one in fields(self)})


def boot_times_ns(
    brackets: Brackets, position_ned_m: FloatArray, velocity_ned_mps: FloatArray
) -> Times:
    """Return the creation times, boot time (N,), of truth messages.

    Positions and velocities are (N, 3); NaN for an unknown velocity.
    """
    paced, pins = _interpolated_by_arrival(brackets), _determined_ns(brackets)
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
        found[rows] = _with_common_shift(own_ns, brackets.rows(rows), paced[rows], pins[rows])
    return found


def _keeps_pace(brackets: Brackets) -> NDArray[np.bool_]:
    gap_ns = brackets.after_arrival_ns - brackets.before_arrival_ns
    span_ns = brackets.after_ns - brackets.before_ns
    kept: NDArray[np.bool_] = (gap_ns >= PACE_RATIOS[0] * span_ns) & (
        gap_ns <= PACE_RATIOS[1] * span_ns
    )
    return kept & (gap_ns > 0)


def _interpolated_by_arrival(brackets: Brackets) -> FloatArray:
    """Interpolate times (N,) by arrival; NaN where arrivals do not keep the pace."""
    gap_ns = np.maximum(brackets.after_arrival_ns - brackets.before_arrival_ns, 1)
    share = np.clip((brackets.arrival_ns - brackets.before_arrival_ns) / gap_ns, 0.0, 1.0)
    by_share = brackets.before_ns + share * (brackets.after_ns - brackets.before_ns)
    return np.where(_keeps_pace(brackets), by_share, np.nan)


def _times_between_s(position_ned_m: FloatArray, velocity_ned_mps: FloatArray) -> FloatArray:
    """Return times (N - 1,) from each point to the next, by distance over mean velocity.

    NaN at low speed. In a turn by x rad the chord over the mean velocity is too long by x²/12.
    """
    mean = (velocity_ned_mps[1:] + velocity_ned_mps[:-1]) / 2
    speed2 = np.sum(mean * mean, axis=1)
    fast = np.nan_to_num(speed2) >= MIN_SPEED_MPS**2
    speed2 = np.where(fast, speed2, 1.0)
    gained = np.diff(velocity_ned_mps, axis=0)
    along2 = np.sum(gained * mean, axis=1) ** 2 / speed2
    turned2 = np.clip((np.sum(gained * gained, axis=1) - along2) / speed2, 0.0, 1.0)
    way = np.sum(np.diff(position_ned_m, axis=0) * mean, axis=1)
    return np.where(fast, way / speed2 / (1 + turned2 / 12), np.nan)


def _determined_ns(brackets: Brackets) -> FloatArray:
    """Return times (N,) that a bracket or an arrival determines; NaN for other messages."""
    narrow = brackets.after_ns - brackets.before_ns <= NARROW_BRACKET_NS
    steady = _keeps_pace(brackets)
    with_before = steady & (brackets.arrival_ns - brackets.before_arrival_ns <= SIMULTANEOUS_NS)
    with_after = steady & (brackets.after_arrival_ns - brackets.arrival_ns <= SIMULTANEOUS_NS)
    middle = (brackets.before_ns + brackets.after_ns) / 2
    neither = np.where(with_after, brackets.after_ns, np.nan)
    return np.where(narrow, middle, np.where(with_before, brackets.before_ns, neither))


def _with_common_shift(
    own_ns: Times, brackets: Brackets, paced: FloatArray, pins: FloatArray
) -> Times:
    """Return boot times (N,) of points whose times on the track are ``own_ns`` up to a shift."""
    ordered = np.maximum.accumulate(own_ns)
    nearest, (starts, stops) = (
        (
            np.searchsorted(ordered, ordered - within_ns, side="left"),
            np.searchsorted(ordered, ordered + within_ns, side="right"),
        )
        for within_ns in NEIGHBOURHOODS_NS
    )
    lowest = -least(own_ns - brackets.before_ns, starts, stops)
    highest = np.maximum(least(brackets.after_ns - own_ns, starts, stops), lowest)
    shift = np.clip(_median_of_known(paced - own_ns, starts, stops), lowest, highest)
    shift = np.where(np.isnan(shift), lowest, shift)
    for among in ((starts, stops), nearest):
        pinned = _median_of_known(pins - own_ns, *among)
        shift = np.where(np.isnan(pinned), shift, pinned)
    found: Times = own_ns + np.round(shift).astype(np.int64)
    return np.clip(
        found, brackets.before_ns - BRACKET_ERROR_NS, brackets.after_ns + BRACKET_ERROR_NS
    )


def _median_of_known(values: FloatArray, starts: IntArray, stops: IntArray) -> FloatArray:
    """Return the median of the known values in ``values[start:stop]``, (K,); NaN without any."""
    at = np.flatnonzero(~np.isnan(values))
    first, last = np.searchsorted(at, starts), np.searchsorted(at, stops)
    known = values[at]
    return np.array(
        [
            np.median(known[a:b]) if b > a else np.nan
            for a, b in zip(first.tolist(), last.tolist(), strict=True)
        ]
    )
