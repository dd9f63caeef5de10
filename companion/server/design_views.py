"""``/v1/design``: the observer in use, its gains at each UAV's interval, and its certificate."""

from typing import Any

import numpy as np

from companion import designing
from companion.config import ObserverSettings, Settings, kinematic_design
from companion.pipeline import Pipeline
from companion.server.words import rfc3339
from companion.tracking import kinematic
from companion.tracking.kinematic import KinematicDesign
from companion.tracking.kinematic_observer import VELOCITY_SHARE
from companion.values import FloatArray, Track

Json = dict[str, Any]


class DesignView:
    """Of one node's settings: the table of gains is read once. ``ConfigError`` if that fails."""

    def __init__(self, settings: Settings) -> None:
        self._observer = settings.observer
        self._table = None if self._observer.model == "position" else kinematic_design(settings)

    def show(self, pipeline: Pipeline, now_ns: int) -> Json:
        """The answer. ``designs`` has the keys of ``companion design --json``, one for each UAV
        of which an interval is known. ``feasible``: the interval is in the certified range; beyond
        it the gains are those at its end.
        """
        given = self._observer
        return {
            "valid_at": rfc3339(now_ns),
            "model": given.model,
            "assumed": {
                "speed_max_mps": given.speed_max_mps,
                "acceleration_max_mps2": given.acceleration_max_mps2,
                "position_noise_m": given.position_noise_m,
                "velocity_noise_mps": given.velocity_noise_mps,
            },
            "certificate": None if self._table is None else _certificate(self._table, given),
            "designs": [
                {"uav": track.uav, **self._row(pipeline, track, track.dt_s)}
                for track in pipeline.tracks(now_ns, now_ns)
                if track.dt_s is not None and track.dt_s > 0
            ],
        }

    def _row(self, pipeline: Pipeline, track: Track, dt_s: float) -> Json:
        given, newest = self._observer, pipeline.newest(track.uav)
        has_velocity = newest is not None and newest.velocity_ned_mps is not None
        if self._table is not None:
            return _kinematic(self._table, given, dt_s) if has_velocity else _shared(given, dt_s)
        lead_s = given.feedthrough_s
        if has_velocity:
            lead_s += max(given.velocity_lead_s, dt_s)
        alpha = None if given.alpha == "auto" else given.alpha
        return designing.row(dt_s, lead_s, alpha, None, "position", "closed-form")


def _scale(table: KinematicDesign, given: ObserverSettings) -> float:
    """How much larger the bounds taken for granted are than those of the table: the errors obey a
    linear equation, so the guarantee grows alike."""
    ratios = [
        given.acceleration_max_mps2 / table.acceleration_mps2,
        given.position_noise_m / table.position_noise_m,
    ]
    if table.velocity_noise_mps is not None:
        ratios.append(given.velocity_noise_mps / table.velocity_noise_mps)
    return max(ratios)


def _certificate(table: KinematicDesign, given: ObserverSettings) -> Json:
    """What holds for every order of intervals within the range: e'Pe <= scale^2 stays so."""
    scale = _scale(table, given)
    return {
        "P": table.p.tolist(),
        "dt_range_s": [table.dt_s[0], table.dt_s[-1]],
        "margin": table.margin,
        "scale": scale,
        "bound_m": scale * kinematic.invariant_bound(table),
        "provenance": table.provenance,
    }


def _kinematic(table: KinematicDesign, given: ObserverSettings, dt_s: float) -> Json:
    """By the table: mu, gamma and residual are those of its certificate, one for all intervals."""
    bound_m = _scale(table, given) * kinematic.invariant_bound(table)
    noise_mps = None if table.velocity_noise_mps is None else given.velocity_noise_mps
    return _row(dt_s, kinematic.gain(table, dt_s), given, noise_mps) | {
        "alpha": float(np.interp(dt_s, table.dt_s, table.alphas)),
        "mu": bound_m**2,
        "gamma": bound_m,
        "residual": table.margin,
        "feasible": table.dt_s[0] <= dt_s <= table.dt_s[-1],
        "method": "lmi",
    }


def _shared(given: ObserverSettings, dt_s: float) -> Json:
    """Of a UAV that reports no velocity: a fixed share of what two reports show, no certificate."""
    gain = np.array([[1 + VELOCITY_SHARE], [VELOCITY_SHARE / dt_s]])
    return _row(dt_s, gain, given, None) | {
        "alpha": None,
        "mu": None,
        "gamma": None,
        "residual": None,
        "feasible": False,
        "method": "fixed-share",
    }


def _row(
    dt_s: float, gain: FloatArray, given: ObserverSettings, velocity_noise_mps: float | None
) -> Json:
    motion = designing.Motion(
        given.acceleration_max_mps2, given.position_noise_m, velocity_noise_mps
    )
    return {
        "dt_s": dt_s,
        "model": "kinematic",
        "feedthrough_s": 0.0,
        "L": gain.tolist(),
        "Q": (kinematic.transition(dt_s) - gain @ np.eye(2)[: gain.shape[1]]).tolist(),
        "peak_gain": designing.peak_error_m(dt_s, gain, motion),
        "dt_limit_s": None,
    }
