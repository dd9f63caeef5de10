"""Flights made to break the bounds, within everything that the bounds assume.

A search turns the latencies, accelerations, errors, lags, drifts and gaps of a flight towards what
does most harm. It found no answer outside a bound in a million (docs/math.md 5.6); these are a few
hundred thousand, or with the quick tests some thousands.
"""

import adversary
import adversary_carrier
import numpy as np
import pytest
from numpy.random import default_rng

from companion.values import FloatArray

QUICK, FULL = 4, 80


def search_flights(seed: int, flights: int) -> None:
    asked = 0

    def harm(genes: FloatArray, number: int) -> float:
        nonlocal asked
        found = adversary.worst(adversary.Flight(genes, number))
        asked += found.queries
        assert found.ratio <= 1.0, (number, found.at)
        assert found.outside <= 1.0 + 1e-9, number
        assert found.refused == ()
        assert found.refuted == ()
        return found.ratio

    adversary.search(harm, adversary.GENES, default_rng(seed), flights)
    assert asked > 1000 * flights


def search_turns(seed: int, flights: int) -> None:
    asked = 0

    def harm(genes: FloatArray, number: int) -> float:
        nonlocal asked
        ratio, what, queries = adversary_carrier.worst(adversary_carrier.Turning(genes, number))
        asked += queries
        assert ratio <= 1.0, (number, what)
        return ratio

    adversary.search(harm, adversary_carrier.GENES, default_rng(seed), flights)
    assert asked > 100 * flights


def test_nothing_that_is_assumed_possible_breaks_a_bound_or_is_refused() -> None:
    search_flights(1, QUICK)


def test_a_carrier_that_turns_away_is_within_its_bounds_and_so_are_its_beams() -> None:
    search_turns(1, 1)


@pytest.mark.full
@pytest.mark.parametrize("seed", [2, 3])
def test_a_search_finds_no_flight_that_breaks_a_bound(seed: int) -> None:
    search_flights(seed, FULL)


@pytest.mark.full
def test_a_search_finds_no_turn_that_breaks_a_bound() -> None:
    search_turns(4, FULL // 3)


def test_the_adversary_reaches_what_it_may() -> None:
    """A flight that came nowhere near the bound would prove nothing."""
    flight = adversary.Flight(default_rng(3).random(adversary.GENES))
    accelerations = np.diff(flight.velocities, axis=0) / adversary.STEP_S
    sizes = np.linalg.norm(accelerations, axis=1)
    assert sizes.max() == pytest.approx(adversary.ACCELERATION_MPS2, rel=1e-2)
    assert sizes.max() <= adversary.ACCELERATION_MPS2
    assert np.linalg.norm(flight.velocities, axis=1).max() <= adversary.SPEED_MPS
    assert adversary.worst(flight).ratio > 0.5
