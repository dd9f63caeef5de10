"""Values of a fleet: the messages that nodes exchange."""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

from companion.values.described import Meaning
from companion.values.events import RoundTrip


class SharedFrame(NamedTuple):
    """Frame that another node received: its arrival on that node's timeline, and its bytes."""

    heard_ns: int
    raw: bytes


@dataclass(frozen=True, slots=True)
class Shared:
    """Recent frames and round trips that a node shares; times on the node's own timeline."""

    told_ns: int  # when it was published
    frames: tuple[SharedFrame, ...] = ()  # frames from vehicles, in the order of arrival
    trips: tuple[RoundTrip, ...] = ()  # answers of vehicles to its TIMESYNC requests


@dataclass(frozen=True, slots=True, kw_only=True)
class Offer:
    """Gain and SNR that a node's array would give a UAV if it served that UAV alone."""

    uav: Annotated[str, Meaning("UAV of the offer", 1)]
    sure_db: Annotated[
        float | None, Meaning("guaranteed gain within the pointing bound; null: none", 2)
    ]
    likely_db: Annotated[
        float | None, Meaning("gain within the usual pointing error; null: none", 3)
    ]
    sinr_db: Annotated[
        float | None,
        Meaning(
            "SNR at the UAV with full power and the guaranteed gain, else with the likely gain", 4
        ),
    ]
    heard_s: Annotated[
        float | None, Meaning("time since that node itself received the UAV; null: never", 5)
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Standing:
    """Status message that a node publishes a few times a second.

    node       its name
    place      of its array: latitude and longitude in degrees, height above mean sea level in
               metres; None if unknown
    reach_m    distance of the farthest UAV that it receives itself; None without one
    most       largest number of UAVs that it serves
    serves     UAVs that it serves, each with its value when it was claimed, dB
    handing    handovers in progress: the UAV, and the node that takes it over
    """

    node: str
    place: tuple[float, float, float] | None
    reach_m: float | None
    most: int
    serves: tuple[tuple[str, float], ...]
    handing: tuple[tuple[str, str], ...] = ()
