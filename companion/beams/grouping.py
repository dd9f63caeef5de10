"""Which users are served together: those whom zero forcing can tell apart at the agreed price."""

from collections.abc import Callable, Sequence

import numpy as np

from companion.values import ComplexArray, FloatArray, IntArray

Fits = Callable[[Sequence[int]], bool]
"""Whether zero forcing serves these users within the limits."""


def semi_orthogonal(steering: ComplexArray, order: Sequence[int], fits: Fits) -> list[IntArray]:
    """Groups of users, each of which ``fits``, in the order in which they are served.

    Each group begins with the highest priority that is left and takes in, again and again, the
    user with the largest part outside the span of the group, while all of it fits (semi-orthogonal
    user selection: Yoo and Goldsmith 2006, with the cost of zero forcing itself as the threshold).
    """
    left = list(order)
    groups = []
    while left:
        group = [left.pop(0)]
        while left:
            apart = _share_outside(steering[:, left], steering[:, group])
            best = left[int(np.argmax(apart))]
            if not fits([*group, best]):
                break
            group.append(best)
            left.remove(best)
        groups.append(np.sort(np.array(group)))
    return groups


def without_the_lowest(order: Sequence[int], fits: Fits) -> IntArray:
    """The users kept: by descending priority, each that fits with those kept before."""
    kept: list[int] = []
    for user in order:
        if not kept or fits([*kept, user]):
            kept.append(user)
    return np.sort(np.array(kept))


def _share_outside(candidates: ComplexArray, group: ComplexArray) -> FloatArray:
    """The share of each candidate's power that lies outside the span of a group, (n,)."""
    basis, _ = np.linalg.qr(group)
    inside = np.abs(basis.conj().T @ candidates) ** 2
    whole = np.sum(np.abs(candidates) ** 2, axis=0)
    share: FloatArray = 1 - inside.sum(axis=0) / whole
    return share
