"""Events that drive the pipeline: frames, and events of the node itself."""

from dataclasses import dataclass
from typing import Annotated, Final

from companion.values.clock import ClockSet
from companion.values.described import Meaning
from companion.values.names import Source
from companion.values.observed import Observation
from companion.values.received import Frame
from companion.values.rejections import Rejection


@dataclass(frozen=True, slots=True)
class Tick:
    """Timer event at which beams are due."""

    t_ns: Annotated[int, Meaning("when beams are due", 1)]
    in_two: Annotated[
        bool,
        Meaning(
            "whether this tick only predicts the UAVs; the beams follow with a Tock, after the "
            "frames received meanwhile",
            2,
        ),
    ] = False
    waited_ns: Annotated[
        int,
        Meaning(
            "time for which frames may have waited to be read by this machine when beams were due",
            3,
        ),
    ] = 0


@dataclass(frozen=True, slots=True)
class Tock:
    """Event at which the beams of the preceding split tick are ready."""

    t_ns: Annotated[int, Meaning("when they are computed", 1)]


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundTrip:
    """TIMESYNC request of this node, or of another one of its fleet, with its answer."""

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
    is_shared: Annotated[bool, Meaning("whether another node of the fleet measured it", 6)] = False


DUTY_MAX: Final = 10_000  # most UAVs that a duty serves, and most that it protects


@dataclass(frozen=True, slots=True)
class Duty:
    """UAVs that this node of a fleet serves from now on, and UAVs that it protects."""

    t_ns: Annotated[int, Meaning("when the duty begins", 1)]
    serves: Annotated[tuple[str, ...], Meaning("UAVs that get a beam", 2)]
    spares: Annotated[
        tuple[str, ...], Meaning("UAVs of other nodes, on which beams have nulls", 3)
    ] = ()


Event = Frame | Tick | Tock | Rejection | RoundTrip | ClockSet | Duty | Observation
"""Any event that drives the pipeline, in the order of processing.

Events are in order of time, with one exception: a frame's time is its arrival. If the node was
busy, a tick with a later time may precede the frame.

Framing emits rejections as events: the bytes are discarded, but their arrival must be recorded. A
round trip is an event because only the service knows its own requests. ``ClockSet`` is an event so
that a replay prints the same times as the service. A duty is an event because other nodes take part
in the decision. An observation comes from a receiver that is no part of the program.
"""
