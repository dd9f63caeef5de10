"""What keeps beams steady: their shapes, method and slots follow what is known, but not at once.

A report changes what is known of a UAV from one moment to the next, by a factor over a slow radio.
A beam's shape follows at a limited pace. A method and a set of slots are kept for a while after
they were chosen, unless they no longer do. The state is that of the last tick of the pipeline.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.beams.weights.grouping import PreviousSlots
from companion.values import Beam, BeamSet, Cause, FloatArray, Method

PACE: Final = 3.0  # most by which the angles of a shape grow or shrink in a second, as a factor
FOLLOWED_S: Final = 60.0
"""Longest time that is followed: a process may be stopped for days, whose powers are no number."""
GROWN_WIDTHS: Final = 3.5
"""Most by which they grow in a second, in natural widths.

The phases at the ends of the aperture go with the width itself.
"""
SHRUNK_WIDTHS: Final = 3.0  # most by which they shrink in a second, in natural widths
HELD_WIDTHS: Final = 1.0
"""The same for a bound that was as wide as its shape within the last ``HELD_NS``.

Over a slow radio a bound grows from report to report and falls with each: a shape that followed
would change to and fro, and what is wider than it must be still holds.
"""
HELD_NS: Final = 3_000_000_000
SURE_PLANE: Final = 1 / 3
"""Share of the pace for a plane's beams that are shaped for the bound alone.

Of all shapes the greatest least gains of planes change the most from one width to the next.
"""
LEAST_WIDTHS: Final = 0.25
"""Angle in natural widths that shapes nothing: where growth by factors begins."""
MOST_WIDTHS: Final = 16.0
"""Angle beyond which a bound shapes nothing more: what is not followed need not be left again."""
KEPT_NS: Final = 500_000_000  # time for which a method and slots are kept


@dataclass(frozen=True, slots=True, kw_only=True)
class Steady:
    """What the beams of the last tick were.

    shaped       the likely angle and the bound of each UAV's shape, radians
    filled_ns    when last the bound of each UAV was no less than that of its shape
    """

    valid_at_ns: int  # for when they were made
    shaped: Mapping[str, tuple[float, float]]
    filled_ns: Mapping[str, int]
    slots: Mapping[str, int]  # the slot of each UAV; those left out are missing
    known: frozenset[str]  # the UAVs that could have a beam
    slots_since_ns: int  # since when these UAVs have had these slots
    inexact_ns: int | None  # when last a UAV did not lie in all nulls; None: never


def after(before: Steady | None, made: BeamSet) -> Steady:
    """The state once these beams were made."""
    slots = {beam.uav: beam.group for beam in made.beams}
    same = before is not None and before.slots == slots
    inexact_ns = None if before is None else before.inexact_ns
    return Steady(
        valid_at_ns=made.valid_at_ns,
        shaped={beam.uav: (beam.shaped_likely_rad, beam.shaped_bound_rad) for beam in made.beams},
        filled_ns={beam.uav: _filled_ns(before, beam, made.valid_at_ns) for beam in made.beams},
        slots=slots,
        known=frozenset(slots) | {out.uav for out in made.left_out if out.cause is Cause.CROWDED},
        slots_since_ns=before.slots_since_ns if before is not None and same else made.valid_at_ns,
        inexact_ns=inexact_ns if made.exact else made.valid_at_ns,
    )


def _filled_ns(before: Steady | None, beam: Beam, valid_at_ns: int) -> int:
    """When last the bound of a UAV was no less than that of its shape; at first, now."""
    bound_rad = 0.0 if beam.pointing_bound_rad is None else beam.pointing_bound_rad
    if before is None or bound_rad >= beam.shaped_bound_rad:
        return valid_at_ns
    return before.filled_ns.get(beam.uav, valid_at_ns)


def followed_rad(
    before: Steady | None,
    valid_at_ns: int,
    uavs: list[str],
    *,
    wanted_rad: FloatArray,
    natural_rad: float,
    pace: float = 1.0,
) -> FloatArray:
    """Angles (N, 2) for which beams are shaped, at the most so far from the last ones.

    before       the last beams; None: none
    valid_at_ns  for when beams are made
    uavs         names of the N UAVs
    wanted_rad   (N, 2), their likely angles and their bounds
    natural_rad  the natural width of the array
    pace         share of the usual pace at which they follow
    """
    wanted_rad = np.minimum(wanted_rad, MOST_WIDTHS * natural_rad)
    if before is None:
        return wanted_rad
    passed_s = pace * min(abs(valid_at_ns - before.valid_at_ns) * 1e-9, FOLLOWED_S)
    last = np.array([before.shaped.get(uav, (np.nan, np.nan)) for uav in uavs])
    begin = np.maximum(last, LEAST_WIDTHS * natural_rad)
    widths_rad = natural_rad * passed_s
    further = begin - last + np.minimum(begin * (PACE**passed_s - 1), GROWN_WIDTHS * widths_rad)
    nearer = np.minimum(last * (1 - PACE**-passed_s), SHRUNK_WIDTHS * widths_rad)
    held = [abs(valid_at_ns - before.filled_ns.get(uav, valid_at_ns)) < HELD_NS for uav in uavs]
    nearer[held, 1] = np.minimum(nearer[held, 1], HELD_WIDTHS * widths_rad)
    followed: FloatArray = np.where(
        np.isnan(last), wanted_rad, np.clip(wanted_rad, last - nearer, last + further)
    )
    return followed


def slots(before: Steady | None, valid_at_ns: int, uavs: list[str]) -> PreviousSlots | None:
    """The slots of these UAVs before, and whether it is too early to leave them.

    None if there were other UAVs. The slot of one that was left out is -1.
    """
    if before is None or before.known != frozenset(uavs):
        return None
    numbers = np.array([before.slots.get(uav, -1) for uav in uavs])
    return PreviousSlots(numbers, valid_at_ns - before.slots_since_ns < KEPT_NS)


def named(before: Steady | None, valid_at_ns: int, method: Method, exact: bool) -> Method:
    """The name of a method: zero forcing only where it has been exact for a while."""
    if method is not Method.ZERO_FORCING or before is None or before.inexact_ns is None:
        return method
    since_ns = valid_at_ns - before.inexact_ns
    return method if exact and since_ns >= KEPT_NS else Method.REGULARISED
