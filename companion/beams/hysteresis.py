"""Hysteresis of beams: shapes, method and time slots follow the estimates with a delay.

A report changes the estimates of a UAV abruptly, over a slow radio by a factor. A beam's shape
follows at a limited rate. A method and a set of slots are kept for ``KEPT_NS`` after they were
selected, unless they exceed the limits. The state is that of the pipeline's last tick.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.beams.weights.grouping import PreviousSlots
from companion.values import Beam, BeamSet, Cause, FloatArray, Method

MAX_RATIO_PER_S: Final = 3.0  # largest factor by which the angles of a shape change in a second
MAX_ELAPSED_S: Final = 60.0
"""Limit on the time between two ticks, since ``MAX_RATIO_PER_S ** s`` overflows after days."""
MAX_WIDENING: Final = 3.5
"""Largest growth of a beam's width per second, in natural widths."""
MAX_NARROWING: Final = 3.0  # largest shrinkage in a second, in natural widths
MAX_HELD_NARROWING: Final = 1.0
"""Largest narrowing per second if the bound filled the shape within the last ``HELD_NS``.

Over a slow radio a bound grows until the next report; a shape that followed would oscillate.
"""
HELD_NS: Final = 3_000_000_000
GUARANTEE_PLANE_SHARE: Final = 1 / 3
"""Factor on the rates of widening and narrowing for planar arrays, ``widen = "guarantee"``.

Their beams change most with the width.
"""
MIN_WIDTHS: Final = 0.25
"""Angle in natural widths that has no effect on a shape: reached at once; growth by factors starts
there."""
MAX_WIDTHS: Final = 16.0
"""Angle in natural widths beyond which a wider bound no longer changes the shape."""
KEPT_NS: Final = 500_000_000  # time for which a method and slots are kept


@dataclass(frozen=True, slots=True, kw_only=True)
class Hysteresis:
    """State of the hysteresis after the beams of the last tick.

    shaped       the likely angle and the bound of each UAV's shape, radians
    filled_ns    when each UAV's bound was last at least its shape's bound
    """

    valid_at_ns: int  # when they are applied
    shaped: Mapping[str, tuple[float, float]]
    filled_ns: Mapping[str, int]
    slots: Mapping[str, int]  # the slot of each UAV; those left out are missing
    known: frozenset[str]  # the UAVs that could have a beam
    slots_since_ns: int  # when these slots were assigned
    inexact_ns: int | None  # when zero forcing last was not exact; None: never


def updated(before: Hysteresis | None, made: BeamSet) -> Hysteresis:
    """Return the state of the hysteresis after new beams."""
    slots = {beam.uav: beam.group for beam in made.beams}
    same = before is not None and before.slots == slots
    inexact_ns = None if before is None else before.inexact_ns
    return Hysteresis(
        valid_at_ns=made.valid_at_ns,
        shaped={beam.uav: (beam.shaped_likely_rad, beam.shaped_bound_rad) for beam in made.beams},
        filled_ns={beam.uav: _filled_ns(before, beam, made.valid_at_ns) for beam in made.beams},
        slots=slots,
        known=frozenset(slots) | {out.uav for out in made.left_out if out.cause is Cause.CROWDED},
        slots_since_ns=before.slots_since_ns if before is not None and same else made.valid_at_ns,
        inexact_ns=inexact_ns if made.exact else made.valid_at_ns,
    )


def _filled_ns(before: Hysteresis | None, beam: Beam, valid_at_ns: int) -> int:
    """Return when the bound of a UAV was last at least its shape's bound; now for a new UAV."""
    bound_rad = 0.0 if beam.pointing_bound_rad is None else beam.pointing_bound_rad
    if before is None or bound_rad >= beam.shaped_bound_rad:
        return valid_at_ns
    return before.filled_ns.get(beam.uav, valid_at_ns)


def rate_limited_rad(
    before: Hysteresis | None,
    valid_at_ns: int,
    uavs: list[str],
    *,
    wanted_rad: FloatArray,
    natural_rad: float,
    pace: float = 1.0,
) -> FloatArray:
    """Angles (N, 2) for which beams are shaped, limited in their rate of change.

    before       state of the last beams; None: no limit
    valid_at_ns  when the new beams are applied
    uavs         names of the N UAVs
    wanted_rad   (N, 2), their likely angles and their bounds
    natural_rad  the natural width of the array
    pace         factor of the usual rates
    """
    wanted_rad = np.minimum(wanted_rad, MAX_WIDTHS * natural_rad)
    if before is None:
        return wanted_rad
    passed_s = pace * min(abs(valid_at_ns - before.valid_at_ns) * 1e-9, MAX_ELAPSED_S)
    last = np.array([before.shaped.get(uav, (np.nan, np.nan)) for uav in uavs])
    begin = np.maximum(last, MIN_WIDTHS * natural_rad)
    widths_rad = natural_rad * passed_s
    factor = MAX_RATIO_PER_S**passed_s
    further = begin - last + np.minimum(begin * (factor - 1), MAX_WIDENING * widths_rad)
    held = [abs(valid_at_ns - before.filled_ns.get(uav, valid_at_ns)) < HELD_NS for uav in uavs]
    narrowing = np.array(
        [(MAX_NARROWING, MAX_HELD_NARROWING if is_held else MAX_NARROWING) for is_held in held]
    )
    nearer = np.minimum(last * (1 - MAX_RATIO_PER_S**-passed_s), narrowing * widths_rad)
    limited = np.minimum(np.maximum(wanted_rad, last - nearer), last + further)
    followed: FloatArray = np.where(np.isnan(last), wanted_rad, limited)
    return followed


def previous_slots(
    before: Hysteresis | None, valid_at_ns: int, uavs: list[str]
) -> PreviousSlots | None:
    """Return the previous time slots of these UAVs, -1 for one that was left out.

    None if the UAVs have changed.
    """
    if before is None or before.known != frozenset(uavs):
        return None
    numbers = np.array([before.slots.get(uav, -1) for uav in uavs])
    return PreviousSlots(numbers, valid_at_ns - before.slots_since_ns < KEPT_NS)


def reported_method(
    before: Hysteresis | None, valid_at_ns: int, method: Method, exact: bool
) -> Method:
    """Return the method to report: zero forcing only after it has been exact for ``KEPT_NS``."""
    if method is not Method.ZERO_FORCING or before is None or before.inexact_ns is None:
        return method
    since_ns = valid_at_ns - before.inexact_ns
    return method if exact and since_ns >= KEPT_NS else Method.REGULARISED
