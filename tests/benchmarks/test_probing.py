"""What powers through dithered beams can say of an attitude: the exact set, over a grid.

It is the best that any method without statistics can know (docs/decisions/10-no-probing.md).
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import pytest
from figures import Figures
from numpy.random import Generator, default_rng

from companion.values import FloatArray

UAVS: Final = 4
CURVATURE_DB: Final = 0.0732
"""Loss at 1 degree beside the peak of a beam of an 8 x 8 array, half a wavelength apart."""
BOUND_DEG, ERROR_DEG, POWER_BOUND_DB = 4.0, 2.0, 1.0
SECONDS, RATE_HZ = 30.0, 10.0
AZIMUTHS: Final = np.radians(np.linspace(-50.0, 50.0, UAVS))


@dataclass(frozen=True, kw_only=True)
class Case:
    """How far beams are dithered, and what changes between powers.

    drift_degps   rate at which the attitude's error may change
    position_deg  bound on each UAV's direction by its position
    """

    dither_deg: float
    drift_degps: float
    position_deg: float = 0.0


def offsets_deg(errors_deg: FloatArray, uav: int) -> FloatArray:
    """Return how far a UAV is beside its expected direction, for rotations (..., 3)."""
    yaw, pitch, roll = np.moveaxis(errors_deg, -1, 0)
    return np.stack([yaw, pitch * np.cos(AZIMUTHS[uav]) + roll * np.sin(AZIMUTHS[uav])], axis=-1)


def powers_db(off_deg: FloatArray, side: int, dither_deg: float) -> FloatArray:
    """Return the power of a beam that is dithered to one of four sides."""
    turn = side * np.pi / 2
    beside = off_deg - dither_deg * np.array([np.cos(turn), np.sin(turn)])
    power: FloatArray = -CURVATURE_DB * (beside**2).sum(axis=-1)
    return power


def candidates(true_deg: FloatArray) -> FloatArray:
    """Return rotations (C, 3) within the bound, closer to one another near the true one."""
    steps = np.linspace(-1.0, 1.0, 23)
    cube = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    sizes = (6.0, 3.0, 1.5, 0.7, 0.3, 0.1)
    found = np.concatenate([true_deg + cube * size for size in sizes])
    return np.asarray(found[np.linalg.norm(found, axis=1) <= BOUND_DEG])


def pointing_bound_deg(case: Case, rng: Generator) -> float:
    """Return the pointing bound by all rotations that agree with the powers, median over UAVs."""
    axis = rng.standard_normal(3)
    true_deg = axis / np.linalg.norm(axis) * ERROR_DEG
    possible = candidates(true_deg)
    times_s = np.arange(0.0, SECONDS, 1 / RATE_HZ)
    unsure_deg = case.drift_degps * (SECONDS - times_s) + case.position_deg
    agrees = np.ones(len(possible), dtype=bool)
    for uav in range(UAVS):
        off, truly = offsets_deg(possible, uav), offsets_deg(true_deg, uav)
        slope_db = 2 * CURVATURE_DB * (np.linalg.norm(off, axis=1) + case.dither_deg)
        least, most = np.full(len(off), -np.inf), np.full(len(off), np.inf)
        for side in range(4):
            unsure = unsure_deg[side::4]
            noise = rng.uniform(-POWER_BOUND_DB, POWER_BOUND_DB, len(unsure))
            level = powers_db(truly, side, case.dither_deg) + noise
            level = level - powers_db(off, side, case.dither_deg)[:, np.newaxis]
            spread = POWER_BOUND_DB + slope_db[:, np.newaxis] * unsure
            least = np.maximum(least, (level - spread).max(axis=1))
            most = np.minimum(most, (level + spread).min(axis=1))
        agrees &= most >= least
    bounds = []
    for uav in range(UAVS):
        off = offsets_deg(possible[agrees], uav)
        middle = (off.max(axis=0) + off.min(axis=0)) / 2
        bounds.append(np.linalg.norm(off - middle, axis=1).max())
    return float(np.median(bounds))


@pytest.mark.benchmark
def test_dithered_beams_say_too_little_of_a_drifting_attitude(figures: Figures) -> None:
    """At 1.2 degrees to either side, which costs 0.1 dB."""
    found = {}
    for drift_degps, position_deg in ((0.0, 0.0), (0.05, 0.0), (0.3, 0.0), (0.3, 0.3)):
        case = Case(dither_deg=1.17, drift_degps=drift_degps, position_deg=position_deg)
        several = [pointing_bound_deg(case, default_rng(seed)) for seed in range(5)]
        name = f"pointing bound by dithered beams, drift {drift_degps:g}, position {position_deg:g}"
        found[drift_degps, position_deg] = figures.note(name, several, "degrees", "less")
    assert found[0.0, 0.0] < 0.5  # powers do show the attitude, if nothing changes
    assert found[0.3, 0.0] > 1.2
    assert found[0.3, 0.3] > 3.0
