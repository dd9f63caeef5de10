"""The first error of invalid settings, in one line: key, value, allowed values."""

import difflib
import re
from collections.abc import Mapping
from typing import Any, Final

from pydantic import ValidationError
from pydantic.fields import FieldInfo

from companion.settings.section import Section
from companion.settings.tracking import LimitSettings
from companion.values import shown

Place = tuple[int | str, ...]
Sections = Mapping[str, FieldInfo]
MIN_SIMILARITY: Final = 0.7
"""Least similarity (difflib's ratio) of a setting that is suggested for an unknown one."""
_ALLOWED: Final = {
    "dict_type": "give a table",
    "missing": "too few values",
    "model_type": "give a table",
    "tuple_type": "give a list",
}
"""Allowed values in TOML's words, by the type of an error that Pydantic words for Python."""
_BARE: Final = re.compile(r"[A-Za-z0-9_-]+")


def _suggestion(place: Place, sections: Sections) -> str:
    """Return a suggestion of the most similar setting's name; empty if none is similar."""
    section, *keys = map(str, place)
    if not keys:
        near = difflib.get_close_matches(section, sections, 1, MIN_SIMILARITY)
        owners = [name for name, field in sections.items() if section in _keys(field.default)]
        if owners and not near:
            return f"; did you mean {owners[0]}.{section}?"
        return f"; did you mean {near[0]}?" if near else ""
    *table, key = keys
    # Tables inside sections hold the limits of a type of aircraft, or of one UAV.
    known = list(LimitSettings.model_fields) if table else _keys(sections[section].default)
    near = difflib.get_close_matches(key, known, 1, MIN_SIMILARITY)
    return f"; did you mean {_dotted((section, *table, near[0]))}?" if near else ""


def _keys(section: Section) -> list[str]:
    return list(type(section).model_fields)


def first_error(error: ValidationError, sections: Sections, given: Any = None) -> str:
    """Return the first error of invalid settings as one line: key, value, allowed values.

    A key with several allowed types has one error per type; the line contains all of them.
    ``given``: what was validated, in which the key is found; None: the key has at most two parts.
    ``sections``: the fields of the settings.
    """
    errors = error.errors(include_url=False)
    place = _place(errors[0]["loc"], given)
    if errors[0]["type"] == "extra_forbidden":
        return f"{_dotted(place)} is not a setting{_suggestion(place, sections)}"
    said = [
        _ALLOWED.get(wrong["type"], wrong["msg"])
        for wrong in errors
        if _place(wrong["loc"], given) == place
    ]
    allowed = dict.fromkeys(text.removeprefix("Value error, ") for text in said)
    return f"{_dotted(place)} = {shown(errors[0]['input'])}: {', or '.join(allowed)}"


def _place(loc: Place, given: Any) -> Place:
    """Return the keys of an error's location, without the types that were tried."""
    place = list[int | str]()
    for part in loc:
        if not isinstance(given, dict) or part not in given:
            break
        place.append(part)
        given = given[part]
    if "[key]" in loc:  # the key itself is the wrong value
        place = place[:-1]
    return tuple(place) if len(place) > 2 else loc[:2]


def _dotted(place: Place) -> str:
    """Return the name of a setting as TOML writes it."""
    return ".".join(str(one) if _BARE.fullmatch(str(one)) else f'"{one}"' for one in place)
