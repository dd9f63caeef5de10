"""The state of the program as the API shows it."""

from collections.abc import Awaitable, Mapping
from dataclasses import dataclass
from typing import Annotated, Final, Literal, Protocol

import numpy as np

from companion.mavlink.clock.estimates import ClockEstimate
from companion.mavlink.links.lag import ArrivalLag, LagSeen
from companion.mavlink.links.status import LinkStatus
from companion.mavlink.voice.rate_watch import MessageRate
from companion.pipeline.assembly import Equipment
from companion.pipeline.fold import Pipeline
from companion.settings.origins import Origins
from companion.tracking.geodesy import Place
from companion.values import (
    AltitudeDatum,
    Blame,
    Carrier,
    Level,
    Limits,
    Notice,
    Rejection,
    Track,
    Vector,
)
from companion.values.described import Inline, Meaning
from companion.views import center_state, health, link_state
from companion.views import fleet as fleet_view
from companion.views.as_json import Json, as_json
from companion.views.center_state import Center
from companion.views.fleet import FleetStatus, Served
from companion.views.health import Headline, LinkHealth
from companion.views.last_messages import LastMessages
from companion.views.lateness import Lateness
from companion.views.link_state import HeardLink, Links, LinkState, OutLink
from companion.views.series import Series


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingStatus:
    """The recording that is being written."""

    state: Annotated[
        Literal["recording", "degraded", "off"],
        Meaning("recording; degraded: something is lost; off"),
    ]
    file: Annotated[str | None, Meaning("name of the file")]
    bytes: Annotated[int, Meaning("size of the file so far")]
    messages: Annotated[int, Meaning("messages recorded so far")]
    dropped: Annotated[int, Meaning("events that could not be recorded")]
    queued: Annotated[int, Meaning("events that wait to be written")] = 0
    lag_s: Annotated[float | None, Meaning("age of the newest written event")] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayStatus:
    """Progress of a replay."""

    log: Annotated[str, Meaning("name of the log")]
    speed: Annotated[
        float | None, Meaning("multiple of the log's own speed; null: as fast as possible")
    ]
    at_s: Annotated[float, Meaning("replayed part of the log")]
    of_s: Annotated[float | None, Meaning("length of the log")]
    state: Annotated[
        Literal["running", "finished"], Meaning("finished: the page shows the end of the log")
    ]


@dataclass(frozen=True, slots=True)
class Throughput:
    """Rates over the last seconds."""

    frames_hz: Annotated[float | None, Meaning("rate of MAVLink frames")]
    updates_hz: Annotated[float | None, Meaning("rate of beam updates")]


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """The service at a glance; ``replay`` is null where it is live."""

    version: Annotated[str, Meaning("version of the program")]
    node: Annotated[
        str | None, Meaning("this node's name in its fleet; null without a fleet", example="north")
    ]
    time_ns: Annotated[int, Meaning("the service's own time")]
    uptime_s: Annotated[float, Meaning("time since the start")]
    center: Annotated[Center, Meaning("what carries the array")]
    health: Annotated[Headline, Meaning("how many links are good")]
    links: Annotated[list[LinkState], Meaning("the links, in the order of the settings")]
    recording: Annotated[RecordingStatus, Meaning("the recording that is being written")]
    arrival_lag: Annotated[LagSeen, Meaning("how long frames waited for this machine")]
    rates: Annotated[Throughput, Meaning("rates over the last seconds")]
    frames: Annotated[int, Meaning("MAVLink frames processed since the start")]
    updates: Annotated[int, Meaning("beam updates so far")]
    rejected: Annotated[dict[str, int], Meaning("what was received and not used, by reason")]
    digest: Annotated[str, Meaning("running SHA-256 over every decision: equal for equal events")]
    replay: Annotated[ReplayStatus | None, Meaning("progress of a replay; null where live")]


@dataclass(frozen=True, slots=True)
class ReportedFix:
    """The newest reported position of a UAV, and when the UAV was there."""

    t_ns: Annotated[int, Meaning("when the UAV was there")]
    place: Annotated[Place, Inline()]


@dataclass(frozen=True, slots=True)
class Assumptions:
    """What the bounds of one UAV assume, and how often its reports or time stamps refuted that."""

    limits: Annotated[Limits, Inline()]
    refuted: Annotated[int, Meaning("times that reports or time stamps refuted an assumption")]


