"""Received values: frames, and the messages decoded from them.

Over 300 lines: a class for each kind of message.
"""

from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

from companion.values.described import DescribedEnum, Meaning
from companion.values.names import Source, UavKind


class Frame(NamedTuple):
    """MAVLink frame with a correct checksum.

    The class is a tuple for speed: one is created for every frame received, used or not.
    """

    t_ns: Annotated[
        int, Meaning("arrival; for a frame that another node received, its latest arrival", 1)
    ]
    link: Annotated[str, Meaning("link over which it arrived", 2)]
    source: Annotated[Source, Meaning("sender: MAVLink system and component id", 3)]
    msgid: Annotated[int, Meaning("MAVLink message id", 5)]
    raw: Annotated[
        bytes, Meaning("whole frame, from the magic byte to the checksum or signature", 6)
    ]
    doubt_ns: Annotated[
        int, Meaning("how much earlier than stated it may have arrived", 7, wire="uint64")
    ] = 0

    @property
    def version(self) -> int:
        """MAVLink protocol version: 1 or 2."""
        return 2 if self.raw[0] == 0xFD else 1

    @property
    def seq(self) -> int:
        """Sequence number of the sender, 8 bits."""
        return self.raw[4] if self.raw[0] == 0xFD else self.raw[2]

    @property
    def payload(self) -> bytes:
        """Payload as sent; MAVLink 2 senders truncate its trailing zeros."""
        start = 10 if self.raw[0] == 0xFD else 6
        return self.raw[start : start + self.raw[1]]


class AltitudeDatum(DescribedEnum):
    """Surface that an altitude is measured from."""

    MSL = "msl", "mean sea level"
    PRESSURE = (
        "pressure",
        "pressure altitude in the standard atmosphere; weather shifts it by hundreds of metres",
    )
    GEOMETRIC = "geometric", "the WGS84 ellipsoid"


class Accuracy(NamedTuple):
    """Accuracy that a report states: radii that hold 68 % of errors, as GNSS receivers give them.

    Metres and m/s; None: unknown. Figures stated for 95 % are converted to 68 % when decoded
    (``mavlink/wire/accuracy.py``). ``vertical_m`` refers to a height above the ellipsoid;
    ``time_s`` is the largest error of the time at which the position was true.
    """

    horizontal_m: float | None = None
    vertical_m: float | None = None
    velocity_mps: float | None = None
    time_s: float | None = None


class Report(NamedTuple):
    """Position that a UAV sent of itself, or that a receiver relayed of it.

    The class is a tuple for speed, as others here of which one is made for every message.

        t_ns               arrival, node time
        lat_deg, lon_deg   WGS84
        alt_m, alt_datum   height and its datum
        relative_alt_m     height above the UAV's home
        velocity_ne_mps    north and east, in the north-east-down frame at the UAV
        velocity_down_mps  positive down
        heading_deg        from true north, clockwise
        boot_ms            the sender's boot time, or another continuous clock, when the position
                           was true; None for ADS-B
        tslc_s             age of the position as stated by an ADS-B receiver, in place of
                           ``boot_ms``
        alt_age_s          time between the instants at which position and altitude were true; 0
                           if one message held both
        accuracy           stated accuracy; None if the message has no such field
        alt_step_m         resolution of heights in its message; 0: negligible

    None: not sent.
    """

    t_ns: int
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
    accuracy: Accuracy | None = None
    alt_step_m: float = 0.0


RELAYED_TIME_ERROR_S: Final = 1.0
"""Largest error of the age of a relayed aircraft's report, unless it states another.

MAVLink's ``tslc`` is in whole seconds.
"""
RELAYED_DELAY_S: Final = 0.25  # delay of its transmission that this error includes


@dataclass(frozen=True, slots=True, kw_only=True)
class AdsbVehicle:
    """Aircraft relayed by a receiver (ADSB_VEHICLE).

        alt_m, alt_datum   height and its datum; both None or neither
        velocity_ne_mps    north and east, in the north-east-down frame at the aircraft
        accuracy           accuracy that the transponder states; None if the relay does not send it

    A field is None unless its own validity flag is set.
    """

    t_ns: int  # arrival, node time
    icao: int  # 24-bit ICAO address of the aircraft
    source: Source  # the relay, not the aircraft
    callsign: str | None
    position_deg: tuple[float, float] | None  # latitude, longitude
    alt_m: float | None
    alt_datum: AltitudeDatum | None
    heading_deg: float | None  # from true north, clockwise
    velocity_ne_mps: tuple[float, float] | None
    velocity_down_mps: float | None  # positive down
    tslc_s: float  # time since the last message of the aircraft; MAVLink states whole seconds
    accuracy: Accuracy | None = None

    @property
    def uav(self) -> str:
        """UAV id of the aircraft: ``icao:`` and six hexadecimal digits."""
        return UavKind.ADSB.uav(f"{self.icao:06X}")

    @property
    def true_ns(self) -> int:
        """When its content was true; up to a second earlier, if ``tslc_s`` has whole seconds."""
        return self.t_ns - round(self.tslc_s * 1e9)


