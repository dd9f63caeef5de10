"""The table of reports: every position that was received, used or not."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from companion.mavlink.wire.cot_link import TUNNEL
from companion.mavlink.wire.decode import GLOBAL_POSITION_INT, decode
from companion.mavlink.wire.remote_id import LOCATION, MESSAGE_PACK
from companion.mavlink.wire.transponder import ADSB_VEHICLE
from companion.recording.tables.columns import Column, Kind, Table
from companion.values import (
    AdsbVehicle,
    AltitudeDatum,
    Estimate,
    Frame,
    Output,
    Rejection,
    RemoteId,
    Report,
    ReportNoise,
)

MESSAGES: Final = {
    GLOBAL_POSITION_INT: "GLOBAL_POSITION_INT",
    ADSB_VEHICLE: "ADSB_VEHICLE",
    LOCATION: "OPEN_DRONE_ID_LOCATION",
    MESSAGE_PACK: "OPEN_DRONE_ID_MESSAGE_PACK",
    TUNNEL: "TUNNEL",
}
"""Messages that are reports, or may be, by id."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Heard:
    """A report that was received: with its estimate where it was used, else why it was not.

    ``said`` is None where the message could not be read.
    """

    frame: Frame
    estimate: Estimate | None
    refused: Rejection | None
    said: Report | AdsbVehicle | None

    @property
    def uav(self) -> str:
        if self.said is not None:
            return self.said.uav
        return self.refused.source if self.refused is not None else str(self.frame.source)

    @property
    def position_deg(self) -> tuple[float, float] | None:
        if isinstance(self.said, Report):
            return self.said.lat_deg, self.said.lon_deg
        return None if self.said is None else self.said.position_deg

    @property
    def report(self) -> Report | None:
        return self.said if isinstance(self.said, Report) else None

    @property
    def noise(self) -> ReportNoise | None:
        return None if self.estimate is None else self.estimate.fix.noise


def heard(frame: Frame, outputs: Sequence[Output]) -> Heard | None:
    """The report that a frame held, with what came of it; None where it held none."""
    if frame.msgid not in MESSAGES:
        return None
    for output in outputs:
        if isinstance(output, Estimate):
            return Heard(frame=frame, estimate=output, refused=None, said=output.fix.report)
    refused = next((one for one in outputs if isinstance(one, Rejection)), None)
    said = decode(frame)
    if isinstance(
        said, RemoteId
    ):  # what it was refused for names its aircraft, where that is known
        report, named = said.report, None if refused is None else refused.source
        said = replace(report, uav=named) if report is not None and named is not None else report
    if refused is None and said is None:  # a message that may be a report, and was none
        return None
    return Heard(
        frame=frame,
        estimate=None,
        refused=refused,
        said=said if isinstance(said, Report | AdsbVehicle) else None,
    )


def _of_said(heard: Heard, name: str) -> float | AltitudeDatum | None:
    found: float | AltitudeDatum | None = getattr(heard.said, name, None)
    return found


def _degrees(heard: Heard, axis: int) -> float | None:
    return None if heard.position_deg is None else heard.position_deg[axis]


def _level_mps(heard: Heard, axis: int) -> float | None:
    velocity = None if heard.said is None else heard.said.velocity_ne_mps
    return None if velocity is None else velocity[axis]


def _boot_s(heard: Heard) -> float | None:
    boot_ms = None if heard.report is None else heard.report.boot_ms
    return None if boot_ms is None else boot_ms / 1000


def _true_ns(heard: Heard) -> int | None:
    return None if heard.estimate is None else heard.estimate.fix.t_ns


def _latency_s(heard: Heard) -> float | None:
    true_ns = _true_ns(heard)
    return None if true_ns is None else (heard.frame.t_ns - true_ns) * 1e-9


def _of_noise(heard: Heard, name: str) -> float | None:
    found: float | None = getattr(heard.noise, name, None)
    return found


def _of_estimate(heard: Heard, name: str) -> float | None:
    found: float | None = getattr(heard.estimate, name, None)
    return found


_T, _N, _TIME, _INT, _TRUTH = Kind.TEXT, Kind.NUMBER, Kind.TIME, Kind.INTEGER, Kind.TRUTH

