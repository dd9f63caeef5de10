"""Predictors of the best beam from a position: each learns from some samples and ranks all beams.

``nearest`` and ``geometry`` are what others do, to compare with. ``kernel`` is the product's
way: the density of beams over bearing and distance from the fitted place of the array, by a
Gaussian kernel (Nadaraya 1964, Watson 1964), with beams about as far aside where there are few
samples. All make their choices by what is learned from alone.
"""

from collections.abc import Callable
from functools import partial
from typing import Final

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from companion.studies.deepsense import geometry
from companion.studies.deepsense.geometry import Geometry
from companion.studies.deepsense.samples import Samples, inner
from companion.values import BoolArray, FloatArray, IntArray

Fitted = Callable[[BoolArray], FloatArray]
"""Probabilities (N, beams) by samples that are learned from, all choices being made."""
Predictor = Callable[[Samples, BoolArray], Fitted]
NEIGHBOURS: Final = 20
BANDWIDTHS: Final = tuple((a, b) for a in (0.015, 0.03) for b in (0.1, 0.2))
"""Bearing, rad, and distance, of normalised coordinates: the kernel's widths that are tried."""
_INNER: Final = (16, 4)
_CELL: Final = (0.005, 0.025)
_BEARINGS: Final = round(2 * np.pi / _CELL[0])
_PRIOR: Final = 0.05
_SPREAD_BEAMS: Final = 1.5


def nearest(samples: Samples, _: BoolArray) -> Fitted:
    """Votes of the nearest samples; of equal ones the beam of the nearer counts a little more."""
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
    """Beams by their distance from the one that the sine of the bearing says."""
    at = geometry.fit(samples.place, samples.beam, learned, samples.beams, lags=False)
    off = np.abs(np.arange(samples.beams) - at.beams(samples.place)[:, None])
    likely: FloatArray = np.exp(-off)
    likely /= likely.sum(axis=1, keepdims=True)
    return lambda _: likely


def kernel(samples: Samples, learned: BoolArray) -> Fitted:
    """The density of beams over bearing and distance, its widths chosen within what is learned."""
    at, widths = chosen(samples, learned)
    return lambda mask: density(samples, mask, at, widths)


def chosen(samples: Samples, learned: BoolArray) -> tuple[Geometry, tuple[float, float]]:
    """The geometry, and the kernel's widths that do best in blocks within what is learned."""
    at = geometry.fit(samples.place, samples.beam, learned, samples.beams, lags=True)
    parts = inner(learned, *_INNER)
    widths = max(BANDWIDTHS, key=lambda one: _worth(samples, learned, parts, at, one))
    return at, widths


def _worth(
    samples: Samples,
    learned: BoolArray,
    parts: list[BoolArray],
    at: Geometry,
    widths: tuple[float, float],
) -> float:
    """Top-1, 3 and 5 hits in blocks that are left out in turn."""
    hits = 0.0
    for part in parts:
        rank = rank_of(density(samples, learned & ~part, at, widths), samples.beam)[part]
        hits += float(sum((rank < top).sum() for top in (1, 3, 5)))
    return hits


def rank_of(likely: FloatArray, beam: IntArray) -> IntArray:
    """The place of each beam (N,) among all by their probabilities (N, beams), from 0.

    Of equal ones it is the last: a predictor that cannot tell has not told.
    """
    own = likely[np.arange(len(beam)), beam % likely.shape[1]]
    found: IntArray = (likely >= own[:, None]).sum(axis=1) - 1
    return found


def density(
    samples: Samples, learned: BoolArray, at: Geometry, widths: tuple[float, float]
) -> FloatArray:
    """Probabilities (N, beams) by the learned samples around each, counted in small cells."""
    bearing, distance = at.seen(samples.place)
    farthest = min(6.0, float(distance.max()) + _CELL[1])
    row = np.clip((bearing + np.pi) / _CELL[0], 0, _BEARINGS - 1).astype(np.int64)
    column = np.clip(distance / _CELL[1], 0, farthest / _CELL[1]).astype(np.int64)
    counts = np.zeros((_BEARINGS, int(column.max()) + 1, samples.beams))
    beam = samples.beam % samples.beams
    np.add.at(counts, (row[learned], column[learned], beam[learned]), 1.0)
    sigma = (widths[0] / _CELL[0], widths[1] / _CELL[1], 0.0)
    smooth = gaussian_filter(counts, sigma, mode=("wrap", "constant", "constant"), truncate=5.0)
    found = smooth[row, column]
    wide = gaussian_filter(counts.sum(axis=1), (4 * sigma[0], 0.0), mode="wrap", truncate=5.0)[row]
    # Where nothing is near, beams around those of about this bearing; popular ones first.
    spread = gaussian_filter(wide, (0.0, _SPREAD_BEAMS), mode="constant", truncate=4.0)
    popular = np.bincount(beam[learned], minlength=samples.beams) + 1.0
    prior = (spread + 1e-9) * np.sqrt(popular)
    prior /= prior.sum(axis=1, keepdims=True)
    peak = 1.0 / (2 * np.pi * sigma[0] * sigma[1])  # of one sample's kernel
    mixed: FloatArray = found + _PRIOR * peak * prior + 1e-4 * peak / samples.beams
    mixed /= mixed.sum(axis=1, keepdims=True)
    return mixed
