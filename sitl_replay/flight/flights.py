"""Flights of single UAVs: path, attitude, effect of the wind, and message intervals.

UAVs are counted from 0; random numbers depend on the seed and that number only.

Over 300 lines: a function for each flight.
"""

import math
import random
from collections.abc import Callable
from typing import Final

from companion.values import AltitudeDatum
from sitl_replay.flight.attitudes import Banked, Leaning
from sitl_replay.flight.fleet import Airframe, Vehicle, uav_source, uptime_ms
from sitl_replay.flight.motion import GRAVITY_MPS2, Flight, Motion, Path, Pose, Vector
from sitl_replay.flight.paths import Limits, Orbit, Racetrack, Swing, Tour
from sitl_replay.flight.relay import EVERYTHING, Aircraft, Valid
from sitl_replay.flight.wind import Displacement, Hold, displaced, gusts, low_altitude

REPORT_INTERVALS_S: Final = (0.10, 0.15, 0.20, 0.25)
ATTITUDE_INTERVAL_S: Final = 0.2

# A copter of some kilograms and a small fixed wing, and their position control in gusts.
COPTER_LIMITS: Final = Limits(speed_mps=12.0, climb_mps=3.0, acceleration_mps2=3.0)
COPTER_HOLD: Final = Hold(natural_radps=0.8, damping=0.8, drag_s=3.0)
COPTER_AIRSPEED_MPS: Final = 8.0
PLANE_HOLD: Final = Hold(natural_radps=0.4, damping=0.8, drag_s=2.0)
WIND_MPS: Final = 6.0

STAND_S: Final = 4.0
TOUR_REACH_M: Final = 110.0
LEG_MIN_M: Final = 50.0

ROLL_S: Final = 2.0
BANK_MAX_RAD: Final = math.radians(30.0)
ANGLE_OF_ATTACK_RAD: Final = math.radians(3.0)

PAIR_AZIMUTHS_DEG: Final = (-50.0, -25.0, 0.0, 25.0, 50.0)
SWING_REACH_M: Final = 50.0
SWING_RADPS: Final = 0.2
BEHIND_RATIO: Final = 1.6

CELL_M: Final = 300.0
CELLS: Final = 100
LAYERS: Final = 10
LAYER_M: Final = 40.0

GOLDEN_ANGLE_RAD: Final = math.pi * (3.0 - math.sqrt(5.0))


def uav(
    index: int,
    trajectory: Callable[[float], Motion],
    attitude: Callable[[float], Pose],
    airframe: Airframe = Airframe.COPTER,
) -> Vehicle:
    """Return a UAV with one of four report rates, 4 to 10 Hz."""
    return Vehicle(
        source=uav_source(index),
        trajectory=trajectory,
        attitude=attitude,
        report_interval_s=REPORT_INTERVALS_S[index % len(REPORT_INTERVALS_S)],
        attitude_interval_s=ATTITUDE_INTERVAL_S,
        uptime_ms=uptime_ms(index),
        airframe=airframe,
    )


def calm(index: int, path: Path) -> Vehicle:
    """Return a copter on a path in still air."""
    return uav(index, Flight(path), Leaning(path))


def circling(index: int, centre_m: float = 250.0) -> Vehicle:
    """Return a copter in still air on a circle of 40 m radius, away from the others."""
    north_m, east_m = on_spiral(index, centre_m)
    return calm(
        index,
        Orbit(
            centre_ned_m=(north_m, east_m, -60.0),
            radius_m=40.0,
            rate_radps=0.2,
            phase_rad=float(index),
        ),
    )


def touring(index: int, seed: int) -> Vehicle:
    """Return a copter on a tour of waypoints, in turbulence."""
    rng = random.Random(f"{seed} tour {index}")
    north_m, east_m = on_spiral(index, 250.0)
    path = Tour.over(
        _waypoints(rng, (north_m, east_m, -60.0)), COPTER_LIMITS, STAND_S, rng.uniform(0.0, 60.0)
    )
    moved = _displacement(index, seed, 60.0, COPTER_AIRSPEED_MPS, COPTER_HOLD)
    return uav(index, Flight(path, moved), Leaning(path))


