"""Models of the API's answers, for the OpenAPI document only. Nothing is validated by them in
flight.

Angles in degrees, distances in metres, times in RFC 3339 (UTC). Null is not known, never 0.

Over 300 lines: it is a list, the words of the API.
"""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field

from companion.server import beam_models

Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Time = Annotated[str, Field(examples=["2026-11-20T13:00:00.123Z"])]
Uav = Annotated[str, Field(examples=["3:1"])]
Link = Annotated[str, Field(examples=["udpin:0.0.0.0:14550"])]

Beams, Weights, Pattern = beam_models.Beams, beam_models.Weights, beam_models.Pattern


class Problem(BaseModel):
    """An error (RFC 9457). ``title`` says what is wrong, in one line."""

    type: Literal["about:blank"]
    title: Annotated[str, Field(examples=["no UAV '9:9' has been heard"])]
    status: Annotated[int, Field(examples=[404])]


class Health(BaseModel):
    """The process answers."""

    status: Literal["ok"]


class Readiness(BaseModel):
    """Whether the service is fit to be used; ``reasons`` say why not."""

    ready: bool
    reasons: Annotated[list[str], Field(examples=[["no link is up"]])]


class Clock(BaseModel):
    """What is known of a sender's clock."""

    kind: str
    guarantee: Literal["measured", "assumed"]
    offset_s: float
    drift_ppm: float | None
    uncertainty_s: float | None
    before_s: float
    after_s: float
    constant_delay_s: float | None
    latency_s: float | None


class Refusal(BaseModel):
    """A report that was not used."""

    at: Time
    reason: Annotated[str, Field(examples=["unreachable"])]
    detail: str


class Fix(BaseModel):
    """Where a UAV said last that it was, and when it was there."""

    at: Time
    lat_deg: float
    lon_deg: float
    alt_m: float


class Assumptions(BaseModel):
    """What the bounds of one UAV rest on, and how often its reports or stamps refuted that."""

    source: Literal["settings", "type", "raised"]
    speed_max_mps: float
    acceleration_max_mps2: float
    refuted: int


class LinkHealth(BaseModel):
    """What is behind the verdict on the link to a UAV; gains are those of the array, dB."""

    cause: (
        Literal[
            "carrier",
            "silent",
            "refused",
            "rate",
            "late",
            "agile",
            "clock",
            "position",
            "crowded",
            "coverage",
            "range",
            "machine",
            "unserved",
        ]
        | None
    )
    reason: Annotated[str | None, Field(examples=["reports 1.1 s apart"])]
    remedy: Annotated[str | None, Field(examples=["ask for 10 Hz ([presence] position_hz)"])]
    since: Time | None
    needed_gain_db: float | None
    guaranteed_gain_db: float | None
    likely_gain_db: float | None


class Headline(BaseModel):
    """How many links to UAVs are good, weak, none; and the same in words."""

    good: int
    weak: int
    none: int
    headline: Annotated[str, Field(examples=["3 of 4 links good"])]
    behind: str | None


class UavState(BaseModel):
    """One UAV as it is at ``valid_at``; north, east and down are seen from the array."""

    id: Uav
    state: Literal["live", "coasting", "stale", "lost"]
    verdict: Literal["good", "weak", "none"] | None
    health: LinkHealth | None
    target: bool
    served_by: list[str] | None
    same_as: Uav | None
    callsign: Annotated[str | None, Field(examples=["SWR12A"])]
    relays: list[str]
    altitude_datum: Literal["msl", "pressure", "geometric"] | None
    fix: Fix | None
    valid_at: Time
    age_s: float
    lat_deg: Annotated[float, Field(examples=[47.3977])]
    lon_deg: Annotated[float, Field(examples=[8.5456])]
    alt_m: Annotated[float, Field(examples=[531.2])]
    north_m: float | None
    east_m: float | None
    down_m: float | None
    velocity_ned_mps: Vector | None
    speed_mps: float | None
    heading_deg: float | None
    unknown_input_mps: Vector | None
    acceleration_ned_mps2: Vector | None
    bound_m: Annotated[float, Field(examples=[4.2])]
    bound_cylinder_ned_m: Vector
    bound_ellipsoid_ned_m: Annotated[Vector, Field(deprecated=True)]
    set_center_ned_m: Vector
    set_radius_m: float
    error_p95_m: float | None
    assumptions: Assumptions
    clock_bound_s: float
    clock: Clock | None
    dt_s: float | None
    latency_s: float | None
    gamma: float | None
    innovation_m: float | None
    reports: int
    rejected: dict[str, int]
    recent_rejections: list[Refusal]


