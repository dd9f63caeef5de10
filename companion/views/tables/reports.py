"""Table of reports: every received position, used or not."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np

from companion.mavlink.wire.decode import decode
from companion.mavlink.wire.positions import POSITIONS
from companion.recording.tables.columns import Table
from companion.tracking.geodesy import Place
from companion.values import (
    AdsbVehicle,
    AltitudeDatum,
    Estimate,
    FloatArray,
    Frame,
    Output,
    Rejection,
    RemoteId,
    Report,
    ReportNoise,
)
from companion.values.described import Inline, Meaning


@dataclass(frozen=True, kw_only=True)
class Heard:
    """Received report, with its estimate if it was used, else with the reason.

    ``said`` is None if the message could not be decoded.
    """

    frame: Frame
    estimate: Annotated[Estimate | None, Inline(omit=("reacquired",))]
    refused: Rejection | None
    said: Report | AdsbVehicle | None

    @property
    def arrival_ns(self) -> Annotated[int, Meaning("arrival time of the message")]:
        return self.frame.t_ns

    @property
    def uav(self) -> Annotated[str, Meaning("UAV whose position it is")]:
        if self.said is not None:
            return self.said.uav
        return self.refused.source if self.refused is not None else str(self.frame.source)

    @property
    def message(self) -> Annotated[str, Meaning("name of the MAVLink message")]:
        return POSITIONS[self.frame.msgid].name

    @property
    def link(self) -> Annotated[str, Meaning("link or log over which it arrived")]:
        return self.frame.link

    @property
    def sender(self) -> Annotated[str, Meaning("sender of the message: the UAV, or a relay")]:
        return str(self.frame.source)

    @property
    def accepted(self) -> Annotated[bool, Meaning("whether it was used")]:
        return self.estimate is not None

    @property
    def reason(self) -> Annotated[str | None, Meaning("why the data was not used")]:
        return None if self.refused is None else self.refused.reason

    @property
    def detail(
        self,
    ) -> Annotated[str | None, Meaning("explanation of the rejection, with its numbers")]:
        return None if self.refused is None else self.refused.detail

    @property
    def true_ns(
        self,
    ) -> Annotated[int | None, Meaning("when the position was true, by the sender's clock")]:
        return None if self.estimate is None else self.estimate.fix.t_ns

    @property
    def latency_s(self) -> Annotated[float | None, Meaning("time from `true_utc` to the arrival")]:
        return None if self.true_ns is None else (self.frame.t_ns - self.true_ns) * 1e-9

    @property
    def boot_s(self) -> Annotated[float | None, Meaning("the sender's clock since boot, as sent")]:
        boot_ms = self._number("boot_ms")
        return None if boot_ms is None else boot_ms / 1000

    @property
    def position(self) -> Annotated[Place | None, Inline(omit=("alt_m",))]:
        if isinstance(self.said, Report):
            return Place(self.said.lat_deg, self.said.lon_deg, self.said.alt_m)
        known = None if self.said is None else self.said.position_deg
        return None if known is None else Place(*known, 0.0)

    @property
    def alt_m(self) -> Annotated[float | None, Meaning("altitude above `alt_datum`")]:
        return self._number("alt_m")

    @property
    def alt_datum(
        self,
    ) -> Annotated[AltitudeDatum | None, Meaning("what `alt_m` is measured from")]:
        return None if self.said is None else self.said.alt_datum

    @property
    def relative_alt_m(self) -> Annotated[float | None, Meaning("height above its home")]:
        return self._number("relative_alt_m")

    @property
    def velocity_ned_mps(self) -> Annotated[FloatArray | None, Meaning("velocity as sent")]:
        if self.said is None:
            return None
        down_mps = self.said.velocity_down_mps
        level_mps = self.said.velocity_ne_mps or (math.nan, math.nan)
        return np.array([*level_mps, math.nan if down_mps is None else down_mps])

    @property
    def heading_deg(self) -> Annotated[float | None, Meaning("heading from true north, as sent")]:
        return self._number("heading_deg")

    @property
    def tslc_s(
        self,
    ) -> Annotated[float | None, Meaning("age of the position as a relay states it")]:
        return self._number("tslc_s")

    @property
    def reacquired(self) -> Annotated[bool, Meaning("whether this report restarted the track")]:
        return self.estimate is not None and self.estimate.reacquired

    @property
    def noise(self) -> Annotated[ReportNoise | None, Inline(prefix="noise_")]:
        return None if self.estimate is None else self.estimate.fix.noise

    def _number(self, name: str) -> float | None:
        return getattr(self.said, name, None)


def heard(frame: Frame, outputs: Sequence[Output]) -> Heard | None:
    """Return the report in a frame, with its outcome; None if the frame contains no report."""
    if frame.msgid not in POSITIONS:
        return None
    for output in outputs:
        if isinstance(output, Estimate):
            return Heard(frame=frame, estimate=output, refused=None, said=output.fix.report)
    refused = next((one for one in outputs if isinstance(one, Rejection)), None)
    said = decode(frame)
    if isinstance(said, RemoteId):  # the rejection names the aircraft if it is known
        report, named = said.report, None if refused is None else refused.source
        said = report._replace(uav=named) if report is not None and named is not None else report
    if refused is None and said is None:  # this message may contain a report, but did not
        return None
    return Heard(
        frame=frame,
        estimate=None,
        refused=refused,
        said=said if isinstance(said, Report | AdsbVehicle) else None,
    )


REPORTS: Final = Table(
    name="reports", row_is="a received report, from any message", row_class=Heard
)
