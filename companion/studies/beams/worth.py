"""Performance of beams at each sampling instant, and its summary."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from companion.beams.aim import aim, directions
from companion.beams.array.steering import steering_matrix
from companion.beams.worth import guarantee
from companion.pipeline.fold import Pipeline
from companion.studies.origin import Row
from companion.values import BeamSet, FloatArray, Method, Update, Widen

ROUNDING_DB: Final = 1e-9  # rounding tolerance between true and guaranteed gain
SHARP: Final = "sharp_"
"""Prefix of keys for beams with ``[beams] widen = false``; other keys are for beams as set."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Worth:
    """Performance of one beam at one time; gains are the array's, dB, element pattern included.

    guaranteed_gain_db   least gain within the pointing bound; None: not guaranteed
    """

    gain_db: float  # towards the predicted direction
    loss_db: float  # loss against a beam for the UAV alone
    guaranteed_gain_db: float | None
    true_gain_db: float | None  # towards the true direction; None: unknown
    sinr_db: float  # as predicted; -inf where no element faces the UAV
    spectral_efficiency: float  # bit/s/Hz, time slots counted
    group: int  # number of its time slot
    widened: bool  # its main lobe was broadened
    method: Method  # how the weights were computed
    condition_number: float  # of the steering matrix

    @property
    def violated(self) -> bool:
        """Whether the true gain was below the guaranteed one."""
        sure, true = self.guaranteed_gain_db, self.true_gain_db
        return sure is not None and true is not None and sure > true + ROUNDING_DB


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """One tracked UAV at one sampling instant; without a beam only the first two fields are set.

    pointing_bound_rad  bound on the angle between predicted and true direction
    codebook_best       index of the best stored beam for the predicted direction
    sweep_share share of the codebook to sweep for the best stored beam
    """

    t_s: float  # seconds into the log
    uav: str  # its name
    pointing_bound_rad: float | None = None
    off_rad: float | None = None  # that angle
    codebook_best: int | None = None
    sweep_share: float | None = None
    missed: bool | None = None  # whether the truly best stored beam is not in that share
    as_set: Worth | None = None  # the beam with the settings' width
    sharp: Worth | None = None  # the same beam not widened

    @property
    def beyond(self) -> bool:
        """Whether the true direction is outside the pointing bound."""
        off, bound = self.off_rad, self.pointing_bound_rad
        return off is not None and bound is not None and bool(off > bound)


def summed_up(samples: Sequence[Sample]) -> Row:
    """Return the summary figures of samples.

    Counts and shares are of samples in which the UAV had a beam, except ``without_beam``. None
    without data. Percentiles are values that occurred, and count missing values: 95 % of all
    samples have at least the guaranteed gain p5, which is None if fewer have any. Violations and
    misses are broken guarantees: those of UAVs within the bound are faults of this program, the
    others follow from settings whose bounds did not hold.
    """
    served = [sample for sample in samples if sample.as_set is not None]
    bounds = [_or(sample.pointing_bound_rad, math.inf) for sample in served]
    shares = [s.sweep_share for s in served if s.sweep_share is not None]
    known = [sample for sample in served if sample.off_rad is not None]
    missed = [(s.missed, s.beyond) for s in served if s.missed is not None]
    return {
        "without_beam": len(samples) - len(served),
        "n_true": len(known),
        "pointing_bound_median_deg": degrees(percentile(bounds, 50)),
        "pointing_bound_p95_deg": degrees(percentile(bounds, 95)),
        "pointing_error_p95_deg": degrees(percentile([_or(s.off_rad, 0) for s in known], 95)),
        "bound_violations": sum(sample.beyond for sample in known) if known else None,
        "sweep_share_mean": float(np.mean(shares)) if shares else None,
        "sweep_share_p95": percentile(shares, 95),
        "codebook_misses": sum(miss for miss, _ in missed) if missed else None,
        "codebook_misses_within_bound": sum(miss and not beyond for miss, beyond in missed)
        if missed
        else None,
        **_of_beams([(s.as_set, s.beyond) for s in served if s.as_set is not None], ""),
        **_of_beams([(s.sharp, s.beyond) for s in samples if s.sharp is not None], SHARP),
    }


