"""The state of the program as shown by the API."""

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, Protocol

from companion.mavlink.links.lag import ArrivalLag, LagSeen
from companion.mavlink.links.status import LinkStatus
from companion.mavlink.voice.rate_watch import MessageRate
from companion.pipeline.assembly import Equipment
from companion.pipeline.fold import Pipeline
from companion.settings.origins import Origins
from companion.values import Blame, Notice, Observation
from companion.values.described import Meaning
from companion.views import center_state, health, link_state
from companion.views.as_json import Json, as_json
from companion.views.center_state import Center
from companion.views.health import Headline
from companion.views.last_messages import LastMessages
from companion.views.lateness import Lateness
from companion.views.link_state import Components, HeardLink, Links, LinkState, OutLink
from companion.views.series import Series
from companion.views.served import FleetStatus, served_uavs


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingStatus:
    """Recording that is being written."""

    state: Annotated[
        Literal["recording", "degraded", "off"],
        Meaning("recording; degraded: some events are lost; off"),
    ]
    file: Annotated[str | None, Meaning("name of the file")]
    bytes: Annotated[int, Meaning("size of the file so far")]
    messages: Annotated[int, Meaning("messages recorded so far")]
    dropped: Annotated[int, Meaning("events that could not be recorded")]
    queued: Annotated[int, Meaning("events waiting to be written")] = 0
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


@dataclass(slots=True, kw_only=True)
class ObservationCounts:
    """Observations of the array's own receiver since the start, over UDP and HTTP."""

    received: Annotated[int, Meaning("valid observations received")] = 0
    malformed: Annotated[int, Meaning("malformed observations received")] = 0
    dropped: Annotated[
        int, Meaning("observations dropped, because more arrived than are processed")
    ] = 0


@dataclass(frozen=True, slots=True)
class Throughput:
    """Rates of frames and updates over the last seconds."""

    frames_hz: Annotated[float | None, Meaning("rate of MAVLink frames")]
    updates_hz: Annotated[float | None, Meaning("rate of beam updates")]


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """Status of the service at a glance; ``replay`` is null in a live service."""

    version: Annotated[str, Meaning("version of the program")]
    node: Annotated[
        str | None, Meaning("this node's name in its fleet; null without a fleet", example="north")
    ]
    time_ns: Annotated[int, Meaning("the service's own time")]
    uptime_s: Annotated[float, Meaning("time since the start")]
    center: Annotated[Center, Meaning("the carrier of the array")]
    health: Annotated[Headline, Meaning("number of good, weak and missing links")]
    not_ready: Annotated[
        list[str],
        Meaning("why the service is not ready; empty if it is", example=["no link is up"]),
    ]
    links: Annotated[list[LinkState], Meaning("the links, in the order of the settings")]
    recording: Annotated[RecordingStatus, Meaning("the recording that is being written")]
    arrival_lag: Annotated[
        LagSeen, Meaning("time from the arrival of frames at this computer until they were read")
    ]
    observations: Annotated[
        ObservationCounts | None,
        Meaning("observations of the array's own receiver; null in a replay"),
    ]
    rates: Annotated[Throughput, Meaning("rates over the last seconds")]
    frames: Annotated[int, Meaning("MAVLink frames processed since the start")]
    updates: Annotated[int, Meaning("beam updates so far")]
    rejected: Annotated[dict[str, int], Meaning("number of rejections by reason")]
    digest: Annotated[
        str,
        Meaning("running SHA-256 over all estimates and weights; equal events give equal digests"),
    ]
    replay: Annotated[ReplayStatus | None, Meaning("progress of a replay; null: live service")]


class Node(Protocol):
    """Interface that the server reads: the running service, a replay, or a test double.

    ``replay`` returns None in a live service, ``fleet_status`` without a fleet. ``may_observe``
    spends the budget of one observation, and returns False if none is left. ``observe`` then
    processes a valid observation, or counts one that is invalid for the given reason.
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
    def observations(self) -> ObservationCounts | None: ...
    def may_observe(self) -> bool: ...
    def observe(self, found: Observation | str) -> None: ...
    def events(self) -> list[Notice]: ...
    def notify(self, notice: Notice) -> None: ...
    def replay(self) -> ReplayStatus | None: ...
    def fleet_status(self) -> FleetStatus | None: ...
    def ticked(self) -> Awaitable[None]: ...


def component_count(node: Node) -> int:
    """Return the number of components received over all links."""
    return sum(len(item.components) for item in node.links())


def links(node: Node) -> Callable[[], Json]:
    """Read the links; return a function that makes the answer of ``/v1/links``, on any thread.

    There may be thousands of components; their counts are read by that function.
    """
    now_ns, utc_ns = node.now_ns(), node.pipeline.utc_ns
    heard, components = list[HeardLink](), list[Components]()
    for item in node.links():
        share = node.pipeline.senders.link_share(item.url)
        heard.append(HeardLink(link_state.link(item, share, now_ns), []))
        components.append(list(item.components.items()))
    out = [OutLink(item) for item in node.out_links()]
    shown = as_json(
        Links(valid_at_ns=now_ns, links=heard, out=out, message_rates=node.message_rates()), utc_ns
    )

    def made() -> Json:
        for one, received in zip(shown["links"], components, strict=True):
            found = link_state.components(received, now_ns)
            one["components"] = [as_json(component, utc_ns) for component in found]
        return shown

    return made


def status(node: Node, version: str) -> Json:
    """Return the answer of ``/v1/status``."""
    pipeline, now_ns = node.pipeline, node.now_ns()
    fleet_status, senders = node.fleet_status(), pipeline.senders
    shown = Status(
        version=version,
        node=None if fleet_status is None else fleet_status.member.name,
        time_ns=now_ns,
        uptime_s=node.uptime_s(),
        center=center_state.center(pipeline, now_ns),
        health=summary(node, now_ns),
        not_ready=node.unfit(),
        links=[link_state.link(one, senders.link_share(one.url), now_ns) for one in node.links()],
        recording=node.recording(),
        arrival_lag=node.arrival_lag.seen(now_ns),
        observations=node.observations(),
        rates=Throughput(**node.rates()),
        frames=pipeline.frames,
        updates=pipeline.updates,
        rejected={str(reason): n for reason, n in sorted(pipeline.refusals.total.items())},
        digest=pipeline.digest.hexdigest(),
        replay=node.replay(),
    )
    return as_json(shown, pipeline.utc_ns)


def overload(node: Node, now_ns: int) -> Blame | None:
    """Return the cause of weak links if this machine is overloaded; None otherwise."""
    if node.replay() is not None:
        return None
    update = node.pipeline.last_update
    age_s = None if update is None else (now_ns - update.t_ns) * 1e-9
    update_hz = node.pipeline.settings.beams.update_hz
    return health.behind(node.arrival_lag.seen(now_ns), age_s, update_hz)


def summary(node: Node, now_ns: int) -> Headline:
    """Return the headline on the links, including UAVs that no node of a fleet serves."""
    pipeline = node.pipeline
    served = served_uavs(pipeline, node.fleet_status(), now_ns)
    machine = overload(node, now_ns)
    verdicts = health.shown_verdicts(pipeline.health, machine)
    if served is None:
        return health.summary(verdicts.values(), machine)
    here = [one for uav, one in verdicts.items() if served.is_here(uav)]
    unserved, elsewhere = len(served.unserved), served.elsewhere
    return health.summary(here, machine, unserved=unserved, elsewhere=elsewhere)
