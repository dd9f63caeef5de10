"""Time slots: greedy grouping against the same computation by pseudo-inverses."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.beams.weights.grouping import (
    YOUNG_MARGIN_DB,
    CostLimits,
    PreviousSlots,
    kept_groups,
    lost_db,
    semi_orthogonal,
    without_the_lowest,
)
from companion.values import ComplexArray

LIMITS = CostLimits(3.0, 100.0)


def drawn(seed: int, elements: int, users: int) -> ComplexArray:
    """Draw directions of a half-wave line, some nearly equal, with unequal element gains."""
    rng = np.random.default_rng(seed)
    sines = rng.uniform(-0.6, 0.6, users)
    made: ComplexArray = np.exp(1j * np.pi * np.outer(np.arange(elements), sines))
    return made * rng.uniform(0.01, 100, users)  # the length is irrelevant


def fit(steering: ComplexArray, some: list[int]) -> bool:
    """Return whether zero forcing is within the limits, by numpy's pseudo-inverse and cond."""
    unit = steering[:, some] / np.linalg.norm(steering[:, some], axis=0)
    if len(some) > len(unit) or np.linalg.cond(unit) > LIMITS.condition:
        return False
    losses = np.sum(np.abs(np.linalg.pinv(unit)) ** 2, axis=1)
    return bool(10 * np.log10(losses.max()) <= LIMITS.loss_db)


def outside(candidate: ComplexArray, group: ComplexArray) -> float:
    """Return the share of a vector's power outside the span of a group, by least squares."""
    held, *_ = np.linalg.lstsq(group, candidate, rcond=None)
    rest = candidate - group @ held
    return float(np.sum(np.abs(rest) ** 2) / np.sum(np.abs(candidate) ** 2))


@settings(max_examples=examples(60), deadline=None)
@given(st.integers(0, 2**16), st.integers(1, 14), st.integers(3, 16))
def test_grouping_adds_the_most_separate_uav_that_fits(
    seed: int, users: int, elements: int
) -> None:
    """Every UAV is in one group, every group fits, and each choice is that of the oracle."""
    steering = drawn(seed, elements, users)
    order = np.random.default_rng(seed).permutation(users).tolist()
    groups = semi_orthogonal(steering, order, LIMITS)
    expected, left = [], list(order)
    while left:
        group = [left.pop(0)]
        while left:
            best = max(left, key=lambda user: outside(steering[:, user], steering[:, group]))
            if not fit(steering, [*group, best]):
                break
            group.append(best)
            left.remove(best)
        expected.append(sorted(group))
    assert [group.tolist() for group in groups] == expected


@settings(max_examples=examples(60), deadline=None)
@given(st.integers(0, 2**16), st.integers(1, 9))
def test_kept_uavs_fit_with_all_of_higher_priority(seed: int, users: int) -> None:
    steering = drawn(seed, 8, users)
    order = np.random.default_rng(seed).permutation(users).tolist()
    found = without_the_lowest(steering, order, LIMITS).tolist()
    assert found == sorted(found)
    for place, user in enumerate(order):
        before = [other for other in order[:place] if other in found]
        assert (user in found) == (not before or fit(steering, [*before, user]))


@settings(max_examples=examples(40), deadline=None)
@given(st.integers(0, 2**16), st.integers(1, 9))
def test_loss_matches_the_pseudo_inverse(seed: int, users: int) -> None:
    steering = drawn(seed, 8, users)
    assert (lost_db(steering, LIMITS) <= LIMITS.loss_db) == fit(steering, list(range(users)))


def test_identical_uavs_get_separate_time_slots() -> None:
    one = np.exp(1j * np.pi * 0.3 * np.arange(8))
    groups = semi_orthogonal(np.stack([one, one, one], axis=1), [2, 0, 1], LIMITS)
    assert [group.tolist() for group in groups] == [[2], [0], [1]]


@pytest.mark.parametrize("young", [True, False])
def test_time_slots_are_kept_within_limits_plus_a_margin_while_new(young: bool) -> None:
    sines = np.linspace(-0.5, 0.5, 5)

    def at(apart: float) -> ComplexArray:
        made: ComplexArray = np.exp(
            1j * np.pi * np.outer(np.arange(16), [*sines, sines[0] + apart])
        )
        return made

    slots = PreviousSlots(np.array([0, 0, 0, 0, 0, 0]), young)
    found = {apart: kept_groups(at(apart), slots, LIMITS) for apart in (0.12, 0.056, 0.01)}
    assert found[0.12] is not None
    assert [group.tolist() for group in found[0.12]] == [[0, 1, 2, 3, 4, 5]]
    assert LIMITS.loss_db < lost_db(at(0.056), LIMITS) < LIMITS.loss_db + YOUNG_MARGIN_DB
    assert (found[0.056] is not None) is young
    assert found[0.01] is None
