"""What is known of where everything is: fixes, estimates, tracks and the carrier."""

from dataclasses import dataclass
from enum import StrEnum

from companion.values.numbers import FloatArray
from companion.values.received import Report


@dataclass(frozen=True, slots=True)
class ReportNoise:
    """Bounds on one report's errors: of the position in the plane, in height and in norm, and of
    the velocity in norm."""

    horizontal_m: float
    vertical_m: float
    position_m: float
    velocity_mps: float


@dataclass(frozen=True, slots=True)
class Fix:
    """A report on the node's timeline and in the local frame: ``sender_ns`` is when the
    position was true on the sender's own timeline (intervals between reports are taken there:
    they carry nothing of the link), ``t_ns`` the same on the node's as far as was known on
    arrival at ``arrival_ns``; the last two differ by the latency that is seen. For a report
    without a sender's clock the two timelines are one. ``position_ned_m`` and
    ``velocity_ned_mps``: shape (3,), local frame; ``noise`` bounds their errors."""

    uav: str
    sender_ns: int
    t_ns: int
    arrival_ns: int
    position_ned_m: FloatArray
    velocity_ned_mps: FloatArray | None
    noise: ReportNoise
    report: Report


@dataclass(frozen=True, slots=True)
class Estimate:
    """What the observer makes of an accepted report, at its time: ``position_ned_m`` (3,) is
    the estimate before this report enters it, ``bound_m`` its error bound, ``innovation_m`` how
    far the report lies from it, ``dt_s`` the interval since the report before. The last two are
    None for the first report of a track. ``reacquired``: the track was begun again, from
    reports that disagreed with it but not with one another."""

    fix: Fix
    position_ned_m: FloatArray
    bound_m: float
    innovation_m: float | None
    dt_s: float | None
    reacquired: bool = False


class TrackState(StrEnum):
    """How old the newest report of a UAV is: the limits are settings."""

    LIVE = "live"
    COASTING = "coasting"
    STALE = "stale"
    LOST = "lost"


@dataclass(frozen=True, slots=True)
class Track:
    """What is known of one UAV at ``valid_at_ns``; local frame.

    ``bound_m`` bounds the position error's norm if the settings' bounds on speed, acceleration
    and noise hold, ``horizontal_bound_m`` and ``vertical_bound_m`` its two parts: the error lies in
    that upright cylinder. What is not known of the sender's clock, ``clock_bound_s``, is in them.
    ``acceleration_ned_mps2`` is what was fed forward; ``age_s`` is ``valid_at_ns`` less the time of
    the newest accepted report;
    ``dt_s`` the last interval between reports, ``gamma`` the certified gain over all of them;
    ``innovation_m`` how far the last report lay from its prediction.
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
    clock_bound_s: float
    dt_s: float | None
    latency_s: float | None
    gamma: float | None
    innovation_m: float | None
    reports: int


@dataclass(frozen=True, slots=True)
class Carrier:
    """Where the array is at ``valid_at_ns``, and how it is turned: ``body_from_local``, (3, 3).

    ``body_rates_radps`` (3,) turn it about its own axes. ``bound_m`` bounds its position's error,
    ``attitude_bound_rad`` the angle by which its attitude can be off; ``age_s`` is that of its
    newest report, None for a fixed station.
    """

    valid_at_ns: int
    position_ned_m: FloatArray
    velocity_ned_mps: FloatArray | None
    body_from_local: FloatArray
    body_rates_radps: FloatArray
    bound_m: float
    attitude_bound_rad: float
    age_s: float | None
