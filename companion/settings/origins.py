"""Origin of each setting: a file, a recording, an option, or the program itself."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from companion.settings.model import Settings


@dataclass(frozen=True, slots=True)
class Origin:
    """Source that set a value; ``name`` is the file or recording, None for other kinds."""

    kind: Literal["file", "recording", "option", "program"]
    name: str | None = None


Origins = Mapping[tuple[str, str], Origin]
"""Origins of settings by section and key; a key without an origin has its default."""


def given(settings: Settings, origin: Origin) -> Origins:
    """Return the origins of all keys that were given, even if the default was given."""
    return {
        (section, key): origin
        for section in settings.model_fields_set
        for key in getattr(settings, section).model_fields_set
    }


def changed(settings: Settings, origin: Origin) -> Origins:
    """Return the origins of all keys whose values differ from the default."""
    plain = Settings()
    return {
        (section, key): origin
        for section in Settings.model_fields
        for key, value in getattr(settings, section)
        if value != getattr(getattr(plain, section), key)
    }


def of_options(options: Mapping[str, Mapping[str, Any]]) -> Origins:
    """Return the origins of all keys that ``Settings.override`` replaces with some sections."""
    return {
        (section, key): Origin("option")
        for section, keys in options.items()
        for key, value in keys.items()
        if value is not None
    }
