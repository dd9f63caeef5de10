"""Schedule of a scenario as MAVLink 2: the frames of each vehicle, with their times.

Pure: the schedule is a function of the scenario, a seed and the Unix time of its start. A message
is sampled at a whole millisecond, so that its time stamp is exact, and sent up to ``JITTER_S``
later, as by the scheduler of an autopilot.
"""

import heapq
import itertools
import math
import random
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

from companion.mavlink.wire.encode import pack
from companion.tracking.geodesy import LocalFrame
from sitl_replay.flight.fleet import Scenario, Vehicle
from sitl_replay.flight.payloads import (
    Builder,
    Sample,
    adsb_vehicle,
    attitude,
    global_position_int,
    gps_raw_int,
    heartbeat,
    system_time,
)
from sitl_replay.flight.relay import Aircraft, relayed

JITTER_S = 0.005


class Transmission(NamedTuple):
    """Frame to send: time of sending (seconds since the start), sender, and bytes."""

    t_s: float
    vehicle: Vehicle
    raw: bytes


def schedule(
    scenario: Scenario, seed: int = 0, epoch_ns: int = 0, duration_s: float | None = None
) -> Iterator[Transmission]:
    """Yield every frame of a scenario in order of sending; endless if ``duration_s`` is None.

    ``epoch_ns`` is the Unix time at the start. The same arguments give the same bytes; another seed
    gives other phases and jitter of the timers. Each vehicle has its own sequence numbers, even if
    several share an id.
    """
    local = LocalFrame(*scenario.origin)
    vehicles = scenario.vehicles
    sequence = [0] * len(vehicles)
    timers = list(_timers(vehicles, seed))
    due = [next(timer) for _, timer in timers]
    # At equal times, the timer with the lower number comes first.
    waiting = [(first.send_s, number) for number, first in enumerate(due)]
    heapq.heapify(waiting)
    while True:
        send_s, number = waiting[0]
        if duration_s is not None and send_s >= duration_s:
            return
        who, timer = timers[number]
        vehicle = vehicles[who]
        _, sample_s, build = due[number]
        since_start_ms = math.floor(sample_s * 1000)
        sample = Sample(
            local=local,
            home_alt_m=scenario.home_alt_m,
            vehicle=vehicle,
            t_s=since_start_ms / 1000,
            boot_ms=vehicle.uptime_ms + since_start_ms,
            unix_us=epoch_ns // 1000 + since_start_ms * 1000,
        )
        yield Transmission(send_s, vehicle, pack(build(sample), sequence[who]))
        sequence[who] = (sequence[who] + 1) % 256
        due[number] = following = next(timer)
        heapq.heapreplace(waiting, (following.send_s, number))


class _Due(NamedTuple):
    send_s: float
    sample_s: float
    build: Builder


def _timers(vehicles: tuple[Vehicle, ...], seed: int) -> Iterator[tuple[int, Iterator[_Due]]]:
    for who, vehicle in enumerate(vehicles):
        for build, interval_s in (
            (heartbeat, vehicle.heartbeat_interval_s),
            (global_position_int, vehicle.report_interval_s),
            (attitude, vehicle.attitude_interval_s),
            (gps_raw_int, vehicle.gnss_interval_s),
            (system_time, vehicle.clock_interval_s),
        ):
            yield who, _timer(vehicle, build, interval_s, seed)
        for aircraft in vehicle.hears:
            yield who, _relay(vehicle, aircraft, seed)


def _timer(vehicle: Vehicle, build: Builder, interval_s: float, seed: int) -> Iterator[_Due]:
    # A generator for each timer: an additional vehicle does not change the others.
    rng = random.Random(f"{seed} {vehicle.name} {build.__name__}")
    phase_s = rng.uniform(0.0, interval_s)
    for count in itertools.count():
        sample_s = phase_s + count * interval_s
        yield _Due(sample_s + rng.uniform(0.0, JITTER_S), sample_s, build)


def _relay(vehicle: Vehicle, aircraft: Aircraft, seed: int) -> Iterator[_Due]:
    for told in relayed(aircraft, vehicle.name, seed):
        yield _Due(told.t_s, told.t_s, partial(adsb_vehicle, told=told))
