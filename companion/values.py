"""The frozen values that flow through the program, from a received frame to a set of weights.

Conventions, here and everywhere:

* Time is integer nanoseconds since the Unix epoch on the node's own clock (``_ns``).
* The *local frame* is north-east-down (NED), metres, tangent to WGS84 at a fixed origin.
* The *body frame* is forward-right-down (FRD), as MAVLink has it; so is the *array frame*, with
  x along boresight.
* ``a_from_b`` is the 3x3 matrix that takes coordinates in frame b to coordinates in frame a.
* Unknown is ``None``, never 0.

Arrays inside these values are not to be written to.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


class Source(NamedTuple):
    """Who sent a frame: MAVLink system and component id. Written ``SYSID:COMPID``."""

    sysid: int
    compid: int

    def __str__(self) -> str:
        return f"{self.sysid}:{self.compid}"

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``SYSID:COMPID``; ``ValueError`` where it is not two numbers of 0 to 255."""
        sysid, colon, compid = text.partition(":")
        if not (colon and sysid.isdecimal() and compid.isdecimal()):
            raise ValueError(f"{text!r} is not SYSID:COMPID, such as 5:1")
        if int(sysid) > 255 or int(compid) > 255:
            raise ValueError(f"{text!r}: system and component ids are at most 255")
        return cls(int(sysid), int(compid))


class Frame(NamedTuple):
    """One MAVLink frame whose checksum holds; ``raw`` is all of it, magic byte to checksum or
    signature. A tuple, for there is one for every frame received, wanted or not."""

    t_ns: int
    link: str
    source: Source
    msgid: int
    raw: bytes

    @property
    def version(self) -> int:
        """MAVLink protocol version: 1 or 2."""
        return 2 if self.raw[0] == 0xFD else 1

    @property
    def seq(self) -> int:
        """The sender's 8-bit sequence number."""
        return self.raw[4] if self.raw[0] == 0xFD else self.raw[2]

    @property
    def payload(self) -> bytes:
        """The payload as sent: MAVLink 2 has cut its trailing zeros."""
        start = 10 if self.raw[0] == 0xFD else 6
        return self.raw[start : start + self.raw[1]]


@dataclass(frozen=True, slots=True)
class Tick:
    """The timer says that beams are due."""

    t_ns: int


class Reason(StrEnum):
    """Why something received was not used. The value is what recordings and the API show."""

    GARBAGE = "garbage"  # bytes between frames; counted in bytes
    BAD_CRC = "bad-crc"  # framed like a known message, but the checksum is wrong
    UNKNOWN_MESSAGE = "unknown-message"  # an id without a known checksum seed: cannot be trusted
    BAD_STAMP = "bad-stamp"  # a log's own time stamp steps back or leaps; the step was clamped
    MALFORMED = "malformed"  # a checked frame whose fields cannot be what they say
    UNREACHABLE = "unreachable"  # farther from the track than it can have flown since
    ALTITUDE_JUMP = "altitude-jump"  # the same in height alone: the datum has changed
    FROZEN = "frozen"  # a fresh stamp on an old position, while the velocity says it moves
    SHARED_ID = "shared-id"  # two vehicles send under one id: neither can be believed
    ZERO_POSITION = "zero-position"  # within 5 km of 0 N 0 E: what is sent before a fix
    NO_POSITION = "no-position"  # ADSB_VEHICLE whose flags do not vouch for its coordinates
    NO_ALTITUDE = "no-altitude"  # a position in the plane only
    UNPLACED_STAMP = "unplaced-stamp"  # off the sender's clock, and not enough others yet to agree
    DUPLICATE = "duplicate"  # the same report again, over this link or another
    OUT_OF_ORDER = "out-of-order"  # later than the window for late reports


@dataclass(frozen=True, slots=True)
class Rejection:
    """Something received that was not used, and why. ``count`` in frames (bytes for garbage)."""

    t_ns: int
    source: str
    reason: Reason
    count: int = 1
    msgid: int | None = None
    detail: str = ""


Event = Frame | Tick | Rejection
"""Everything that drives the pipeline, in order of time. A rejection made while framing is an
event as well: the bytes are gone, but that they came is part of what happened."""


class AltitudeDatum(StrEnum):
    """What a height is measured from; pressure altitude is off by the weather, up to 100s of m."""

    MSL = "msl"
    PRESSURE = "pressure"
    GEOMETRIC = "geometric"


