"""Answer of ``/v1/design``: the observer in use, its gains, and its certificate."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Final, Literal, NamedTuple

import numpy as np

from companion.pipeline import assembly
from companion.pipeline.snapshots import UavSnapshot
from companion.settings.files import kinematic_design
from companion.settings.model import Settings
from companion.settings.tracking import ObserverSettings
from companion.tracking.design import answers, gain_table
from companion.tracking.design.gain_table import KinematicDesign
from companion.tracking.observers.kinematic import VELOCITY_SHARE
from companion.values import FloatArray, Limits
from companion.values.described import Inline, Meaning
from companion.views.as_json import Json, Utc, as_json

ROWS_KEPT: Final = 4096
Matrix = list[list[float]]
Model = Literal["kinematic", "position"]


class Assumed(NamedTuple):
    """Bounds that the observer assumes."""

    limits: Annotated[Limits, Inline(omit=("limits_source",))]
    position_noise_m: Annotated[float, Meaning("largest error of a reported position")]
    velocity_noise_mps: Annotated[float, Meaning("largest error of a reported velocity")]


@dataclass(frozen=True, slots=True, kw_only=True)
class Certificate:
    """Certificate of the gain table: e'Pe <= scale^2 holds for every order of intervals.

    ``scale`` is the ratio of the assumed bounds to those of the table.
    """

    P: Annotated[Matrix, Meaning("matrix of the quadratic form, (position, velocity) in one axis")]
    dt_range_s: Annotated[tuple[float, float], Meaning("shortest and longest certified interval")]
    margin: Annotated[float, Meaning("smallest eigenvalue of all matrix inequalities; at least 0")]
    scale: Annotated[float, Meaning("assumed bounds over those of the table")]
    bound_m: Annotated[float, Meaning("certified bound on the position error")]
    provenance: Annotated[str, Meaning("how the gains were computed")]


@dataclass(frozen=True, slots=True, kw_only=True)
class UavDesign:
    """Gains at a UAV's report interval, with the keys of ``companion design --json``."""

    uav: Annotated[str, Meaning("id of the UAV", example="3:1")]
    dt_s: Annotated[float, Meaning("interval between reports")]
    model: Annotated[Model, Meaning("the observer's model")]
    alpha: Annotated[float | None, Meaning("decay of the quadratic form per report, in (0, 1)")]
    feedthrough_s: Annotated[float, Meaning("time by which a report leads the position")]
    L: Annotated[float | Matrix, Meaning("observer gain on the innovation: number or matrix rows")]
    Q: Annotated[float | Matrix, Meaning("share of the last estimate: transition minus L C")]
    mu: Annotated[float | None, Meaning("square of gamma, s² or m²")]
    gamma: Annotated[
        float | None,
        Meaning("certified gain from unknown input to error, s; kinematic: certified error, m"),
    ]
    peak_gain: Annotated[
        float | None,
        Meaning("largest steady-state error: per m/s of unknown input, s; kinematic: in m"),
    ]
    residual: Annotated[
        float | None,
        Meaning("smallest eigenvalue of the matrix inequalities, which hold if it is not negative"),
    ]
    feasible: Annotated[bool, Meaning("whether the design has a solution")]
    dt_limit_s: Annotated[float | None, Meaning("longest interval for which the gain is certified")]
    method: Annotated[
        Literal["lmi", "closed-form", "fixed-share"], Meaning("how the gain was computed")
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """Observer in use, with its gains and its certificate."""

    valid_at_ns: Annotated[int, Meaning("the instant for which the values hold")]
    model: Annotated[Model, Meaning("the observer's model")]
    assumed: Annotated[Assumed, Meaning("bounds that the observer assumes")]
    certificate: Annotated[
        Certificate | None, Meaning("certificate of the table of gains; null for the closed form")
    ]
    designs: Annotated[
        list[UavDesign], Meaning("observer gains at each UAV's interval between reports")
    ]


def _bounds(given: ObserverSettings, limits: Limits) -> Assumed:
    return Assumed(limits, given.position_noise_m, given.velocity_noise_mps)


class DesignView:
    """Observer design of one node's settings; the gain table is read once.

    The answer is that of ``show``, with the ``designs`` of all UAVs but the carrier.

    Raises ``ConfigError`` if the gain table cannot be read.
    """

    def __init__(self, settings: Settings) -> None:
        self._observer = settings.observer
        self._default_bounds = _bounds(settings.observer, assembly.default_limits(settings))
        self._table = None if self._observer.model == "position" else kinematic_design(settings)
        self._known_row = lru_cache(ROWS_KEPT)(self._row)  # until the next report nothing changes

    def show(self, now_ns: int, utc_ns: Utc) -> Json:
        """Return the answer of ``/v1/design``, to which ``designs`` is to be added."""
        shown = Design(
            valid_at_ns=now_ns,
            model=self._observer.model,
            assumed=self._default_bounds,
            certificate=None
            if self._table is None
            else _certificate(self._table, self._default_bounds),
            designs=[],
        )
        return as_json(shown, utc_ns)

    def designs(self, snapshots: Iterable[UavSnapshot]) -> Iterator[UavDesign]:
        """Yield the designs of UAVs with a known interval, as in ``companion design --json``.

        ``feasible``: the interval is in the certified range; outside of this range, the gains at
        its end apply. Runs on any thread.
        """
        for track, _ in snapshots:
            dt_s = track.last.dt_s
            if dt_s is not None and dt_s > 0:
                has_velocity = track.fix.velocity_ned_mps is not None
                row = self._known_row(dt_s, has_velocity, track.limits)
                yield UavDesign(uav=track.fix.uav, **row)

    def _row(self, dt_s: float, has_velocity: bool, limits: Limits) -> Json:
        given = self._observer
        if self._table is not None:
            bounds = _bounds(given, limits)
            return _kinematic(self._table, bounds, dt_s) if has_velocity else _shared(bounds, dt_s)
        lead_s = given.feedthrough_s
        if has_velocity:
            lead_s += max(given.velocity_lead_s, dt_s)
        alpha = None if given.alpha == "auto" else given.alpha
        return answers.row(
            dt_s,
            feedthrough_s=lead_s,
            alpha=alpha,
            mu_max=None,
            model="position",
            method="closed-form",
        )


def _scale(table: KinematicDesign, given: Assumed) -> float:
    """Return the largest ratio of an assumed bound to the bound in the gain table.

    The error dynamics are linear, so the guarantee scales by the same factor (docs/math.md 4).
    """
    ratios = [
        given.limits.acceleration_max_mps2 / table.acceleration_mps2,
        given.position_noise_m / table.position_noise_m,
    ]
    if table.velocity_noise_mps is not None:
        ratios.append(given.velocity_noise_mps / table.velocity_noise_mps)
    return max(ratios)


def _certificate(table: KinematicDesign, given: Assumed) -> Certificate:
    """Return the gain table's certificate, valid for every order of intervals in its range."""
    scale = _scale(table, given)
    return Certificate(
        P=table.p.tolist(),
        dt_range_s=(table.dt_s[0], table.dt_s[-1]),
        margin=table.margin,
        scale=scale,
        bound_m=scale * gain_table.invariant_bound(table),
        provenance=table.provenance,
    )


def _kinematic(table: KinematicDesign, given: Assumed, dt_s: float) -> Json:
    """Return the gains of the kinematic model from its table.

    Mu, gamma and residual are from the table's certificate, which covers all intervals.
    """
    bound_m = _scale(table, given) * gain_table.invariant_bound(table)
    noise_mps = None if table.velocity_noise_mps is None else given.velocity_noise_mps
    return _row(dt_s, gain_table.gain(table, dt_s), given, noise_mps) | {
        "alpha": float(np.interp(dt_s, table.dt_s, table.alphas)),
        "mu": bound_m**2,
        "gamma": bound_m,
        "residual": table.margin,
        "feasible": table.dt_s[0] <= dt_s <= table.dt_s[-1],
        "method": "lmi",
    }


def _shared(given: Assumed, dt_s: float) -> Json:
    """Return the gains for a UAV that reports no velocity: a fixed share, without a certificate."""
    gain = np.array([[1 + VELOCITY_SHARE], [VELOCITY_SHARE / dt_s]])
    return _row(dt_s, gain, given, None) | {
        "alpha": None,
        "mu": None,
        "gamma": None,
        "residual": None,
        "feasible": False,
        "method": "fixed-share",
    }


def _row(dt_s: float, gain: FloatArray, given: Assumed, velocity_noise_mps: float | None) -> Json:
    motion = answers.KinematicLimits(
        given.limits.acceleration_max_mps2, given.position_noise_m, velocity_noise_mps
    )
    return {
        "dt_s": dt_s,
        "model": "kinematic",
        "feedthrough_s": 0.0,
        "L": gain.tolist(),
        "Q": (gain_table.transition(dt_s) - gain @ np.eye(2)[: gain.shape[1]]).tolist(),
        "peak_gain": answers.peak_error_m(dt_s, gain, motion),
        "dt_limit_s": None,
    }
