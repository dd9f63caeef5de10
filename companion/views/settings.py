"""The effective settings as the API shows them: each with its default, and where it comes from."""

from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

from companion.settings.model import Settings
from companion.settings.origins import Origin, Origins
from companion.values.described import Meaning
from companion.views.as_json import Json

LONGEST: Final = 400
"""Most characters of a text that is shown whole; what files held may be millions."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """One setting, and where it comes from."""

    value: Annotated[Any, Meaning("value in effect, in the unit that the key's name ends in")]
    default: Annotated[Any, Meaning("the default value")]
    source: Annotated[
        Literal["default", "file", "recording", "option", "program"],
        Meaning("what set it; the program sets some in its demo"),
    ]
    file: Annotated[str | None, Meaning("the file or recording that set it")]


@dataclass(frozen=True, slots=True)
class EffectiveSettings:
    """The settings by section and key."""

    sections: Annotated[dict[str, dict[str, Setting]], Meaning("settings by section and key")]


def show(settings: Settings, origins: Origins) -> Json:
    """The answer of ``/v1/settings``.

    What differs from its default, and nobody is known to have said, the program itself has set.
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
