"""Settings: a TOML file and flags, checked once at start, frozen from then on.

Every key is listed here with its unit, default and range. An error names the key, the value and
what is allowed.
"""

import json
import math
import tomllib
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from tokenize import TokenError
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    Field,
    FiniteFloat,
    PositiveFloat,
    ValidationError,
)

from companion.beam_settings import (
    ArraySettings,
    BeamSettings,
    CodebookSettings,
    HardwareSettings,
    RadioSettings,
)
from companion.link_settings import (
    LinkSettings,
    PresenceSettings,
    SigningSettings,
    TrackSettings,
)
from companion.section import Section
from companion.tracking.kinematic import KinematicDesign
from companion.values import ComplexArray, FloatArray, Source

DEFAULT_DESIGN: Final = "kinematic_default.json"


class ConfigError(ValueError):
    """Settings that cannot be used; the message is one line for the user."""


@dataclass(frozen=True, slots=True)
class VehicleCenter:
    """The array rides on a vehicle in the stream: its position and attitude are followed."""

    source: Source

    def __str__(self) -> str:
        return str(self.source)


@dataclass(frozen=True, slots=True)
class FixedCenter:
    """The array stands: degrees, metres, heading from true north; level."""

    lat_deg: float
    lon_deg: float
    alt_m: float
    heading_deg: float = 0.0

    def __str__(self) -> str:
        return f"{self.lat_deg},{self.lon_deg},{self.alt_m},{self.heading_deg}"


@dataclass(frozen=True, slots=True)
class HomeCenter:
    """A fixed station, level and facing north, where the first accepted report was made."""

    def __str__(self) -> str:
        return "home"


Center = VehicleCenter | FixedCenter | HomeCenter


def parse_center(text: str) -> Center:
    """Read ``SYSID:COMPID``, ``LAT,LON,ALT[,HEADING]`` or ``home``; ``ValueError`` otherwise."""
    if text == "home":
        return HomeCenter()
    if ":" in text:
        return VehicleCenter(Source.parse(text))
    if "," not in text:
        raise ValueError(f"{text!r} is not SYSID:COMPID, LAT,LON,ALT[,HEADING] or home")
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (3, 4) or not all(map(math.isfinite, numbers[2:])):
        raise ValueError(f"{text!r} is not LAT,LON,ALT[,HEADING], such as 47.4,8.55,500,90")
    if not (abs(numbers[0]) <= 90 and abs(numbers[1]) <= 180):
        raise ValueError(f"{text!r}: latitude is within 90 degrees and longitude within 180")
    return FixedCenter(*numbers)


def _center_text(text: str) -> str:
    parse_center(text)
    return text


class CenterSettings(Section):
    """What carries the array; ``run`` refuses to start without it.

    ``attitude_bound_deg`` bounds the error of a vehicle's attitude, mounting included: headings of
    autopilots are off by a degree or more (in simulation by 1.1 at the median).
    """

    source: Annotated[str, AfterValidator(_center_text)] | None = None
    attitude_bound_deg: Annotated[float, Field(ge=0, le=180)] = 2.0


class ClockSettings(Section):
    """How senders' boot clocks are put on the node's timeline.

    ``constant_delay_s`` is how old a report is when it arrives at its earliest, which no one-way
    observation can see: the link's smallest latency, and the age of the position at its stamp
    (ArduPilot's trails by 28 ms in simulation). The default is what none stays below. ``window_s``
    is how far back the lower envelope of the arrivals looks. ``trust_gnss``
    believes SYSTEM_TIME where it passes its checks, given that the node's own clock is UTC to
    within ``node_utc_error_s``.
    """

    constant_delay_s: Annotated[FiniteFloat, Field(ge=0, le=10)] = 0.01
    window_s: Annotated[float, Field(ge=5, le=3600)] = 60.0
    trust_gnss: bool = False
    node_utc_error_s: Annotated[float, Field(ge=0, le=10)] | None = None


