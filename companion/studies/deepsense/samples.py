"""Samples of measured beams, and how they are split honestly into what is learned and tested."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.values import BoolArray, FloatArray, IntArray

_STAYED: Final = 0.1
"""What a sample counts that is where the one before was, to one that is a mean step farther."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Samples:
    """What was measured, in order of time.

    power      (N, beams), received power of each, linear; None where the table has none
    """

    name: str  # of the table
    place: FloatArray  # (N, 2), both coordinates from 0 to 1: which way they point is not known
    beam: IntArray  # (N,), the beam of the greatest received power
    beams: int  # how many beams the codebook has
    power: FloatArray | None = None

    def neighbours_alike(self) -> float:
        """Share of samples that have the beam of the one before: what a random split leaks."""
        return float(np.mean(self.beam[1:] == self.beam[:-1]))

    def apart(self) -> BoolArray:
        """Samples (N,) about a mean step from the one before of them, along the way flown.

        A UAV that hovers is measured again and again where it is: that says little more than once.
        """
        step = np.hypot(*np.diff(self.place, axis=0, prepend=self.place[:1]).T)
        way = np.cumsum(step / max(float(step.mean()), 1e-12) + _STAYED)
        begun: BoolArray = np.diff(np.floor(way), prepend=-1.0) > 0
        return begun


def blocks(count: int, number: int, folds: int) -> list[BoolArray]:
    """Contiguous blocks of ``count`` samples, every ``folds``-th of them a fold: masks (N,).

    No sample that is tested has its neighbours among those that were learned from, but at the ends
    of the blocks.
    """
    which = np.arange(count) * number // count
    return [which % folds == fold for fold in range(folds)]


def shuffled(count: int, folds: int, seed: int) -> list[BoolArray]:
    """Folds at random, as published: masks (N,). Neighbours in time are on both sides."""
    which = np.random.default_rng(seed).permutation(count) % folds
    return [which == fold for fold in range(folds)]


def inner(learned: BoolArray, number: int, folds: int) -> list[BoolArray]:
    """Blocks within what is learned from, for choices that must not see what is tested."""
    (rows,) = np.nonzero(learned)
    found = []
    for part in blocks(len(rows), number, folds):
        mask = np.zeros(len(learned), dtype=bool)
        mask[rows[part]] = True
        found.append(mask)
    return found
