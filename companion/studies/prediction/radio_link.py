"""Links over which predictors are compared: the effect of each on a vehicle's messages.

A radio thins every kind of message to a rate, loses some, and delays each by an independent
lognormal time, so that they overtake one another. ``hostile_link`` defines the regimes of the
hostile link.
"""

import math
from dataclasses import dataclass
from typing import Final

from companion.values import UserError


@dataclass(frozen=True, slots=True, kw_only=True)
class RadioLink:
    """Effect of a radio link on messages.

        latency_s    median and 95th percentile of the added latency; None: no latency is added
        known_delay  the sender's clock is known as well as over the log's own link, as by TIMESYNC

    Added noise is clipped at ``NOISE_MOST`` deviations, and the receiver's stated accuracy includes
    it.

    Raises ``UserError`` for values out of range.
    """

    name: str  # its name in tables
    rate_hz: float | None = None  # rate to which each kind is thinned; None: as in the log
    latency_s: tuple[float, float] | None = None
    loss: float = 0.0  # share of messages that never arrive
    known_delay: bool = False
    hostile: bool = False  # latency as in hostile_link instead
    noise_m: float = 0.0  # deviation, per axis, of the noise added to reported positions
    noise_mps: float = 0.0  # the same for velocities

    def __post_init__(self) -> None:
        if self.rate_hz is not None and not 0 < self.rate_hz < math.inf:
            raise UserError(f"rate is {self.rate_hz}; give a positive number of Hz")
        if self.latency_s is not None and not 0 < self.latency_s[0] <= self.latency_s[1] < math.inf:
            raise UserError(
                "latency is {:g},{:g}; give MEDIAN,P95 in seconds, 0 < MEDIAN <= P95".format(
                    *self.latency_s
                )
            )
        if not 0 <= self.loss < 1:
            raise UserError(f"loss is {self.loss}; give a share from 0 to below 1")

    @property
    def as_logged(self) -> bool:
        """Whether the link leaves the log's messages unchanged."""
        return self == RadioLink(name=self.name)


CLEAN: Final = RadioLink(name="clean")  # the log's own link
RADIO: Final = RadioLink(name="radio", rate_hz=1.2, latency_s=(0.6, 2.2), loss=0.1)
"""Link of a slow telemetry radio."""
HOSTILE: Final = RadioLink(name="hostile", hostile=True)
"""Link at the log's own rate whose latency changes in many ways."""
NOISY: Final = RadioLink(
    name="noisy", rate_hz=1.25, latency_s=(0.7, 1.0), noise_m=0.9, noise_mps=0.25
)
"""Link with long intervals and a poor receiver: a report per 0.8 s, errors of 1.4 m."""
LINKS: Final = (CLEAN, RADIO, HOSTILE, NOISY)
NOISE_MOST: Final = 1.7
"""Limit of added noise in deviations per axis, so that all three axes together stay below 3."""
