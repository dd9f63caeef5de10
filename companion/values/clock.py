"""What the node's wall clock has to do with its timeline."""

from dataclasses import dataclass
from typing import NewType

UtcNs = NewType("UtcNs", int)
"""A time in UTC, ns since the Unix epoch, by the wall clock as it was set last."""


@dataclass(frozen=True, slots=True)
class ClockSet:
    """The node's wall clock was set, as by NTP; the node's timeline went on.

    t_ns           when that was noticed, node time
    utc_offset_ns  UTC less the node's timeline, from now on
    """

    t_ns: int
    utc_offset_ns: int
