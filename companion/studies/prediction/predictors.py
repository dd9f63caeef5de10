"""Predictors that a study compares, all with one interface.

``kalman-peng`` is named after Peng et al. (2018), cited elsewhere for a Kalman filter of position
and velocity with known statistics. The paper was not available: no number and no equation here is
from that paper. The motion model is the constant-velocity one of
``companion.studies.prediction.kalman``, and the statistics are those of ``known_tuning``, which
uses the settings and never a log.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from companion.pipeline import assembly
from companion.pipeline.fold import Pipeline
from companion.settings.center import FixedCenter
from companion.settings.model import Settings
from companion.studies.prediction.baselines import (
    DeadReckoning,
    DeadReckoningOnArrival,
    Hold,
    Predicted,
    Predictor,
)
from companion.studies.prediction.kalman import Kalman, Tuning
from companion.values import Event, Refuted
from companion.values.extras import needs

Make = Callable[[], Predictor]
KALMAN_STATES: Final = {"kalman-cv": 2, "kalman-ca": 3}
MANOEUVRE_S: Final = 1.0  # duration of an acceleration, as kalman-peng assumes


class Product:
    """Product as a predictor of one UAV: its pipeline, from frames to tracks.

    The array is at the origin of the study's local frame, so that its frame is the study's.

    uav        the UAV
    refuted_ns  node times at which the product reported that an assumption about it was refuted
    """

    def __init__(self, settings: Settings, uav: str, origin: tuple[float, float, float]) -> None:
        stands = FixedCenter(lat_deg=origin[0], lon_deg=origin[1], alt_m=origin[2])
        self.uav = uav
        self.refuted_ns: list[int] = []
        self._pipeline = Pipeline(settings.override(center={"source": str(stands)}))

    def hear(self, event: Event) -> None:
        """Process an event, in order of arrival."""
        for output in self._pipeline.step(event):
            if isinstance(output, Refuted) and output.uav == self.uav:
                self.refuted_ns.append(output.t_ns)

    def predict(self, now_ns: int, at_ns: int) -> Predicted | None:
        """Return the track at a time, with its bound."""
        for track in self._pipeline.tracks(now_ns, at_ns):
            if track.uav == self.uav:
                return Predicted(
                    position_ned_m=track.position_ned_m,
                    velocity_ned_mps=track.velocity_ned_mps,
                    bound_m=track.bound_m,
                    usual_m=track.error_p95_m,
                )
        return None


MODELS: Final = {f"uio-{model}": model for model in ("position", "kinematic")}
"""Observers of the product, by their names as predictors."""


def product(settings: Settings, name: str, uav: str, origin: tuple[float, float, float]) -> Product:
    """Return the product as a predictor, with an observer of ``MODELS``."""
    return Product(settings.override(observer={"model": MODELS[name]}), uav, origin)


SIMPLE: Final[Mapping[str, Make]] = {
    "hold": Hold,
    "dead-reckoning-arrival": DeadReckoningOnArrival,
    "dead-reckoning": DeadReckoning,
}


def kalman(name: str, tuning: Tuning) -> Make:
    """Return a factory of one of the ``KALMAN_STATES`` filters with given noise."""
    return lambda: Kalman(KALMAN_STATES[name], tuning)


def learned(path: Path) -> Make:
    """Return a factory of predictors with the network in a file.

    Raises ``UserError`` if the file contains no network, or PyTorch is missing.
    """
    with needs("torch", "learned", "--learned"):
        from companion.studies.prediction.learned import load
    return load(path)


def known_tuning(settings: Settings) -> Tuning:
    """Return the noise that corresponds to the settings' bounds, the same for every log and link.

    A bound counts as ``accuracy_factor`` standard deviations, as the settings assume for receivers.
    The process noise is white acceleration whose density is its variance times ``MANOEUVRE_S``.
    """
    given = settings.observer
    deviation_mps2 = assembly.default_limits(settings).acceleration_max_mps2 / given.accuracy_factor
    return Tuning(
        process_density=deviation_mps2**2 * MANOEUVRE_S,
        position_noise_m=given.position_noise_m / given.accuracy_factor,
        velocity_noise_mps=given.velocity_noise_mps / given.accuracy_factor,
    )
