"""Prediction of the best beam from a position, on contiguous blocks and on a random split."""

from typing import Any, Final

import numpy as np

from companion.studies.deepsense import predictors
from companion.studies.deepsense.predictors import Fitted, Predictor, own, rank_of
from companion.studies.deepsense.samples import Samples, blocks, inner, shuffled
from companion.studies.figures.text_tables import text_table
from companion.studies.origin import Progress, command_line, silent, versions
from companion.values import BoolArray, FloatArray, IntArray

BLOCKS: Final = 20
FOLDS: Final = 5
TOPS: Final = (1, 3, 5, 8)
COVERAGE: Final = 0.99
PREDICTORS: Final[dict[str, Predictor]] = {
    "nearest neighbours": predictors.nearest,
    "plain geometry": predictors.plain,
    "geometry and kernel": predictors.kernel,
}
TARGETS: Final = {1: 45.0, 3: 82.0, 5: 95.0}  # the product's targets on blocks, percent
_CALIBRATION: Final = (16, 4)
_TARGET_COVERAGE: Final = 1 - 0.75 * (1 - COVERAGE)
"""Coverage aimed at: a quarter of the allowed misses is reserved for harder blocks."""


def study(samples: Samples, seed: int, progress: Progress = silent) -> dict[str, Any]:
    """Return the answer of the study, as written to ``deepsense.json``."""
    count = len(samples.beam)
    splits = {"blocks": blocks(count, BLOCKS, FOLDS), "shuffled": shuffled(count, FOLDS, seed)}
    rows = []
    for split, folds in splits.items():
        for name, predictor in PREDICTORS.items():
            progress(f"{split}: {name}")
            rows.append({"split": split, "predictor": name} | _scores(samples, predictor, folds))
    at, (width, weight) = predictors.chosen(samples, np.ones(count, dtype=bool))
    return {
        "command": command_line("deepsense", samples.name, seed=seed),
        "table": samples.name,
        "samples": count,
        "beams": samples.beams,
        "neighbours_alike": samples.neighbours_alike(),
        "blocks": BLOCKS,
        "folds": FOLDS,
        "seed": seed,
        "rows": rows,
        "targets": {str(top): percent for top, percent in TARGETS.items()},
        "coverage_wanted": COVERAGE,
        "geometry": {name: getattr(at, name) for name in at.__slots__},
        "kernel_width": width,
        "prior_weight": weight,
        "versions": versions(),
    }


def _scores(samples: Samples, predictor: Predictor, folds: list[BoolArray]) -> dict[str, Any]:
    """Return a predictor's scores over all folds, each sample tested once."""
    count = len(samples.beam)
    rank, size, lost_db = np.zeros(count, int), np.zeros(count, int), np.full(count, np.nan)
    for tested in folds:
        fitted = predictor(samples, ~tested)
        likely = fitted(~tested)
        rank[tested] = rank_of(likely, samples.beam)[tested]
        size[tested] = _sizes(likely, _threshold(samples, fitted, ~tested))[tested]
        if samples.power is not None:
            lost_db[tested] = _lost_db(samples.power[tested], likely[tested])
    known = bool(np.isfinite(lost_db).any())
    return {
        **{f"top_{top}": 100.0 * float(np.mean(rank < top)) for top in TOPS},
        "set_size_mean": float(size.mean()),
        "set_size_max": int(size.max()),
        "set_coverage": float(np.mean(rank < size)),
        "power_lost_db": float(np.nanmean(lost_db)) if known else None,
    }


def _threshold(samples: Samples, fitted: Fitted, learned: BoolArray) -> float:
    """Return the probability threshold for enough coverage, in blocks of training samples.

    Of all sets with the same mean coverage, sets by one such threshold are the smallest (Sadinle,
    Lei and Wasserman 2019).
    """
    reached = []
    for part in inner(learned, *_CALIBRATION):
        reached.append(own(fitted(learned & ~part), samples.beam)[part])
    return float(np.quantile(np.concatenate(reached), 1 - _TARGET_COVERAGE))


def _sizes(likely: FloatArray, threshold: float) -> IntArray:
    """Return the number of beams that reach a probability, at least one, (N,)."""
    sizes: IntArray = np.maximum((likely >= threshold).sum(axis=1), 1)
    return sizes


def _lost_db(power: FloatArray, likely: FloatArray) -> FloatArray:
    """Return the loss of received power by the likeliest beam against the best beam, dB, (N,)."""
    columns = np.argmax(likely, axis=1) % power.shape[1]
    got = power[np.arange(len(power)), columns]
    found: FloatArray = 10.0 * np.log10(power.max(axis=1) / np.maximum(got, 1e-12))
    return found


def text(answer: dict[str, Any]) -> str:
    """Return the table of scores as text."""
    lines = [
        f"{answer['table']}: {answer['samples']} samples, {answer['beams']} beams;"
        f" {answer['neighbours_alike']:.0%} of neighbours share a beam",
        f"{answer['blocks']} contiguous blocks in {answer['folds']} folds; shuffled with seed"
        f" {answer['seed']}",
    ]
    rows = [["split and predictor", "top-1", "top-3", "top-5", "set", "covers"]]
    for row in answer["rows"]:
        shares = [f"{row[key]:.1f}" for key in ("top_1", "top_3", "top_5", "set_size_mean")]
        covers = f"{100 * row['set_coverage']:.1f}%"
        rows.append([f"{row['split']}: {row['predictor']}", *shares, covers])
    return "\n".join([*lines, text_table(rows)])
