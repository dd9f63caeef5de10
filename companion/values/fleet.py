"""Values of a fleet: what the nodes of a site tell one another, and what each is to do."""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

from companion.values.described import Meaning
from companion.values.events import RoundTrip


class SharedFrame(NamedTuple):
    """A frame that a node heard: when, on that node's timeline, and its bytes."""

    heard_ns: int
    raw: bytes


@dataclass(frozen=True, slots=True)
class Shared:
    """What a node heard of late and tells the others; times are on its own timeline."""

    told_ns: int  # when it tells
    frames: tuple[SharedFrame, ...] = ()  # frames from vehicles, in the order in which they came
    trips: tuple[RoundTrip, ...] = ()  # answers of vehicles to its TIMESYNC requests


@dataclass(frozen=True, slots=True, kw_only=True)
class Offer:
    """What a node's array would offer a UAV, if it served that UAV alone."""

    uav: Annotated[str, Meaning("UAV of the offer", 1)]
    sure_db: Annotated[float | None, Meaning("gain guaranteed wherever the UAV is; null: none", 2)]
    likely_db: Annotated[float | None, Meaning("gain where the UAV usually is; null: none", 3)]
    sinr_db: Annotated[
        float | None,
        Meaning(
            "SNR at the UAV with full power and the guaranteed gain, or else the likely gain", 4
        ),
    ]
    heard_s: Annotated[
        float | None, Meaning("time since that node itself received the UAV; null: never", 5)
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Standing:
    """What a node says of itself, some times a second.

    node       its name
    place      of its array: latitude and longitude in degrees, height above mean sea level in
               metres; None: not known
    reach_m    distance of the farthest UAV that it hears itself; None: none
    most       UAVs that it serves at most
    serves     UAVs that it serves, each with its worth when it was claimed, dB
    handing    UAVs that it serves until another node takes them: the UAV, and that node
    """

    node: str
    place: tuple[float, float, float] | None
    reach_m: float | None
    most: int
    serves: tuple[tuple[str, float], ...]
    handing: tuple[tuple[str, str], ...] = ()
