"""Positions: fixes, estimates, tracks and the carrier of the array."""

import math
from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

from companion.values.described import DescribedEnum, Inline, Meaning
from companion.values.numbers import FloatArray, Vector
from companion.values.received import Report


class ReportNoise(NamedTuple):
    """Bounds on the errors of one report. The class is a tuple for speed.

    apart_m  difference between the receiver's own altitudes and the recently reported ones, while
             it is unknown which is wrong; 0 if they agree
    """

    horizontal_m: Annotated[float, Meaning("bound on the horizontal position error")]
    vertical_m: Annotated[float, Meaning("bound on the altitude error")]
    position_m: Annotated[float, Meaning("bound on the position error in space")]
    velocity_mps: Annotated[float, Meaning("bound on the velocity error")]
    time_s: Annotated[float, Meaning("bound on the error of the report's time stamp")] = 0.0
    apart_m: float = 0.0


class LimitSource(DescribedEnum):
    """Where an aircraft's limits came from."""

    SETTINGS = "settings", "[observer] in the settings"
    TYPE = "type", "the aircraft's type"
    RAISED = "raised", "raised, because reports refuted the limits before"


@dataclass(frozen=True, slots=True)
class Limits:
    """Largest speed and acceleration of an aircraft, norms of 3-vectors, assumed by bounds."""

    speed_max_mps: Annotated[float, Meaning("largest speed that the bounds assume", 21)]
    acceleration_max_mps2: Annotated[
        float, Meaning("largest acceleration that the bounds assume", 22)
    ]
    limits_source: Annotated[LimitSource, Meaning("origin of both limits", 23)] = (
        LimitSource.SETTINGS
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Refuted:
    """Assumption that reports refuted and that was raised, in the unit of its setting."""

    t_ns: Annotated[int, Meaning("when it was refuted")]
    uav: str
    setting: Annotated[str, Meaning("setting whose assumption was refuted")]
    limit: Annotated[float, Meaning("assumed value")]
    proven: Annotated[float, Meaning("least value that the reports prove")]
    raised_to: Annotated[float, Meaning("value assumed from then on; it decays over minutes")]


class Fix(NamedTuple):
    """Report with its time on the node's timeline and its position in the local frame.

    The class is a tuple for speed.

    sender_ns  when the position was true, on the sender's timeline; intervals between reports are
               computed from it, since link delay does not affect it
    limits     assumed limits of the aircraft; None: those of the observer's model

    ``arrival_ns - t_ns`` is the visible latency. A report without a sender's clock has ``sender_ns
    == t_ns``.
    """

    uav: str
    sender_ns: int
    t_ns: int  # the same instant on the node's timeline, as estimated on arrival
    arrival_ns: int  # when the report arrived, node time
    position_ned_m: Vector  # in the local frame
    velocity_ned_mps: Vector | None  # in the local frame; None if not sent
    noise: ReportNoise  # bounds on the errors of both
    report: Report
    limits: Limits | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Observer's answer to an accepted report, at the time of that report.

    A track is restarted from reports that disagree with it but agree with one another.
    ``innovation_m`` is None for the first report of a track; after a restart it is the jump.
    """

    fix: Fix  # the accepted report
    position_ned_m: Vector  # local frame: the estimate before this report was used
    bound_m: Annotated[float, Meaning("bound on the error of the prediction for this report")]
    innovation_m: Annotated[
        float | None, Meaning("distance from the prediction to the reported position")
    ]
    dt_s: Annotated[float | None, Meaning("interval since the UAV's previous report")]
    reacquired: Annotated[bool, Meaning("whether this report restarted the track")] = False


@dataclass(frozen=True, slots=True, kw_only=True)
class SenderTime:
    """Time of the node, ``node_ns``, converted to a sender's timeline.

    node_ns, sender_ns  the time on both timelines
    before_s, after_s   largest amounts by which the true sender time precedes or follows
                        ``sender_ns``
    """

    node_ns: int
    sender_ns: int
    before_s: float
    after_s: float
    usual_s: float = 0.0  # usual error of ``sender_ns``: an estimate, not a bound

    @property
    def bound_s(self) -> float:
        """Bound on the error of ``sender_ns``, seconds."""
        return max(self.before_s, self.after_s)


class TrackState(DescribedEnum):
    """State of a track, by the age of its newest report; ``[tracks]`` sets the limits."""

    LIVE = "live", "reports arrive"
    COASTING = "coasting", "predicted without new reports"
    STALE = "stale", "too old for a beam"
    LOST = "lost", "about to be dropped"


_LOCAL_FRAME: Final = "coordinates of the node's own frame; see `lat_deg` … and `north_m` …"


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """One UAV predicted to the instant ``valid_at_ns``. Vectors are (3,), in the local frame.

    The bounds hold if the assumed limits of speed, acceleration and noise do (docs/math.md 5.6). A
    value of None is unknown.
    """

    uav: Annotated[str, Meaning("id of the UAV", 1, label="UAV", example="3:1")]
    state: Annotated[TrackState, Meaning("state of the track, by the age of its newest report", 2)]
    valid_at_ns: Annotated[int, Meaning("the instant for which the values hold", 3)]
    age_s: Annotated[float, Meaning("age of the newest accepted report", 4)]
    position_ned_m: Annotated[
        FloatArray, Meaning("position in the local frame", 5, absent={"api": _LOCAL_FRAME})
    ]
    velocity_ned_mps: Annotated[
        FloatArray | None, Meaning("estimated velocity to the north, east and down", 6)
    ]
    unknown_input_mps: Annotated[
        FloatArray | None, Meaning("estimate of the unknown input (docs/math.md 3)", 7)
    ]
    acceleration_ned_mps2: Annotated[
        FloatArray | None, Meaning("acceleration that is fed forward (docs/math.md 5.1)", 15)
    ]
    bound_m: Annotated[
        float, Meaning("guaranteed bound on the position error", 8, label="Bound", example=4.2)
    ]
    horizontal_bound_m: Annotated[
        float, Meaning("radius of the cylinder that contains the position", 16)
    ]
    vertical_bound_m: Annotated[
        float, Meaning("half height of the cylinder that contains the position", 17)
    ]
    set_center_ned_m: Annotated[
        FloatArray, Meaning("centre of the smallest ball that contains every possible position", 19)
    ]
    set_radius_m: Annotated[float, Meaning("radius of that ball", 20)]
    limits: Annotated[Limits, Inline()]
    error_p95_m: Annotated[
        float | None,
        Meaning(
            "95th percentile of recent prediction errors at this age: an estimate, not a bound",
            24,
            label="Usual error",
        ),
    ]
    clock_bound_s: Annotated[
        float, Meaning("uncertainty of the sender's clock; every bound includes its effect", 18)
    ]
    dt_s: Annotated[float | None, Meaning("interval between the last two reports", 9, label="ΔT")]
    latency_s: Annotated[
        float | None,
        Meaning("age of the newest report on arrival; negative: the autopilot predicts", 10),
    ]
    gamma: Annotated[
        float | None,
        Meaning("certified gain from the unknown input to the error, s; position model only", 11),
    ]
    innovation_m: Annotated[
        float | None, Meaning("distance from the prediction to the newest report", 12)
    ]
    reports: Annotated[int, Meaning("accepted reports", 13)]

    @property
    def speed_mps(self) -> Annotated[float | None, Meaning("estimated speed", 25)]:
        velocity = self.velocity_ned_mps
        return None if velocity is None else math.hypot(*velocity)

    @property
    def climb_rate_mps(self) -> Annotated[float | None, Meaning("estimated rate of climb", 26)]:
        velocity = self.velocity_ned_mps
        return None if velocity is None else -float(velocity[2])


@dataclass(frozen=True, slots=True, kw_only=True)
class Carrier:
    """Position and attitude of the array's carrier at the instant ``valid_at_ns``.

    error_p95_m       estimated 95th percentile of the position error; None if unknown
    attitude_p95_rad  estimated 95th percentile of the attitude error; None if unknown
    extrapolation_rad part of ``attitude_bound_rad`` by the extrapolation of the newest attitude
    """

    valid_at_ns: int
    position_ned_m: FloatArray  # (3,), local frame
    velocity_ned_mps: FloatArray | None  # (3,), local frame; None if unknown
    body_from_local: FloatArray  # (3, 3) rotation matrix
    body_rates_radps: FloatArray  # (3,), angular rates about the body axes
    bound_m: Annotated[float, Meaning("guaranteed bound on the error of the carrier's position")]
    attitude_bound_rad: Annotated[
        float, Meaning("largest angle between the estimated and the true attitude")
    ]
    age_s: Annotated[
        float | None, Meaning("age of the carrier's newest report; null for a fixed station")
    ]
    error_p95_m: float | None = None
    attitude_p95_rad: float | None = None
    extrapolation_rad: float = 0.0

    @property
    def roll_rad(self) -> Annotated[float, Meaning("roll, right side down positive")]:
        return roll_pitch_yaw_rad(self.body_from_local)[0]

    @property
    def pitch_rad(self) -> Annotated[float, Meaning("pitch, nose up positive")]:
        return roll_pitch_yaw_rad(self.body_from_local)[1]

    @property
    def yaw_rad(self) -> Annotated[float, Meaning("yaw of the nose, from true north, clockwise")]:
        return roll_pitch_yaw_rad(self.body_from_local)[2]


def roll_pitch_yaw_rad(rotated_from: FloatArray) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of a frame by its rotation (3, 3) from another frame."""
    (ahead, right, down), (_, _, side), (_, _, below) = rotated_from.tolist()
    pitch = math.asin(min(max(-down, -1.0), 1.0))
    return math.atan2(side, below), pitch, math.atan2(right, ahead)
