"""Flights built to break the bounds within all of their assumptions.

A search steers the latencies, accelerations, errors, lags, drifts and gaps of a flight towards
the largest violation. ``python tests/adversary_search.py`` is the long run (docs/math.md 5.6);
these tests evaluate some hundred thousand predictions, or some thousands in quick mode.
"""

from itertools import islice

import adversary
import numpy as np
import pytest
from adversary_search import FAMILIES, Family, Tried, search
from numpy.random import default_rng

QUICK, FULL = 4, 40


def assert_no_violation_found(family: str, seed: int, flights: int) -> None:
    tried = list(islice(search(FAMILIES[family], default_rng(seed)), flights))
    for number, one in enumerate(tried):
        assert one.wrong == "", number
        assert one.ratio <= 1.0 + 1e-9
    assert sum(one.queries for one in tried) > 100 * flights


def test_flights_within_the_assumptions_keep_bounds_and_are_accepted() -> None:
    assert_no_violation_found("everything", 1, QUICK)


def test_turning_carrier_keeps_attitude_and_beam_bounds() -> None:
    assert_no_violation_found("turns and gaps of attitudes", 1, 1)


@pytest.mark.full
@pytest.mark.parametrize("family", FAMILIES)
def test_search_finds_no_bound_violation(family: str) -> None:
    assert_no_violation_found(family, 2, FULL)


def test_search_converges_on_the_worst_case() -> None:
    """On a bowl-shaped function the samples improve steadily and the edges are reachable."""

    def harm(genes: np.ndarray, _number: int) -> Tried:
        return Tried(1.0 - float(np.sum((genes - best) ** 2)), "", 1)

    best = np.tile([0.0, 0.3, 1.0], 4)
    family = Family(harm, len(best), ())
    ratios = [one.ratio for one in islice(search(family, default_rng(1)), 600)]
    assert max(ratios) > 0.8
    assert np.mean(ratios[:50]) < 0.0


def test_adversary_uses_its_full_limits() -> None:
    """A flight far inside the bound would prove nothing."""
    flight = adversary.Flight(default_rng(3).random(adversary.GENES))
    accelerations = np.diff(flight.velocities, axis=0) / adversary.STEP_S
    sizes = np.linalg.norm(accelerations, axis=1)
    assert sizes.max() == pytest.approx(adversary.ACCELERATION_MPS2, rel=1e-2)
    assert sizes.max() <= adversary.ACCELERATION_MPS2
    assert np.linalg.norm(flight.velocities, axis=1).max() <= adversary.SPEED_MPS
    assert adversary.worst(flight).ratio > 0.5