@dataclass(frozen=True, slots=True, kw_only=True)
class RemoteId:
    """Message that a Remote ID receiver relays from one radio: an id, a position, or both.

    A field is None if it was not sent.
    """

    t_ns: int
    source: Source
    heard_as: str  # the radio's address, hexadecimal; empty if the receiver does not send it
    uas_id: str | None = None  # the aircraft's id
    id_kind: int | None = None  # type of the id, MAVLink's MAV_ODID_ID_TYPE
    aircraft: int | None = None  # number of aircraft that the sender represents
    report: Report | None = None  # its position, under the name of the radio
    is_flat: bool = False  # whether a position came without a height


class Attitude(NamedTuple):
    """Body attitude and body rates (ATTITUDE).

    Roll, pitch and yaw, in radians, rotate the NED frame into the FRD body frame; the rates, in
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Presence:
    """Presence of a component by its HEARTBEAT, which does not prove that there is a vehicle."""

    t_ns: int
    source: Source
    mav_type: int
    autopilot: int
    is_armed: bool


FIX_3D: Final = 3  # GPS_FIX_TYPE_3D_FIX; better fixes have larger numbers


class GnssStatus(NamedTuple):
    """Fix type, position and stated accuracies of a GNSS receiver (GPS_RAW_INT).

    ``fix_type`` is MAVLink's GPS_FIX_TYPE, ``alt_m`` above mean sea level; accuracies are in metres
    and m/s, None if not sent. ``time_us`` counts since boot or since 1970; 0 if unknown.
    ``position_deg``: latitude and longitude, WGS84; None if both are 0.
    """

    t_ns: int
    source: Source
    fix_type: int
    alt_m: float
    h_acc_m: float | None
    v_acc_m: float | None
    vel_acc_mps: float | None
    time_us: int = 0
    position_deg: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SystemTime:
    """Clock readings of a sender: Unix time in microseconds, and boot time (SYSTEM_TIME)."""

    t_ns: int
    source: Source
    unix_us: int | None
    boot_ms: int


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimatorStatus:
    """Status of an autopilot's estimator (EKF_STATUS_REPORT).

    knows_…        whether its attitude or horizontal position is valid
    is_absolute    whether that position is by GNSS
    compass_ratio  compass innovation over its gate: above 1 the compass is rejected
    """

    t_ns: int
    source: Source
    link: str
    knows_attitude: bool
    knows_position: bool
    is_absolute: bool
    compass_ratio: float


@dataclass(frozen=True, slots=True, kw_only=True)
class GnssHeading:
    """Heading that a GNSS receiver with two antennas measures (GPS_RAW_INT, GPS2_RAW).

    link          link over which it came
    receiver      1 or 2
    heading_rad   from true north, clockwise
    accuracy_rad  stated standard deviation; None: not stated
    """

    t_ns: int
    source: Source
    link: str
    receiver: int
    heading_rad: float
    accuracy_rad: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class StatedAttitude:
    """Attitude that a vehicle sends beside ATTITUDE (ATTITUDE_QUATERNION_COV, ODOMETRY).

    link            link over which it came
    msgid           message that held it
    ned_from_body   unit quaternion (w, x, y, z); None: the estimate has failed
    deviations_rad  standard deviations of roll, pitch and yaw; None: unknown
    """

    t_ns: int
    source: Source
    link: str
    msgid: int
    ned_from_body: tuple[float, float, float, float] | None
    deviations_rad: tuple[float, float, float] | None


AttitudeEvidence = EstimatorStatus | GnssHeading | StatedAttitude
"""What a vehicle sends about the error of its attitude."""

Message = (
    Report
    | AdsbVehicle
    | RemoteId
    | Attitude
    | Presence
    | GnssStatus
    | SystemTime
    | EstimatorStatus
    | GnssHeading
    | StatedAttitude
)
