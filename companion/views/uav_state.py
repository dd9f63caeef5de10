"""UAVs as shown by the API.

What is known about them is read where the pipeline runs; states are computed from it on any thread.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

from companion.mavlink.clock.estimates import ClockEstimate
from companion.pipeline.fold import Pipeline
from companion.pipeline.snapshots import UavSnapshot
from companion.tracking.geodesy import LocalFrame, Place
from companion.values import (
    AltitudeDatum,
    Blame,
    Carrier,
    Level,
    Limits,
    Reason,
    Rejection,
    Source,
    Track,
    Vector,
    Verdict,
)
from companion.values.described import Inline, Meaning
from companion.views import health
from companion.views.as_json import Json, as_json
from companion.views.health import LinkHealth
from companion.views.served import Served, Within, served_uavs, within_reach
from companion.views.state import Node, overload


@dataclass(frozen=True, slots=True)
class ReportedFix:
    """Newest reported position of a UAV, with its time."""

    t_ns: Annotated[int, Meaning("time of the position")]
    place: Annotated[Place, Inline()]


@dataclass(frozen=True, slots=True)
class Assumptions:
    """Assumptions for one UAV's bounds, and how often its reports or stamps refuted them."""

    limits: Annotated[Limits, Inline()]
    refuted: Annotated[int, Meaning("how often reports or time stamps have refuted an assumption")]


