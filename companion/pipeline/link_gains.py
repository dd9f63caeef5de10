"""Gains of the links to UAVs: what each needs, and what its beam guarantees and usually has."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from companion.beams.aim import directions
from companion.beams.array.coverage import Coverage
from companion.beams.array.geometry import Array
from companion.beams.worth import guarantee, link_budget
from companion.beams.worth.link_budget import LinkBudget
from companion.settings.beams import NeedSettings
from companion.values import Beam, BeamSet, FloatArray


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
