"""Samples of measured beams, and their split into training and test samples."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.values import BoolArray, FloatArray, IntArray

_STATIONARY_SHARE: Final = 0.1
"""Weight of a sample at the previous position, relative to a sample a mean step away."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Samples:
    """Measured samples of a scenario, in order of time.

    power (N, beams), received power per beam, linear; None if the table has none
    """

    name: str  # of the table
    place: FloatArray  # (N, 2), both coordinates from 0 to 1, of unknown orientation
    beam: IntArray  # (N,), the beam of the largest received power
    beams: int  # number of beams in the codebook
    power: FloatArray | None = None

    def neighbours_alike(self) -> float:
        """Return the share of samples whose beam equals the previous sample's."""
        return float(np.mean(self.beam[1:] == self.beam[:-1]))

    def apart(self) -> BoolArray:
        """Return samples (N,) about a mean step apart along the flown path.

        Repeated measurements of a hovering UAV add little information.
        """
        step = np.hypot(*np.diff(self.place, axis=0, prepend=self.place[:1]).T)
        way = np.cumsum(step / max(float(step.mean()), 1e-12) + _STATIONARY_SHARE)
        begun: BoolArray = np.diff(np.floor(way), prepend=-1.0) > 0
        return begun


def blocks(count: int, number: int, folds: int) -> list[BoolArray]:
    """Return contiguous blocks of ``count`` samples, every ``folds``-th in one fold: masks (N,).

    Only at the ends of the blocks do test samples have neighbours among the training samples.
    """
    which = np.arange(count) * number // count
    return [which % folds == fold for fold in range(folds)]


def shuffled(count: int, folds: int, seed: int) -> list[BoolArray]:
    """Return random folds, as published: masks (N,). Neighbours in time are in different folds."""
    which = np.random.default_rng(seed).permutation(count) % folds
    return [which == fold for fold in range(folds)]


def inner(learned: BoolArray, number: int, folds: int) -> list[BoolArray]:
    """Return blocks within the training samples, for choices made without the test samples."""
    (rows,) = np.nonzero(learned)
    found = []
    for part in blocks(len(rows), number, folds):
        mask = np.zeros(len(learned), dtype=bool)
        mask[rows[part]] = True
        found.append(mask)
    return found