_BOUND_AXES: Final = Meaning(
    text="half axes of the cylinder that contains the position, north, east, down",
    deprecated="horizontal_bound_m and vertical_bound_m",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class UavState:
    """State of one UAV at ``valid_at``; north, east and down are measured from the array."""

    id: Annotated[str, Meaning("SYSID:COMPID, icao:HEX, rid:ID or cot:UID", example="3:1")]
    verdict: Annotated[
        Level | None,
        Meaning("whether the UAV's beam has the gain that the link needs", label="Link"),
    ]
    health: Annotated[LinkHealth | None, Meaning("cause and gains of the verdict")]
    target: Annotated[bool, Meaning("whether a beam is wanted for the UAV, from any node")]
    served_by: Annotated[
        list[str] | None,
        Meaning("nodes of the fleet that serve it; null: no fleet, or no beam is wanted"),
    ]
    same_as: Annotated[
        str | None,
        Meaning(
            "id of the better track of this aircraft; null: this is the best track", example="3:1"
        ),
    ]
    callsign: Annotated[str | None, Meaning("callsign of the aircraft", example="SWR12A")]
    relays: Annotated[list[str], Meaning("components that relay this aircraft")]
    alt_datum: Annotated[AltitudeDatum | None, Meaning("what `alt_m` is measured from")]
    fix: Annotated[ReportedFix | None, Meaning("newest reported position")]
    place: Annotated[Place, Inline()]
    north_m: Annotated[float | None, Meaning("position seen from the array, to the north")]
    east_m: Annotated[float | None, Meaning("position seen from the array, to the east")]
    down_m: Annotated[float | None, Meaning("position seen from the array, down")]
    heading_deg: Annotated[float | None, Meaning("reported heading from true north, clockwise")]
    track: Annotated[
        Track, Inline(omit=("speed_max_mps", "acceleration_max_mps2", "limits_source"))
    ]
    assumptions: Annotated[Assumptions, Meaning("assumptions of the bounds of this UAV")]
    clock: Annotated[ClockEstimate | None, Meaning("the sender's clock; null for relayed aircraft")]
    rejected: Annotated[dict[str, int], Meaning("number of rejections by reason")]
    recent_rejections: Annotated[list[Rejection], Meaning("latest rejections")]

    @property
    def bound_cylinder_ned_m(self) -> Annotated[Vector, _BOUND_AXES]:
        return (
            self.track.horizontal_bound_m,
            self.track.horizontal_bound_m,
            self.track.vertical_bound_m,
        )

    @property
    def bound_ellipsoid_ned_m(self) -> Annotated[Vector, _BOUND_AXES]:
        return self.bound_cylinder_ned_m


@dataclass(frozen=True, slots=True)
class Uavs:
    """States of every UAV with a track, at ``valid_at``."""

    valid_at_ns: Annotated[int, Meaning("the instant for which the values hold")]
    uavs: Annotated[list[UavState], Meaning("the UAVs")]


def uavs(node: Node) -> Json:
    """Return the answer of ``/v1/uavs``."""
    now_ns, utc_ns = node.now_ns(), node.pipeline.utc_ns
    return as_json(Uavs(now_ns, states(node, now_ns)), utc_ns)


def states(node: Node, now_ns: int, only: str | None = None) -> list[UavState]:
    """Return the present state of every UAV, or of one."""
    known = known_uavs(node.pipeline, node.pipeline.tracker.uavs if only is None else [only])
    return list(overview(node, known, now_ns).states())


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownUav:
    """What is known about one UAV besides its place in time; nothing changes it afterwards."""

    snapshot: UavSnapshot
    is_target: bool
    same_as: str | None
    callsign: str | None
    relays: tuple[Source, ...]
    judged: Verdict | None
    refuted: int
    rejected: Mapping[Reason, int]
    recent_rejections: list[Rejection]


def known_uavs(pipeline: Pipeline, uavs: Iterable[str]) -> list[KnownUav]:
    """Return what is known about those UAVs that have a track, without the carrier."""
    targets, aircraft, verdicts = pipeline.targets, pipeline.senders.aircraft, pipeline.health
    known = []
    for snapshot in pipeline.snapshots(uav for uav in uavs if uav != pipeline.center.vehicle):
        uav = snapshot.track.fix.uav
        refused = pipeline.refusals.of(uav)
        known.append(
            KnownUav(
                snapshot=snapshot,
                is_target=targets.wants(uav),
                same_as=targets.identities.same_as(uav),
                callsign=aircraft.callsign(uav),
                relays=aircraft.relays(uav),
                judged=verdicts.verdicts.get(uav),
                refuted=pipeline.refuted(uav),
                rejected=dict(refused.counts),
                recent_rejections=list(refused.recent),
            )
        )
    return known


@dataclass(frozen=True, slots=True, kw_only=True)
class Overview:
    """UAVs, carrier and fleet as known now. Any thread may compute states from it.

    local      the local frame of all positions; None: there is none yet
    machine    cause of weak links by overload
    within     what the fleet can do for UAVs that it does not serve
    """

    now_ns: int
    uavs: Sequence[KnownUav]
    local: LocalFrame | None
    carrier: Carrier | None
    machine: Blame | None
    served: Served | None
    within: Mapping[str, Within]

    def tracks(self) -> Iterator[Track]:
        """Yield the UAVs predicted to now."""
        for known in self.uavs:
            yield known.snapshot.at(self.now_ns, self.now_ns)

    def states(self) -> Iterator[UavState]:
        """Yield the state of each UAV now; none before there is a local frame."""
        if self.local is None:
            return
        for known, track in zip(self.uavs, self.tracks(), strict=True):
            yield _state(self, known, track, self.local.place(*track.position_ned_m.tolist()))


def overview(node: Node, uavs: Sequence[KnownUav], now_ns: int) -> Overview:
    """Return an overview of some UAVs; ``now_ns`` is not before they became known."""
    pipeline, status = node.pipeline, node.fleet_status()
    found = pipeline.carrier(now_ns, now_ns)
    names = [known.snapshot.track.fix.uav for known in uavs]
    served = served_uavs(pipeline, status, now_ns, names)
    return Overview(
        now_ns=now_ns,
        uavs=uavs,
        local=pipeline.local,
        carrier=None if isinstance(found, str) else found,
        machine=overload(node, now_ns),
        served=served,
        within=within_reach(status, served, now_ns),
    )


def _state(seen: Overview, known: KnownUav, track: Track, place: Place) -> UavState:
    carrier, served, uav = seen.carrier, seen.served, track.uav
    north_m, east_m, down_m = (
        (None, None, None)
        if carrier is None
        else (track.position_ned_m - carrier.position_ned_m).tolist()
    )
    is_here = served is None or served.is_here(uav)
    within = seen.within.get(uav)
    level, why = health.verdict(
        known.judged if is_here else None,
        seen.machine,
        None if within is None else within.blame(track),
    )
    newest, clock = known.snapshot.track.fix, known.snapshot.timeline.clock
    report = newest.report
    return UavState(
        id=uav,
        verdict=level,
        health=why,
        target=known.is_target,
        served_by=served.by.get(uav, []) if served and known.is_target else None,
        same_as=known.same_as,
        callsign=known.callsign,
        relays=[str(relay) for relay in known.relays],
        alt_datum=report.alt_datum,
        fix=ReportedFix(newest.t_ns, Place(report.lat_deg, report.lon_deg, report.alt_m)),
        place=place,
        north_m=north_m,
        east_m=east_m,
        down_m=down_m,
        heading_deg=report.heading_deg,
        track=track,
        assumptions=Assumptions(track.limits, known.refuted),
        clock=None if clock is None else clock.estimate(),
        rejected={str(reason): count for reason, count in sorted(known.rejected.items())},
        recent_rejections=known.recent_rejections,
    )