_BOUND_AXES: Final = Meaning(
    text="half axes of the cylinder that contains the position, north, east, down",
    deprecated="horizontal_bound_m and vertical_bound_m",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class UavState:
    """One UAV as it is at ``valid_at``; north, east and down are measured from the array."""

    id: Annotated[str, Meaning("SYSID:COMPID, icao:HEX, rid:ID or cot:UID", example="3:1")]
    verdict: Annotated[
        Level | None,
        Meaning(
            "whether the beam has the gain that the link needs: good: guaranteed; weak: usually"
        ),
    ]
    health: Annotated[LinkHealth | None, Meaning("what is behind the verdict")]
    target: Annotated[bool, Meaning("whether a beam is wanted for it, of whichever node")]
    served_by: Annotated[
        list[str] | None,
        Meaning("nodes of the fleet that serve it; null: no fleet, or no beam is wanted"),
    ]
    same_as: Annotated[
        str | None, Meaning("id under which this aircraft is known better", example="3:1")
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
    assumptions: Annotated[Assumptions, Meaning("what the bounds of this UAV assume")]
    clock: Annotated[ClockEstimate | None, Meaning("the sender's clock; null for relayed aircraft")]
    rejected: Annotated[dict[str, int], Meaning("what was received and not used, by reason")]
    recent_rejections: Annotated[list[Rejection], Meaning("last reports that were not used")]

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
    """Every UAV that was heard, at ``valid_at``."""

    valid_at_ns: Annotated[int, Meaning("the instant for which the values hold")]
    uavs: Annotated[list[UavState], Meaning("the UAVs")]


class Node(Protocol):
    """What the server reads: the running service, a replay, or a test's substitute for them.

    ``replay`` returns None where the node is live, ``fleet_status`` where it is part of no fleet.
    """

    pipeline: Pipeline
    origins: Origins
    equipment: Equipment
    last_messages: LastMessages
    lateness: Lateness
    series: Series
    arrival_lag: ArrivalLag

    def now_ns(self) -> int: ...
    def uptime_s(self) -> float: ...
    def links(self) -> list[LinkStatus]: ...
    def out_links(self) -> list[LinkStatus]: ...
    def recording(self) -> RecordingStatus: ...
    def rates(self) -> Mapping[str, float | None]: ...
    def unfit(self) -> list[str]: ...
    def message_rates(self) -> list[MessageRate]: ...
    def events(self) -> list[Notice]: ...
    def replay(self) -> ReplayStatus | None: ...
    def fleet_status(self) -> FleetStatus | None: ...
    def ticked(self) -> Awaitable[None]: ...


def links(node: Node) -> Json:
    """The answer of ``/v1/links``."""
    now_ns = node.now_ns()
    heard = [
        HeardLink(
            link_state.link(item, node.pipeline.senders.link_share(item.url), now_ns),
            link_state.components(item, now_ns),
        )
        for item in node.links()
    ]
    out = [OutLink(item) for item in node.out_links()]
    return as_json(
        Links(valid_at_ns=now_ns, links=heard, out=out, message_rates=node.message_rates()),
        node.pipeline.utc_ns,
    )


def status(node: Node, version: str) -> Json:
    """The answer of ``/v1/status``."""
    pipeline, now_ns = node.pipeline, node.now_ns()
    fleet_status, senders = node.fleet_status(), pipeline.senders
    shown = Status(
        version=version,
        node=None if fleet_status is None else fleet_status.member.name,
        time_ns=now_ns,
        uptime_s=node.uptime_s(),
        center=center_state.center(pipeline, now_ns),
        health=summary(node, now_ns),
        links=[link_state.link(one, senders.link_share(one.url), now_ns) for one in node.links()],
        recording=node.recording(),
        arrival_lag=node.arrival_lag.seen(now_ns),
        rates=Throughput(**node.rates()),
        frames=pipeline.frames,
        updates=pipeline.updates,
        rejected={str(reason): n for reason, n in sorted(pipeline.refusals.total.items())},
        digest=pipeline.digest.hexdigest(),
        replay=node.replay(),
    )
    return as_json(shown, pipeline.utc_ns)


def summary(node: Node, now_ns: int) -> Headline:
    """How good the links are, those included that no node of a fleet serves."""
    pipeline = node.pipeline
    served = fleet_view.served(pipeline, node.fleet_status(), now_ns)
    verdicts, machine = pipeline.health.verdicts, health.behind(node.arrival_lag.seen(now_ns))
    if served is None:
        return health.summary(verdicts.values(), machine)
    here = [one for uav, one in verdicts.items() if served.is_here(uav)]
    nobody, elsewhere = len(served.nobody), served.elsewhere
    return health.summary(here, machine, unserved=nobody, elsewhere=elsewhere)


def uavs(node: Node) -> Json:
    """The answer of ``/v1/uavs``."""
    now_ns, utc_ns = node.now_ns(), node.pipeline.utc_ns
    return as_json(Uavs(now_ns, states(node, now_ns)), utc_ns)


def states(node: Node, now_ns: int, only: str | None = None) -> list[UavState]:
    """Every UAV, or one, as it is now."""
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
    served = fleet_view.served(pipeline, node.fleet_status(), now_ns)
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
    """One UAV; ``machine`` is what to blame for weak links where this machine is behind."""
    north_m, east_m, down_m = (
        (None, None, None)
        if carrier is None
        else (track.position_ned_m - carrier.position_ned_m).tolist()
    )
    uav, refused = track.uav, pipeline.refusals.of(track.uav)
    is_target = pipeline.targets.wants(uav)
    is_here = served is None or served.is_here(uav)
    judged = pipeline.health.verdicts.get(uav) if is_here else None
    unserved = None if served is None else served.nobody.get(uav)
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