def racing(index: int, seed: int) -> Vehicle:
    """Return a fixed wing on a racetrack, in turbulence."""
    rng = random.Random(f"{seed} racetrack {index}")
    north_m, east_m = on_spiral(index, 450.0)
    height_m = 60.0 + 30.0 * (index % 8)
    speed_mps = rng.uniform(20.0, 30.0)
    path = Racetrack(
        centre_ned_m=(north_m, east_m, -height_m),
        axis_rad=rng.uniform(0.0, math.tau),
        straight_m=rng.uniform(200.0, 400.0),
        speed_mps=speed_mps,
        radius_m=speed_mps**2 / (GRAVITY_MPS2 * math.tan(BANK_MAX_RAD)),
        roll_s=ROLL_S,
        offset_s=rng.uniform(0.0, 60.0),
    )
    wind_rad = wind_course_rad(seed)
    wind_ne_mps = (WIND_MPS * math.cos(wind_rad), WIND_MPS * math.sin(wind_rad))
    moved = _displacement(index, seed, height_m, speed_mps, PLANE_HOLD)
    return uav(
        index, Flight(path, moved), Banked(path, wind_ne_mps, ANGLE_OF_ATTACK_RAD), Airframe.PLANE
    )


def paired(index: int, *, mirrored: bool) -> Vehicle:
    """Return one of a pair that swings about one azimuth and elevation in opposite directions.

    UAVs with even numbers are nearer to the carrier. ``mirrored``: the farther one swings behind
    the carrier, about the azimuth mirrored in the east-west line.
    """
    pair, second = divmod(index, 2)
    shell, slot = divmod(pair, len(PAIR_AZIMUTHS_DEG))
    near_m = 150.0 + 60.0 * shell
    far_m = BEHIND_RATIO * near_m
    range_m = far_m if second else near_m
    azimuth_rad = math.radians(PAIR_AZIMUTHS_DEG[slot])
    amplitude_rad = SWING_REACH_M / far_m
    if second:
        azimuth_rad = math.pi - azimuth_rad if mirrored else azimuth_rad
        amplitude_rad = amplitude_rad if mirrored else -amplitude_rad
    elevation_rad = math.radians(4.0 + 3.0 * (pair % 4))
    height_m = range_m * math.tan(elevation_rad)
    return calm(
        index,
        Swing(
            range_m=range_m,
            height_m=height_m,
            azimuth_rad=azimuth_rad,
            amplitude_rad=amplitude_rad,
            omega_radps=SWING_RADPS,
            phase_rad=1.7 * pair + 0.8,
        ),
    )


def swarming(index: int, seed: int) -> Vehicle:
    """Return one of a thousand copters: it circles in its own cell and sends at low rates.

    Cells are 300 m wide, circles at most 90 m in radius. Ten copters share a cell, in layers 40 m
    apart. Neighbouring cells fill the layers evenly.
    """
    rng = random.Random(f"{seed} swarm {index}")
    turn, cell = divmod(index, CELLS)
    layer = (3 * cell + turn) % LAYERS
    north_m, east_m = _CELL_CENTRES_M[cell]
    radius_m = rng.uniform(60.0, 90.0)
    rate_radps = rng.choice((-1.0, 1.0)) * rng.uniform(8.0, 13.0) / radius_m
    path = Orbit(
        centre_ned_m=(north_m, east_m, -LAYER_M * (layer + 1)),
        radius_m=radius_m,
        rate_radps=rate_radps,
        phase_rad=rng.uniform(0.0, math.tau),
    )
    return Vehicle(
        source=uav_source(index),
        trajectory=Flight(path),
        attitude=Leaning(path),
        report_interval_s=0.25,
        attitude_interval_s=1.0,
        uptime_ms=uptime_ms(index),
        gnss_interval_s=5.0,
        clock_interval_s=10.0,
    )


