"""Nodes of the fleet that serve each UAV, and reasons why no node serves a UAV."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from companion.pipeline import blame
from companion.pipeline.fleet.assignment import offer_value_db
from companion.pipeline.fleet.member import FleetMember
from companion.pipeline.fold import Pipeline
from companion.values import Blame, Offer, Standing, Track


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetStatus:
    """State of this node and of its fleet."""

    member: FleetMember  # its knowledge and decisions
    site: str  # name of the fleet
    sent_bps: float  # bits per second passed to Zenoh over the last second
    heard_bps: float  # bits per second received from others
    damaged: int  # malformed fleet messages received


@dataclass(frozen=True, slots=True, kw_only=True)
class Served:
    """Nodes that serve each UAV for which a beam is wanted."""

    node: str  # this node
    by: Mapping[str, list[str]]  # nodes that serve each UAV, without excluded nodes
    unserved: Sequence[str]  # UAVs that no node serves
    elsewhere: int  # number of UAVs that only other nodes serve

    def is_here(self, uav: str) -> bool:
        """Return whether this node serves a UAV. Its verdicts on other UAVs are outdated."""
        return self.node in self.by.get(uav, [])


def served_uavs(
    pipeline: Pipeline, status: FleetStatus | None, now_ns: int, uavs: Iterable[str] | None = None
) -> Served | None:
    """Return which nodes serve each UAV; None without a fleet. ``uavs``: None means all."""
    if status is None:
        return None
    member, wants = status.member, pipeline.targets.wants
    by = served_by(member, now_ns)
    wanted = [uav for uav in (pipeline.tracker.uavs if uavs is None else uavs) if wants(uav)]
    return Served(
        node=member.name,
        by=by,
        unserved=[uav for uav in wanted if uav not in by],
        elsewhere=sum(uav in by and member.name not in by[uav] for uav in wanted),
    )


class Within(NamedTuple):
    """What the nodes of a fleet can do for a UAV that none of them serves.

    reached  some node's array has a gain towards it
    full     each of those serves as many UAVs as it may
    """

    reached: bool
    full: bool

    def blame(self, track: Track) -> Blame:
        """Return why no node serves the UAV."""
        return blame.of_unserved(track, reached=self.reached, full=self.full)


def within_reach(
    status: FleetStatus | None, served: Served | None, now_ns: int
) -> dict[str, Within]:
    """Return what the fleet can do for each UAV that it does not serve; empty without a fleet."""
    if status is None or served is None or not served.unserved:
        return {}
    full, offers = _full(status.member, now_ns), offers_of(status.member)
    found = dict[str, Within]()
    for uav in served.unserved:
        able = [
            full.get(node, False)
            for node, one in offers.get(uav, {}).items()
            if offer_value_db(one) is not None
        ]
        found[uav] = Within(bool(able), all(able))
    return found


def offers_of(member: FleetMember) -> dict[str, dict[str, Offer]]:
    """Return the offers of all trusted nodes, by UAV and node."""
    found: dict[str, dict[str, Offer]] = {}
    for uav, offer in member.offers.items():
        found.setdefault(uav, {})[member.name] = offer
    for name in sorted(filter(member.trust.is_trusted, member.neighbours)):
        for uav, offer in (member.neighbours[name].offers or {}).items():
            found.setdefault(uav, {})[name] = offer
    return found


def standing(member: FleetMember, now_ns: int) -> dict[str, Standing]:
    """Return the ``Standing`` of other nodes that are present and trusted, by name."""
    others = sorted(member.duties.others(now_ns).items())
    return {name: said for name, said in others if member.trust.is_trusted(name)}


def _full(member: FleetMember, now_ns: int) -> dict[str, bool]:
    """Return for each present node whether it serves as many UAVs as it may."""
    others = standing(member, now_ns).items()
    full = {name: len(said.serves) >= said.most for name, said in others}
    return full | {member.name: len(member.duties.serves) >= member.most}


def served_by(member: FleetMember, now_ns: int) -> dict[str, list[str]]:
    """Return the nodes that serve each UAV, this node first; untrusted nodes are ignored."""
    served_by: dict[str, list[str]] = {uav: [member.name] for uav in member.duties.serves}
    for name, said in standing(member, now_ns).items():
        for uav, _ in said.serves:
            served_by.setdefault(uav, []).append(name)
    return served_by