# fmt: off
REPORTS: Final = Table("reports", "a report received, over whatever message", (
    Column(name="arrival_ns", kind=_INT, unit="ns", meaning="when it arrived, since 1970",
           of=lambda h: h.frame.t_ns),
    Column(name="arrival_utc", kind=_TIME, unit="UTC", meaning="the same",
           of=lambda h: h.frame.t_ns),
    Column(name="uav", kind=_T, unit="", meaning="whose position it is", of=lambda h: h.uav),
    Column(name="message", kind=_T, unit="", meaning="the MAVLink message",
           of=lambda h: MESSAGES[h.frame.msgid]),
    Column(name="link", kind=_T, unit="", meaning="the link, or the log, over which it came",
           of=lambda h: h.frame.link),
    Column(name="sender", kind=_T, unit="",
           meaning="who sent the message: the UAV, or who relays it", of=lambda h: h.frame.source),
    Column(name="accepted", kind=_TRUTH, unit="", meaning="whether it was used",
           of=lambda h: h.estimate is not None),
    Column(name="reason", kind=_T, unit="", meaning="why it was not used",
           of=lambda h: None if h.refused is None else h.refused.reason),
    Column(name="detail", kind=_T, unit="", meaning="more of that",
           of=lambda h: h.refused and h.refused.detail),
    Column(name="true_utc", kind=_TIME, unit="UTC",
           meaning="when the position was true, by the sender's clock", of=_true_ns),
    Column(name="latency_s", kind=_N, unit="s", meaning="from then to the arrival", of=_latency_s),
    Column(name="boot_s", kind=_N, unit="s", meaning="the sender's clock since boot, as sent",
           of=_boot_s),
    Column(name="tslc_s", kind=_N, unit="s", meaning="age of the position as a relay says",
           of=lambda h: _of_said(h, "tslc_s")),
    Column(name="lat_deg", kind=_N, unit="deg", meaning="latitude, WGS84",
           of=lambda h: _degrees(h, 0)),
    Column(name="lon_deg", kind=_N, unit="deg", meaning="longitude, WGS84",
           of=lambda h: _degrees(h, 1)),
    Column(name="alt_m", kind=_N, unit="m", meaning="height over `alt_datum`",
           of=lambda h: _of_said(h, "alt_m")),
    Column(name="alt_datum", kind=_T, unit="", meaning="`msl`, `pressure` or `geometric`",
           of=lambda h: _of_said(h, "alt_datum")),
    Column(name="relative_alt_m", kind=_N, unit="m", meaning="height above its home",
           of=lambda h: _of_said(h, "relative_alt_m")),
    Column(name="velocity_north_mps", kind=_N, unit="m/s", meaning="velocity as sent",
           of=lambda h: _level_mps(h, 0)),
    Column(name="velocity_east_mps", kind=_N, unit="m/s", meaning="velocity as sent",
           of=lambda h: _level_mps(h, 1)),
    Column(name="velocity_down_mps", kind=_N, unit="m/s", meaning="velocity as sent",
           of=lambda h: _of_said(h, "velocity_down_mps")),
    Column(name="heading_deg", kind=_N, unit="deg", meaning="from true north, as sent",
           of=lambda h: _of_said(h, "heading_deg")),
    Column(name="noise_horizontal_m", kind=_N, unit="m",
           meaning="bound on the error of the position in the plane",
           of=lambda h: _of_noise(h, "horizontal_m")),
    Column(name="noise_vertical_m", kind=_N, unit="m", meaning="bound on the error of the height",
           of=lambda h: _of_noise(h, "vertical_m")),
    Column(name="noise_velocity_mps", kind=_N, unit="m/s",
           meaning="bound on the error of the velocity", of=lambda h: _of_noise(h, "velocity_mps")),
    Column(name="noise_time_s", kind=_N, unit="s",
           meaning="what the UAV's own lag leaves of error in `true_utc`",
           of=lambda h: _of_noise(h, "time_s")),
    Column(name="dt_s", kind=_N, unit="s", meaning="interval since the UAV's report before",
           of=lambda h: _of_estimate(h, "dt_s")),
    Column(name="innovation_m", kind=_N, unit="m",
           meaning="from where the UAV was expected to where it says it is",
           of=lambda h: _of_estimate(h, "innovation_m")),
    Column(name="bound_m", kind=_N, unit="m", meaning="bound on the error of that expectation",
           of=lambda h: _of_estimate(h, "bound_m")),
    Column(name="reacquired", kind=_TRUTH, unit="",
           meaning="whether the track was begun again with it",
           of=lambda h: h.estimate is not None and h.estimate.reacquired),
))
# fmt: on
