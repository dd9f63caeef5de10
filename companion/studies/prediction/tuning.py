"""Tuning of the Kalman filters' noise in hindsight: the best of a grid over all UAVs and leads."""

from collections.abc import Sequence
from itertools import product as product_of
from typing import Final

import numpy as np

from companion.studies.prediction.delivery import Delivery
from companion.studies.prediction.kalman import Kalman, Tuning
from companion.studies.prediction.pointing import Questions
from companion.studies.prediction.predictors import KALMAN_STATES
from companion.studies.truth.vehicles import Flight
from companion.values import FloatArray

TUNE_EVERY: Final = 5
"""Step between the questions that are used to search the grid of tunings.

The cost is smooth over the grid, and there are many candidates.
"""

DENSITIES: Final = {
    "kalman-cv": (0.1, 1.0, 3.0, 10.0, 30.0, 100.0, 1000.0),
    "kalman-ca": (0.001, 0.01, 0.03, 0.1, 0.3, 1.0, 10.0),
}
NOISES: Final = tuple(product_of((0.03, 0.3), (0.1, 0.3)))
"""Grid of position noise (m) and velocity noise (m/s) for tuning the filters.

``DENSITIES`` has the grid's process noises.
"""

Case = tuple[Flight, Delivery, Questions]
"""Case for tuning: a flight, its delivery by a link, and the questions."""


def tune(name: str, cases: Sequence[Case]) -> Tuning:
    """Return the grid's noise of least mean square position error, over all UAVs and leads.

    All tunings are evaluated at once.
    """
    tunings = [
        Tuning(
            process_density=density,
            position_noise_m=position_noise_m,
            velocity_noise_mps=velocity_noise_mps,
        )
        for density, (position_noise_m, velocity_noise_mps) in product_of(DENSITIES[name], NOISES)
    ]
    squares = [_squares(name, tunings, delivery, asked) for _, delivery, asked in cases]
    costs = np.nanmean(np.concatenate(squares), axis=0)
    return tunings[int(np.argmin(costs))]


def _squares(
    name: str, tunings: Sequence[Tuning], delivery: Delivery, asked: Questions
) -> FloatArray:
    """Return squared errors (n, T), m², of scored answers per tuning; NaN without an answer."""
    few = asked.every(TUNE_EVERY)
    filters = Kalman(KALMAN_STATES[name], *tunings)
    found = np.full((*few.counts.shape, len(tunings)), np.nan)
    observed, arrived = delivery.observed, 0
    for k, now_ns in enumerate(few.now_ns.tolist()):
        while arrived < len(observed) and observed[arrived].arrival_ns <= now_ns:
            filters.report(observed[arrived])
            arrived += 1
        for lead, lead_ns in enumerate(few.leads_ns.tolist()):
            predicted = filters.predict(now_ns, now_ns + lead_ns)
            if predicted is not None:
                error = predicted.position_ned_m - few.truth_ned_m[lead, k]
                found[lead, k] = np.sum(error * error, axis=-1)
    return found[few.counts]
