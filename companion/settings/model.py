"""All settings as one frozen value, checked once at start.

Each section lists its keys with unit, default and range. An error names the key, the value and what
is allowed.
"""

import difflib
from typing import Any, Final, Self

import tomli_w
from pydantic import ValidationError

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
from companion.settings.mavlink import (
    LinkSettings,
    OutSettings,
    PresenceSettings,
    SigningSettings,
    TrackSettings,
)
from companion.settings.outlets import (
    DriveSettings,
    PageSettings,
    RecordingSettings,
    RecordSettings,
    ServerSettings,
)
from companion.settings.section import ConfigError, Section
from companion.settings.tracking import ClockSettings, ObserverSettings
from companion.values import UserError, read_toml, shown

NEAR: Final = 0.7
"""Likeness (difflib's ratio) from which on a setting may have been meant by another name."""

MODELLED: Final = frozenset(
    (
        "center", "clocks", "observer", "tracks", "array", "beams", "codebook", "hardware", "radio",
        "link",
    )
)  # fmt: skip
"""Sections that make estimates and beams: what a recording has to say to its replay."""
EMBEDDED: Final = (
    ("array", "positions", "positions_m"),
    ("array", "coupling", "coupling_stored"),
    ("observer", "design", "design_json"),
    ("codebook", "file", "stored"),
    ("hardware", "calibration", "calibration_csv"),
    ("hardware", "unit", "unit_toml"),
)
"""Section; its key that names a file; its key that holds what is in that file."""


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

    @classmethod
    def from_toml(cls, text: str, where: str) -> Self:
        """Read settings from TOML text.

        Raises ``ConfigError``, its message beginning with ``where``, if they cannot be used.
        """
        return cls._from_sections(sections(text, where), where)

    @classmethod
    def from_recording(cls, text: str, where: str) -> Self:
        """The settings of a recording, as far as they make estimates and beams.

        Whoever made the recording is not trusted with anything else: where it listened, what it
        sent, where it wrote, and any path are left out. What a file held that they name is in the
        settings themselves. Raises ``ConfigError`` as ``from_toml``, and where it is not.
        """
        found = {name: kept for name, kept in sections(text, where).items() if name in MODELLED}
        for section, key, content in EMBEDDED:
            keys = found.get(section)
            if isinstance(keys, dict) and keys.pop(key, None) is not None and content not in keys:
                said = f"what {section}.{key} named is not in the recording"
                raise ConfigError(f"{where}: {said}: give the settings with --config")
        return cls._from_sections(found, where)

    @classmethod
    def _from_sections(cls, found: dict[str, Any], where: str) -> Self:
        try:
            return cls.model_validate(found)
        except ValidationError as error:
            raise ConfigError(f"{where}: {_first(error)}") from error

    def to_toml(self) -> str:
        """All settings, defaults included, as ``from_toml`` reads them."""
        return tomli_w.dumps(self.model_dump(mode="json", exclude_none=True))

    def override(self, **sections: dict[str, Any]) -> "Settings":
        """A copy with some keys of some sections replaced; a value of None leaves the key as it is.

        Which keys were given, as pydantic's ``model_fields_set`` tells, is kept. Raises
        ``ConfigError`` if the result cannot be used.
        """
        merged = self.model_dump(mode="json", exclude_none=True, exclude_unset=True)
        for name, keys in sections.items():
            merged.setdefault(name, {}).update(
                {key: value for key, value in keys.items() if value is not None}
            )
        try:
            return Settings.model_validate(merged)
        except ValidationError as error:
            raise ConfigError(_first(error)) from error


def sections(text: str, where: str) -> dict[str, Any]:
    """The sections of settings in TOML, unchecked. Raises ``ConfigError`` as ``read_toml``."""
    try:
        return read_toml(text)
    except UserError as error:
        raise ConfigError(f"{where}: {error}") from error


def _meant(place: tuple[int | str, ...]) -> str:
    """The setting whose name is nearest, as the end of a message; empty where none is near."""
    section, *keys = map(str, place)
    if not keys:
        near = difflib.get_close_matches(section, Settings.model_fields, 1, NEAR)
        owners = [
            name for name, field in Settings.model_fields.items() if section in _keys(field.default)
        ]
        if owners and not near:
            return f"; did you mean {owners[0]}.{section}?"
        return f"; did you mean {near[0]}?" if near else ""
    near = difflib.get_close_matches(
        keys[0], _keys(Settings.model_fields[section].default), 1, NEAR
    )
    return f"; did you mean {section}.{near[0]}?" if near else ""


def _keys(section: Section) -> list[str]:
    return list(type(section).model_fields)


def _first(error: ValidationError) -> str:
    """The first error as one line: key, value, what is allowed.

    A key that may be of several types has one error per type; all of them are said.
    """
    errors = error.errors(include_url=False)
    place = errors[0]["loc"][:2]
    key = ".".join(map(str, place))
    if errors[0]["type"] == "extra_forbidden":
        return f"{key} is not a setting{_meant(place)}"
    said = [wrong["msg"] for wrong in errors if wrong["loc"][:2] == place]
    allowed = dict.fromkeys(text.removeprefix("Value error, ") for text in said)
    return f"{key} = {shown(errors[0]['input'])}: {', or '.join(allowed)}"