class ObserverSettings(Section):
    """The observer and what it takes for granted: bounds that are never exceeded.

    Speed, acceleration and noise are norms of 3-vectors. Where the autopilot sends its own
    accuracy (GPS_RAW_INT) and ``follow_accuracy`` is true, ``accuracy_factor`` times that accuracy
    takes the place of the noise. ``alpha``, ``feedthrough_s`` and ``velocity_lead_s`` are of the
    position model; ``feed_forward`` (an estimated acceleration) and ``design`` (a file of gains
    that ``companion design --model kinematic --out`` wrote, which is read into ``design_json``)
    are of the kinematic one.
    """

    model: Literal["kinematic", "position"] = "kinematic"
    alpha: Literal["auto"] | Annotated[float, Field(gt=0, lt=1)] = "auto"
    feedthrough_s: Annotated[float, Field(ge=-10, le=10)] = 0.0
    velocity_lead_s: Annotated[float, Field(gt=0, le=10)] = 0.2
    feed_forward: bool = True
    design: str | None = None
    design_json: str | None = None
    speed_max_mps: PositiveFloat = 60.0
    acceleration_max_mps2: PositiveFloat = 5.0
    position_noise_m: PositiveFloat = 3.0
    velocity_noise_mps: PositiveFloat = 0.5
    follow_accuracy: bool = True
    accuracy_factor: PositiveFloat = 3.0


class RecordingSettings(Section):
    """Where recordings go (None: nowhere), how often at most weights, tracks and the scene are
    written, and when a new file is begun: at a size, in millions of bytes (None: however large it
    grows), and after a time. The files of a run replay together to its digest."""

    directory: str | None = None
    weights_hz: Literal["all"] | PositiveFloat = 10.0
    scene_hz: Annotated[float, Field(gt=0, le=100)] = 2.0
    rotate_mb: Annotated[float, Field(ge=0.1, le=1e6)] | None = None
    rotate_s: Annotated[float, Field(ge=1, le=1e7)] = 3600.0


class ServerSettings(Section):
    """Where HTTP is served; ``foxglove`` is the port on this machine at which the channels of a
    recording are live (None: nowhere, 0: one that is free). It needs the extra ``live``."""

    listen: str = "127.0.0.1:8080"
    foxglove: Annotated[int, Field(ge=0, le=65535)] | None = None


class Settings(Section):
    """All settings of the service."""

    center: CenterSettings = CenterSettings()
    links: LinkSettings = LinkSettings()
    presence: PresenceSettings = PresenceSettings()
    signing: SigningSettings = SigningSettings()
    clocks: ClockSettings = ClockSettings()
    observer: ObserverSettings = ObserverSettings()
    tracks: TrackSettings = TrackSettings()
    array: ArraySettings = ArraySettings()
    beams: BeamSettings = BeamSettings()
    codebook: CodebookSettings = CodebookSettings()
    hardware: HardwareSettings = HardwareSettings()
    radio: RadioSettings = RadioSettings()
    recording: RecordingSettings = RecordingSettings()
    server: ServerSettings = ServerSettings()

    @classmethod
    def from_toml(cls, text: str, where: str) -> Self:
        """Read settings; ``ConfigError``, beginning with ``where``, if they cannot be used."""
        try:
            return cls.model_validate(tomllib.loads(text))
        except tomllib.TOMLDecodeError as error:
            raise ConfigError(f"{where}: not TOML: {error}") from error
        except ValidationError as error:
            raise ConfigError(f"{where}: {_first(error)}") from error

    def to_toml(self) -> str:
        """All settings, defaults included, as ``from_toml`` reads them."""
        lines: list[str] = []
        for name, keys in self.model_dump(mode="json", exclude_none=True).items():
            lines += [f"[{name}]", *(f"{key} = {_toml(keys[key])}" for key in keys), ""]
        return "\n".join(lines)

    def override(self, **sections: dict[str, Any]) -> "Settings":
        """These settings with some keys replaced; None leaves a key as it is."""
        merged = self.model_dump(mode="json", exclude_none=True)
        for name, keys in sections.items():
            merged[name].update({key: value for key, value in keys.items() if value is not None})
        try:
            return Settings.model_validate(merged)
        except ValidationError as error:
            raise ConfigError(_first(error)) from error


def load(path: Path | None) -> Settings:
    """The settings of a TOML file, or the defaults. Raises ``ConfigError``."""
    if path is None:
        return Settings()
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not TOML: it is not UTF-8 text") from error
    return _with_design(_with_positions(Settings.from_toml(text, str(path))))


def _with_positions(settings: Settings) -> Settings:
    """Settings that hold the element positions themselves, so that a recording holds them too."""
    named = settings.array.positions
    if named is None:
        return settings
    rows = [tuple(row) for row in numbers_file("array.positions", named, 3).tolist()]
    array = {**settings.array.model_dump(mode="json"), "positions": None, "positions_m": rows}
    return settings.model_copy(update={"array": ArraySettings.model_validate(array)})


