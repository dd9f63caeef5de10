"""Everything that drives the pipeline: frames, and what the node itself adds to them."""

from dataclasses import dataclass
from typing import Final

from companion.values.clock import ClockSet
from companion.values.names import Source
from companion.values.received import Frame
from companion.values.rejections import Rejection


@dataclass(frozen=True, slots=True)
class Tick:
    """The timer event at which beams are due.

    t_ns    when
    in_two  whether UAVs are predicted now alone, and the beams come with an event of their own,
            ``Tock``: what is received while they are made is taken in between
    """

    t_ns: int
    in_two: bool = False


@dataclass(frozen=True, slots=True)
class Tock:
    """The beams of the tick before, which came in two, are made; when."""

    t_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundTrip:
    """A TIMESYNC request sent by this node, and its answer.

    t_ns       when the answer was received, node time
    source     who answered
    sent_ns    when the request was sent, node time
    remote_ns  the sender's clock since boot, read at some time between ``sent_ns`` and ``t_ns``
    """

    t_ns: int
    source: Source
    sent_ns: int
    remote_ns: int


DUTY_MAX: Final = 10_000
"""Most UAVs that a duty serves, and most that it spares."""


@dataclass(frozen=True, slots=True)
class Duty:
    """The UAVs that this node serves from now on, and those that it spares; an event.

    t_ns    since when, node time
    serves  UAVs that get a beam
    spares  UAVs that another node serves, on which beams are to have nulls
    """

    t_ns: int
    serves: tuple[str, ...]
    spares: tuple[str, ...] = ()


Event = Frame | Tick | Tock | Rejection | RoundTrip | ClockSet | Duty
"""Everything that drives the pipeline, in the order in which it was taken in.

That is the order of time, but that a frame's time is its arrival: where the node was busy, a tick
of a later time may have been taken in before it.

A rejection made while framing is an event too: its bytes are gone, but that they came must be
recorded. A round trip is an event because only the service knows which requests were its own; a
clock that was set, because a replay is to say the times that the service said; a duty, because it
is decided with other nodes.
"""
