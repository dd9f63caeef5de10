"""Values that come in: frames, and the messages decoded from them."""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

from companion.values.described import DescribedEnum, Meaning
from companion.values.names import Source, UavKind


class Frame(NamedTuple):
    """One MAVLink frame whose checksum is right.

    It is a tuple because one is made for every frame received, wanted or not.
    """

    t_ns: Annotated[
        int, Meaning("arrival; for a frame that another node received, its latest arrival", 1)
    ]
    link: Annotated[str, Meaning("link that it came over", 2)]
    source: Annotated[Source, Meaning("sender: MAVLink system and component id", 3)]
    msgid: Annotated[int, Meaning("MAVLink message id", 5)]
    raw: Annotated[
        bytes, Meaning("whole frame, from the magic byte to the checksum or signature", 6)
    ]
    doubt_ns: Annotated[
        int, Meaning("by how much the arrival may be earlier than stated", 7, wire="uint64")
    ] = 0

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


class AltitudeDatum(DescribedEnum):
    """What an altitude is measured from."""

    MSL = "msl", "mean sea level"
    PRESSURE = (
        "pressure",
        "pressure altitude in the standard atmosphere; weather shifts it by hundreds of metres",
    )
    GEOMETRIC = "geometric", "the WGS84 ellipsoid"


class Accuracy(NamedTuple):
    """How exact a report says that it is: radii that hold 68 % of errors, as GNSS receivers say.

    Metres and m/s; None: unknown. What is stated for 95 % is brought to 68 % where it is read
    (``mavlink/wire/accuracy.py``). ``vertical_m`` is that of a height above the ellipsoid, and
    ``time_s`` the greatest error of the time at which the position was true.
    """

    horizontal_m: float | None = None
    vertical_m: float | None = None
    velocity_mps: float | None = None
    time_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """A position that a UAV sent of itself, or that a receiver relayed of it.

        t_ns               when it arrived, node time
        lat_deg, lon_deg   WGS84
        alt_m, alt_datum   height and what it is measured from
        relative_alt_m     height above the UAV's home; None if not sent
        velocity_ne_mps    north and east, in the north-east-down frame at the UAV
        velocity_down_mps  positive down
        heading_deg        from true north, clockwise
        boot_ms            the sender's clock since boot, or another that goes on, when the position
                           was true; None for ADS-B
        tslc_s             age of the position as stated by an ADS-B receiver, in place of
                           ``boot_ms``
        alt_age_s          time between the instants at which position and altitude were true; 0
                           where one message held both
        accuracy           how exact it says that it is; None where its message has no word for it
        alt_step_m         step in which its message gives heights; 0: too small to count

    None stands for what was not sent.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class AdsbVehicle:
    """An aircraft relayed by a receiver (ADSB_VEHICLE).

        alt_m, alt_datum   height and what it is measured from; both None or neither
        velocity_ne_mps    north and east, in the north-east-down frame at the aircraft
        accuracy           how exact the transponder says that it is; None where no relay says

    A field whose own validity flag is not set is None.
    """

    t_ns: int  # when it arrived, node time
    icao: int  # 24-bit ICAO address of the aircraft
    source: Source  # the relay, not the aircraft
    callsign: str | None
    position_deg: tuple[float, float] | None  # latitude, longitude
    alt_m: float | None
    alt_datum: AltitudeDatum | None
    heading_deg: float | None  # from true north, clockwise
    velocity_ne_mps: tuple[float, float] | None
    velocity_down_mps: float | None  # positive down
    tslc_s: int  # whole seconds since the aircraft was last heard
    accuracy: Accuracy | None = None

    @property
    def uav(self) -> str:
        """The aircraft's name here: ``icao:`` and six hexadecimal digits."""
        return UavKind.ADSB.uav(f"{self.icao:06X}")


@dataclass(frozen=True, slots=True, kw_only=True)
class RemoteId:
    """What a Remote ID receiver heard from one radio: an id, a position, or both.

    None stands for what was not sent.
    """

    t_ns: int
    source: Source
    heard_as: str  # the radio's address, hexadecimal; empty where the receiver does not say
    uas_id: str | None = None  # the aircraft's id
    id_kind: int | None = None  # MAVLink's MAV_ODID_ID_TYPE of it
    aircraft: int | None = None  # how many aircraft the sender says to stand for
    report: Report | None = None  # its position, under the name of the radio
    is_flat: bool = False  # there was a position, and no height


@dataclass(frozen=True, slots=True, kw_only=True)
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Presence:
    """A HEARTBEAT: a component exists. It does not prove that there is a vehicle."""

    t_ns: int
    source: Source
    mav_type: int
    autopilot: int


@dataclass(frozen=True, slots=True, kw_only=True)
class GnssStatus:
    """Fix type, height and stated accuracies of a GNSS receiver (GPS_RAW_INT).

    ``fix_type`` is MAVLink's GPS_FIX_TYPE, ``alt_m`` above mean sea level; accuracies are in metres
    and m/s, None if not sent. ``time_us`` counts since boot or 1970, 0 if it is not known.
    """

    t_ns: int
    source: Source
    fix_type: int
    alt_m: float
    h_acc_m: float | None
    v_acc_m: float | None
    vel_acc_mps: float | None
    time_us: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class SystemTime:
    """The sender's Unix clock, in microseconds, beside its clock since boot (SYSTEM_TIME)."""

    t_ns: int
    source: Source
    unix_us: int | None
    boot_ms: int


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimatorStatus:
    """What an autopilot's estimator says of its attitude (EKF_STATUS_REPORT).

    knows_attitude  whether it stands by its attitude at all
    compass_ratio   how far compass and attitude contradict one another, over what the estimator
                    accepts: beyond 1 it refuses its compass
    """

    t_ns: int
    source: Source
    knows_attitude: bool
    compass_ratio: float


Message = (
    Report
    | AdsbVehicle
    | RemoteId
    | Attitude
    | Presence
    | GnssStatus
    | SystemTime
    | EstimatorStatus
)
