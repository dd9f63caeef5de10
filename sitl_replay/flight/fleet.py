"""Vehicles, the intervals of their messages, and scenarios of vehicles."""

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

# System ids are 1 to 250 without the carrier's; higher ones are for ground stations (255) and the
# like. Further UAVs have the next component id.
CARRIER_SYSID: Final = 5
HIGHEST_SYSID: Final = 250
UAV_SYSIDS: Final = tuple(n for n in range(1, HIGHEST_SYSID + 1) if n != CARRIER_SYSID)


class Airframe(Enum):
    """Kind of vehicle, as in HEARTBEAT: MAV_TYPE, and the number of ArduPilot's guided mode."""

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
    """Vehicle of a scenario: id, motion, and message intervals."""

    source: Source  # system and component id
    trajectory: Callable[[float], Motion]  # position and velocity at a time
    attitude: Callable[[float], Pose]  # attitude and body rates at a time
    report_interval_s: float  # of GLOBAL_POSITION_INT
    attitude_interval_s: float  # of ATTITUDE
    uptime_ms: int  # boot clock at the start of the scenario
    heartbeat_interval_s: float = 1.0  # of HEARTBEAT
    gnss_interval_s: float = 0.5  # of GPS_RAW_INT
    clock_interval_s: float = 1.0  # of SYSTEM_TIME
    airframe: Airframe = Airframe.COPTER  # copter or plane
    hears: tuple[Aircraft, ...] = ()  # aircraft that its ADS-B receiver relays
    twin: int = 0  # number among vehicles with the same source; 0: the only one

    @property
    def name(self) -> str:
        return f"{self.source}/{self.twin}" if self.twin else str(self.source)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """Scenario: a carrier at ``origin`` and the UAVs around it.

    ``home_alt_m`` is the reference of relative altitudes.
    """

    name: str
    description: str
    origin: Place
    home_alt_m: float
    carrier: Vehicle
    uavs: tuple[Vehicle, ...]

    @property
    def vehicles(self) -> tuple[Vehicle, ...]:
        """All vehicles: the carrier first, then the UAVs."""
        return (self.carrier, *self.uavs)

    def truth(self, uav: Source | str, t_s: float) -> tuple[Motion, ...]:
        """Return the true motions at a time of all vehicles with an id, ``3:1`` or ``icao:F00001``.

        Motions are NED from the carrier: several if vehicles share the id; empty if none has the
        id.
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
    """Return the id of UAV ``index`` (from 0): 1:1, 2:1 and so on to 250:1, then 1:2."""
    component, system = divmod(index, len(UAV_SYSIDS))
    return Source(UAV_SYSIDS[system], component + 1)


def uptime_ms(index: int) -> int:
    """Return the boot clock of a UAV at the scenario's start, different for every UAV."""
    return 61_007 + 37_219 * index


def around_carrier(name: str, description: str, uavs: tuple[Vehicle, ...]) -> Scenario:
    """Return a scenario at the default position with the default carrier."""
    return Scenario(
        name=name,
        description=description,
        origin=ORIGIN,
        home_alt_m=HOME_ALT_M,
        carrier=CARRIER,
        uavs=uavs,
    )


def checked(uavs: int, fewest: int = 1) -> int:
    """Return a number of UAVs. Raises ``UserError`` if it is not ``fewest`` to ``MAX_UAVS``."""
    if not fewest <= uavs <= MAX_UAVS:
        raise UserError(f"{uavs} UAVs; allowed: {fewest} to {MAX_UAVS}")
    return uavs
