"""Values that describe a sender's clock: assumptions, estimates and changes."""

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

from companion.values.described import DescribedEnum, Meaning


class ClockKind(DescribedEnum):
    """Kind of evidence from which a sender's clock is estimated."""

    TIMESYNC = "timesync", "TIMESYNC round trips"
    GNSS = "gnss", "SYSTEM_TIME of a GNSS receiver"
    ENVELOPE = "envelope", "time stamps and arrivals of its frames alone"


class Guarantee(DescribedEnum):
    """Whether both ends of a clock offset's interval were measured."""

    MEASURED = "measured", "both ends were measured"
    ASSUMED = "assumed", "one end is assumed"


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockAssumptions:
    """Assumptions about a sender's clock and its link.

    node_utc_error_s  bound on the difference between the node's timeline and UTC; None: unbounded
    """

    constant_delay_s: float = 0.0  # known smallest latency, which stamps alone cannot show
    trust_gnss: bool = False  # use SYSTEM_TIME, if node_utc_error_s is known
    node_utc_error_s: float | None = None
    gnss_error_s: float = 0.02  # bound on the error of the sender's UTC
    window_s: float = 60.0  # time over which latencies are sampled
    drift_max_ppm: float = 250.0  # largest drift assumed
    late_max_s: float = 10.0  # greatest lateness of any frame

    def __post_init__(self) -> None:
        if not 0.0 <= self.constant_delay_s < math.inf:
            raise ValueError(f"constant_delay_s is {self.constant_delay_s}, allowed: at least 0")
        if not 1.0 <= self.window_s <= 3600.0:
            raise ValueError(f"window_s is {self.window_s}, allowed: 1 to 3600")
        if not 0.0 <= self.drift_max_ppm <= 20_000.0:
            raise ValueError(f"drift_max_ppm is {self.drift_max_ppm}, allowed: 0 to 20000")


class Stamp(NamedTuple):
    """Stamp placed on the sender's and the node's timelines.

    sender_ns  the sender's time since boot, unwrapped past its 32-bit milliseconds; starts again
               after a reboot
    latency_s  estimated age of the stamp on arrival, at least 0
    rebooted   True once, at the stamp that confirms a reboot
    oldest_ns  earliest time at which it may have been made, node time
    """

    sender_ns: int
    latency_s: float
    rebooted: bool
    oldest_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockEstimate:
    """Estimate of a sender's clock relative to the node's clock."""

    kind: Annotated[ClockKind, Meaning("evidence that leaves the least uncertainty")]
    guarantee: Annotated[
        Guarantee,
        Meaning("whether both ends of the clock's interval were measured, or one is assumed"),
    ]
    offset_ns: int  # most likely difference, node time minus sender time
    before_s: Annotated[float, Meaning("how much earlier the sender's time may be than estimated")]
    after_s: Annotated[float, Meaning("how much later the sender's time may be than estimated")]
    drift_ppm: Annotated[
        float | None, Meaning("observed drift beyond the largest assumed; 0 where none was seen")
    ]
    constant_delay_s: Annotated[
        float | None,
        Meaning("estimated latency of the fastest frame, already subtracted from the offset"),
    ]
    latency_s: Annotated[float | None, Meaning("latency of the newest time stamp")]

    @property
    def offset_s(self) -> Annotated[float, Meaning("node time minus sender time")]:
        return self.offset_ns * 1e-9

    @property
    def uncertainty_s(self) -> Annotated[float, Meaning("bound on the error of the offset")]:
        return max(self.before_s, self.after_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockChange:
    """Change of a sender's clock, or of its link, beyond the assumed drift.

    proven     whether two-way evidence proves that the clock changed; otherwise all frames are
               late by that much, because of the clock or the link
    step_s     size of the change, seconds; negative: frames arrive earlier than all before them,
               which were late by more than was assumed
    drift_ppm  drift equivalent to the change; inf if it is too fast for a drift
    leapt      whether it exceeds the largest lateness of a frame: a clock jump, by assumption
    """

    proven: bool
    step_s: float
    drift_ppm: float
    leapt: bool = False

    @property
    def was_late(self) -> bool:
        """Whether frames before this change were later than assumed, and their bounds too small."""
        return not self.proven and not self.leapt and self.step_s < 0.0
