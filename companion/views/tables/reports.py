"""The table of reports: every position that was received, used or not."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from companion.mavlink.wire.decode import decode
from companion.mavlink.wire.positions import POSITIONS
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


@dataclass(frozen=True, slots=True)
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
    if frame.msgid not in POSITIONS:
        return None
    for output in outputs:
        if isinstance(output, Estimate):
            return Heard(frame, output, None, output.fix.report)
    refused = next((one for one in outputs if isinstance(one, Rejection)), None)
    said = decode(frame)
    if isinstance(
        said, RemoteId
    ):  # what it was refused for names its aircraft, where that is known
        report, named = said.report, None if refused is None else refused.source
        said = replace(report, uav=named) if report is not None and named is not None else report
    if refused is None and said is None:  # a message that may be a report, and was none
        return None
    return Heard(frame, None, refused, said if isinstance(said, Report | AdsbVehicle) else None)


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
    Column("arrival_ns", _INT, "ns", "when it arrived, since 1970", lambda h: h.frame.t_ns),
    Column("arrival_utc", _TIME, "UTC", "the same", lambda h: h.frame.t_ns),
    Column("uav", _T, "", "whose position it is", lambda h: h.uav),
    Column("message", _T, "", "the MAVLink message", lambda h: POSITIONS[h.frame.msgid].name),
    Column("link", _T, "", "the link, or the log, over which it came", lambda h: h.frame.link),
    Column("sender", _T, "", "who sent the message: the UAV, or who relays it",
           lambda h: h.frame.source),
    Column("accepted", _TRUTH, "", "whether it was used", lambda h: h.estimate is not None),
    Column("reason", _T, "", "why it was not used",
           lambda h: None if h.refused is None else h.refused.reason),
    Column("detail", _T, "", "more of that", lambda h: h.refused and h.refused.detail),
    Column("true_utc", _TIME, "UTC", "when the position was true, by the sender's clock", _true_ns),
    Column("latency_s", _N, "s", "from then to the arrival", _latency_s),
    Column("boot_s", _N, "s", "the sender's clock since boot, as sent", _boot_s),
    Column("tslc_s", _N, "s", "age of the position as a relay says",
           lambda h: _of_said(h, "tslc_s")),
    Column("lat_deg", _N, "deg", "latitude, WGS84", lambda h: _degrees(h, 0)),
    Column("lon_deg", _N, "deg", "longitude, WGS84", lambda h: _degrees(h, 1)),
    Column("alt_m", _N, "m", "height over `alt_datum`", lambda h: _of_said(h, "alt_m")),
    Column("alt_datum", _T, "", "`msl`, `pressure` or `geometric`",
           lambda h: _of_said(h, "alt_datum")),
    Column("relative_alt_m", _N, "m", "height above its home",
           lambda h: _of_said(h, "relative_alt_m")),
    Column("velocity_north_mps", _N, "m/s", "velocity as sent", lambda h: _level_mps(h, 0)),
    Column("velocity_east_mps", _N, "m/s", "velocity as sent", lambda h: _level_mps(h, 1)),
    Column("velocity_down_mps", _N, "m/s", "velocity as sent",
           lambda h: _of_said(h, "velocity_down_mps")),
    Column("heading_deg", _N, "deg", "from true north, as sent",
           lambda h: _of_said(h, "heading_deg")),
    Column("noise_horizontal_m", _N, "m", "bound on the error of the position in the plane",
           lambda h: _of_noise(h, "horizontal_m")),
    Column("noise_vertical_m", _N, "m", "bound on the error of the height",
           lambda h: _of_noise(h, "vertical_m")),
    Column("noise_velocity_mps", _N, "m/s", "bound on the error of the velocity",
           lambda h: _of_noise(h, "velocity_mps")),
    Column("noise_time_s", _N, "s", "what the UAV's own lag leaves of error in `true_utc`",
           lambda h: _of_noise(h, "time_s")),
    Column("dt_s", _N, "s", "interval since the UAV's report before",
           lambda h: _of_estimate(h, "dt_s")),
    Column("innovation_m", _N, "m", "from where the UAV was expected to where it says it is",
           lambda h: _of_estimate(h, "innovation_m")),
    Column("bound_m", _N, "m", "bound on the error of that expectation",
           lambda h: _of_estimate(h, "bound_m")),
    Column("reacquired", _TRUTH, "", "whether the track was begun again with it",
           lambda h: h.estimate is not None and h.estimate.reacquired),
))
# fmt: on
