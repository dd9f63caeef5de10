"""The Kalman filters' noise, tuned in hindsight: the best of a grid over all UAVs and leads."""

from collections.abc import Sequence
from itertools import product as product_of
from typing import Final

import numpy as np

from companion.studies.prediction.baselines import Kalman, Tuning
from companion.studies.prediction.delivery import Delivery
from companion.studies.prediction.pointing import Questions, answers
from companion.studies.prediction.predictors import KALMAN_STATES
from companion.studies.truth.vehicles import Flight
from companion.values import FloatArray

TUNE_EVERY: Final = 5
"""Step between the questions on which the grid is searched.

The grid is smooth, and there are many settings.
"""

DENSITIES: Final = {
    "kalman-cv": (0.1, 1.0, 3.0, 10.0, 30.0, 100.0, 1000.0),
    "kalman-ca": (0.001, 0.01, 0.03, 0.1, 0.3, 1.0, 10.0),
}
NOISES: Final = tuple(product_of((0.03, 0.3), (0.1, 0.3)))
"""Noise of position (m) and velocity (m/s) of the grid on which the filters are tuned.

``DENSITIES`` holds its process noises.
"""

Case = tuple[Flight, Delivery, Questions]
"""A flight, what a link delivered of it, and what is asked."""


def tune(name: str, cases: Sequence[Case]) -> Tuning:
    """The noise of the grid with the least mean square position error over all UAVs and leads."""
    few = [(delivery.observed, asked.every(TUNE_EVERY)) for _, delivery, asked in cases]

    def cost(tuning: Tuning) -> float:
        squares: list[FloatArray] = []
        for observed, asked in few:
            given = answers(Kalman(KALMAN_STATES[name], tuning), observed, asked)
            error = (given.position_ned_m - asked.truth_ned_m)[asked.counts]
            squares.append(np.sum(error * error, axis=1))
        return float(np.nanmean(np.concatenate(squares)))

    grid = product_of(DENSITIES[name], NOISES)
    return min((Tuning(density, *noises) for density, noises in grid), key=cost)
