"""The links over which predictors are compared: what each does to a vehicle's messages.

A radio thins every kind of message to a rate, loses some, and delays each by a lognormal time of
its own, so that they overtake one another. What the hostile link does is in ``hostile_link``.
"""

import math
from dataclasses import dataclass
from typing import Final

from companion.values import UserError


@dataclass(frozen=True, slots=True, kw_only=True)
class RadioLink:
    """What a link does to messages.

        latency_s    median and 95th percentile of the added latency; None: none is added
        known_delay  the sender's clock is known as well as over the log's own link, as by TIMESYNC

    Noise that is added is cut off at ``NOISE_MOST`` deviations, and the receiver's accuracy says
    that it is there.

    Raises ``UserError`` for values out of range.
    """

    name: str  # its name in tables
    rate_hz: float | None = None  # rate to which each kind is thinned; None: as in the log
    latency_s: tuple[float, float] | None = None
    loss: float = 0.0  # share of messages that never arrive
    known_delay: bool = False
    hostile: bool = False  # latency as in hostile_link instead
    noise_m: float = 0.0  # deviation, each axis, of what is added to reported positions
    noise_mps: float = 0.0  # the same of velocities

    def __post_init__(self) -> None:
        if self.rate_hz is not None and not 0 < self.rate_hz < math.inf:
            raise UserError(f"a rate is a positive number of Hz, not {self.rate_hz}")
        if self.latency_s is not None and not 0 < self.latency_s[0] <= self.latency_s[1] < math.inf:
            raise UserError(
                "a latency is MEDIAN,P95 in seconds, 0 < MEDIAN <= P95, not {:g},{:g}".format(
                    *self.latency_s
                )
            )
        if not 0 <= self.loss < 1:
            raise UserError(f"a loss is at least 0 and below 1, not {self.loss}")

    @property
    def as_logged(self) -> bool:
        """Whether the link leaves everything as it was."""
        return self == RadioLink(name=self.name)


CLEAN: Final = RadioLink(name="clean")  # the log's own link
RADIO: Final = RadioLink(name="radio", rate_hz=1.2, latency_s=(0.6, 2.2), loss=0.1)
"""A slow telemetry radio."""
HOSTILE: Final = RadioLink(name="hostile", hostile=True)
"""The log's own rate, and a latency that does everything that a latency can do."""
NOISY: Final = RadioLink(
    name="noisy", rate_hz=1.25, latency_s=(0.7, 1.0), noise_m=0.9, noise_mps=0.25
)
"""Long intervals and a poor receiver, as real logs have them: a report each 0.8 s, off by 1.4 m."""
LINKS: Final = (CLEAN, RADIO, HOSTILE, NOISY)
NOISE_MOST: Final = 1.7
"""Deviations of each axis at which added noise is cut off: 3 of them for all three together."""
