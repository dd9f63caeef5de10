"""The fleet as the API shows it: nodes, who serves whom, what each offers, handovers."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from companion.pipeline import blame
from companion.pipeline.fleet.assignment import worth_db
from companion.pipeline.fleet.member import Member
from companion.pipeline.fleet.neighbours import Neighbour
from companion.pipeline.fold import Pipeline
from companion.values import Blame, Offer, Standing
from companion.views.words import rfc3339

Json = dict[str, Any]

STATES: Final = ("here", "there", "silent", "aside", "gone")
"""What a node is: this one; another, whose word holds; one that says nothing; one not believed; one
that left.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetStatus:
    """This node's place in a fleet.

    member      what it knows and decides
    site        name of the fleet
    sent_bps    bits per second that it tells, by what it gave to Zenoh over the last second
    heard_bps   bits per second that others told it
    damaged     samples of others that were none
    """

    member: Member
    site: str
    sent_bps: float
    heard_bps: float
    damaged: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Served:
    """Who serves the UAVs for which beams are wanted.

    node       this node
    by         nodes that serve each UAV, those put aside not among them
    nobody     why nobody serves a UAV, for each such UAV
    elsewhere  how many other nodes serve, and this one does not
    """

    node: str
    by: Mapping[str, list[str]]
    nobody: Mapping[str, Blame]
    elsewhere: int

    def is_here(self, uav: str) -> bool:
        """Whether this node serves a UAV. A verdict on another is of the time when it did."""
        return self.node in self.by.get(uav, [])


def served(pipeline: Pipeline, status: FleetStatus | None, now_ns: int) -> Served | None:
    """Who serves whom, and why nobody does; None where there is no fleet."""
    if status is None:
        return None
    member = status.member
    by = _served_by(member, now_ns)
    wanted = [uav for uav in pipeline.tracker.uavs if pipeline.targets.wants(uav)]
    alone = [uav for uav in wanted if uav not in by]
    tracks = pipeline.tracks(now_ns, now_ns, alone) if alone else []
    full = _full(member, now_ns) if tracks else {}
    offers = _offers(member) if tracks else {}
    nobody = dict[str, Blame]()
    for track in tracks:
        given = offers.get(track.uav, {})
        able = [full.get(node, False) for node, one in given.items() if worth_db(one) is not None]
        nobody[track.uav] = blame.of_unserved(track, reached=bool(able), full=all(able))
    elsewhere = sum(uav in by and member.name not in by[uav] for uav in wanted)
    return Served(node=member.name, by=by, nobody=nobody, elsewhere=elsewhere)


def fleet(pipeline: Pipeline, status: FleetStatus | None, now_ns: int) -> Json:
    """The answer of ``/v1/fleet``; ``node`` is null where there is no fleet."""
    if status is None:
        return {
            "valid_at": rfc3339(pipeline.utc_ns(now_ns)),
            "node": None,
            "site": None,
            "nodes": [],
            "uavs": [],
            "handovers": [],
            "sent_bps": None,
            "heard_bps": None,
            "damaged": 0,
            "untold": 0,
        }
    member = status.member
    return {
        "valid_at": rfc3339(pipeline.utc_ns(now_ns)),
        "node": member.name,
        "site": status.site,
        "nodes": nodes(member, now_ns),
        "uavs": _uavs(member, now_ns),
        "handovers": [
            {
                "time": rfc3339(pipeline.utc_ns(one.t_ns)),
                "uav": one.uav,
                "before": one.before,
                "after": one.after,
            }
            for one in member.handovers
        ],
        "sent_bps": status.sent_bps,
        "heard_bps": status.heard_bps,
        "damaged": status.damaged,
        "untold": member.sharing.untold,
    }


def nodes(member: Member, now_ns: int) -> list[Json]:
    """This node, then the others by name, and then those that are gone."""
    own = _NOTHING | {
        "node": member.name,
        "is_self": True,
        "state": "here",
        "near": True,
        "place": _place(member.place),
        "reach_m": member.reach_m,
        "serves": len(member.duties.serves),
        "most": member.most,
    }
    others = [_node(name, member, now_ns) for name in sorted(member.neighbours)]
    gone = [
        _NOTHING
        | {
            "node": name,
            "state": "gone",
            "place": _place(place),
            "heard_s": (now_ns - at_ns) * 1e-9,
        }
        for name, (at_ns, place) in sorted(member.gone.items())
    ]
    return [own, *others, *gone]


