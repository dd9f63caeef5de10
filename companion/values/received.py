"""What is received: frames, what they say, and what was not used of them."""

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple, Self


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
    NOT_ALLOWED = "not-allowed"  # a sender that the lists of the settings keep out
    TOO_MANY = "too-many"  # another sender, where as many are tracked as the settings allow
    UNSIGNED = "unsigned"  # without a signature, over a link that requires them
    BAD_SIGNATURE = "bad-signature"  # signed with another key, or altered
    REPLAYED = "replayed"  # well signed, but not newer than what was heard before
    SECRET = "secret"  # SETUP_SIGNING carries a key: it is not used, and not recorded
    SOCKET_OVERFLOW = "socket-overflow"  # lost before it was read: the system's buffer was full
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


@dataclass(frozen=True, slots=True)
class RoundTrip:
    """A TIMESYNC request of ours and its answer, received at ``t_ns``: the sender's clock since
    boot was ``remote_ns`` some time between ``sent_ns`` and ``t_ns`` of the node's."""

    t_ns: int
    source: Source
    sent_ns: int
    remote_ns: int


Event = Frame | Tick | Rejection | RoundTrip
"""Everything that drives the pipeline, in order of time. A rejection made while framing is an
event as well: the bytes are gone, but that they came is part of what happened. So is a round trip,
for only the service knows which requests were its own."""


class AltitudeDatum(StrEnum):
    """What a height is measured from; pressure altitude is off by the weather, up to 100s of m."""

    MSL = "msl"
    PRESSURE = "pressure"
    GEOMETRIC = "geometric"


@dataclass(frozen=True, slots=True)
class Report:
    """A position that a UAV sent of itself, or that a receiver relayed of it: degrees, metres, m/s
    in the north-east-down frame at the UAV itself. ``boot_ms`` is the sender's clock at the
    position, ``tslc_s`` the age that an ADS-B receiver states in its stead. ``alt_age_s``: how far
    apart in time the position and the altitude were true; 0 where one message had both."""

    t_ns: int
    link: str
    uav: str
    source: Source
    lat_deg: float
    lon_deg: float
    alt_m: float
    alt_datum: AltitudeDatum
    relative_alt_m: float | None
    velocity_ne_mps: tuple[float, float] | None
    velocity_down_mps: float | None
    heading_deg: float | None
    boot_ms: int | None
    tslc_s: float | None
    alt_age_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Traffic:
    """What a receiver relays of an aircraft (ADSB_VEHICLE): degrees, metres, m/s in the
    north-east-down frame at the aircraft. ``source`` is the relay. A field that its own flag does
    not vouch for is None; ``alt_datum`` is None where ``alt_m`` is. ``tslc_s`` counts whole seconds
    since the aircraft was last heard; ``emitter_type`` is MAVLink's ADSB_EMITTER_TYPE, which knows
    vehicles on the ground and obstacles as well."""

    t_ns: int
    link: str
    icao: int
    source: Source
    callsign: str | None
    emitter_type: int
    position_deg: tuple[float, float] | None
    alt_m: float | None
    alt_datum: AltitudeDatum | None
    heading_deg: float | None
    velocity_ne_mps: tuple[float, float] | None
    velocity_down_mps: float | None
    tslc_s: int

    @property
    def uav(self) -> str:
        """The aircraft's name here: ``icao:`` and six hexadecimal digits."""
        return f"icao:{self.icao:06X}"


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


Message = Report | Traffic | Attitude | Presence | GnssStatus | SystemTime
