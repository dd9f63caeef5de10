"""Grouping: which users share a time slot, given the allowed cost of zero forcing."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.values import ComplexArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class CostLimits:
    """Allowed cost of zero forcing: the loss of any user in dB, and the condition number."""

    loss_db: float
    condition: float


@dataclass(frozen=True, slots=True)
class PreviousSlots:
    """Previous time slot of each user, -1 if left out; ``young`` if the slots are new."""

    numbers: IntArray
    young: bool


YOUNG_MARGIN_DB: Final = 1.5  # loss accepted beyond the limit while slots are young


def kept_groups(
    steering: ComplexArray, before: PreviousSlots, limits: CostLimits
) -> list[IntArray] | None:
    """Return the previous groups if they are still within the cost limits; else None."""
    groups = [np.flatnonzero(before.numbers == n) for n in range(int(before.numbers.max()) + 1)]
    most_db = limits.loss_db + (YOUNG_MARGIN_DB if before.young else 0.0)
    if not groups or any(not len(g) or lost_db(steering[:, g], limits) > most_db for g in groups):
        return None
    return groups


def lost_db(steering: ComplexArray, limits: CostLimits) -> float:
    """Return the loss of the worst user by zero forcing, dB; infinite above the condition limit.

    Computed with columns of equal length: a weak element pattern towards a user does not make the
    user harder to separate.
    """
    unit: ComplexArray = steering / np.linalg.norm(steering, axis=0)
    return _lost_db(unit.T @ unit.conj(), len(steering), limits)


def _lost_db(gram: ComplexArray, elements: int, limits: CostLimits) -> float:
    if len(gram) > elements:
        return math.inf
    values, vectors = np.linalg.eigh(gram)
    if values[0] <= 1e-14 or values[-1] > limits.condition**2 * values[0]:
        return math.inf
    worst = float((np.abs(vectors) ** 2 @ (1.0 / values)).max())
    return 10 * math.log10(worst)


class _Group:
    """Growing group of users: the inverse of its Gram matrix, bordered with each added user."""

    def __init__(
        self, *, gram: ComplexArray, first: int, elements: int, limits: CostLimits
    ) -> None:
        self.members = [first]
        self._gram, self._elements, self._limits = gram, elements, limits
        self._inverse: ComplexArray = np.array([[1.0 / gram[first, first]]])

    def take(self, user: int) -> bool:
        """Add a user if the group then stays within the limits; return whether it was added."""
        if len(self.members) >= self._elements:
            return False
        beside = self._gram[self.members, user]
        moved = self._inverse @ beside
        rest = float((self._gram[user, user] - beside.conj() @ moved).real)
        if rest <= 1e-12:
            return False
        losses = np.append(self._inverse.diagonal().real + np.abs(moved) ** 2 / rest, 1.0 / rest)
        if losses.max() > 10 ** (self._limits.loss_db / 10) or not self._is_well_conditioned(
            user, losses
        ):
            return False
        count = len(self.members)
        inverse = np.empty((count + 1, count + 1), dtype=complex)
        inverse[:count, :count] = self._inverse + np.outer(moved, moved.conj()) / rest
        inverse[:count, count] = -moved / rest
        inverse[count, :count] = inverse[:count, count].conj()
        inverse[count, count] = 1.0 / rest
        self._inverse = inverse
        self.members.append(user)
        return True

    def _is_well_conditioned(self, user: int, losses: FloatArray) -> bool:
        """Return whether the condition number is within its limit.

        Its square is at most the product of the traces, which mostly decides.
        """
        square = self._limits.condition**2
        if len(losses) * float(losses.sum()) <= square:
            return True
        together = [*self.members, user]
        values = np.linalg.eigvalsh(self._gram[np.ix_(together, together)])
        return bool(values[-1] <= square * values[0])


def semi_orthogonal(
    steering: ComplexArray, order: Sequence[int], limits: CostLimits
) -> list[IntArray]:
    """Return groups of users, each within the limits, in the order in which they are served.

        steering  A, (M, N)
        order     users in descending priority
        limits    allowed cost of zero forcing

    Each group starts with the remaining user of highest priority. It then repeatedly adds the user
    with the largest component outside the span of the group, while the group stays within the
    limits (semi-orthogonal user selection: Yoo and Goldsmith 2006, with the cost of zero forcing
    itself as the threshold; docs/math.md 7). The components are updated by pivoted Cholesky of the
    Gram matrix.
    """
    unit: ComplexArray = steering / np.linalg.norm(steering, axis=0)
    gram = unit.conj().T @ unit
    left = np.ones(steering.shape[1], dtype=bool)
    groups = []
    for begin in order:
        if not left[begin]:
            continue
        group = _Group(gram=gram, first=begin, elements=len(steering), limits=limits)
        left[begin] = False
        factors: ComplexArray = np.empty((min(len(gram), len(steering)), len(gram)), dtype=complex)
        count = 0
        apart = np.ones(len(gram))
        taken = begin
        while left.any():
            if count == len(factors):
                break
            before = factors[:count]
            row = gram[taken] - before[:, taken].conj() @ before
            row /= math.sqrt(max(apart[taken], 1e-300))
            factors[count] = row
            count += 1
            apart = apart - (row.real**2 + row.imag**2)
            best = int(np.argmax(np.where(left, apart, -np.inf)))
            if not group.take(best):
                break
            left[best] = False
            taken = best
        groups.append(np.sort(np.array(group.members)))
    return groups


def without_the_lowest(
    steering: ComplexArray, order: Sequence[int], limits: CostLimits
) -> IntArray:
    """Return the users kept: by descending priority, each that fits with those already kept."""
    unit: ComplexArray = steering / np.linalg.norm(steering, axis=0)
    kept = _Group(gram=unit.conj().T @ unit, first=order[0], elements=len(steering), limits=limits)
    for user in order[1:]:
        kept.take(user)
    return np.sort(np.array(kept.members))