_NOTHING: Final[Json] = {
    "is_self": False,
    "near": False,
    "reason": None,
    "place": None,
    "reach_m": None,
    "serves": 0,
    "most": None,
    "heard_s": None,
    "clock_offset_s": None,
    "clock_doubt_s": None,
    "frames": None,
    "used": None,
    "way_p50_ms": None,
    "way_p99_ms": None,
}
"""What is said of a node of which nothing is known."""


def _node(name: str, member: Member, now_ns: int) -> Json:
    known: Neighbour = member.neighbours[name]
    said, ahead = known.standing, known.clock.newest()
    reason = member.trust.aside.get(name)
    standing = member.duties.others(now_ns)
    median_ms, p99_ms = _ways_ms(known, now_ns)
    state = "aside" if reason is not None else "there" if name in standing else "silent"
    return {
        "node": name,
        "is_self": False,
        "state": state,
        "near": name in member.near,
        "reason": reason,
        "place": None if said is None else _place(said.place),
        "reach_m": None if said is None else said.reach_m,
        "serves": 0 if said is None else len(said.serves),
        "most": None if said is None else said.most,
        "heard_s": None if said is None else (now_ns - known.heard_ns) * 1e-9,
        "clock_offset_s": None if ahead is None else -(ahead.low_ns + ahead.high_ns) / 2e9,
        "clock_doubt_s": None if ahead is None else ahead.doubt_ns * 1e-9,
        "frames": known.frames,
        "used": known.used,
        "way_p50_ms": median_ms,
        "way_p99_ms": p99_ms,
    }


def _ways_ms(known: Neighbour, now_ns: int) -> tuple[float | None, float | None]:
    """Median and 99th percentile of how long reports were on their way; None: none came."""
    ways_ns = known.ways_ns(now_ns)
    if not ways_ns:
        return None, None
    median_ns, p99_ns = np.percentile(ways_ns, (50, 99)).tolist()
    return median_ns * 1e-6, p99_ns * 1e-6


def _place(place: tuple[float, float, float] | None) -> Json | None:
    return None if place is None else dict(zip(("lat_deg", "lon_deg", "alt_m"), place, strict=True))


def _offers(member: Member) -> dict[str, dict[str, Offer]]:
    """What each node that is believed offers, by UAV and node."""
    found: dict[str, dict[str, Offer]] = {}
    for uav, offer in member.offers.items():
        found.setdefault(uav, {})[member.name] = offer
    for name in sorted(filter(member.trust.believes, member.neighbours)):
        for uav, offer in (member.neighbours[name].offers or {}).items():
            found.setdefault(uav, {})[name] = offer
    return found


def _standing(member: Member, now_ns: int) -> dict[str, Standing]:
    """The other nodes that are there and believed, by name."""
    others = sorted(member.duties.others(now_ns).items())
    return {name: said for name, said in others if member.trust.believes(name)}


def _full(member: Member, now_ns: int) -> dict[str, bool]:
    """Whether each node that is there serves as many as it may."""
    others = _standing(member, now_ns).items()
    full = {name: len(said.serves) >= said.most for name, said in others}
    return full | {member.name: len(member.duties.serves) >= member.most}


def _served_by(member: Member, now_ns: int) -> dict[str, list[str]]:
    """The nodes that serve each UAV, this one first; nodes put aside are not believed."""
    served_by: dict[str, list[str]] = {uav: [member.name] for uav in member.duties.serves}
    for name, said in _standing(member, now_ns).items():
        for uav, _ in said.serves:
            served_by.setdefault(uav, []).append(name)
    return served_by


def _uavs(member: Member, now_ns: int) -> list[Json]:
    """Every UAV that some node offers to serve or serves, and by whom it is served."""
    offers, by = _offers(member), _served_by(member, now_ns)
    handing = dict(member.duties.handing)
    for said in _standing(member, now_ns).values():
        handing |= dict(said.handing)
    unconfirmed = member.trust.unconfirmed
    return [
        {
            "uav": uav,
            "served_by": by.get(uav, []),
            "handing_to": handing.get(uav),
            "unconfirmed": uav in unconfirmed,
            "offers": [
                {
                    "node": name,
                    "sure_db": offer.sure_db,
                    "likely_db": offer.likely_db,
                    "sinr_db": offer.sinr_db,
                    "heard_s": offer.heard_s,
                }
                for name, offer in sorted(offers.get(uav, {}).items())
            ],
        }
        for uav in sorted({*offers, *by}, key=_natural)
    ]


def _natural(uav: str) -> tuple[int, int, str]:
    """Telemetry by its numbers, then the others by name."""
    sysid, _, compid = uav.partition(":")
    is_plain = sysid.isdecimal() and compid.isdecimal()
    return (int(sysid), int(compid), uav) if is_plain else (256, 0, uav)