class Uavs(BaseModel):
    """Every UAV that was heard, at ``valid_at``."""

    valid_at: Time
    uavs: list[UavState]


class Angles(BaseModel):
    """Attitude of the carrier's body."""

    roll: float
    pitch: float
    yaw: float


class LastPose(BaseModel):
    """Where the array was at a time, and how it was turned."""

    at: Time
    lat_deg: float
    lon_deg: float
    alt_m: float
    heading_deg: float
    attitude_deg: Angles


class Center(BaseModel):
    """What carries the array; ``unfit`` says why its place is not known."""

    source: Annotated[str, Field(examples=["5:1"])]
    fixed: bool
    lat_deg: float | None
    lon_deg: float | None
    alt_m: float | None
    heading_deg: float | None
    attitude_deg: Angles | None
    age_s: float | None
    bound_m: float | None
    unfit: str | None
    last_known: LastPose | None


class LinkReports(BaseModel):
    """Reports over a link: how many came first over it, and how old they were."""

    total: int
    first: int
    first_share: float | None
    latency_p50_s: float | None
    latency_p95_s: float | None


class LinkState(BaseModel):
    """One link; ``lost`` counts refusals by reason, garbage in bytes."""

    url: Link
    state: Literal["up", "connecting", "down"]
    age_s: float | None
    frames: int
    bytes: int
    peers: int
    bad_crc: int
    lost: dict[str, int]
    gaps: int
    late: int
    repeats: int
    arrival: Literal["kernel", "read"]
    misstamped: int
    overflowed: int | None
    receive_buffer_bytes: int | None
    sent: int
    send_dropped: int
    reports: LinkReports


class Component(BaseModel):
    """Who is heard over a link."""

    id: Uav
    frames: int
    gaps: int
    age_s: float
    mavlink: Literal[1, 2]


class HeardLink(LinkState):
    """One link, and who is heard over it."""

    components: list[Component]


class OutLink(BaseModel):
    """One link of ``[out]``, on which only is spoken."""

    url: Link
    state: Literal["up", "connecting", "down"]
    peers: int
    sent: int
    send_dropped: int


class MessageRate(BaseModel):
    """A message whose rate is asked of a UAV."""

    uav: Uav
    message_id: int
    wanted_hz: float
    observed_hz: float | None
    state: str
    asked: int
    changed_by: str | None


class Links(BaseModel):
    """Links, who is heard over each, and the rates that are asked for."""

    valid_at: Time
    links: list[HeardLink]
    out: list[OutLink]
    message_rates: list[MessageRate]


class RecordingState(BaseModel):
    """The recording that is being written."""

    state: Literal["recording", "degraded", "off"]
    file: str | None
    bytes: int
    messages: int
    dropped: int
    queued: int
    lag_s: float | None


class ArrivalLag(BaseModel):
    """How long frames waited for this machine, over ten seconds; null where no stamp tells.

    The 95th percentile and the greatest are of the worst of each tenth of a second. ``behind``:
    above half a second for a second or more, until two seconds after that.
    """

    newest_s: float | None
    p95_s: float | None
    max_s: float | None
    behind: bool


class Throughput(BaseModel):
    """Rates over the last seconds."""

    frames_hz: float | None
    updates_hz: float | None


class FleetPlace(BaseModel):
    """Where a node's array is."""

    lat_deg: float
    lon_deg: float
    alt_m: float


class FleetNode(BaseModel):
    """A node of the fleet: this one, then the others by name, and then those that are gone."""

    node: str
    is_self: bool
    state: Literal["here", "there", "silent", "aside", "gone"]
    near: bool
    reason: str | None
    place: FleetPlace | None
    reach_m: float | None
    serves: int
    most: int | None
    heard_s: float | None
    clock_offset_s: float | None
    clock_doubt_s: float | None
    frames: int | None
    used: int | None
    way_p50_ms: float | None
    way_p99_ms: float | None


class FleetOffer(BaseModel):
    """What a node's array would have towards a UAV, if it served it alone."""

    node: str
    sure_db: float | None
    likely_db: float | None
    sinr_db: float | None
    heard_s: float | None


class FleetUav(BaseModel):
    """A UAV, who serves it, and what each node offers it."""

    uav: Uav
    served_by: list[str]
    handing_to: str | None
    unconfirmed: bool
    offers: list[FleetOffer]


class FleetHandover(BaseModel):
    """A change of who serves a UAV, that this node took part in."""

    time: Time
    uav: Uav
    before: str | None
    after: str | None