@dataclass(frozen=True, slots=True)
class Report:
    """A position that a UAV sent of itself, or that a receiver relayed of it: degrees, metres, m/s
    in the north-east-down frame at the UAV itself. ``boot_ms`` is the sender's clock at the
    position, ``tslc_s`` the age that an ADS-B receiver states in its stead."""

    t_ns: int
    link: str
    uav: str
    source: Source
    lat_deg: float
    lon_deg: float
    alt_m: float | None
    alt_datum: AltitudeDatum
    relative_alt_m: float | None
    velocity_ne_mps: tuple[float, float] | None
    velocity_down_mps: float | None
    heading_deg: float | None
    boot_ms: int | None
    tslc_s: float | None


@dataclass(frozen=True, slots=True)
class Attitude:
    """Body attitude and body rates (ATTITUDE): roll, pitch, yaw of FRD from NED, radians."""

    t_ns: int
    source: Source
    boot_ms: int
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    rollspeed_radps: float
    pitchspeed_radps: float
    yawspeed_radps: float


@dataclass(frozen=True, slots=True)
class Presence:
    """HEARTBEAT: a component exists. It does not prove a vehicle."""

    t_ns: int
    source: Source
    mav_type: int
    autopilot: int
    system_status: int
    armed: bool


@dataclass(frozen=True, slots=True)
class GnssStatus:
    """GPS_RAW_INT: fix type (MAVLink's GPS_FIX_TYPE) and the receiver's own accuracies."""

    t_ns: int
    source: Source
    fix_type: int
    satellites: int | None
    h_acc_m: float | None
    v_acc_m: float | None
    vel_acc_mps: float | None


@dataclass(frozen=True, slots=True)
class SystemTime:
    """SYSTEM_TIME: the sender's Unix clock beside its boot clock."""

    t_ns: int
    source: Source
    unix_us: int | None
    boot_ms: int


Message = Report | Attitude | Presence | GnssStatus | SystemTime


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


class Method(StrEnum):
    """How a set of weights was made. RZF is the fallback of ZF when it is ill-conditioned."""

    ZERO_FORCING = "zf"
    REGULARISED = "rzf"


@dataclass(frozen=True, slots=True)
class Beam:
    """One beam: azimuth (to the right) and elevation (up) in the array frame, range in metres, and
    how fast they change (None where a velocity is not known).

    ``gain_db`` is the array gain towards the predicted direction under unit weight power,
    ``pointing_bound_rad`` how far the true direction can lie from it (None: anywhere).
    """

    uav: str
    azimuth_rad: float
    elevation_rad: float
    range_m: float
    azimuth_rate_radps: float | None
    elevation_rate_radps: float | None
    range_rate_mps: float | None
    pointing_bound_rad: float | None
    gain_db: float


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A UAV that is tracked but has no beam, and why."""

    uav: str
    reason: str


@dataclass(frozen=True, slots=True)
class BeamSet:
    """The weights of one update. ``weights``: (M, N), columns in the order of ``beams``.

    With A the (M, N) steering matrix, zero forcing has AᵀF = I: unit response to each UAV, nulls
    on the others, no power normalisation. ``condition_number`` is that of A in the 2-norm
    (None without beams). ``t_ns`` is when the update was made, ``valid_at_ns`` when the beams are
    applied.
    """

    t_ns: int
    valid_at_ns: int
    beams: tuple[Beam, ...]
    weights: ComplexArray
    method: Method
    condition_number: float | None
    left_out: tuple[LeftOut, ...]

    @property
    def uavs(self) -> tuple[str, ...]:
        return tuple(beam.uav for beam in self.beams)

    @property
    def regularised(self) -> bool:
        return self.method is Method.REGULARISED


class Severity(StrEnum):
    """How much a notice matters to an operator."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True, slots=True)
class Notice:
    """Something that an operator should know: said once, when it changes."""

    t_ns: int
    severity: Severity
    subject: str
    text: str


@dataclass(frozen=True, slots=True)
class Update:
    """Every target at the time of use, and the beams on them; without a carrier there are none,
    and ``unfit`` says why."""

    t_ns: int
    carrier: Carrier | None
    unfit: str | None
    tracks: tuple[Track, ...]
    beams: BeamSet


Output = Rejection | Estimate | Notice | Update
"""What the pipeline makes of an event."""
