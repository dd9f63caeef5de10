"""Grouping: which users are served together, given what zero forcing may cost."""

from collections.abc import Callable, Sequence

import numpy as np

from companion.values import ComplexArray, IntArray

Fits = Callable[[Sequence[int]], bool]
"""Function that says whether zero forcing serves these users within the limits."""


def semi_orthogonal(steering: ComplexArray, order: Sequence[int], fits: Fits) -> list[IntArray]:
    """Groups of users, each of which ``fits``, in the order in which they are served.

        steering  A, (M, N)
        order     users in descending priority
        fits      whether a set of users can be served together

    Each group begins with the highest priority that is left. It then takes in, again and again, the
    user with the largest part outside the span of the group, while all of it fits (semi-orthogonal
    user selection: Yoo and Goldsmith 2006, with the cost of zero forcing itself as the threshold;
    docs/math.md 7).
    """
    left = list(order)
    groups = []
    unit: ComplexArray = steering / np.linalg.norm(steering, axis=0)
    while left:
        group = [left.pop(0)]
        outside = _less(unit, group[0])
        while left:
            apart = np.sum(np.abs(outside[:, left]) ** 2, axis=0)
            best = left[int(np.argmax(apart))]
            if not fits([*group, best]):
                break
            group.append(best)
            left.remove(best)
            outside = _less(outside, best)
        groups.append(np.sort(np.array(group)))
    return groups


def without_the_lowest(order: Sequence[int], fits: Fits) -> IntArray:
    """The users kept: by descending priority, each that fits with those kept before."""
    kept: list[int] = []
    for user in order:
        if not kept or fits([*kept, user]):
            kept.append(user)
    return np.sort(np.array(kept))


def _less(outside: ComplexArray, taken: int) -> ComplexArray:
    """Parts of all users (M, N) outside the span of a group, once one more belongs to it.

    This is a step of the modified Gram-Schmidt process.
    """
    axis = outside[:, taken] / np.linalg.norm(outside[:, taken])
    rest: ComplexArray = outside - np.outer(axis, axis.conj() @ outside)
    return rest
