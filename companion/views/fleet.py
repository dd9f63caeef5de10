"""The fleet as shown by the API: nodes, the UAVs that each serves, offers, handovers."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated

import numpy as np

from companion.pipeline.fleet.duties import Handover
from companion.pipeline.fleet.member import FleetMember
from companion.pipeline.fleet.neighbours import Neighbour
from companion.tracking.geodesy import Place
from companion.values import Offer
from companion.values.described import DescribedEnum, Inline, Meaning
from companion.views.served import FleetStatus, offers_of, served_by, standing


class NodeState(DescribedEnum):
    """State of a node of the fleet."""

    HERE = "here", "the node that answers"
    THERE = "there", "its messages are current"
    SILENT = "silent", "no message for longer than `[fleet] lease_s`"
    EXCLUDED = "aside", "excluded, because its messages contradict those of others"
    GONE = "gone", "it left"


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetNode:
    """Node of the fleet: this node, then the others by name, and then those that left."""

    node: Annotated[str, Meaning("name of the node", example="north")]
    is_self: Annotated[bool, Meaning("whether this is the node that answers the request")] = False
    state: Annotated[
        NodeState,
        Meaning(
            "here: it answers; there: current; silent: no message; aside: excluded; gone: left"
        ),
    ]
    near: Annotated[
        bool,
        Meaning(
            "whether the node is near: ranges overlap, within about 10 km, or position unknown;"
            " only near nodes exchange reports and offers"
        ),
    ] = False
    reason: Annotated[str | None, Meaning("why the node is excluded")] = None
    place: Annotated[Place | None, Meaning("position of the node's array")] = None
    reach_m: Annotated[
        float | None, Meaning("distance of the farthest UAV that the node receives")
    ] = None
    serves: Annotated[int, Meaning("UAVs that the node serves")] = 0
    most: Annotated[int | None, Meaning("largest number of UAVs that the node serves")] = None
    heard_s: Annotated[
        float | None, Meaning("time since the node's last message, or since it left")
    ] = None
    clock_offset_s: Annotated[
        float | None,
        Meaning(
            "the node's clock minus this node's, middle of the possible interval", label="Clock"
        ),
    ] = None
    clock_doubt_s: Annotated[float | None, Meaning("width of the possible interval")] = None
    frames: Annotated[int | None, Meaning("frames of vehicles that it shared")] = None
    used: Annotated[
        int | None, Meaning("shared frames used here, of vehicles that this node does not receive")
    ] = None
    way_p50_ms: Annotated[
        float | None,
        Meaning("median delay from reception at that node to reception here, last minute"),
    ] = None
    way_p99_ms: Annotated[
        float | None,
        Meaning(
            "99th percentile of the delay from reception at that node to reception here",
            label="Delay p99",
        ),
    ] = None


@dataclass(frozen=True, slots=True)
class FleetOffer:
    """Gain and SINR that a node offers for a UAV, computed as if it served no other UAV."""

    node: Annotated[str, Meaning("node that offers")]
    offer: Annotated[Offer, Inline(omit=("uav",))]


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetUav:
    """UAV with the nodes that serve it, and with the offer of each node."""

    uav: Annotated[str, Meaning("id of the UAV", example="3:1")]
    served_by: Annotated[
        list[str], Meaning("nodes that serve the UAV; two during a handover or in a split fleet")
    ]
    handing_to: Annotated[str | None, Meaning("node to which it is being handed over")]
    unconfirmed: Annotated[
        bool, Meaning("whether only one node reports the UAV, though others should receive it")
    ]
    offers: Annotated[list[FleetOffer], Meaning("what each node offers the UAV")]


@dataclass(frozen=True, slots=True, kw_only=True)
class Fleet:
    """The fleet as this node knows it; ``node`` is null without a fleet."""

    valid_at_ns: Annotated[int, Meaning("the instant for which the values hold")]
    node: Annotated[str | None, Meaning("this node")] = None
    site: Annotated[str | None, Meaning("name of the fleet")] = None
    nodes: Annotated[list[FleetNode], Meaning("this node, then the others by name")] = field(
        default_factory=list
    )
    uavs: Annotated[list[FleetUav], Meaning("every UAV that a node serves or offers to serve")] = (
        field(default_factory=list)
    )
    handovers: Annotated[list[Handover], Meaning("newest handovers of this node, oldest first")] = (
        field(default_factory=list)
    )
    sent_bps: Annotated[float | None, Meaning("data that this node shares, last second")] = None
    heard_bps: Annotated[float | None, Meaning("data that others share, last second")] = None
    damaged: Annotated[int, Meaning("malformed fleet messages received")] = 0
    untold: Annotated[
        int, Meaning("frames and round trips not shared: queue full, or too many vehicles received")
    ] = 0


def offer_count(status: FleetStatus | None) -> int:
    """Return how many offers of all nodes the answer of ``/v1/fleet`` is made of."""
    if status is None:
        return 0
    others = (known.offers or () for known in status.member.neighbours.values())
    return len(status.member.offers) + sum(map(len, others))


def fleet(status: FleetStatus | None, now_ns: int) -> Callable[[], Fleet]:
    """Read the fleet; return a function that makes the answer of ``/v1/fleet``, on any thread."""
    if status is None:
        return partial(Fleet, valid_at_ns=now_ns)
    member = status.member
    uavs = _uavs(member, now_ns)
    shown = Fleet(
        valid_at_ns=now_ns,
        node=member.name,
        site=status.site,
        nodes=nodes(member, now_ns),
        handovers=list(member.handovers),
        sent_bps=status.sent_bps,
        heard_bps=status.heard_bps,
        damaged=status.damaged,
        untold=member.sharing.dropped,
    )
    return lambda: replace(shown, uavs=uavs())


def nodes(member: FleetMember, now_ns: int) -> list[FleetNode]:
    """Return the nodes: this one, then the others by name, and then those that left."""
    own = FleetNode(
        node=member.name,
        is_self=True,
        state=NodeState.HERE,
        near=True,
        place=_place(member.place),
        reach_m=member.reach_m,
        serves=len(member.duties.serves),
        most=member.most,
    )
    others = [_node(name, member, now_ns) for name in sorted(member.neighbours)]
    gone = [
        FleetNode(
            node=name, state=NodeState.GONE, place=_place(place), heard_s=(now_ns - at_ns) * 1e-9
        )
        for name, (at_ns, place) in sorted(member.gone.items())
    ]
    return [own, *others, *gone]


def _node(name: str, member: FleetMember, now_ns: int) -> FleetNode:
    known: Neighbour = member.neighbours[name]
    said, ahead = known.standing, known.clock.newest_offset()
    reason = member.trust.excluded.get(name)
    is_connected = name in member.duties.others(now_ns)
    median_ms, p99_ms = _ways_ms(known, now_ns)
    state = NodeState.THERE if is_connected else NodeState.SILENT
    return FleetNode(
        node=name,
        state=state if reason is None else NodeState.EXCLUDED,
        near=name in member.near,
        reason=reason,
        place=None if said is None else _place(said.place),
        reach_m=None if said is None else said.reach_m,
        serves=0 if said is None else len(said.serves),
        most=None if said is None else said.most,
        heard_s=None if said is None else (now_ns - known.heard_ns) * 1e-9,
        clock_offset_s=None if ahead is None else -(ahead.low_ns + ahead.high_ns) / 2e9,
        clock_doubt_s=None if ahead is None else ahead.width_ns * 1e-9,
        frames=known.frames,
        used=known.used,
        way_p50_ms=median_ms,
        way_p99_ms=p99_ms,
    )


def _ways_ms(known: Neighbour, now_ns: int) -> tuple[float | None, float | None]:
    """Return median and 99th percentile of the delays of reports, ms; None without reports."""
    ways_ns = known.delays_ns(now_ns)
    if not ways_ns:
        return None, None
    median_ns, p99_ns = np.percentile(ways_ns, (50, 99)).tolist()
    return median_ns * 1e-6, p99_ns * 1e-6


def _place(place: tuple[float, float, float] | None) -> Place | None:
    return None if place is None else Place(*place)


def _uavs(member: FleetMember, now_ns: int) -> Callable[[], list[FleetUav]]:
    offers, by = offers_of(member), served_by(member, now_ns)
    handing, unconfirmed = dict(member.duties.handing), frozenset(member.trust.unconfirmed)
    for said in standing(member, now_ns).values():
        handing |= dict(said.handing)
    return lambda: [
        FleetUav(
            uav=uav,
            served_by=by.get(uav, []),
            handing_to=handing.get(uav),
            unconfirmed=uav in unconfirmed,
            offers=[FleetOffer(name, one) for name, one in sorted(offers.get(uav, {}).items())],
        )
        for uav in sorted({*offers, *by}, key=_natural)
    ]


def _natural(uav: str) -> tuple[int, int, str]:
    """Return a sort key of UAV ids: telemetry by its numbers, then other kinds by name."""
    sysid, _, compid = uav.partition(":")
    is_plain = sysid.isdecimal() and compid.isdecimal()
    return (int(sysid), int(compid), uav) if is_plain else (256, 0, uav)
