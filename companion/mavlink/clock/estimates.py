"""Values of a sender's clock: what is assumed of it, what is known of it, how it changed."""

import math
from dataclasses import dataclass
from typing import Annotated

from companion.values.described import DescribedEnum, Meaning


class ClockKind(DescribedEnum):
    """The evidence from which a sender's clock is estimated."""

    TIMESYNC = "timesync", "TIMESYNC round trips"
    GNSS = "gnss", "SYSTEM_TIME of a GNSS receiver"
    ENVELOPE = "envelope", "time stamps and arrivals of its frames alone"


class Guarantee(DescribedEnum):
    """Whether both ends of a clock's interval were measured."""

    MEASURED = "measured", "both ends were measured"
    ASSUMED = "assumed", "one end is assumed"


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockAssumptions:
    """What is assumed of a sender's clock and its link.

    node_utc_error_s  bound on the node's distance from UTC; None: its timeline is not UTC
    """

    constant_delay_s: float = 0.0  # known smallest latency, which stamps alone cannot show
    trust_gnss: bool = False  # use SYSTEM_TIME, if node_utc_error_s is known
    node_utc_error_s: float | None = None
    gnss_error_s: float = 0.02  # bound on the sender's distance from UTC
    window_s: float = 60.0  # how far back latencies are sampled
    drift_max_ppm: float = 250.0  # greatest drift taken for possible
    late_max_s: float = 10.0  # greatest lateness of any frame

    def __post_init__(self) -> None:
        if not 0.0 <= self.constant_delay_s < math.inf:
            raise ValueError(f"constant_delay_s is {self.constant_delay_s}, allowed: at least 0")
        if not 1.0 <= self.window_s <= 3600.0:
            raise ValueError(f"window_s is {self.window_s}, allowed: 1 to 3600")
        if not 0.0 <= self.drift_max_ppm <= 20_000.0:
            raise ValueError(f"drift_max_ppm is {self.drift_max_ppm}, allowed: 0 to 20000")


@dataclass(frozen=True, slots=True)
class Stamp:
    """A stamp placed on the sender's and the node's timelines.

    sender_ns  the sender's time since boot, past the wrap of its 32-bit milliseconds; it begins
               anew after a reboot
    latency_s  how long before its arrival the stamp was made, by all that is known now; at
               least 0
    rebooted   True once, at the stamp that confirms a reboot
    """

    sender_ns: int
    latency_s: float
    rebooted: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockEstimate:
    """A sender's clock against the node's."""

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
    """A change of a sender's clock, or of its link, beyond what was taken for possible.

    proven     whether evidence from both sides proves that the clock changed; else all frames are
               late by that much, by the clock or by the link
    step_s     by how much, seconds
    drift_ppm  drift that this amounts to; inf where it is too quick for a drift
    leapt      whether it is more than any frame is taken to be late: the clock's, by assumption
    """

    proven: bool
    step_s: float
    drift_ppm: float
    leapt: bool = False
