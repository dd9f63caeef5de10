"""The program's state as the API shows it: degrees, metres, RFC 3339 times, null for unknown."""

from collections.abc import Awaitable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np

from companion.mavlink.clock.estimates import ClockEstimate
from companion.mavlink.links.lag import ArrivalLag
from companion.mavlink.links.status import LinkStatus
from companion.mavlink.voice.rate_watch import MessageRate
from companion.pipeline.assembly import Equipment
from companion.pipeline.fold import Pipeline
from companion.settings.origins import Origins
from companion.values import Blame, Carrier, Fix, FloatArray, Notice, Track
from companion.views import center_state, health, link_state
from companion.views import fleet as fleet_view
from companion.views.fleet import FleetStatus, Served
from companion.views.last_messages import LastMessages
from companion.views.lateness import Lateness
from companion.views.series import Series
from companion.views.words import rfc3339

Json = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingStatus:
    """The recording as the API shows it.

    state     "recording", "degraded" or "off"
    file      name of the file being written
    bytes     its size
    messages  messages recorded so far
    dropped   events that were not recorded
    queued    events that wait to be written
    lag_s     how far behind the newest written event is; None before the first
    """

    state: str
    file: str | None
    bytes: int
    messages: int
    dropped: int
    queued: int = 0
    lag_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayStatus:
    """Progress of a replay.

    log    name of the log
    speed  multiple of the log's own speed; None: as fast as it goes
    at_s   seconds of log since its first event
    of_s   length of the log in seconds; None while it is not known
    state  "running" or "finished"
    """

    log: str
    speed: float | None
    at_s: float
    of_s: float | None
    state: str


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
    """The answer of ``/v1/links``: who is heard over each, what goes out, the rates asked for."""
    now_ns = node.now_ns()
    shown = [
        link_state.link(item, node.pipeline.senders.link_share(item.url), now_ns)
        | {"components": link_state.components(item, now_ns)}
        for item in node.links()
    ]
    out = [link_state.out(item) for item in node.out_links()]
    rates = [link_state.rate(rate) for rate in node.message_rates()]
    return {
        "valid_at": rfc3339(node.pipeline.utc_ns(now_ns)),
        "links": shown,
        "out": out,
        "message_rates": rates,
    }


def vector(values: FloatArray | None) -> list[float] | None:
    """A 3-vector as a list; None stays null."""
    return None if values is None else [float(value) for value in values]


def status(node: Node, version: str) -> Json:
    """The answer of ``/v1/status``."""
    pipeline, now_ns = node.pipeline, node.now_ns()
    recording, replay = node.recording(), node.replay()
    fleet_status = node.fleet_status()
    return {
        "version": version,
        "node": None if fleet_status is None else fleet_status.member.name,
        "time": rfc3339(pipeline.utc_ns(now_ns)),
        "uptime_s": node.uptime_s(),
        "center": center_state.center(pipeline, now_ns),
        "health": summary(node, now_ns),
        "links": [
            link_state.link(item, pipeline.senders.link_share(item.url), now_ns)
            for item in node.links()
        ],
        "recording": {
            "state": recording.state,
            "file": recording.file,
            "bytes": recording.bytes,
            "messages": recording.messages,
            "dropped": recording.dropped,
            "queued": recording.queued,
            "lag_s": recording.lag_s,
        },
        "arrival_lag": asdict(node.arrival_lag.seen(now_ns)),
        "rates": dict(node.rates()),
        "frames": pipeline.frames,
        "updates": pipeline.updates,
        "rejected": {str(reason): n for reason, n in sorted(pipeline.refusals.total.items())},
        "digest": pipeline.digest.hexdigest(),
        "replay": asdict(replay) if replay else None,
    }


def summary(node: Node, now_ns: int) -> Json:
    """How good the links are, those included that no node of a fleet serves."""
    pipeline = node.pipeline
    served = fleet_view.served(pipeline, node.fleet_status(), now_ns)
    verdicts, machine = pipeline.health.verdicts, health.behind(node.arrival_lag.seen(now_ns))
    if served is None:
        return health.summary(verdicts.values(), machine)
    here = [one for uav, one in verdicts.items() if served.is_here(uav)]
    nobody, elsewhere = len(served.nobody), served.elsewhere
    return health.summary(here, machine, unserved=nobody, elsewhere=elsewhere)


def uavs(node: Node, only: str | None = None) -> list[Json]:
    """Every UAV, or one, as it is now."""
    pipeline, now_ns = node.pipeline, node.now_ns()
    tracks = [
        track for track in pipeline.tracks(now_ns, now_ns) if only is None or track.uav == only
    ]
    if not tracks or pipeline.local is None:
        return []
    found = pipeline.carrier(now_ns, now_ns)
    carrier = None if isinstance(found, str) else found
    places = np.array([track.position_ned_m for track in tracks])
    geodetic = zip(*pipeline.local.geodetic(places), strict=True)
    machine = health.behind(node.arrival_lag.seen(now_ns))
    served = fleet_view.served(pipeline, node.fleet_status(), now_ns)
    return [
        uav(
            pipeline, track, carrier, place=tuple(map(float, place)), machine=machine, served=served
        )
        for track, place in zip(tracks, geodetic, strict=True)
    ]


