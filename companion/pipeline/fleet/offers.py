"""Offers of this node: gain and SINR that it would give each UAV, if it served that UAV alone.

Offers are computed in batches: for a new UAV at once, otherwise about every two seconds. The
caller holds the pipeline while UAVs are predicted; the beams are computed on any thread.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from companion.beams.aim import aim, directions
from companion.beams.worth import guarantee, link_budget
from companion.pipeline.fleet.assignment import STEP_DB
from companion.pipeline.fold import Pipeline
from companion.values import BeamSet, Method, Offer, Policy, Power

ROUND_NS: Final = 2_000_000_000  # time in which all offers are renewed
MIN_BATCH: Final = 2  # least number of UAVs per batch
MAX_BATCH: Final = 64
"""Largest number of UAVs per batch. Late looks would compute those of thousands at once."""


class Offers:
    """Offers of one node. ``silent_s`` returns the age of a UAV's last report; None: never.

    ``made`` are in the order in which UAVs get beams if there are too many (``Pipeline.ranked``).
    """

    def __init__(self, pipeline: Pipeline, silent_s: Callable[[str, int], float | None]) -> None:
        self.made: dict[str, Offer] = {}
        self._pipeline = pipeline
        self._silent_s = silent_s
        self._alone = replace(
            pipeline.precoder, method=Method.MATCHED, policy=Policy.REGULARISE, power=Power.EQUAL
        )
        self._waiting: list[str] = []
        self._order: list[str] = []
        self._last_ns: int | None = None

    def look(self, now_ns: int) -> Callable[[], dict[str, Offer]] | None:
        """Return a function that computes the due offers, on any thread; None if none are due.

        Pass its result to ``take``. Call this a few times a second, not at every update: it takes
        milliseconds even for few UAVs.
        """
        pipeline = self._pipeline
        targets = [uav for uav in pipeline.tracker.uavs if pipeline.targets.wants(uav)]
        wanted = pipeline.ranked(now_ns, targets)
        self._order = wanted
        new = [uav for uav in wanted if uav not in self.made]
        if not self._waiting or new:
            self.made = {uav: self.made[uav] for uav in wanted if uav in self.made}
            self._waiting = new + [uav for uav in self._waiting or wanted if uav in self.made]
        share = 0.0 if self._last_ns is None else (now_ns - self._last_ns) / ROUND_NS
        self._last_ns = now_ns
        many = min(max(MIN_BATCH, math.ceil(share * len(self.made))), MAX_BATCH)
        chosen, self._waiting = self._waiting[:many], self._waiting[many:]
        return self._made_of(now_ns, chosen) if chosen else None

    def take(self, made: dict[str, Offer]) -> None:
        """Store the computed offers."""
        self.made |= made
        self.made = {uav: self.made[uav] for uav in self._order if uav in self.made}

    def _made_of(self, now_ns: int, uavs: list[str]) -> Callable[[], dict[str, Offer]]:
        """Read some UAVs now, and return a function that computes the offers to them."""
        pipeline = self._pipeline
        at_ns = now_ns + round(pipeline.settings.beams.actuation_delay_s * 1e9)
        carrier = pipeline.carrier(now_ns, at_ns)
        known = None if isinstance(carrier, str) else carrier
        snapshots = pipeline.snapshots(uavs)
        heard_s = {uav: self._silent_s(uav, now_ns) for uav in uavs}
        array, alone, coverage = pipeline.array, self._alone, pipeline.coverage

        def make() -> dict[str, Offer]:
            return self._make(
                aim(
                    now_ns,
                    valid_at_ns=at_ns,
                    tracks=[one.at(now_ns, at_ns) for one in snapshots],
                    carrier=known,
                    array=array,
                    precoder=alone,
                    coverage=coverage,
                ),
                heard_s,
            )

        return make

    def _make(self, aimed: BeamSet, heard_s: dict[str, float | None]) -> dict[str, Offer]:
        made = {
            uav: Offer(uav=uav, sure_db=None, likely_db=None, sinr_db=None, heard_s=since_s)
            for uav, since_s in heard_s.items()
        }
        if not aimed.beams:
            return made
        sure = self._least_db(aimed, [beam.pointing_bound_rad for beam in aimed.beams])
        likely = self._least_db(aimed, [beam.pointing_p95_rad for beam in aimed.beams])
        ranges_m = np.array([beam.range_m for beam in aimed.beams])
        budget, antennas = self._alone.budget, self._alone.uav_antennas
        array = self._pipeline.array
        snr_db = 10 * np.log10(link_budget.isotropic_snr(ranges_m, array, budget, antennas))
        for i, beam in enumerate(aimed.beams):
            gain_db = likely[i] if sure[i] is None else sure[i]
            sinr_db = None if gain_db is None else float(snr_db[i]) + gain_db
            made[beam.uav] = Offer(
                uav=beam.uav,
                sure_db=_step(sure[i]),
                likely_db=_step(likely[i]),
                sinr_db=_step(sinr_db),
                heard_s=heard_s[beam.uav],
            )
        return made

    def _least_db(self, made: BeamSet, angles_rad: list[float | None]) -> tuple[float | None, ...]:
        """Return the least gain of each beam within given angles of its UAV's direction, dB."""
        array, towards = self._pipeline.array, directions(made)
        bounds = guarantee.covered_bounds(array, self._pipeline.coverage, towards, angles_rad)
        return guarantee.guaranteed_gains_db(array, towards, bounds, made.weights)


def _step(value_db: float | None) -> float | None:
    return None if value_db is None else round(value_db / STEP_DB) * STEP_DB
