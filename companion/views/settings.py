"""The effective settings as shown by the API: each with its default and its origin."""

from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

from companion.settings.model import Settings
from companion.settings.origins import Origin, Origins
from companion.values.described import Meaning
from companion.views.as_json import Json

LONGEST: Final = 400
"""Longest text of a setting shown in full; contents of files may have millions of characters."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """Setting with its default and its origin."""

    value: Annotated[Any, Meaning("value in effect, in the unit that the key's name ends in")]
    default: Annotated[Any, Meaning("the default value")]
    source: Annotated[
        Literal["default", "file", "recording", "option", "program"],
        Meaning("origin of the value; program: set by the program itself, as in its demo"),
    ]
    file: Annotated[str | None, Meaning("the file or recording that set it")]


@dataclass(frozen=True, slots=True)
class EffectiveSettings:
    """Effective settings by section and key."""

    sections: Annotated[dict[str, dict[str, Setting]], Meaning("settings by section and key")]


def show(settings: Settings, origins: Origins) -> Json:
    """Return the answer of ``/v1/settings``.

    A value that differs from its default and has no recorded origin was set by the program itself.
    """
    plain, effective = Settings().model_dump(mode="json"), settings.model_dump(mode="json")
    return {
        "sections": {
            section: {
                key: _shown(value, plain[section][key], origins.get((section, key)))
                for key, value in keys.items()
            }
            for section, keys in effective.items()
        }
    }


def _shown(value: Any, default: Any, origin: Origin | None) -> Json:
    if origin is None and value != default:
        origin = Origin("program")
    return {
        "value": _cut(value),
        "default": default,
        "source": origin.kind if origin else "default",
        "file": origin.name if origin else None,
    }


def _cut(value: Any) -> Any:
    if not isinstance(value, str) or len(value) <= LONGEST:
        return value
    return f"{value[:LONGEST]}… ({len(value)} characters)"
