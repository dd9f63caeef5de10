"""Scenarios, as pure functions of time.

Each builder takes the number of UAVs (and a seed, if it uses random numbers) and returns a
``Scenario``, whose vehicles move as functions of the seconds since its start (conventions: see
``motion``). An additional UAV does not change the others, except in ``hover``, which spreads them
evenly. A builder raises ``UserError`` for an impossible number of UAVs.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

from companion.tracking.geodesy import Place
from sitl_replay.flight.fleet import (
    CARRIER,
    HOME_ALT_M,
    MAX_UAVS,
    ORIGIN,
    Scenario,
    Vehicle,
    around_carrier,
    checked,
    uptime_ms,
)
from sitl_replay.flight.flights import aircraft as aircraft_about
from sitl_replay.flight.flights import calm, circling, paired, racing, swarming, touring, uav
from sitl_replay.flight.motion import PAPER_GUST, Circle, Hover, Motion, Pose, Sway, Vector
from sitl_replay.flight.paths import Orbit

__all__ = [
    "BUILDERS",
    "CARRIER",
    "HOME_ALT_M",
    "MAX_UAVS",
    "ORIGIN",
    "Builder",
    "Circle",
    "Hover",
    "Motion",
    "Place",
    "Pose",
    "Scenario",
    "Sway",
    "Vector",
    "Vehicle",
    "adsb",
    "crossing",
    "hover",
    "mirror",
    "paper",
    "racetrack",
    "shared_id",
    "swarm",
    "waypoints",
]

# The paper's angular rate, and the speed of its fastest UAV. Circles beyond the paper's four are
# flown at that speed: at 0.5 rad/s the tenth would exceed the velocity range of
# GLOBAL_POSITION_INT (327 m/s).
PAPER_RATE_RADPS = 0.5
PAPER_TOP_SPEED_MPS = 125.0

HEIGHTS_M = (0.0, 10.0, 20.0, 30.0)


class Builder(Protocol):
    """Function that builds a scenario of ``uavs`` UAVs; ``seed`` seeds the random numbers."""

    def __call__(self, uavs: int = 4, seed: int = 0) -> Scenario:
        """Return the scenario. Raises ``UserError`` for an impossible number of UAVs."""


def paper(uavs: int = 4, gust: float = PAPER_GUST) -> Scenario:
    """The paper's UAVs on circles of 100, 150, 200, 250 m and so on around the carrier.

    Each UAV is a quarter turn from the previous one, at 0.5 rad/s (beyond four: see
    ``PAPER_TOP_SPEED_MPS``).
    """
    return around_carrier(
        "paper",
        "the paper's UAVs circling the carrier at up to 125 m/s, with gusts",
        tuple(_on_paper(index, gust) for index in range(checked(uavs))),
    )


def hover(uavs: int = 4) -> Scenario:
    """UAVs hovering within 60° of north, where a broadside array can separate them."""
    step_deg = 120.0 / max(1, uavs - 1)
    first_deg = -60.0 if uavs > 1 else 0.0
    return around_carrier(
        "hover",
        "UAVs hovering 150 to 225 m away, spread within 60 degrees of north",
        tuple(
            _hovering(index, math.radians(first_deg + step_deg * index))
            for index in range(checked(uavs))
        ),
    )


def waypoints(uavs: int = 4, seed: int = 0) -> Scenario:
    """Copters on tours of five or six waypoints each, some 200 m and more from the carrier.

    They fly at most 12 m/s and 3 m/s², 3 m/s up and down, with a stop of 4 s and a turn at each
    waypoint. Dryden turbulence at a mean wind of 6 m/s displaces them by some decimetres, at some
    dm/s.
    """
    return around_carrier(
        "waypoints",
        "copters flying between waypoints, with stops, turns, climbs and turbulent wind",
        tuple(touring(index, seed) for index in range(checked(uavs))),
    )


def racetrack(uavs: int = 4, seed: int = 0) -> Scenario:
    """Fixed wings on stadiums at 20 to 30 m/s over ground, in coordinated turns of up to 30°.

    In a mean wind of 6 m/s with Dryden turbulence, yaw differs from the course, and airspeed varies
    with the wind.
    """
    return around_carrier(
        "racetrack",
        "fixed wings on racetracks at 20 to 30 m/s, with coordinated turns and turbulent wind",
        tuple(racing(index, seed) for index in range(checked(uavs))),
    )


def crossing(uavs: int = 4) -> Scenario:
    """Pairs, one behind the other from the carrier, that swing in opposite directions.

    They fly in still air at the same elevation: when their azimuths cross, every half swing (15.7
    s), their directions are exactly equal. If the number is odd, the last UAV swings alone.
    """
    return around_carrier(
        "crossing",
        "pairs, one behind the other, whose directions from the carrier cross every 16 s",
        tuple(paired(index, mirrored=False) for index in range(checked(uavs))),
    )


def mirror(uavs: int = 4) -> Scenario:
    """Pairs as in ``crossing``, but with the second UAV behind the carrier, mirrored in its array.

    The array faces north, with elements from west to east. When a pair passes mirrored directions,
    every half swing (15.7 s), a linear array cannot separate the two.
    """
    return around_carrier(
        "mirror",
        "pairs, one before and one behind the carrier, that pass mirrored bearings every 16 s",
        tuple(paired(index, mirrored=True) for index in range(checked(uavs))),
    )


def swarm(uavs: int = 4, seed: int = 0) -> Scenario:
    """Up to 1000 copters, each on its own circle, in ten layers over 3 km by 3 km.

    The minimum distance between two is 40 m. Each copter sends 6.3 frames a second (4 reports, a
    heartbeat, an attitude, a fifth of a GPS_RAW_INT, a tenth of a SYSTEM_TIME), the carrier 34: 100
    UAVs give 664 frames a second, 1000 give 6334. Ids: 1:1 to 250:1 without the carrier's, then 1:2
    and so on.
    """
    return around_carrier(
        "swarm",
        "copters spread in three dimensions over 3 km; 1000 of them send 6300 frames a second",
        tuple(swarming(index, seed) for index in range(checked(uavs))),
    )


def adsb(uavs: int = 4, seed: int = 0) -> Scenario:
    """Copters as in ``waypoints``; 1:1 and 2:1 have ADS-B receivers and relay the same aircraft.

    3:1 has a transponder, so it has two ids, 3:1 and icao:F00006. Needs three UAVs.
    """
    fleet = [touring(index, seed) for index in range(checked(uavs, fewest=3))]
    hears = aircraft_about(fleet[2].trajectory)
    relays = [replace(one, hears=hears) for one in fleet[:2]]
    return around_carrier(
        "adsb",
        "copters, two of which relay aircraft by ADS-B; one of these aircraft is also a UAV",
        (*relays, *fleet[2:]),
    )


def shared_id(uavs: int = 4) -> Scenario:
    """Two copters about 600 m apart that both send as 1:1, with separate clocks and sequences.

    The others, from 2:1 on, have their own ids. Needs two UAVs.
    """
    west = calm(
        0, Orbit(centre_ned_m=(200.0, -300.0, -30.0), radius_m=30.0, rate_radps=0.2, phase_rad=0.0)
    )
    east = calm(
        0, Orbit(centre_ned_m=(200.0, 300.0, -40.0), radius_m=30.0, rate_radps=0.2, phase_rad=2.0)
    )
    honest = (circling(index) for index in range(1, checked(uavs, fewest=2) - 1))
    return around_carrier(
        "shared-id",
        "two copters 600 m apart that both send as 1:1, and others with their own ids",
        (replace(west, twin=1), replace(east, twin=2, uptime_ms=uptime_ms(MAX_UAVS)), *honest),
    )


def _unseeded(build: Callable[[int], Scenario]) -> Builder:
    """Return the builder of a scenario without random numbers, which ignores the seed."""

    def built(uavs: int = 4, seed: int = 0) -> Scenario:
        return build(uavs)

    return built


BUILDERS: dict[str, Builder] = {
    "paper": _unseeded(paper),
    "hover": _unseeded(hover),
    "waypoints": waypoints,
    "racetrack": racetrack,
    "crossing": _unseeded(crossing),
    "mirror": _unseeded(mirror),
    "swarm": swarm,
    "adsb": adsb,
    "shared-id": _unseeded(shared_id),
}


def _on_paper(index: int, gust: float) -> Vehicle:
    radius_m = 100.0 + 50.0 * index
    rate_radps = min(PAPER_RATE_RADPS, PAPER_TOP_SPEED_MPS / radius_m)
    phase_rad = index * math.pi / 2
    circle = Circle(
        radius_m=radius_m,
        rate_radps=rate_radps,
        phase_rad=phase_rad,
        height_m=HEIGHTS_M[index % len(HEIGHTS_M)],
        gust=gust,
    )
    # The heading follows the nominal velocity, whose course is −(ωt+φ).
    return uav(
        index,
        circle,
        Sway(heading_rad=-phase_rad, turn_rate_radps=-rate_radps, phase_rad=float(index + 1)),
    )


def _hovering(index: int, azimuth_rad: float) -> Vehicle:
    range_m = 150.0 + 25.0 * (index % 4)
    position_ned_m = (
        range_m * math.cos(azimuth_rad),
        range_m * math.sin(azimuth_rad),
        -HEIGHTS_M[index % len(HEIGHTS_M)],
    )
    return uav(
        index, Hover(position_ned_m), Sway(heading_rad=azimuth_rad, phase_rad=float(index + 1))
    )
