"""Where each setting comes from: a file, a recording, an option, or the program itself."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from companion.settings.model import Settings


@dataclass(frozen=True, slots=True)
class Origin:
    """Who said a setting; ``name`` is the file or recording that did, None for the others."""

    kind: Literal["file", "recording", "option", "program"]
    name: str | None = None


Origins = Mapping[tuple[str, str], Origin]
"""By section and key; who is not named there left the setting at its default."""


def given(settings: Settings, origin: Origin) -> Origins:
    """Every key that was given when these settings were made, be it with its default."""
    return {
        (section, key): origin
        for section in settings.model_fields_set
        for key in getattr(settings, section).model_fields_set
    }


def changed(settings: Settings, origin: Origin) -> Origins:
    """Every key that is not at its default."""
    plain = Settings()
    return {
        (section, key): origin
        for section in Settings.model_fields
        for key, value in getattr(settings, section)
        if value != getattr(getattr(plain, section), key)
    }


def of_options(options: Mapping[str, Mapping[str, Any]]) -> Origins:
    """Every key that ``Settings.override`` replaces, given the same sections."""
    return {
        (section, key): Origin("option")
        for section, keys in options.items()
        for key, value in keys.items()
        if value is not None
    }
