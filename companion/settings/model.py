"""All settings as one frozen value, validated at the start.

Each section lists its keys with unit, default and range. An error names the key, its value and
the allowed values.
"""

import base64
from collections.abc import Mapping
from typing import Any, Final, NamedTuple, Self

import tomli_w
from pydantic import PrivateAttr, ValidationError

from companion.settings.beams import (
    ArraySettings,
    BeamSettings,
    CodebookSettings,
    HardwareSettings,
    NeedSettings,
    RadioSettings,
)
from companion.settings.center import CenterSettings
from companion.settings.fleet import FleetSettings
from companion.settings.invalid import first_error
from companion.settings.mavlink import (
    LinkSettings,
    OutSettings,
    PresenceSettings,
    SigningSettings,
    TrackSettings,
)
from companion.settings.observations import ObservationSettings
from companion.settings.outlets import (
    DriveSettings,
    PageSettings,
    RecordingSettings,
    RecordSettings,
    ServerSettings,
)
from companion.settings.section import ConfigError, Section
from companion.settings.tracking import ClockSettings, ObserverSettings
from companion.values import UserError, is_uav_id, read_toml, shown

REPLAYED_SECTIONS: Final = frozenset(
    (
        "center", "clocks", "observer", "tracks", "array", "beams", "codebook", "hardware", "radio",
        "link", "observations",
    )
)  # fmt: skip
"""Sections that determine estimates and beams: a replay takes them from the recording."""

ADDRESSES: Final = (("observations", "udp"),)
"""Keys of these sections that name an address; a replay ignores them."""
UAV_NAMED: Final = (
    ("observer", "uav"), ("clocks", "apart_s"), ("beams", "priority"), ("beams", "rate_weights"),
)  # fmt: skip
"""Keys of these sections that name UAVs."""


class NamedFile(NamedTuple):
    """File that a setting names; recordings contain it as an attachment."""

    setting: str
    attachment: str  # its name in a recording
    former_key: str  # key with its contents in older recordings: text, base64 for .npy

    @property
    def section(self) -> str:
        return self.setting.partition(".")[0]

    @property
    def key(self) -> str:
        return self.setting.partition(".")[2]


COUPLING: Final = NamedFile("array.coupling", "coupling.npy", "coupling_stored")
CODEBOOK: Final = NamedFile("codebook.file", "codebook.npy", "stored")
CALIBRATION: Final = NamedFile("hardware.calibration", "calibration.csv", "calibration_csv")
UNIT: Final = NamedFile("hardware.unit", "unit.toml", "unit_toml")
DESIGN: Final = NamedFile("observer.design", "design.json", "design_json")
NAMED_FILES: Final = (COUPLING, CODEBOOK, CALIBRATION, UNIT, DESIGN)


