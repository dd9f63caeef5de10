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

RINGS: Final = np.repeat([0.0, 0.5, 1.0], [1, 8, 8])
"""Samples of a cone, (K,): on its axis and on two rings, as radii over that of the cone."""
ROUND: Final = np.arange(-1, 16) * (math.pi / 4)  # their angles about its axis, (K,)
ACROSS: Final = np.cos(ROUND)
ALONG: Final = np.sin(ROUND)
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
        needed_db = self._needed_db(beam_set)
        least_db = self._least_db(beam_set, which)
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
        frames = _frames(beams)
        bounds = guarantee.covered_bounds(array, self._site.coverage, frames[:, 0], angles)
        radii = np.array([0.0 if bound is None else bound for bound in bounds])
        samples = _samples(frames, radii)
        steered = steering.steering_matrix(array, samples.reshape(-1, 3))
        weights = array.fed(beam_set.weights[:, list(which)]).T
        shape = (array.size, *samples.shape[:2])
        fields = (steered.reshape(shape).transpose(1, 2, 0) @ weights[:, :, np.newaxis])[:, :, 0]
        squares = (fields.real**2 + fields.imag**2).min(axis=1)
        gains = squares / np.maximum(np.vecdot(weights, weights).real, NOTHING)
        least_db = (10 * np.log10(np.maximum(gains, NOTHING))).tolist()
        needed_db = self._needed_db(beam_set)
        return [
            bound is None or least < needed_db[i]
            for i, bound, least in zip(which, bounds, least_db, strict=True)
        ]

    def _least_db(
        self, beam_set: BeamSet, which: Sequence[int]
    ) -> tuple[Sequence[float | None], Sequence[float | None]]:
        """Return each beam's least gain within its UAV's bound, and within the usual error."""
        array, beams = self._site.array, [beam_set.beams[i] for i in which]
        towards = _frames(beams)[:, 0]
        both = np.concatenate((towards, towards))
        angles = [beam.pointing_bound_rad for beam in beams]
        angles += [beam.pointing_p95_rad for beam in beams]
        bounds = guarantee.covered_bounds(array, self._site.coverage, both, angles)
        weights = beam_set.weights[:, [*which, *which]]
        gains = guarantee.guaranteed_gains_db(array, both, bounds, weights)
        return gains[: len(beams)], gains[len(beams) :]

    def _needed_db(self, beam_set: BeamSet) -> list[float]:
        """Return the array gain that each link needs, dB.

        With ``needed_sinr_db`` that is the beam's gain less the excess of its SINR.
        """
        need, site, beams = self._need, self._site, beam_set.beams
        if need.needed_sinr_db is None:
            return [need.needed_db] * len(beams)
        sinr_db = link_budget.sinr_of_beams_db(
            site.array, beam_set, directions(beam_set), site.budget, site.uav_antennas
        )
        spare_db = sinr_db - need.needed_sinr_db
        return [beam.gain_db - spare for beam, spare in zip(beams, spare_db.tolist(), strict=True)]


def _frames(beams: Sequence[Beam]) -> FloatArray:
    """Return each beam's direction, and two axes across it, (N, 3, 3), as rows."""
    angles = np.array([(beam.azimuth_rad, beam.elevation_rad) for beam in beams]).T
    (east, level), (right, up) = np.cos(angles), np.sin(angles)
    frames: FloatArray = np.empty((len(beams), 3, 3))
    frames[:, 0, 0], frames[:, 0, 1], frames[:, 0, 2] = level * east, level * right, -up
    frames[:, 1, 0], frames[:, 1, 1], frames[:, 1, 2] = -right, east, 0.0
    frames[:, 2, 0], frames[:, 2, 1], frames[:, 2, 2] = up * east, up * right, level
    return frames


def _samples(frames: FloatArray, radii_rad: FloatArray) -> FloatArray:
    """Return directions (N, K, 3) in cones around the first rows of frames (N, 3, 3)."""
    angles = radii_rad[:, np.newaxis] * RINGS
    aside = np.sin(angles)
    parts: FloatArray = np.empty((*angles.shape, 3))
    parts[:, :, 0], parts[:, :, 1], parts[:, :, 2] = np.cos(angles), aside * ACROSS, aside * ALONG
    return np.asarray(parts @ frames)
