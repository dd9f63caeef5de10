"""Relation between the node's wall clock and its timeline."""

from dataclasses import dataclass
from typing import Annotated, NewType

from companion.values.described import Meaning

UtcNs = NewType("UtcNs", int)
"""UTC time, ns since the Unix epoch, by the wall clock as last set."""


@dataclass(frozen=True, slots=True)
class ClockSet:
    """Step of the node's wall clock, as by NTP; the node's timeline did not step."""

    t_ns: Annotated[int, Meaning("when the change was noticed", 1)]
    utc_offset_ns: Annotated[
        int, Meaning("UTC minus the node's timeline, from then on", 2, wire="sfixed64")
    ]