class Fleet(BaseModel):
    """The fleet as this node knows it; ``node`` is null where there is none."""

    valid_at: Time
    node: str | None
    site: str | None
    nodes: list[FleetNode]
    uavs: list[FleetUav]
    handovers: list[FleetHandover]
    sent_bps: float | None
    heard_bps: float | None
    damaged: int
    untold: int


class Replay(BaseModel):
    """How far a replay is: seconds of the log, of how many; ``speed`` null: as fast as it goes."""

    log: str
    speed: float | None
    at_s: float
    of_s: float | None
    state: Literal["running", "finished"]


class Status(BaseModel):
    """The service at a glance; ``replay`` is null where it is live."""

    version: str
    node: Annotated[str | None, Field(examples=["north"])]
    time: Time
    uptime_s: float
    center: Center
    health: Headline
    links: list[LinkState]
    recording: RecordingState
    arrival_lag: ArrivalLag
    rates: Throughput
    frames: int
    updates: int
    rejected: dict[str, int]
    digest: str
    replay: Replay | None


class Setting(BaseModel):
    """One setting, and where it comes from."""

    value: Any
    default: Any
    source: Literal["default", "file", "recording", "option", "program"]
    file: str | None


class EffectiveSettings(BaseModel):
    """The settings by section and key."""

    sections: dict[str, dict[str, Setting]]


Column = list[float | None]


class UavHistory(BaseModel):
    """Columns of one UAV, as long as ``at``; null where it was not known."""

    pointing_bound_deg: Column
    innovation_m: Column
    latency_s: Column
    guaranteed_gain_db: Column


class History(BaseModel):
    """A sample each second, the oldest first."""

    valid_at: Time
    at: list[Time]
    uavs: dict[str, UavHistory]


class AreaMap(BaseModel):
    """The map under the plan view: its file's name, null without one."""

    name: str | None


class Event(BaseModel):
    """Something that was said to the operator."""

    at: Time
    severity: Literal["info", "warning", "error"]
    subject: str
    text: Annotated[str, Field(examples=["3:1 is coasting"])]


class Events(BaseModel):
    """What was said last, the oldest first."""

    events: list[Event]


Matrix = list[list[float]]


class Assumed(BaseModel):
    """Bounds that the observer takes for granted."""

    speed_max_mps: float
    acceleration_max_mps2: float
    position_noise_m: float
    velocity_noise_mps: float


class Certificate(BaseModel):
    """Certificate of the table of gains: e'Pe <= scale^2 stays so, whatever the order of intervals
    in the range; ``scale`` is how much larger the assumed bounds are than those of the table.
    """

    P: Matrix
    dt_range_s: Annotated[list[float], Field(min_length=2, max_length=2)]
    margin: float
    scale: float
    bound_m: float
    provenance: str


class UavDesign(BaseModel):
    """The gains at a UAV's interval, with the keys of ``companion design --json``."""

    uav: Uav
    dt_s: float
    model: Literal["kinematic", "position"]
    alpha: float | None
    feedthrough_s: float
    L: float | Matrix
    Q: float | Matrix
    mu: float | None
    gamma: float | None
    peak_gain: float | None
    residual: float | None
    feasible: bool
    dt_limit_s: float | None
    method: Literal["lmi", "closed-form", "fixed-share"]


class Design(BaseModel):
    """The observer in use."""

    valid_at: Time
    model: Literal["kinematic", "position"]
    assumed: Assumed
    certificate: Certificate | None
    designs: list[UavDesign]


class Recording(BaseModel):
    """A file that can be had at ``/v1/recordings/{name}``; ``unfinished`` was cut short."""

    name: Annotated[str, Field(examples=["companion-20261120T130000Z.mcap"])]
    bytes: int | None
    state: Literal["recording", "finished", "unfinished"]
    started: Time | None


class Recordings(BaseModel):
    """The recordings, by name."""

    recordings: list[Recording]


class MessageTime(BaseModel):
    """When, how many, how often (1/s)."""

    first_update: Time
    last_update: Time
    counter: int
    frequency: float | None


class MessageStatus(BaseModel):
    """As mavlink2rest has it."""

    time: MessageTime


class MavlinkMessage(BaseModel):
    """The last message of its kind: ``type`` is its name, beside its fields."""

    message: Annotated[
        dict[str, Any],
        Field(examples=[{"type": "SYSTEM_TIME", "time_unix_usec": 0, "time_boot_ms": 81}]),
    ]
    status: MessageStatus


class MavlinkComponent(BaseModel):
    """One component: its last messages by name."""

    id: int
    messages: dict[str, MavlinkMessage]


class MavlinkVehicle(BaseModel):
    """One system: its components by id."""

    id: int
    components: dict[str, MavlinkComponent]
