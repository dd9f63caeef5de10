"""The predictors that a study compares, all with one interface.

``kalman-peng`` is named after Peng et al. (2018), who are said to predict a UAV's position and
velocity by a Kalman filter whose statistics are known. Neither the paper nor an account of it was
found: no number and no equation here is theirs. The model over time is the constant-velocity one of
``companion.studies.prediction.baselines``, and the statistics are those of ``known_tuning``, which
uses the settings and never a log.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from companion.pipeline import assembly
from companion.settings.model import Settings
from companion.studies.prediction.baselines import (
    DeadReckoning,
    DeadReckoningOnArrival,
    Hold,
    Kalman,
    Observed,
    Predicted,
    Predictor,
    Tuning,
)
from companion.studies.running.extras import needs
from companion.tracking.noise import reported
from companion.values import AltitudeDatum, Fix, Report, SenderTime, Source

Make = Callable[[], Predictor]
KALMAN_STATES: Final = {"kalman-cv": 2, "kalman-ca": 3}
MANOEUVRE_S: Final = 1.0
"""Time for which an acceleration lasts, as ``kalman-peng`` assumes."""


class FleetPredictor:
    """The product's own tracking as a predictor."""

    def __init__(self, settings: Settings) -> None:
        self._fleet = assembly.fleet(settings)
        self._noise = assembly.noise(settings)
        self._offset_ns = 0
        self._clock_bound_s = 0.0

    def report(self, report: Observed) -> None:
        """Take in a fix; the fleet decides whether it is used."""
        self._offset_ns = report.sent_ns - report.sender_ns
        self._clock_bound_s = report.clock_bound_s
        errors = self._noise.default if report.gnss is None else reported(report.gnss, self._noise)
        self._fleet.accept(
            Fix(
                _UAV,
                report.sender_ns,
                report.sent_ns,
                report.arrival_ns,
                report.position_ned_m,
                report.velocity_ned_mps,
                errors,
                _REPORT,
            )
        )

    def predict(self, now_ns: int, at_ns: int) -> Predicted | None:
        """The track at that time, with its bound."""
        at = SenderTime(at_ns, at_ns - self._offset_ns, self._clock_bound_s, self._clock_bound_s)
        track = self._fleet.track(_UAV, now_ns, at)
        if track is None:
            return None
        return Predicted(track.position_ned_m, track.velocity_ned_mps, track.bound_m)


_UAV: Final = "1:1"
_REPORT: Final = Report(
    0, "study", _UAV, Source(1, 1), 0.0, 0.0, 0.0, AltitudeDatum.MSL, None, None, None, None,
    None, None,
)  # fmt: skip
"""Placeholder for the message of a fix, which tracking does not read."""


def observers(settings: Settings) -> dict[str, Make]:
    """The product's observers by name, each as a maker of predictors."""

    def maker(model: str) -> Make:
        chosen = settings.override(observer={"model": model})
        return lambda: FleetPredictor(chosen)

    return {f"uio-{model}": maker(model) for model in ("position", "kinematic")}


SIMPLE: Final[Mapping[str, Make]] = {
    "hold": Hold,
    "dead-reckoning-arrival": DeadReckoningOnArrival,
    "dead-reckoning": DeadReckoning,
}


def kalman(name: str, tuning: Tuning) -> Make:
    """A maker of one of the ``KALMAN_STATES`` filters with its noise."""
    return lambda: Kalman(KALMAN_STATES[name], tuning)


def learned(path: Path) -> Make:
    """A maker of predictors by the network in a file.

    Raises ``UserError`` where it holds none or PyTorch is missing.
    """
    with needs("torch", "learned", "--learned"):
        from companion.studies.prediction.learned import load
    return load(path)


def known_tuning(settings: Settings) -> Tuning:
    """The noise that the settings' bounds stand for, the same for every log and link.

    A bound is taken for ``accuracy_factor`` standard deviations, as the settings have it of
    receivers. The process noise is white acceleration whose density is its variance times
    ``MANOEUVRE_S``.
    """
    given = settings.observer
    deviation_mps2 = assembly.anyone(settings).acceleration_mps2 / given.accuracy_factor
    return Tuning(
        deviation_mps2**2 * MANOEUVRE_S,
        given.position_noise_m / given.accuracy_factor,
        given.velocity_noise_mps / given.accuracy_factor,
    )
