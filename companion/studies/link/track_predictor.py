"""The product's tracking without link or clock, for scenarios without frames."""

from typing import Final

from companion.pipeline import assembly
from companion.settings.model import Settings
from companion.studies.prediction.baselines import ObservedReport, Predicted
from companion.tracking.noise import reported
from companion.values import AltitudeDatum, Fix, Report, SenderTime, Source, vector


class TrackPredictor:
    """Predictor that uses the product's own tracking."""

    def __init__(self, settings: Settings) -> None:
        self._tracker = assembly.tracker(settings)
        self._noise = assembly.noise(settings)
        self._offset_ns = 0
        self._clock_bound_s = 0.0

    def report(self, report: ObservedReport) -> None:
        """Pass a fix to the tracker, which may reject it."""
        self._offset_ns = report.sent_ns - report.sender_ns
        self._clock_bound_s = report.clock_bound_s
        errors = self._noise.default if report.gnss is None else reported(report.gnss, self._noise)
        velocity = report.velocity_ned_mps
        self._tracker.accept(
            Fix(
                uav=_UAV,
                sender_ns=report.sender_ns,
                t_ns=report.sent_ns,
                arrival_ns=report.arrival_ns,
                position_ned_m=vector(report.position_ned_m),
                velocity_ned_mps=None if velocity is None else vector(velocity),
                noise=errors,
                report=_REPORT,
            )
        )

    def predict(self, now_ns: int, at_ns: int) -> Predicted | None:
        """Return the track at a time, with its bound."""
        at = SenderTime(
            node_ns=at_ns,
            sender_ns=at_ns - self._offset_ns,
            before_s=self._clock_bound_s,
            after_s=self._clock_bound_s,
        )
        track = self._tracker.track(_UAV, now_ns, at)
        if track is None:
            return None
        return Predicted(
            position_ned_m=track.position_ned_m,
            velocity_ned_mps=track.velocity_ned_mps,
            bound_m=track.bound_m,
        )


_UAV: Final = "1:1"
_REPORT: Final = Report(
    t_ns=0,
    uav=_UAV,
    source=Source(1, 1),
    lat_deg=0.0,
    lon_deg=0.0,
    alt_m=0.0,
    alt_datum=AltitudeDatum.MSL,
    relative_alt_m=None,
    velocity_ne_mps=None,
    velocity_down_mps=None,
    heading_deg=None,
    boot_ms=None,
    tslc_s=None,
)
"""Placeholder for the message of a fix, which tracking ignores."""
