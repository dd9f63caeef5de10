"""Values that come in: frames, the messages decoded from them, and what was rejected."""

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple, Self

from companion.values.errors import UserError


class Source(NamedTuple):
    """The sender of a frame: MAVLink system and component id, written ``SYSID:COMPID``."""

    sysid: int
    compid: int

    def __str__(self) -> str:
        return f"{self.sysid}:{self.compid}"

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``SYSID:COMPID``. Raises ``UserError`` unless both are numbers from 0 to 255."""
        sysid, colon, compid = text.partition(":")
        if not (colon and sysid.isdecimal() and compid.isdecimal()):
            raise UserError(f"{text!r} is not SYSID:COMPID, such as 5:1")
        if int(sysid) > 255 or int(compid) > 255:
            raise UserError(f"{text!r}: system and component ids are at most 255")
        return cls(int(sysid), int(compid))


def reports_itself(uav: str) -> bool:
    """True if ``uav`` names a vehicle that sends its own position, False for a relayed aircraft.

    Relayed aircraft are named ``icao:HEX``.
    """
    return not uav.startswith("icao:")


class Frame(NamedTuple):
    """One MAVLink frame whose checksum is right.

    ``raw`` is the whole frame, from the magic byte to the checksum or signature; ``t_ns`` is when
    it arrived, node time. It is a tuple because one is made for every frame received, wanted or
    not.
    """

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
        """The payload as sent; MAVLink 2 senders cut trailing zeros."""
        start = 10 if self.raw[0] == 0xFD else 6
        return self.raw[start : start + self.raw[1]]


@dataclass(frozen=True, slots=True)
class Tick:
    """The timer event at which beams are due."""

    t_ns: int


class Reason(StrEnum):
    """Why something received was not used. The values are shown in recordings and by the API."""

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
    NO_FIX = "no-fix"  # the first position of all, whose sender's receiver does not vouch for it
    OUT_OF_ORDER = "out-of-order"  # later than the window for late reports


@dataclass(frozen=True, slots=True)
class Rejection:
    """Something received that was not used, and why.

    ``count`` is in frames, or in bytes for ``GARBAGE``. ``detail`` is text for the operator.
    """

    t_ns: int
    source: str
    reason: Reason
    count: int = 1
    msgid: int | None = None
    detail: str = ""


@dataclass(frozen=True, slots=True)
class RoundTrip:
    """A TIMESYNC request sent by this node, and its answer.

    t_ns       when the answer was received, node time
    source     who answered
    sent_ns    when the request was sent, node time
    remote_ns  the sender's clock since boot, read at some time between ``sent_ns`` and ``t_ns``
    """

    t_ns: int
    source: Source
    sent_ns: int
    remote_ns: int


Event = Frame | Tick | Rejection | RoundTrip
"""Everything that drives the pipeline, in the order in which it was taken in.

That is the order of time, but that a frame's time is its arrival: where the node was busy, a tick
of a later time may have been taken in before it.

A rejection made while framing is an event too: its bytes are gone, but that they came must be
recorded. A round trip is an event because only the service knows which requests were its own.
"""


class AltitudeDatum(StrEnum):
    """What a height is measured from.

    Pressure altitude can be hundreds of metres off with the weather.
    """

    MSL = "msl"
    PRESSURE = "pressure"
    GEOMETRIC = "geometric"


@dataclass(frozen=True, slots=True)
class Report:
    """A position that a UAV sent of itself, or that a receiver relayed of it.

        t_ns               when it arrived, node time
        lat_deg, lon_deg   WGS84
        alt_m, alt_datum   height and what it is measured from
        relative_alt_m     height above the UAV's home; None if not sent
        velocity_ne_mps    north and east, in the north-east-down frame at the UAV
        velocity_down_mps  positive down
        heading_deg        from true north, clockwise
        boot_ms            the sender's clock since boot when the position was true; None for ADS-B
        tslc_s             age of the position as stated by an ADS-B receiver, in place of
                           ``boot_ms``
        alt_age_s          time between the instants at which position and altitude were true; 0
                           where one message held both

    None stands for what was not sent.
    """

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
class AdsbVehicle:
    """An aircraft relayed by a receiver (ADSB_VEHICLE).

        t_ns               when it arrived, node time
        icao               24-bit ICAO address of the aircraft
        source             the relay, not the aircraft
        emitter_type       MAVLink's ADSB_EMITTER_TYPE, which includes ground vehicles and obstacles
        position_deg       latitude, longitude
        alt_m, alt_datum   height and what it is measured from; both None or neither
        heading_deg        from true north, clockwise
        velocity_ne_mps    north and east, in the north-east-down frame at the aircraft
        velocity_down_mps  positive down
        tslc_s             whole seconds since the aircraft was last heard

    A field whose own validity flag is not set is None.
    """

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
    """Body attitude and body rates (ATTITUDE).

    Roll, pitch and yaw, in radians, turn the NED frame into the FRD body frame; the rates, in
    rad/s, are about the body axes.
    """

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
    """A HEARTBEAT: a component exists. It does not prove that there is a vehicle."""

    t_ns: int
    source: Source
    mav_type: int
    autopilot: int
    system_status: int
    armed: bool


@dataclass(frozen=True, slots=True)
class GnssStatus:
    """Fix type, height and stated accuracies of a GNSS receiver (GPS_RAW_INT).

    ``fix_type`` is MAVLink's GPS_FIX_TYPE, ``alt_m`` above mean sea level; accuracies are in metres
    and m/s, None if not sent.
    """

    t_ns: int
    source: Source
    fix_type: int
    satellites: int | None
    alt_m: float
    h_acc_m: float | None
    v_acc_m: float | None
    vel_acc_mps: float | None


@dataclass(frozen=True, slots=True)
class SystemTime:
    """The sender's Unix clock, in microseconds, beside its clock since boot (SYSTEM_TIME)."""

    t_ns: int
    source: Source
    unix_us: int | None
    boot_ms: int


Message = Report | AdsbVehicle | Attitude | Presence | GnssStatus | SystemTime
