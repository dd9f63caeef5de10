"""Everything that drives the pipeline: frames, and what the node itself adds to them."""

from dataclasses import dataclass
from typing import Annotated, Final

from companion.values.clock import ClockSet
from companion.values.described import Meaning
from companion.values.names import Source
from companion.values.received import Frame
from companion.values.rejections import Rejection


@dataclass(frozen=True, slots=True)
class Tick:
    """The timer event at which beams are due."""

    t_ns: Annotated[int, Meaning("when beams are due", 1)]
    in_two: Annotated[
        bool,
        Meaning(
            "whether this tick only predicts the UAVs; the beams follow with a Tock, after the "
            "frames received meanwhile",
            2,
        ),
    ] = False


@dataclass(frozen=True, slots=True)
class Tock:
    """The beams of the preceding split tick are computed."""

    t_ns: Annotated[int, Meaning("when they are computed", 1)]


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundTrip:
    """A TIMESYNC request sent by this node, and its answer."""

    t_ns: Annotated[int, Meaning("when the answer was received", 1)]
    source: Annotated[Source, Meaning("component that answered", 2)]
    sent_ns: Annotated[int, Meaning("when the request was sent", 4)]
    remote_ns: Annotated[
        int,
        Meaning(
            "clock since boot of the component, read between the request and the answer",
            5,
            wire="sfixed64",
        ),
    ]


DUTY_MAX: Final = 10_000  # most UAVs that a duty serves, and most that it spares


@dataclass(frozen=True, slots=True)
class Duty:
    """The UAVs that this node of a fleet serves from now on, and those that it protects."""

    t_ns: Annotated[int, Meaning("when the duty begins", 1)]
    serves: Annotated[tuple[str, ...], Meaning("UAVs that get a beam", 2)]
    spares: Annotated[
        tuple[str, ...], Meaning("UAVs of other nodes, on which beams have nulls", 3)
    ] = ()


Event = Frame | Tick | Tock | Rejection | RoundTrip | ClockSet | Duty
"""Everything that drives the pipeline, in the order in which it was taken in.

That is the order of time, but that a frame's time is its arrival: where the node was busy, a tick
of a later time may have been taken in before it.

A rejection made while framing is an event too: its bytes are gone, but that they came must be
recorded. A round trip is an event because only the service knows which requests were its own; a
clock that was set, because a replay is to say the times that the service said; a duty, because it
is decided with other nodes.
"""