def uav(
    pipeline: Pipeline,
    track: Track,
    carrier: Carrier | None,
    *,
    place: tuple[float, ...],
    machine: Blame | None,
    served: Served | None,
) -> Json:
    """One entry of ``/v1/uavs``.

    ``place`` is latitude, longitude and height; ``machine`` is to blame for all links where it is
    behind; ``served`` says which node of the fleet serves whom.
    """
    offset = None if carrier is None else track.position_ned_m - carrier.position_ned_m
    north, east, down = (None, None, None) if offset is None else map(float, offset)
    velocity = vector(track.velocity_ned_mps)
    refused = pipeline.refusals.of(track.uav)
    is_target = pipeline.targets.wants(track.uav)
    is_here = served is None or served.is_here(track.uav)
    judged = pipeline.health.verdicts.get(track.uav) if is_here else None
    unserved = None if served is None else served.nobody.get(track.uav)
    newest = pipeline.tracker.newest(track.uav)
    cylinder = [track.horizontal_bound_m] * 2 + [track.vertical_bound_m]
    return {
        "id": track.uav,
        "state": str(track.state),
        **health.verdict(judged, machine, pipeline.utc_ns, unserved),
        "target": is_target,
        "served_by": served.by.get(track.uav, []) if served and is_target else None,
        "same_as": pipeline.targets.same_as(track.uav),
        "callsign": pipeline.senders.aircraft.callsign(track.uav),
        "relays": [str(relay) for relay in pipeline.senders.aircraft.relays(track.uav)],
        "altitude_datum": str(newest.report.alt_datum) if newest else None,
        "fix": None if newest is None else fix(pipeline, newest),
        "valid_at": rfc3339(pipeline.utc_ns(track.valid_at_ns)),
        "age_s": track.age_s,
        "lat_deg": place[0],
        "lon_deg": place[1],
        "alt_m": place[2],
        "north_m": north,
        "east_m": east,
        "down_m": down,
        "velocity_ned_mps": velocity,
        "speed_mps": None if velocity is None else float(np.linalg.norm(velocity)),
        "heading_deg": newest.report.heading_deg if newest else None,
        "unknown_input_mps": vector(track.unknown_input_mps),
        "acceleration_ned_mps2": vector(track.acceleration_ned_mps2),
        "bound_m": track.bound_m,
        "bound_cylinder_ned_m": cylinder,
        "bound_ellipsoid_ned_m": cylinder,
        "set_center_ned_m": vector(track.set_center_ned_m),
        "set_radius_m": track.set_radius_m,
        "error_p95_m": track.error_p95_m,
        "assumptions": {
            "source": str(track.limits.source),
            "speed_max_mps": track.limits.speed_mps,
            "acceleration_max_mps2": track.limits.acceleration_mps2,
            "refuted": pipeline.assumptions.times(track.uav),
        },
        "clock_bound_s": track.clock_bound_s,
        "clock": clock(pipeline.clock_estimate(track.uav)),
        "dt_s": track.dt_s,
        "latency_s": track.latency_s,
        "gamma": track.gamma,
        "innovation_m": track.innovation_m,
        "reports": track.reports,
        "rejected": {str(reason): count for reason, count in sorted(refused.counts.items())},
        "recent_rejections": [
            {
                "at": rfc3339(pipeline.utc_ns(one.t_ns)),
                "reason": str(one.reason),
                "detail": one.detail,
            }
            for one in refused.recent
        ],
    }


def fix(pipeline: Pipeline, newest: Fix) -> Json:
    """The last reported position of a UAV."""
    report = newest.report
    return {
        "at": rfc3339(pipeline.utc_ns(newest.t_ns)),
        "lat_deg": report.lat_deg,
        "lon_deg": report.lon_deg,
        "alt_m": report.alt_m,
    }


def clock(estimate: ClockEstimate | None) -> Json | None:
    """The state of a sender's clock; null for ADS-B traffic, which has none."""
    if estimate is None:
        return None
    return {
        "kind": str(estimate.kind),
        "guarantee": str(estimate.guarantee),
        "offset_s": estimate.offset_ns * 1e-9,
        "drift_ppm": estimate.drift_ppm,
        "uncertainty_s": estimate.uncertainty_s,
        "before_s": estimate.before_s,
        "after_s": estimate.after_s,
        "constant_delay_s": estimate.constant_delay_s,
        "latency_s": estimate.latency_s,
    }
