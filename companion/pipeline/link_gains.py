"""Gains of the links to UAVs: what each needs, and what its beam guarantees and usually has."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from companion.beams.aim import directions
from companion.beams.array import steering
from companion.beams.array.coverage import Coverage
from companion.beams.array.geometry import Array
from companion.beams.worth import guarantee, link_budget
from companion.beams.worth.link_budget import LinkBudget
from companion.settings.beams import NeedSettings
from companion.values import Beam, BeamSet, FloatArray

ROUND: Final = np.array([(math.cos(k * math.pi / 4), math.sin(k * math.pi / 4)) for k in range(8)])
"""Samples on each ring of a cone, as cosine and sine of the angle around its axis."""
RINGS: Final = np.array([0.5, 1.0])  # radii of the rings over that of the cone
NOTHING: Final = 1e-12  # least gain or power that is told from zero


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """Properties common to all beams: the array, its coverage, its radio."""

    array: Array
    coverage: Coverage
    budget: LinkBudget
    uav_antennas: int


class LinkGains(NamedTuple):
    """Beam of a link, its needed gain, its guaranteed and its likely gain (None: no such gain)."""

    beam: Beam
    needed_db: float
    guaranteed_db: float | None
    likely_db: float | None


class GainMeter:
    """Computation of the gains. Changes nothing, takes milliseconds, may run on any thread."""

    def __init__(self, need: NeedSettings, site: Site) -> None:
        self._need = need
        self._site = site

    def gains(self, beam_set: BeamSet, which: Sequence[int]) -> list[LinkGains]:
        """Return the gains of the beams of these numbers."""
        towards = directions(beam_set)
        needed_db = _needed_db(self._need, self._site, beam_set, towards)
        least_db = self._least_db(beam_set, towards, which)
        return [
            LinkGains(
                beam=beam_set.beams[i],
                needed_db=needed_db[i],
                guaranteed_db=sure_db,
                likely_db=likely_db,
            )
            for i, sure_db, likely_db in zip(which, *least_db, strict=True)
        ]

    def is_short(
        self, beam_set: BeamSet, which: Sequence[int], usual: Sequence[bool]
    ) -> list[bool]:
        """Return whether beams of these numbers have too little gain somewhere.

        Within the usual error where ``usual``, else within the bound. Samples of each cone are
        compared with the need: what they show is certain, what lies between them they may miss.
        """
        beams, array = [beam_set.beams[i] for i in which], self._site.array
        angles = [
            beam.pointing_p95_rad if within else beam.pointing_bound_rad
            for beam, within in zip(beams, usual, strict=True)
        ]
        towards = directions(beam_set)
        units = towards[list(which)]
        bounds = guarantee.covered_bounds(array, self._site.coverage, units, angles)
        radii = np.array([0.0 if bound is None else bound for bound in bounds])
        samples = _samples(units, radii)
        steered = steering.steering_matrix(array, samples.reshape(-1, 3))
        weights = array.fed(beam_set.weights[:, list(which)]).T[:, :, np.newaxis]
        shape = (array.size, *samples.shape[:2])
        fields = np.matmul(steered.reshape(shape).transpose(1, 2, 0), weights)[:, :, 0]
        powers = np.sum(np.abs(weights[:, :, 0]) ** 2, axis=1)
        gains = np.min(np.abs(fields), axis=1) ** 2 / np.maximum(powers, NOTHING)
        least_db = 10 * np.log10(np.maximum(gains, NOTHING))
        needed_db = _needed_db(self._need, self._site, beam_set, towards)
        return [
            bound is None or least < needed_db[i]
            for i, bound, least in zip(which, bounds, least_db.tolist(), strict=True)
        ]

    def _least_db(
        self, beam_set: BeamSet, towards: FloatArray, which: Sequence[int]
    ) -> tuple[Sequence[float | None], Sequence[float | None]]:
        """Return each beam's least gain within its UAV's bound, and within the usual error."""
        array, beams = self._site.array, [beam_set.beams[i] for i in which]
        both = np.tile(towards[which], (2, 1))
        angles = [beam.pointing_bound_rad for beam in beams]
        angles += [beam.pointing_p95_rad for beam in beams]
        bounds = guarantee.covered_bounds(array, self._site.coverage, both, angles)
        weights = np.tile(beam_set.weights[:, which], 2)
        gains = guarantee.guaranteed_gains_db(array, both, bounds, weights)
        return gains[: len(beams)], gains[len(beams) :]


def _samples(units: FloatArray, radii_rad: FloatArray) -> FloatArray:
    """Return directions (N, K, 3) in cones around unit directions (N, 3): the axis and rings."""
    x, y, z = units.T
    level = np.maximum(np.hypot(x, y), 1e-9)
    across = np.stack((-y / level, x / level, np.zeros(len(units))), axis=-1)[:, None, None]
    along = np.stack((-z * x / level, -z * y / level, level), axis=-1)[:, None, None]
    angles = radii_rad[:, None, None, None] * RINGS[:, None, None]
    rings = np.cos(angles) * units[:, None, None] + np.sin(angles) * (
        ROUND[:, :1] * across + ROUND[:, 1:] * along
    )
    return np.concatenate((units[:, None], rings.reshape(len(units), -1, 3)), axis=1)


def _needed_db(
    need: NeedSettings, site: Site, beam_set: BeamSet, towards: FloatArray
) -> list[float]:
    """Return the array gain that each link needs, dB.

    With ``needed_sinr_db`` that is the beam's gain less the excess of its SINR.
    """
    beams = beam_set.beams
    if need.needed_sinr_db is None:
        return [need.needed_db] * len(beams)
    sinr_db = link_budget.sinr_of_beams_db(
        site.array, beam_set, towards, site.budget, site.uav_antennas
    )
    spare_db = sinr_db - need.needed_sinr_db
    return [beam.gain_db - spare for beam, spare in zip(beams, spare_db.tolist(), strict=True)]
