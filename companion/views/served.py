"""Which nodes of the fleet serve which UAVs, and why none serves a UAV."""

from collections.abc import Mapping
from dataclasses import dataclass

from companion.pipeline import blame
from companion.pipeline.fleet.assignment import offer_value_db
from companion.pipeline.fleet.member import FleetMember
from companion.pipeline.fold import Pipeline
from companion.values import Blame, Offer, Standing


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetStatus:
    """This node's place in a fleet."""

    member: FleetMember  # what it knows and decides
    site: str  # name of the fleet
    sent_bps: float  # bits per second that it tells, by what it gave to Zenoh over the last second
    heard_bps: float  # bits per second that others told it
    damaged: int  # malformed fleet messages received


@dataclass(frozen=True, slots=True, kw_only=True)
class Served:
    """Who serves the UAVs for which beams are wanted."""

    node: str  # this node
    by: Mapping[str, list[str]]  # nodes that serve each UAV, those put aside not among them
    nobody: Mapping[str, Blame]  # why nobody serves a UAV, for each such UAV
    elsewhere: int  # how many other nodes serve, and this one does not

    def is_here(self, uav: str) -> bool:
        """Whether this node serves a UAV. A verdict on another is of the time when it did."""
        return self.node in self.by.get(uav, [])


def served_uavs(pipeline: Pipeline, status: FleetStatus | None, now_ns: int) -> Served | None:
    """Who serves whom, and why nobody does; None where there is no fleet."""
    if status is None:
        return None
    member = status.member
    by = served_by(member, now_ns)
    wanted = [uav for uav in pipeline.tracker.uavs if pipeline.targets.wants(uav)]
    alone = [uav for uav in wanted if uav not in by]
    tracks = pipeline.tracks(now_ns, now_ns, alone) if alone else []
    full = _full(member, now_ns) if tracks else {}
    offers = offers_of(member) if tracks else {}
    nobody = dict[str, Blame]()
    for track in tracks:
        given = offers.get(track.uav, {})
        able = [
            full.get(node, False) for node, one in given.items() if offer_value_db(one) is not None
        ]
        nobody[track.uav] = blame.of_unserved(track, reached=bool(able), full=all(able))
    elsewhere = sum(uav in by and member.name not in by[uav] for uav in wanted)
    return Served(node=member.name, by=by, nobody=nobody, elsewhere=elsewhere)


def offers_of(member: FleetMember) -> dict[str, dict[str, Offer]]:
    """What each node that is believed offers, by UAV and node."""
    found: dict[str, dict[str, Offer]] = {}
    for uav, offer in member.offers.items():
        found.setdefault(uav, {})[member.name] = offer
    for name in sorted(filter(member.trust.is_trusted, member.neighbours)):
        for uav, offer in (member.neighbours[name].offers or {}).items():
            found.setdefault(uav, {})[name] = offer
    return found


def standing(member: FleetMember, now_ns: int) -> dict[str, Standing]:
    """The other nodes that are there and believed, by name."""
    others = sorted(member.duties.others(now_ns).items())
    return {name: said for name, said in others if member.trust.is_trusted(name)}


def _full(member: FleetMember, now_ns: int) -> dict[str, bool]:
    """Whether each node that is there serves as many as it may."""
    others = standing(member, now_ns).items()
    full = {name: len(said.serves) >= said.most for name, said in others}
    return full | {member.name: len(member.duties.serves) >= member.most}


def served_by(member: FleetMember, now_ns: int) -> dict[str, list[str]]:
    """The nodes that serve each UAV, this one first; nodes put aside are not believed."""
    served_by: dict[str, list[str]] = {uav: [member.name] for uav in member.duties.serves}
    for name, said in standing(member, now_ns).items():
        for uav, _ in said.serves:
            served_by.setdefault(uav, []).append(name)
    return served_by
