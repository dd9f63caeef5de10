"""The answer of ``/v1/design``: the observer in use, its gains, and its certificate."""

from typing import Any, NamedTuple

import numpy as np

from companion.pipeline import assembly
from companion.pipeline.fold import Pipeline
from companion.settings.files import kinematic_design
from companion.settings.model import Settings
from companion.settings.tracking import ObserverSettings
from companion.tracking.design import answers, gain_table
from companion.tracking.design.gain_table import KinematicDesign
from companion.tracking.observers.kinematic import VELOCITY_SHARE
from companion.values import FloatArray, Limits, Track
from companion.views.words import rfc3339

Json = dict[str, Any]


class _Bounds(NamedTuple):
    """The bounds that one aircraft's observer relies on."""

    speed_max_mps: float
    acceleration_max_mps2: float
    position_noise_m: float
    velocity_noise_mps: float


def _bounds(given: ObserverSettings, limits: Limits) -> _Bounds:
    return _Bounds(
        speed_max_mps=limits.speed_mps,
        acceleration_max_mps2=limits.acceleration_mps2,
        position_noise_m=given.position_noise_m,
        velocity_noise_mps=given.velocity_noise_mps,
    )


class DesignView:
    """Shows the observer of one node's settings; the table of gains is read once.

    Raises ``ConfigError`` if that fails.
    """

    def __init__(self, settings: Settings) -> None:
        self._observer = settings.observer
        self._anyone = _bounds(settings.observer, assembly.anyone(settings))
        self._table = None if self._observer.model == "position" else kinematic_design(settings)

    def show(self, pipeline: Pipeline, now_ns: int) -> Json:
        """The answer of ``/v1/design``.

        ``designs`` has the keys of ``companion design --json``, one entry for each UAV with a known
        interval. ``feasible``: the interval is in the certified range; beyond it the gains are
        those at its end.
        """
        given = self._observer
        return {
            "valid_at": rfc3339(pipeline.utc_ns(now_ns)),
            "model": given.model,
            "assumed": self._anyone._asdict(),
            "certificate": None if self._table is None else _certificate(self._table, self._anyone),
            "designs": [
                {"uav": track.uav, **self._row(pipeline, track, track.dt_s)}
                for track in pipeline.tracks(now_ns, now_ns)
                if track.dt_s is not None and track.dt_s > 0
            ],
        }

    def _row(self, pipeline: Pipeline, track: Track, dt_s: float) -> Json:
        given, newest = self._observer, pipeline.tracker.newest(track.uav)
        has_velocity = newest is not None and newest.velocity_ned_mps is not None
        if self._table is not None:
            bounds = _bounds(given, track.limits)
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


def _scale(table: KinematicDesign, given: _Bounds) -> float:
    """How many times larger the assumed bounds are than those of the table.

    The errors obey a linear equation, so the guarantee grows by the same factor (docs/math.md 4).
    """
    ratios = [
        given.acceleration_max_mps2 / table.acceleration_mps2,
        given.position_noise_m / table.position_noise_m,
    ]
    if table.velocity_noise_mps is not None:
        ratios.append(given.velocity_noise_mps / table.velocity_noise_mps)
    return max(ratios)


def _certificate(table: KinematicDesign, given: _Bounds) -> Json:
    """The certificate for every order of intervals within the range: e'Pe <= scale^2 stays true."""
    scale = _scale(table, given)
    return {
        "P": table.p.tolist(),
        "dt_range_s": [table.dt_s[0], table.dt_s[-1]],
        "margin": table.margin,
        "scale": scale,
        "bound_m": scale * gain_table.invariant_bound(table),
        "provenance": table.provenance,
    }


def _kinematic(table: KinematicDesign, given: _Bounds, dt_s: float) -> Json:
    """Gains by the table.

    Mu, gamma and residual are those of its certificate, one for all intervals.
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


def _shared(given: _Bounds, dt_s: float) -> Json:
    """Gains for a UAV without a reported velocity: a fixed share of what two reports show.

    They have no certificate.
    """
    gain = np.array([[1 + VELOCITY_SHARE], [VELOCITY_SHARE / dt_s]])
    return _row(dt_s, gain, given, None) | {
        "alpha": None,
        "mu": None,
        "gamma": None,
        "residual": None,
        "feasible": False,
        "method": "fixed-share",
    }


def _row(dt_s: float, gain: FloatArray, given: _Bounds, velocity_noise_mps: float | None) -> Json:
    motion = answers.KinematicLimits(
        given.acceleration_max_mps2, given.position_noise_m, velocity_noise_mps
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
