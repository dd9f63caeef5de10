"""Predictors of the best beam from a position: each is trained on samples and ranks all beams.

``nearest`` and ``geometry`` are published methods, for comparison. ``kernel`` is the product's
method: the density of beams over the beam that a geometry with a height expects, by a Gaussian
kernel (Nadaraya 1964, Watson 1964), and by the distance from that beam where there are few samples.
All predictors make their choices from the training samples only.
"""

from collections.abc import Callable
from functools import partial
from typing import Final

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from companion.studies.deepsense import geometry
from companion.studies.deepsense.geometry import Geometry
from companion.studies.deepsense.samples import Samples, inner
from companion.values import BoolArray, FloatArray, IntArray

Fitted = Callable[[BoolArray], FloatArray]
"""Function from training samples to probabilities (N, beams), with all choices made."""
Predictor = Callable[[Samples, BoolArray], Fitted]
NEIGHBOURS: Final = 20
KERNELS: Final = tuple((width, weight) for width in (0.25, 0.5) for weight in (5.0, 15.0))
"""Candidate widths of the kernel, in beams, and weights of the prior, in samples."""
_INNER: Final = (16, 4)
_CELL: Final = 0.05
_FAR: Final = 1.3  # beams within which the prior falls to 1/e
_REFLECTED: Final = 0.01


def nearest(samples: Samples, _: BoolArray) -> Fitted:
    """Predict by votes of the nearest samples; ties favour the beam of the nearer sample."""
    return partial(_votes, samples)


def _votes(samples: Samples, learned: BoolArray) -> FloatArray:
    _, near = cKDTree(samples.place[learned]).query(samples.place, NEIGHBOURS)
    beam = samples.beam[learned] % samples.beams
    votes = np.zeros((len(samples.beam), samples.beams))
    for place, row in enumerate(np.asarray(near).T):
        np.add.at(votes, (np.arange(len(votes)), beam[row]), 1.0 - 0.01 * place)
    found: FloatArray = votes / votes.sum(axis=1, keepdims=True)
    return found


def plain(samples: Samples, learned: BoolArray) -> Fitted:
    """Predict by the distance of beams from the beam for the sine of the bearing."""
    at = geometry.fit(samples.place, samples.beam, learned, samples.beams, simple=True)
    likely = _beside(samples, at.beams(samples.place), 1.0)
    likely /= likely.sum(axis=1, keepdims=True)
    return lambda _: likely


def kernel(samples: Samples, learned: BoolArray) -> Fitted:
    """Predict by the density of beams over the expected beam; the kernel is chosen in training."""
    at, (width, weight) = chosen(samples, learned)
    return lambda mask: averaged(samples, mask, _leave_one_out(samples, mask, at), width, weight)


def chosen(samples: Samples, learned: BoolArray) -> tuple[Geometry, tuple[float, float]]:
    """Return the geometry, and the kernel that performs best in blocks of the training samples."""
    counted = learned & samples.apart()
    at = geometry.fit(samples.place, samples.beam, counted, samples.beams)
    worth = dict.fromkeys(KERNELS, 0.0)
    for part in inner(learned, *_INNER):
        mask = learned & ~part
        geometries = _leave_one_out(samples, mask, at)
        for width, weight in KERNELS:
            likely = averaged(samples, mask, geometries, width, weight)
            worth[width, weight] += float(np.log(own(likely, samples.beam)[part]).sum())
    return at, max(KERNELS, key=lambda one: worth[one])


def _leave_one_out(samples: Samples, learned: BoolArray, at: Geometry) -> list[Geometry]:
    """Return geometries from parts of the training samples; their spread shows uncertainty."""
    counted = learned & samples.apart()
    return [
        geometry.refit(at, samples.place, samples.beam, counted & ~part, samples.beams)
        for part in inner(counted, *_INNER)
    ]


def averaged(
    samples: Samples, learned: BoolArray, geometries: list[Geometry], width: float, weight: float
) -> FloatArray:
    """Return the mean of the probabilities (N, beams) over geometries."""
    found: FloatArray = np.mean(
        [density(samples, learned, at, width, weight) for at in geometries], axis=0
    )
    return found


def own(likely: FloatArray, beam: IntArray) -> FloatArray:
    """Return the probability (N,) of each sample's beam among those of all beams (N, beams)."""
    found: FloatArray = likely[np.arange(len(beam)), beam % likely.shape[1]]
    return found


def rank_of(likely: FloatArray, beam: IntArray) -> IntArray:
    """Return the rank of each beam (N,) by its probabilities (N, beams), from 0.

    Ties give the last rank: a predictor that cannot distinguish beams gets no credit.
    """
    found: IntArray = (likely >= own(likely, beam)[:, None]).sum(axis=1) - 1
    return found


def density(
    samples: Samples, learned: BoolArray, at: Geometry, width: float, weight: float
) -> FloatArray:
    """Return probabilities (N, beams) from training samples with about the same expected beam.

    Training samples are counted in small cells; a sample in the same cell counts 1, and the prior
    ``weight``.
    """
    counted = learned & samples.apart()
    expected = at.beams(samples.place)
    cell = np.clip(np.round(expected / _CELL), 0, samples.beams / _CELL).astype(np.int64)
    beam = samples.beam % samples.beams
    counts = np.zeros((round(samples.beams / _CELL) + 1, samples.beams))
    np.add.at(counts, (cell[counted], beam[counted]), 1.0)
    sigma = width / _CELL
    near = gaussian_filter1d(counts, sigma, axis=0, mode="constant", truncate=5.0)
    near *= np.sqrt(2 * np.pi) * sigma
    # Without near samples, prefer beams close to the expected one, frequent ones first.
    popular = np.bincount(beam[learned], minlength=samples.beams) + 1.0
    prior = _beside(samples, expected, _FAR) * np.sqrt(popular)
    prior /= prior.sum(axis=1, keepdims=True)
    # A reflection can make any beam the best one at any position.
    prior = (1 - _REFLECTED) * prior + _REFLECTED / samples.beams
    mixed: FloatArray = near[cell] + weight * prior
    mixed /= mixed.sum(axis=1, keepdims=True)
    return mixed


def _beside(samples: Samples, expected: FloatArray, scale: float) -> FloatArray:
    """Return a decay with the distance (N, beams) from the expected beam, in ``scale`` beams."""
    off = np.abs(np.arange(samples.beams) - expected[:, None])
    return np.exp(-off / scale)
