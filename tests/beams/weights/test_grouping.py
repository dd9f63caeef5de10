"""Who is served together: greedy choices, against the same thing done by least squares."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.beams.weights.grouping import semi_orthogonal, without_the_lowest
from companion.values import ComplexArray


def drawn(seed: int, elements: int, users: int) -> ComplexArray:
    rng = np.random.default_rng(seed)
    made: ComplexArray = rng.standard_normal((elements, users, 2)) @ np.array([1.0, 1j])
    return made


def enemies(seed: int, users: int) -> Callable[[Sequence[int]], bool]:
    """A rule that some pairs break; a larger group breaks it no less."""
    apart = np.random.default_rng(seed).random((users, users)) < 0.3
    return lambda some: not any(apart[i, j] for i in some for j in some if i != j)


def outside(candidate: ComplexArray, group: ComplexArray) -> float:
    """The share of a vector's power that a group does not span, by least squares."""
    held, *_ = np.linalg.lstsq(group, candidate, rcond=None)
    rest = candidate - group @ held
    return float(np.sum(np.abs(rest) ** 2) / np.sum(np.abs(candidate) ** 2))


@settings(max_examples=60)
@given(st.integers(0, 2**16), st.integers(0, 9))
def test_each_takes_in_who_is_most_apart_while_all_fit(seed: int, users: int) -> None:
    """Everybody in one group, every group fits, and each choice is that of the oracle."""
    rng = np.random.default_rng(seed)
    steering = drawn(seed, 12, users) * rng.uniform(0.01, 100, users)  # length says nothing
    order, fits = list(rng.permutation(users)), enemies(seed, users)
    groups = semi_orthogonal(steering, order, fits)
    expected, left = [], list(order)
    while left:
        group = [left.pop(0)]
        while left:
            best = max(left, key=lambda user: outside(steering[:, user], steering[:, group]))
            if not fits([*group, best]):
                break
            group.append(best)
            left.remove(best)
        expected.append(sorted(group))
    assert [group.tolist() for group in groups] == expected
    assert sorted(user for group in expected for user in group) == list(range(users))


def test_a_near_twin_waits_for_the_next_turn() -> None:
    steering = np.array([[1, 1, 0, 0], [0, 0.1, 1, 0], [0, 0, 0, 1]], dtype=complex)
    groups = semi_orthogonal(steering, [0, 1, 2, 3], lambda some: not {0, 1} <= set(some))
    assert [group.tolist() for group in groups] == [[0, 2, 3], [1]]
    first = semi_orthogonal(steering, [1, 0, 2, 3], lambda some: not {0, 1} <= set(some))
    assert 1 in first[0]


def test_where_none_fits_with_another_turns_go_by_priority() -> None:
    groups = semi_orthogonal(drawn(1, 4, 4), [2, 0, 3, 1], lambda some: len(some) == 1)
    assert [group.tolist() for group in groups] == [[2], [0], [3], [1]]


@settings(max_examples=60)
@given(st.integers(0, 2**16), st.integers(1, 9))
def test_those_are_kept_who_fit_with_all_of_higher_priority(seed: int, users: int) -> None:
    order = list(np.random.default_rng(seed).permutation(users))
    fits = enemies(seed, users)
    kept = without_the_lowest(order, fits).tolist()
    assert kept == sorted(kept)
    for place, user in enumerate(order):
        before = [other for other in order[:place] if other in kept]
        assert (user in kept) == (not before or fits([*before, user]))


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0]])
def test_the_highest_priority_is_kept_whatever_fits(order: list[int]) -> None:
    assert without_the_lowest(order, lambda _: False).tolist() == [order[0]]