class Settings(Section):
    """All settings of the service."""

    center: CenterSettings = CenterSettings()
    links: LinkSettings = LinkSettings()
    presence: PresenceSettings = PresenceSettings()
    out: OutSettings = OutSettings()
    signing: SigningSettings = SigningSettings()
    clocks: ClockSettings = ClockSettings()
    observer: ObserverSettings = ObserverSettings()
    tracks: TrackSettings = TrackSettings()
    observations: ObservationSettings = ObservationSettings()
    array: ArraySettings = ArraySettings()
    beams: BeamSettings = BeamSettings()
    codebook: CodebookSettings = CodebookSettings()
    hardware: HardwareSettings = HardwareSettings()
    radio: RadioSettings = RadioSettings()
    link: NeedSettings = NeedSettings()
    recording: RecordingSettings = RecordingSettings()
    records: RecordSettings = RecordSettings()
    drive: DriveSettings = DriveSettings()
    server: ServerSettings = ServerSettings()
    fleet: FleetSettings = FleetSettings()
    page: PageSettings = PageSettings()

    _files: Mapping[str, bytes] = PrivateAttr(default_factory=dict)

    @classmethod
    def from_toml(cls, text: str, where: str) -> Self:
        """Parse settings from TOML text.

        Raises ``ConfigError``, whose message begins with ``where``, if they are unusable.
        """
        found = sections(text, where)
        files = _former_files(found, where)
        return cls._from_sections(found, where).with_files(files)

    @classmethod
    def from_recording(cls, text: str, where: str, attached: Mapping[str, bytes]) -> Self:
        """Parse the settings in a recording, only the sections in ``REPLAYED_SECTIONS``.

        The recording is untrusted: addresses, outgoing links, directories and paths in it are
        ignored. Files that the settings name are taken from ``attached``, by their names there.
        Raises ``ConfigError`` as ``from_toml``, and if a file is missing.
        """
        found = {
            name: kept for name, kept in sections(text, where).items() if name in REPLAYED_SECTIONS
        }
        for section, key in ADDRESSES:
            _table(found, section).pop(key, None)
        attached = {**attached, **_former_files(found, where)}
        files = {}
        for file in NAMED_FILES:
            if file.key in (keys := _table(found, file.section)):
                if file.attachment not in attached:
                    raise _missing_file_error(where, file.setting)
                keys[file.key] = file.attachment
                files[file.attachment] = attached[file.attachment]
        _drop_impossible_uavs(found)
        if "positions" in _table(found, "array"):  # recordings have ``positions_m`` instead
            raise _missing_file_error(where, "array.positions")
        return cls._from_sections(found, where).with_files(files)

    @classmethod
    def _from_sections(cls, found: dict[str, Any], where: str) -> Self:
        try:
            return cls.model_validate(found)
        except ValidationError as error:
            raise ConfigError(f"{where}: {first_error(error, cls.model_fields, found)}") from error

    @property
    def files(self) -> Mapping[str, bytes]:
        """Contents of the files that the settings name and that were read, by attachment name."""
        return self._files

    def with_files(self, files: Mapping[str, bytes]) -> Self:
        """Return a copy of the settings with other ``files``."""
        copy = self.model_copy()
        copy._files = files
        return copy

    def to_toml(self) -> str:
        """Return all settings, defaults included, as TOML for ``from_toml``."""
        return tomli_w.dumps(self.model_dump(mode="json", exclude_none=True))

    def override(self, **sections: dict[str, Any]) -> "Settings":
        """Return a copy with some keys of sections replaced; a value of None keeps the key.

        The set of given keys (pydantic's ``model_fields_set``) is kept. Raises ``ConfigError`` if
        the result is unusable.
        """
        merged = self.model_dump(mode="json", exclude_none=True, exclude_unset=True)
        for name, keys in sections.items():
            merged.setdefault(name, {}).update(
                {key: value for key, value in keys.items() if value is not None}
            )
        files = {
            file.attachment: self.files[file.attachment]
            for file in NAMED_FILES
            if file.attachment in self.files
            and sections.get(file.section, {}).get(file.key) is None
        }
        try:
            return Settings.model_validate(merged).with_files(files)
        except ValidationError as error:
            raise ConfigError(first_error(error, Settings.model_fields, merged)) from error


def _former_files(found: dict[str, Any], where: str) -> dict[str, bytes]:
    """Remove file contents from the settings of an older recording.

    Returns them by name of the attachment. Raises ``ConfigError``.
    """
    files = {}
    for file in NAMED_FILES:
        keys = _table(found, file.section)
        if file.former_key not in keys:
            continue
        text = keys.pop(file.former_key)
        try:
            binary = file.attachment.endswith(".npy")
            data = base64.b64decode(text, validate=True) if binary else text.encode()
        except (AttributeError, TypeError, ValueError) as error:
            key = f"{file.section}.{file.former_key}"
            kind = "base64" if binary else "text"
            raise ConfigError(f"{where}: {key} = {shown(text)}: not {kind}") from error
        files[file.attachment] = data
        keys.setdefault(file.key, file.attachment)
    return files


def _table(found: dict[str, Any], section: str) -> dict[str, Any]:
    keys = found.get(section)
    return keys if isinstance(keys, dict) else {}


def _drop_impossible_uavs(found: dict[str, Any]) -> None:
    """Remove names that no UAV can have, which earlier versions accepted, to no effect."""
    for section, key in UAV_NAMED:
        keys = _table(found, section)
        match keys.get(key):
            case dict() as named:
                keys[key] = {uav: one for uav, one in named.items() if is_uav_id(uav)}
            case list() as named:
                keys[key] = [uav for uav in named if not isinstance(uav, str) or is_uav_id(uav)]


def _missing_file_error(where: str, setting: str) -> ConfigError:
    return ConfigError(
        f"{where}: file of {setting} is not in the recording; give the settings with --config"
    )


def sections(text: str, where: str) -> dict[str, Any]:
    """Parse TOML into sections, unvalidated. Raises ``ConfigError`` like ``read_toml``."""
    try:
        return read_toml(text)
    except UserError as error:
        raise ConfigError(f"{where}: {error}") from error
