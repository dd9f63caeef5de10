"""What the node's wall clock has to do with its timeline."""

from dataclasses import dataclass
from typing import Annotated, NewType

from companion.values.described import Meaning

UtcNs = NewType("UtcNs", int)
"""A time in UTC, ns since the Unix epoch, by the wall clock as it was set last."""


@dataclass(frozen=True, slots=True)
class ClockSet:
    """The node's wall clock was set, as by NTP; the node's timeline went on."""

    t_ns: Annotated[int, Meaning("when the change was noticed", 1)]
    utc_offset_ns: Annotated[
        int, Meaning("UTC minus the node's timeline, from then on", 2, wire="sfixed64")
    ]
