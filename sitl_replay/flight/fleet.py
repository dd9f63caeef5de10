"""Vehicles: who they are, how often they send, and the scenarios that they make up."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Final

from companion.tracking.geodesy import Place
from companion.values import Source, UserError
from sitl_replay.flight.motion import Hover, Motion, Pose, Sway
from sitl_replay.flight.relay import Aircraft

MAX_UAVS = 1000

ORIGIN = Place(47.3977419, 8.5455938, 513.0)
HOME_ALT_M = ORIGIN.alt_m - 25.0

# System ids are 1 to 250 without the carrier's; those above are left to ground stations (255) and
# to what else people number from the top. Once they are used up, component ids count on.
CARRIER_SYSID: Final = 5
HIGHEST_SYSID: Final = 250
UAV_SYSIDS: Final = tuple(n for n in range(1, HIGHEST_SYSID + 1) if n != CARRIER_SYSID)


class Airframe(Enum):
    """HEARTBEAT's account of a vehicle: its MAV_TYPE, and ArduPilot's guided mode for it."""

    COPTER = (2, 4)
    PLANE = (1, 15)

    @property
    def mav_type(self) -> int:
        return self.value[0]

    @property
    def guided_mode(self) -> int:
        return self.value[1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Vehicle:
    """One vehicle: who it is, how it moves, and how often it sends what."""

    source: Source  # its system and component id
    trajectory: Callable[[float], Motion]  # position and velocity at a time
    attitude: Callable[[float], Pose]  # attitude and body rates at a time
    report_interval_s: float  # of GLOBAL_POSITION_INT
    attitude_interval_s: float  # of ATTITUDE
    uptime_ms: int  # its boot clock when the scenario starts
    heartbeat_interval_s: float = 1.0  # of HEARTBEAT
    gnss_interval_s: float = 0.5  # of GPS_RAW_INT
    clock_interval_s: float = 1.0  # of SYSTEM_TIME
    airframe: Airframe = Airframe.COPTER  # copter or plane
    hears: tuple[Aircraft, ...] = ()  # the aircraft that its ADS-B receiver relays
    twin: int = 0  # tells vehicles apart that send under one source; 0 where there is no other

    @property
    def name(self) -> str:
        return f"{self.source}/{self.twin}" if self.twin else str(self.source)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """A carrier at ``origin`` and the UAVs about it.

    ``home_alt_m`` is the height from which relative heights are measured.
    """

    name: str
    description: str
    origin: Place
    home_alt_m: float
    carrier: Vehicle
    uavs: tuple[Vehicle, ...]

    @property
    def vehicles(self) -> tuple[Vehicle, ...]:
        """The carrier first, then the UAVs."""
        return (self.carrier, *self.uavs)

    def truth(self, uav: Source | str, t_s: float) -> tuple[Motion, ...]:
        """True motions of everything under an id, ``3:1`` or ``icao:F00001``, at a time.

        One motion, NED from the carrier; several where vehicles share the id; none where nobody has
        it.
        """
        wanted = str(uav)
        aircraft = {craft.icao: craft for one in self.vehicles for craft in one.hears}
        movers: tuple[Vehicle | Aircraft, ...] = (*self.vehicles, *aircraft.values())
        return tuple(one.trajectory(t_s) for one in movers if wanted == _uav_id(one))


def _uav_id(mover: Vehicle | Aircraft) -> str:
    return str(mover.source) if isinstance(mover, Vehicle) else str(mover)


CARRIER = Vehicle(
    source=Source(CARRIER_SYSID, 1),
    trajectory=Hover((0.0, 0.0, 0.0)),
    attitude=Sway(),
    report_interval_s=0.1,
    attitude_interval_s=0.05,
    uptime_ms=754_321,
)


def uav_source(index: int) -> Source:
    """The id of a UAV, counted from 0: 1:1, 2:1 and so on to 250:1, then 1:2."""
    component, system = divmod(index, len(UAV_SYSIDS))
    return Source(UAV_SYSIDS[system], component + 1)


def uptime_ms(index: int) -> int:
    """The boot clock of a UAV when the scenario starts: no two booted at the same time."""
    return 61_007 + 37_219 * index


def around_carrier(name: str, description: str, uavs: tuple[Vehicle, ...]) -> Scenario:
    """A scenario at the usual place with the usual carrier."""
    return Scenario(
        name=name,
        description=description,
        origin=ORIGIN,
        home_alt_m=HOME_ALT_M,
        carrier=CARRIER,
        uavs=uavs,
    )


def checked(uavs: int, fewest: int = 1) -> int:
    """``uavs`` as it is. Raises ``UserError`` where it is not ``fewest`` to ``MAX_UAVS``."""
    if not fewest <= uavs <= MAX_UAVS:
        raise UserError(f"{uavs} UAVs: {fewest} to {MAX_UAVS} can fly")
    return uavs
