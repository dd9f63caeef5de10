"""What this node offers each UAV: the gain that its array would have, if it served it alone.

Made in turn, some at each call, so that no update is held up: every UAV has its turn about every
two seconds, a new one at once.
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

ROUND_NS: Final = 2_000_000_000
"""Time in which every UAV has its turn."""
LEAST: Final = 2
"""UAVs at least that one call makes offers for."""


class Offers:
    """The offers of one node. ``silent_s`` says how long ago a UAV was heard here; None: never."""

    def __init__(self, pipeline: Pipeline, silent_s: Callable[[str, int], float | None]) -> None:
        self.made: dict[str, Offer] = {}
        self._pipeline = pipeline
        self._silent_s = silent_s
        self._alone = replace(
            pipeline.precoder, method=Method.MATCHED, policy=Policy.REGULARISE, power=Power.EQUAL
        )
        self._waiting: list[str] = []
        self._last_ns: int | None = None

    def look(self, now_ns: int) -> None:
        """Make the offers whose turn it is. Call it some times a second, not at every update:
        a call costs milliseconds, however few UAVs it is for.
        """
        pipeline = self._pipeline
        wanted = [uav for uav in pipeline.tracker.uavs if pipeline.targets.wants(uav)]
        new = [uav for uav in wanted if uav not in self.made]
        if not self._waiting or new:
            self.made = {uav: self.made[uav] for uav in wanted if uav in self.made}
            self._waiting = new + [uav for uav in self._waiting or wanted if uav in self.made]
        share = 0.0 if self._last_ns is None else (now_ns - self._last_ns) / ROUND_NS
        self._last_ns = now_ns
        many = max(LEAST, math.ceil(share * len(self.made)))
        chosen, self._waiting = self._waiting[:many], self._waiting[many:]
        if chosen:
            self._make(now_ns, chosen)

    def _make(self, now_ns: int, uavs: list[str]) -> None:
        pipeline, array = self._pipeline, self._pipeline.array
        at_ns = now_ns + round(pipeline.settings.beams.actuation_delay_s * 1e9)
        carrier = pipeline.carrier(now_ns, at_ns)
        known = None if isinstance(carrier, str) else carrier
        tracks = pipeline.tracks(now_ns, at_ns, uavs)
        made = aim(now_ns, at_ns, tracks, known, array, self._alone, pipeline.coverage)
        for uav in uavs:
            self.made[uav] = Offer(uav, None, None, None, self._silent_s(uav, now_ns))
        if not made.beams:
            return
        sure = self._least_db(made, [beam.pointing_bound_rad for beam in made.beams])
        likely = self._least_db(made, [beam.pointing_p95_rad for beam in made.beams])
        ranges_m = np.array([beam.range_m for beam in made.beams])
        budget, antennas = self._alone.budget, self._alone.uav_antennas
        snr_db = 10 * np.log10(link_budget.isotropic_snr(ranges_m, array, budget, antennas))
        for i, beam in enumerate(made.beams):
            heard_s = self.made[beam.uav].heard_s
            gain_db = likely[i] if sure[i] is None else sure[i]
            sinr_db = None if gain_db is None else float(snr_db[i]) + gain_db
            told = _step(sure[i]), _step(likely[i]), _step(sinr_db)
            self.made[beam.uav] = Offer(beam.uav, *told, heard_s)

    def _least_db(self, made: BeamSet, angles_rad: list[float | None]) -> tuple[float | None, ...]:
        """The least gain of each beam within these angles of where its UAV is predicted."""
        array, towards = self._pipeline.array, directions(made)
        bounds = guarantee.covered_bounds(array, self._pipeline.coverage, towards, angles_rad)
        return guarantee.guaranteed_gains_db(array, towards, bounds, made.weights)


def _step(value_db: float | None) -> float | None:
    return None if value_db is None else round(value_db / STEP_DB) * STEP_DB