def numbers_file(key: str, name: str, columns: int) -> FloatArray:
    """The rows of a file of numbers (.npy, or text with commas or blanks), (n, >= columns).

    ``ConfigError``, naming the key, where it cannot be read.
    """
    found = _npy_file(key, name, "fiu") if name.endswith(".npy") else _text_file(key, name)
    if found.ndim != 2 or found.shape[1] < columns or not np.isfinite(found).all():
        raise ConfigError(f"{key} = {name!r}: rows of at least {columns} finite numbers are needed")
    rows: FloatArray = found.astype(np.float64)
    return rows


def _text_file(key: str, name: str) -> NDArray[Any]:
    try:
        text = Path(name).read_text(encoding="utf-8")
        lines = (line.split("#")[0].replace(",", " ").split() for line in text.splitlines())
        return np.array([[float(word) for word in line] for line in lines if line])
    except OSError as error:
        raise ConfigError(f"{key} = {name!r}: {error.strerror}") from error
    except ValueError as error:
        raise ConfigError(f"{key} = {name!r}: not a table of numbers: {error}") from error


def _npy_file(key: str, name: str, kinds: str) -> NDArray[Any]:
    """The array of a .npy file, of one of these kinds of numbers."""
    try:
        with Path(name).open("rb") as file:
            found = np.lib.format.read_array(file, allow_pickle=False)
    except OSError as error:
        raise ConfigError(f"{key} = {name!r}: {error.strerror or error}") from error
    except (ValueError, MemoryError, TokenError) as error:  # the header is read as Python text
        first = str(error).splitlines()[0]
        raise ConfigError(f"{key} = {name!r}: not a .npy file of numbers: {first}") from error
    if found.dtype.kind not in kinds:
        raise ConfigError(f"{key} = {name!r}: {found.dtype} are not the numbers that are needed")
    return found


def codebook_file(settings: Settings) -> ComplexArray:
    """The beams of ``codebook.file``, one a column (M, K). ``ConfigError`` if it is not such."""
    name = settings.codebook.file or ""
    found = _npy_file("codebook.file", name, "fciu")
    if found.ndim != 2:
        raise ConfigError(f"codebook.file = {name!r}: not a matrix, but of shape {found.shape}")
    beams: ComplexArray = found.astype(np.complex128)
    return beams


def calibration_text(settings: Settings) -> str | None:
    """The calibration table of the hardware as text; None without one."""
    name = settings.hardware.calibration
    if name is None:
        return None
    try:
        return Path(name).read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"hardware.calibration = {name!r}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"hardware.calibration = {name!r}: not UTF-8 text") from error


def _with_design(settings: Settings) -> Settings:
    """Settings that hold the observer's gains themselves, so that a recording holds them too."""
    named = settings.observer.design
    if named is None:
        return settings
    try:
        text = Path(named).read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"observer.design = {named!r}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"observer.design = {named!r}: not UTF-8 text") from error
    return settings.override(observer={"design_json": text})


def kinematic_design(settings: Settings) -> KinematicDesign:
    """The gains of the kinematic observer: those named, or those that come with the program.

    Their certificate is verified. ``ConfigError`` where they cannot be used.
    """
    given = _with_design(settings).observer if settings.observer.design_json is None else None
    given = given or settings.observer
    try:
        if given.design_json is not None:
            return KinematicDesign.from_json(given.design_json)
        source = resources.files("companion.tracking") / DEFAULT_DESIGN
        return KinematicDesign.from_json(source.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ConfigError(f"observer.design = {given.design!r}: {error}") from error


def _toml(value: object) -> str:
    """A string, number, boolean, flat list or table: as in JSON, but for what TOML wants else."""
    if isinstance(value, dict):
        pairs = (f"{_toml(key)} = {_toml(found)}" for key, found in value.items())
        return "{" + ", ".join(pairs) + "}"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _first(error: ValidationError) -> str:
    """The first thing wrong, in one line: key, value, what is allowed.

    A key of two kinds has an error for each kind, under one name.
    """
    errors = error.errors(include_url=False)
    place = errors[0]["loc"][:2]
    key = ".".join(map(str, place))
    if errors[0]["type"] == "extra_forbidden":
        return f"{key} is not a setting"
    said = [wrong["msg"] for wrong in errors if wrong["loc"][:2] == place]
    allowed = dict.fromkeys(text.removeprefix("Value error, ") for text in said)
    return f"{key} = {errors[0]['input']!r}: {', or '.join(allowed)}"
