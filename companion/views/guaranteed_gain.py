"""Least gain and least SINR of beams over all UAV positions that the bounds allow."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from companion.beams.aim import directions
from companion.beams.worth import guarantee, link_budget
from companion.pipeline.assembly import Equipment
from companion.pipeline.fold import Pipeline
from companion.values import ComplexArray, FloatArray, Update, UserError
from companion.views.quantised import device_table

SINR_BEAMS_MAX: Final = 16
"""Largest number of beams for which guaranteed SINRs are computed; work grows with its square."""


def gains_db(pipeline: Pipeline, equipment: Equipment, update: Update) -> list[float | None]:
    """Return the guaranteed gain of each beam of an update, dB; None without a guarantee."""
    if not update.beams.beams:
        return []
    weights = _radiated(pipeline, equipment, update)
    if weights is None:
        return [None] * len(update.beams.beams)
    return list(_bounds_and_gains_db(pipeline, update, directions(update.beams), weights)[1])


def of_beams(
    pipeline: Pipeline,
    equipment: Equipment,
    update: Update,
    towards: FloatArray,
    powers_w: FloatArray,
) -> tuple[Sequence[float | None], Sequence[float | None]]:
    """Return least gain and least SINR of each beam within its UAV's bound.

    A gain is None if the UAV may be out of coverage, in a null, or in any direction. All SINRs are
    None if there are more than ``SINR_BEAMS_MAX`` beams.
    """
    array, beam_set = pipeline.array, update.beams
    weights = _radiated(pipeline, equipment, update)
    if weights is None:
        return [None] * len(beam_set.beams), [None] * len(beam_set.beams)
    bounds, gains_db = _bounds_and_gains_db(pipeline, update, towards, weights)
    known = [i for i, gain_db in enumerate(gains_db) if gain_db is not None]
    unknown: list[float | None] = [None] * len(bounds)
    if not known or len(bounds) > SINR_BEAMS_MAX or update.carrier is None:
        return gains_db, unknown
    farthest_m = {track.uav: track.bound_m + update.carrier.bound_m for track in update.tracks}
    ranges_m = np.array([beam.range_m + farthest_m[beam.uav] for beam in beam_set.beams])
    leaks = guarantee.leakage_bounds(array, towards[known], [bounds[i] for i in known], weights)
    sinr_db = link_budget.least_sinr_db(
        10 ** (np.array([gains_db[i] for i in known], dtype=float) / 10),
        leaks=leaks,
        users=np.array(known),
        farthest_m=ranges_m[known],
        groups=np.array([beam.group for beam in beam_set.beams]),
        powers_w=powers_w,
        budget=equipment.budget,
        wavelength_m=array.wavelength_m,
        uav_antennas=equipment.uav_antennas,
    )
    for i, value in zip(known, sinr_db.tolist(), strict=True):
        unknown[i] = value
    return gains_db, unknown


def _bounds_and_gains_db(
    pipeline: Pipeline, update: Update, towards: FloatArray, weights: ComplexArray
) -> tuple[Sequence[float | None], Sequence[float | None]]:
    """Return each pointing bound, None if it leaves the coverage, and the least gain within, dB."""
    angles = [beam.pointing_bound_rad for beam in update.beams.beams]
    bounds = guarantee.covered_bounds(pipeline.array, pipeline.coverage, towards, angles)
    return bounds, guarantee.guaranteed_gains_db(pipeline.array, towards, bounds, weights)


def _radiated(pipeline: Pipeline, equipment: Equipment, update: Update) -> ComplexArray | None:
    """Return the weights, quantised if a device is set; None if the device cannot apply them."""
    if equipment.device is None:
        return update.beams.weights
    try:
        table = device_table(equipment.device, update.beams, pipeline.array, equipment)
    except UserError:  # a request for the device's table gets the reason
        return None
    return table.weights
