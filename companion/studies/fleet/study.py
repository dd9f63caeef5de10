"""Scaling of a fleet: bandwidth, processor time, time served, takeover times."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from companion.settings.fleet import FleetSettings
from companion.studies.fleet.sky import Sky
from companion.studies.fleet.world import FleetCounts, World
from companion.studies.origin import Progress, silent, versions

SETTLE_S = 8.0  # virtual time for a fleet to settle its assignment
AFTER_S = 4.0  # observed virtual time after a node has died
HALF = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetSize:
    """Results of the fleet study for a fleet of one size.

    twice, none         share of the time in which a UAV within reach had several nodes, or none
    told_kbps           kilobits per second that a node sends, without headers, by kind of message
    takeover_s          time until all of a dead node's UAVs in reach of another are served again
    """

    nodes: int
    uavs: int
    served: float  # share of the time in which a UAV within reach had exactly one node
    twice: float
    none: float
    handovers_per_min: float  # of all UAVs
    told_kbps: dict[str, float]
    link_kbps: float  # kilobits per second that a node receives, headers included
    cpu_share: float  # processor time of a node over time, without its pipeline
    takeover_s: float | None
    orphans: int  # UAVs that the dead node served
    parted_none: float  # unserved share of the time while the network is split in two
    heal_s: float  # time after the split until no UAV has two nodes


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetStudy:
    """Parameters of the fleet study: sizes as (nodes, UAVs), virtual time and network.

    ``spacing_m`` is the distance between neighbouring nodes.
    """

    sizes: tuple[tuple[int, int], ...]
    seconds: float = 10.0
    delay_s: float = 0.02
    loss: float = 0.02
    spacing_m: float = 1500.0
    sampled: int = 50
    seed: int = 1


def run(
    asked: FleetStudy, cpu_s: Callable[[], float], progress: Progress = silent
) -> Iterator[FleetSize]:
    """Simulate the fleet at each size; ``cpu_s`` returns the processor time used."""
    for nodes, uavs in asked.sizes:
        progress(f"{nodes} nodes, {uavs} UAVs")
        sampled = min(asked.sampled, uavs)
        sky = Sky(
            nodes=nodes,
            uavs=uavs,
            spacing_m=asked.spacing_m,
            sampled=sampled,
            delay_s=asked.delay_s,
            loss=asked.loss,
            seed=asked.seed,
        )
        yield _simulate_size(World(sky, FleetSettings(node="any"), cpu_s), asked.seconds)


def _simulate_size(world: World, seconds: float) -> FleetSize:
    sky = world.sky
    world.run(SETTLE_S)
    steady = _counted(world, seconds)
    # Only the sampled UAVs sent frames; scale their traffic to all UAVs.
    scale = {"heard": sky.uavs / sky.sampled if sky.sampled else 1.0}
    told = {
        what: 8e-3 * size * scale.get(what, 1.0) / seconds / sky.nodes
        for what, size in sorted(steady.sent.items())
    }
    received = sum(size * scale.get(what, 1.0) for what, size in steady.received.items())
    cpu_s = sum(steady.cpu_s.values()) + sum(steady.frames_cpu_s.values()) * (scale["heard"] - 1)
    takeover_s, orphans = _measure_takeover(world)
    names = list(world.members)
    left = set(names[: round(HALF * len(names))])
    world.parted = lambda one, other: (one in left) != (other in left)
    parted = _counted(world, seconds)
    world.parted = lambda one, other: False
    served = steady.served + steady.twice + steady.unserved or 1
    unserved = parted.served + parted.twice + parted.unserved or 1
    return FleetSize(
        nodes=sky.nodes,
        uavs=sky.uavs,
        served=steady.served / served,
        twice=steady.twice / served,
        none=steady.unserved / served,
        handovers_per_min=60 * steady.handovers / seconds,
        told_kbps=told,
        link_kbps=8e-3 * received / seconds / sky.nodes,
        cpu_share=cpu_s / seconds / sky.nodes,
        takeover_s=takeover_s,
        orphans=orphans,
        parted_none=parted.unserved / unserved,
        heal_s=_measure_healing_s(world),
    )


def _counted(world: World, seconds: float) -> FleetCounts:
    world.counted = counted = FleetCounts()
    world.run(seconds)
    world.counted = FleetCounts()  # later events go to another object
    return counted


def _measure_takeover(world: World) -> tuple[float | None, int]:
    """Kill the busiest node; return the time until its UAVs are served, and how many there are."""
    victim = max(world.members, key=lambda name: len(world.members[name].duties.serves))
    orphans = set(world.members[victim].duties.serves)
    began_ns, taken = world.now_ns, dict[str, float]()

    def watch() -> None:
        for uav in orphans & world.served_by().keys():
            taken.setdefault(uav, (world.now_ns - began_ns) * 1e-9)

    world.kill(victim)
    watched = orphans & world.servable()
    world.run(AFTER_S, watch)
    left = (watched & world.servable()) - taken.keys()
    times = [taken[uav] for uav in watched if uav in taken]
    return (None if left or not times else max(times)), len(orphans)


def _measure_healing_s(world: World) -> float:
    """Return the time until no UAV has several nodes, handovers aside."""
    began_ns, last_ns = world.now_ns, world.now_ns

    def watch() -> None:
        nonlocal last_ns
        handed = {uav for one in world.members.values() for uav in one.duties.handing}
        if any(len(by) > 1 and uav not in handed for uav, by in world.served_by().items()):
            last_ns = world.now_ns

    world.run(AFTER_S, watch)
    return (last_ns - began_ns) * 1e-9


def answer(asked: FleetStudy, found: Sequence[FleetSize], command: str) -> dict[str, Any]:
    """Return parameters and results of the study as JSON."""
    sizes = [asdict(one) for one in found]
    return {"sizes": sizes, "asked": asdict(asked), "command": command, "versions": versions()}