def _of_beams(beams: Sequence[tuple[Worth, bool]], prefix: str) -> Row:
    """Return each figure of the beams, paired with whether the UAV was outside its bound."""
    worths = [worth for worth, _ in beams]
    gains = [worth.gain_db for worth in worths]
    sure = [_or(worth.guaranteed_gain_db, -math.inf) for worth in worths]
    true = [worth.true_gain_db for worth in worths if worth.true_gain_db is not None]
    losses = [worth.loss_db for worth in worths]
    found: Row = {
        "n": len(worths),
        "gain_p5_db": percentile(gains, 5),
        "gain_median_db": percentile(gains, 50),
        "guaranteed_share": share(worth.guaranteed_gain_db is not None for worth in worths),
        "guaranteed_gain_p5_db": percentile(sure, 5),
        "guaranteed_gain_median_db": percentile(sure, 50),
        "true_gain_p5_db": percentile(true, 5),
        "true_gain_median_db": percentile(true, 50),
        "violations": sum(worth.violated for worth in worths) if true else None,
        "violations_within_bound": sum(worth.violated and not beyond for worth, beyond in beams)
        if true
        else None,
        "loss_median_db": percentile(losses, 50),
        "loss_p95_db": percentile(losses, 95),
        "sinr_median_db": percentile([worth.sinr_db for worth in worths], 50),
        "spectral_efficiency_mean": mean([worth.spectral_efficiency for worth in worths]),
        "widened_share": share(worth.widened for worth in worths),
        "regularised_share": share(worth.method is Method.REGULARISED for worth in worths),
        "turns_max": max((worth.group + 1 for worth in worths), default=None),
        "condition_number_max": max((worth.condition_number for worth in worths), default=None),
    }
    return {prefix + key: value for key, value in found.items()}


def given(
    pipeline: Pipeline, made: BeamSet, truly: Mapping[str, FloatArray]
) -> tuple[Sequence[float | None], FloatArray]:
    """Return guaranteed gains of beams, dB, and power gains (N,) towards the true directions.

    ``truly`` holds the true directions, (3,) each, by UAV; without one the gain is NaN.
    """
    array, towards = pipeline.array, directions(made)
    wanted = [beam.pointing_bound_rad for beam in made.beams]
    bounds = guarantee.covered_bounds(array, pipeline.coverage, towards, wanted)
    guaranteed = guarantee.guaranteed_gains_db(array, towards, bounds, made.weights)
    there = np.array([truly.get(uav, np.full(3, np.nan)) for uav in made.uavs])
    responses = np.einsum("mn,mn->n", steering_matrix(array, there), made.weights)
    power = np.einsum("mn,mn->n", made.weights, made.weights.conj()).real
    true_gains: FloatArray = np.maximum(np.abs(responses) ** 2 / power, 1e-30)
    return guaranteed, true_gains


def aimed(pipeline: Pipeline, update: Update, widen: Widen, **given: Any) -> BeamSet:
    """Return the beams of an update in another width; ``given`` as for ``aim``."""
    return aim(
        update.t_ns,
        valid_at_ns=update.beams.valid_at_ns,
        carrier=update.carrier,
        array=pipeline.array,
        precoder=replace(pipeline.precoder, widen=widen),
        coverage=pipeline.coverage,
        **{"tracks": update.tracks, **given},
    )


def percentile(values: Sequence[float], percent: float) -> float | None:
    """Return the least of some values that is not below ``percent`` of all of them.

    None if that value is not finite, or if there are no values.
    """
    if not values:
        return None
    found = float(np.percentile(values, percent, method="inverted_cdf"))
    return found if math.isfinite(found) else None


def mean(values: Sequence[float]) -> float | None:
    """Return the mean of values; None without values."""
    return float(np.mean(values)) if values else None


def share(marks: Iterable[bool]) -> float | None:
    """Return the share of marks that are true; None without marks."""
    return mean([float(mark) for mark in marks])


def degrees(angle_rad: float | None) -> float | None:
    """Convert radians to degrees; None stays None."""
    return None if angle_rad is None else math.degrees(angle_rad)


def cell(key: str, value: float | str | None) -> str:
    """Format a figure for a table: shares in per cent, a dash for None."""
    if isinstance(value, float):
        return f"{value:.1%}" if "share" in key else f"{value:.2f}"
    return "-" if value is None else str(value)


def _or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value
