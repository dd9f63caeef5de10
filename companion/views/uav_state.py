"""UAVs as shown by the API."""

from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np

from companion.mavlink.clock.estimates import ClockEstimate
from companion.pipeline.fold import Pipeline
from companion.tracking.geodesy import Place
from companion.values import AltitudeDatum, Blame, Carrier, Level, Limits, Rejection, Track, Vector
from companion.values.described import Inline, Meaning
from companion.views import health
from companion.views.as_json import Json, as_json
from companion.views.health import LinkHealth
from companion.views.served import Served, served_uavs
from companion.views.state import Node


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
    pipeline = node.pipeline
    tracks = [
        track for track in pipeline.tracks(now_ns, now_ns) if only is None or track.uav == only
    ]
    if not tracks or pipeline.local is None:
        return []
    found = pipeline.carrier(now_ns, now_ns)
    carrier = None if isinstance(found, str) else found
    columns = pipeline.local.geodetic(np.array([track.position_ned_m for track in tracks]))
    places = zip(*(column.tolist() for column in columns), strict=True)
    machine = health.behind(node.arrival_lag.seen(now_ns))
    served = served_uavs(pipeline, node.fleet_status(), now_ns)
    return [
        _state(pipeline, track, carrier, place=Place(*place), machine=machine, served=served)
        for track, place in zip(tracks, places, strict=True)
    ]


def _state(
    pipeline: Pipeline,
    track: Track,
    carrier: Carrier | None,
    *,
    place: Place,
    machine: Blame | None,
    served: Served | None,
) -> UavState:
    """Return the state of a UAV; ``machine`` is the cause of weak links by overload."""
    north_m, east_m, down_m = (
        (None, None, None)
        if carrier is None
        else (track.position_ned_m - carrier.position_ned_m).tolist()
    )
    uav, refused = track.uav, pipeline.refusals.of(track.uav)
    is_target = pipeline.targets.wants(uav)
    is_here = served is None or served.is_here(uav)
    judged = pipeline.health.verdicts.get(uav) if is_here else None
    unserved = None if served is None else served.unserved.get(uav)
    level, why = health.verdict(judged, machine, unserved)
    newest, aircraft = pipeline.tracker.newest(uav), pipeline.senders.aircraft
    report = newest.report if newest else None
    return UavState(
        id=uav,
        verdict=level,
        health=why,
        target=is_target,
        served_by=served.by.get(uav, []) if served and is_target else None,
        same_as=pipeline.targets.identities.same_as(uav),
        callsign=aircraft.callsign(uav),
        relays=[str(relay) for relay in aircraft.relays(uav)],
        alt_datum=report.alt_datum if report else None,
        fix=ReportedFix(newest.t_ns, Place(report.lat_deg, report.lon_deg, report.alt_m))
        if newest and report
        else None,
        place=place,
        north_m=north_m,
        east_m=east_m,
        down_m=down_m,
        heading_deg=report.heading_deg if report else None,
        track=track,
        assumptions=Assumptions(track.limits, pipeline.refuted(uav)),
        clock=pipeline.clock_estimate(uav),
        rejected={str(reason): count for reason, count in sorted(refused.counts.items())},
        recent_rejections=list(refused.recent),
    )
