"""Values for where things are: fixes, estimates, tracks and the carrier of the array."""

from dataclasses import dataclass
from enum import StrEnum

from companion.values.numbers import FloatArray, Vector
from companion.values.received import Report


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportNoise:
    """Bounds on the errors of one report.

    horizontal_m  norm of the position error in the horizontal plane
    vertical_m    height error
    position_m    norm of the position error in space
    velocity_mps  norm of the velocity error
    time_s        by how much the report may be older or newer than the time it is put at: what is
                  left of its lag
    apart_m       by how much the receiver's own heights differ from those reported, of late: which
                  of them is off is not known; 0 where they are not
    """

    horizontal_m: float
    vertical_m: float
    position_m: float
    velocity_mps: float
    time_s: float = 0.0
    apart_m: float = 0.0


class LimitSource(StrEnum):
    """Where a limit of an aircraft comes from."""

    SETTINGS = "settings"
    TYPE = "type"
    RAISED = "raised"


@dataclass(frozen=True, slots=True)
class Limits:
    """What an aircraft is taken to be able to do, which the bounds rest on.

    speed_mps          greatest speed, norm of a 3-vector
    acceleration_mps2  greatest acceleration, norm of a 3-vector
    source             the settings, the aircraft's type, or raised because reports refuted them
    """

    speed_mps: float
    acceleration_mps2: float
    source: LimitSource = LimitSource.SETTINGS


@dataclass(frozen=True, slots=True, kw_only=True)
class Refuted:
    """An assumption that what was reported proves to be wrong; it was raised.

    t_ns       when that was seen, node time
    uav        whose assumption it is
    setting    name of the setting that holds it
    limit      what was assumed, in the setting's unit
    proven     what was proven at least
    raised_to  what is assumed from now on, fading back over minutes
    """

    t_ns: int
    uav: str
    setting: str
    limit: float
    proven: float
    raised_to: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Fix:
    """A report put on the node's timeline and into the local frame.

        sender_ns          when the position was true, on the sender's timeline; intervals between
                           reports are taken from it, since the link cannot disturb it
        t_ns               the same instant on the node's timeline, as known on arrival
        arrival_ns         when the report arrived, node time
        position_ned_m     in the local frame
        velocity_ned_mps   in the local frame; None if not sent
        noise              bounds on the errors of both
        report             the report itself
        limits             what the aircraft is taken to be able to do; None: the observer's model

    ``arrival_ns - t_ns`` is the visible latency. A report without a sender's clock has ``sender_ns
    == t_ns``.
    """

    uav: str
    sender_ns: int
    t_ns: int
    arrival_ns: int
    position_ned_m: Vector
    velocity_ned_mps: Vector | None
    noise: ReportNoise
    report: Report
    limits: Limits | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """The observer's answer to an accepted report, at the time of that report.

    fix             the accepted report
    position_ned_m  local frame: the estimate before this report entered it
    bound_m         bound on the norm of that estimate's error
    innovation_m    distance from the estimate to the report; None for the first report of a
                    track; of one that was begun again, how far it jumped
    dt_s            interval since the report before; None for the first report of a track
    reacquired      True if the track was begun again, from reports that disagreed with the
                    track but agreed with one another
    """

    fix: Fix
    position_ned_m: Vector
    bound_m: float
    innovation_m: float | None
    dt_s: float | None
    reacquired: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class SenderTime:
    """A time of the node, ``node_ns``, converted to a sender's timeline.

    node_ns, sender_ns  the time on both timelines
    before_s, after_s   by how much the true sender time may be less, or more, than ``sender_ns``
    usual_s             by how much it usually is: an estimate, no bound
    """

    node_ns: int
    sender_ns: int
    before_s: float
    after_s: float
    usual_s: float = 0.0

    @property
    def bound_s(self) -> float:
        """Bound on the error of ``sender_ns``, seconds."""
        return max(self.before_s, self.after_s)


class TrackState(StrEnum):
    """How old the newest report of a UAV is; the age limits are settings (``[tracks]``)."""

    LIVE = "live"
    COASTING = "coasting"
    STALE = "stale"
    LOST = "lost"


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """What is known of one UAV at the instant ``valid_at_ns``.

    Vectors are (3,), in the local frame.

        age_s                  ``valid_at_ns`` less the time of the newest accepted report
        unknown_input_mps      estimate of the unknown input (docs/math.md 3)
        acceleration_ned_mps2  acceleration that was fed forward (docs/math.md 5.1)
        bound_m                bound on the norm of the position error
        horizontal_bound_m     its part in the plane: the error lies in an upright cylinder of this
        vertical_bound_m       radius and of this half height
        set_center_ned_m       centre of the least ball that holds every place that is possible,
        set_radius_m           and its radius: for whoever plans with it, not to point at
        limits                 what the aircraft is taken to be able to do
        error_p95_m            error that 95 of 100 predictions at this age stayed below of late;
                               None before enough reports have shown it
        clock_bound_s          uncertainty of the sender's clock, whose effect is in all bounds
        dt_s                   interval between the last two reports
        latency_s              visible latency of the newest report
        gamma                  certified gain over all intervals that occurred (docs/math.md 2.3);
                               position model only
        innovation_m           distance from the prediction to the last report
        reports                number of accepted reports

    The bounds hold if the settings' bounds on speed, acceleration and noise do (docs/math.md 5.6).
    None stands for what is not known.
    """

    uav: str
    state: TrackState
    valid_at_ns: int
    age_s: float
    position_ned_m: FloatArray
    velocity_ned_mps: FloatArray | None
    unknown_input_mps: FloatArray | None
    acceleration_ned_mps2: FloatArray | None
    bound_m: float
    horizontal_bound_m: float
    vertical_bound_m: float
    set_center_ned_m: FloatArray
    set_radius_m: float
    limits: Limits
    error_p95_m: float | None
    clock_bound_s: float
    dt_s: float | None
    latency_s: float | None
    gamma: float | None
    innovation_m: float | None
    reports: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Carrier:
    """Position and attitude of the array's carrier at the instant ``valid_at_ns``.

    position_ned_m      (3,), local frame
    velocity_ned_mps    (3,), local frame; None if not known
    body_from_local     (3, 3) rotation matrix
    body_rates_radps    (3,), angular rates about the body axes
    bound_m             bound on the norm of the position error
    attitude_bound_rad  bound on the angle by which the attitude is off
    age_s               age of the newest report; None for a fixed station
    error_p95_m         error that positions usually stay below; None where that is not known
    attitude_p95_rad    angle by which the attitude usually is off at most; None likewise
    """

    valid_at_ns: int
    position_ned_m: FloatArray
    velocity_ned_mps: FloatArray | None
    body_from_local: FloatArray
    body_rates_radps: FloatArray
    bound_m: float
    attitude_bound_rad: float
    age_s: float | None
    error_p95_m: float | None = None
    attitude_p95_rad: float | None = None
