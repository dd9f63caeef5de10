"""The product's tracking without a link or a clock, for scenarios that have no frames."""

from typing import Final

from companion.pipeline import assembly
from companion.settings.model import Settings
from companion.studies.prediction.baselines import Observed, Predicted
from companion.tracking.noise import reported
from companion.values import AltitudeDatum, Fix, Report, SenderTime, Source, vector


class TrackPredictor:
    """The product's own tracking as a predictor."""

    def __init__(self, settings: Settings) -> None:
        self._tracker = assembly.tracker(settings)
        self._noise = assembly.noise(settings)
        self._offset_ns = 0
        self._clock_bound_s = 0.0

    def report(self, report: Observed) -> None:
        """Take in a fix; the tracker decides whether it is used."""
        self._offset_ns = report.sent_ns - report.sender_ns
        self._clock_bound_s = report.clock_bound_s
        errors = self._noise.default if report.gnss is None else reported(report.gnss, self._noise)
        velocity = report.velocity_ned_mps
        self._tracker.accept(
            Fix(
                _UAV,
                report.sender_ns,
                report.sent_ns,
                report.arrival_ns,
                vector(report.position_ned_m),
                None if velocity is None else vector(velocity),
                errors,
                _REPORT,
            )
        )

    def predict(self, now_ns: int, at_ns: int) -> Predicted | None:
        """The track at that time, with its bound."""
        at = SenderTime(at_ns, at_ns - self._offset_ns, self._clock_bound_s, self._clock_bound_s)
        track = self._tracker.track(_UAV, now_ns, at)
        if track is None:
            return None
        return Predicted(track.position_ned_m, track.velocity_ned_mps, track.bound_m)


_UAV: Final = "1:1"
_REPORT: Final = Report(
    0, _UAV, Source(1, 1), 0.0, 0.0, 0.0, AltitudeDatum.MSL, None, None, None, None,
    None, None,
)  # fmt: skip
"""Placeholder for the message of a fix, which tracking does not read."""