def aircraft(uav_trajectory: Callable[[float], Motion]) -> tuple[Aircraft, ...]:
    """Return aircraft with transponders about the carrier; the last one is a UAV.

    Addresses are from a block that ICAO has not assigned. One aircraft reports no speed, one no
    height, and one no position a third of the time.
    """

    def holding(north_m: float, east_m: float, height_m: float, speed_mps: float) -> Flight:
        centre_ned_m = (north_m, east_m, -height_m)
        radius_m = speed_mps**2 / (GRAVITY_MPS2 * math.tan(BANK_MAX_RAD))
        # Each place gives an axis and an offset that no other aircraft has.
        return Flight(
            Racetrack(
                centre_ned_m=centre_ned_m,
                axis_rad=north_m,
                straight_m=4.0 * radius_m,
                speed_mps=speed_mps,
                radius_m=radius_m,
                roll_s=5.0,
                offset_s=east_m,
            )
        )

    pressure, geometric = AltitudeDatum.PRESSURE, AltitudeDatum.GEOMETRIC
    still = Valid.HEADING | Valid.VELOCITY | Valid.VERTICAL_VELOCITY
    return (
        Aircraft(
            icao=0xF00001,
            callsign="TEST01",
            emitter_type=3,
            trajectory=holding(9e3, 4e3, 2400.0, 120.0),
            datum=pressure,
        ),
        Aircraft(
            icao=0xF00002,
            callsign="TEST02",
            emitter_type=3,
            trajectory=holding(-7e3, 8e3, 1800.0, 95.0),
            datum=geometric,
        ),
        Aircraft(
            icao=0xF00003,
            callsign="TEST03",
            emitter_type=1,
            trajectory=holding(3e3, -5e3, 700.0, 50.0),
            datum=pressure,
            says=~still & EVERYTHING,
        ),
        Aircraft(
            icao=0xF00004,
            callsign="TEST04",
            emitter_type=7,
            trajectory=holding(-2e3, -3e3, 400.0, 40.0),
            datum=pressure,
            says=EVERYTHING,
            placeless_share=0.33,
        ),
        Aircraft(
            icao=0xF00005,
            callsign="TEST05",
            emitter_type=9,
            trajectory=holding(5e3, 1e3, 900.0, 28.0),
            datum=geometric,
            says=~Valid.ALTITUDE & EVERYTHING,
        ),
        Aircraft(
            icao=0xF00006,
            callsign="TEST06",
            emitter_type=14,
            trajectory=uav_trajectory,
            datum=geometric,
        ),
    )


def on_spiral(index: int, spacing_m: float) -> tuple[float, float]:
    """Return north and east of a point on a sunflower spiral, whose points are evenly spaced.

    No point is nearer to the carrier than 1.4 times the spacing. Source: H. Vogel, "A better way to
    construct the sunflower head", Mathematical Biosciences 44, 1979.
    """
    range_m, azimuth_rad = spacing_m * math.sqrt(index + 2.0), index * GOLDEN_ANGLE_RAD
    return range_m * math.cos(azimuth_rad), range_m * math.sin(azimuth_rad)


def wind_course_rad(seed: int) -> float:
    """Return the direction that the mean wind blows to, the same for all UAVs, radians."""
    return random.Random(f"{seed} wind").uniform(0.0, math.tau)


def _displacement(
    index: int, seed: int, height_m: float, airspeed_mps: float, hold: Hold
) -> Displacement:
    turbulence = low_altitude(height_m, WIND_MPS, airspeed_mps)
    wind = gusts(turbulence, random.Random(f"{seed} gusts {index}"))
    return Displacement(displaced(wind, hold), wind_course_rad(seed))


def _waypoints(rng: random.Random, centre_ned_m: Vector) -> tuple[Vector, ...]:
    wanted = rng.choice((5, 6))
    north_m, east_m, down_m = centre_ned_m
    found: list[Vector] = []
    while len(found) < wanted:
        point = (
            north_m + rng.uniform(-TOUR_REACH_M, TOUR_REACH_M),
            east_m + rng.uniform(-TOUR_REACH_M, TOUR_REACH_M),
            down_m + rng.uniform(-40.0, 40.0),
        )
        neighbours = [found[-1]] if found else []
        neighbours += found[:1] if len(found) == wanted - 1 else []
        if all(math.dist(point[:2], other[:2]) >= LEG_MIN_M for other in neighbours):
            found.append(point)
    return tuple(found)


def _cell_centres_m() -> tuple[tuple[float, float], ...]:
    """Return the cells of a grid around the carrier, without its own cell, nearest first."""
    numbers = range(-5, 6)
    cells = sorted(
        ((n, e) for n in numbers for e in numbers if (n, e) != (0, 0)),
        key=lambda cell: (math.hypot(*cell), math.atan2(cell[1], cell[0])),
    )
    return tuple((CELL_M * north, CELL_M * east) for north, east in cells[:CELLS])


_CELL_CENTRES_M: Final = _cell_centres_m()
