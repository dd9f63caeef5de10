"""Values of a fleet: what the nodes of a site tell one another, and what each is to do."""

from dataclasses import dataclass
from typing import NamedTuple

from companion.values.events import RoundTrip


class SharedFrame(NamedTuple):
    """A frame that a node heard: when, on that node's timeline, and its bytes."""

    heard_ns: int
    raw: bytes


@dataclass(frozen=True, slots=True)
class Shared:
    """What a node heard of late and tells the others; times are on its own timeline.

    told_ns  when it tells
    frames   frames from vehicles, in the order in which they came
    trips    answers of vehicles to its TIMESYNC requests
    """

    told_ns: int
    frames: tuple[SharedFrame, ...] = ()
    trips: tuple[RoundTrip, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Offer:
    """What a node's array would have towards a UAV, if it served it alone.

    uav        the UAV's name
    sure_db    gain that is guaranteed wherever the UAV is; None: none
    likely_db  gain towards where it usually is; None: none
    sinr_db    signal over noise at that UAV with all of the power, of the gain that is guaranteed,
               or else of the likely one; None: neither
    heard_s    how long ago the node itself heard it; None: never
    """

    uav: str
    sure_db: float | None
    likely_db: float | None
    sinr_db: float | None
    heard_s: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Standing:
    """What a node says of itself, some times a second.

    node       its name
    started_ns when it started, on its own timeline: another start is another life
    t_ns       when it says so, on its own timeline
    place      of its array: latitude and longitude in degrees, height above mean sea level in
               metres; None: not known
    reach_m    distance of the farthest UAV that it hears itself; None: none
    most       UAVs that it serves at most
    serves     UAVs that it serves, each with its worth when it was claimed, dB
    handing    UAVs that it serves until another node takes them: the UAV, and that node
    """

    node: str
    started_ns: int
    t_ns: int
    place: tuple[float, float, float] | None
    reach_m: float | None
    most: int
    serves: tuple[tuple[str, float], ...]
    handing: tuple[tuple[str, str], ...] = ()
