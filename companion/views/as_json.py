"""Described values as the API shows them: degrees, RFC 3339 times in UTC, null for unknown.

The names follow by rule from those inside the program (``companion.values.described``).
"""

import functools
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any, Final

import numpy as np

from companion.values import UtcNs
from companion.values.described import Member, members

Json = dict[str, Any]
Utc = Callable[[int], UtcNs]  # function from a time on the node's timeline to UTC

FORMER_NAMES: Final[Mapping[str, Mapping[str, str]]] = {
    "BeamState": {
        "azimuth_rate_dps": "azimuth_rate_degps",
        "elevation_rate_dps": "elevation_rate_degps",
    },
    "Assumptions": {"source": "limits_source"},
    "MessageRate": {"message_id": "msgid"},
    "UavState": {"altitude_datum": "alt_datum"},
}
"""Names that values had in the version before, by class: still written, deprecated."""

_DEGREES: Final = {"_rad": "_deg", "_radps": "_degps"}


def as_json(item: Any, utc_ns: Utc) -> Json:
    """A described value as JSON."""
    kind: Any = type(item)
    shown = {name: write(get(item), utc_ns) for name, get, write in _plan(kind)}
    for old, new in FORMER_NAMES.get(kind.__name__, {}).items():
        shown[old] = shown[new]
    return shown


def name_in_json(name: str) -> str:
    """The name of a value in the API, by the unit that it has inside the program."""
    for inside, outside in _DEGREES.items():
        if name.endswith(inside):
            return name.removesuffix(inside) + outside
    return "at" if name == "t_ns" else name.removesuffix("_ns")


def rfc3339(t_ns: UtcNs) -> str:
    """A time in UTC with milliseconds: 2026-11-20T13:00:00.123Z."""
    seconds, milliseconds = divmod(t_ns // 1_000_000, 1000)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{milliseconds:03d}Z"


def degrees(angle_rad: float | None) -> float | None:
    """Radians to degrees; None stays null."""
    return None if angle_rad is None else float(np.degrees(angle_rad))


Write = Callable[[Any, Utc], Any]


@functools.cache
def _plan(kind: Any) -> tuple[tuple[str, Callable[[Any], Any], Write], ...]:
    """Name, getter and writer of each value of a class."""
    return tuple(
        (name_in_json(member.name), member.get, _writer(member))
        for member in members(kind)
        if "api" not in member.meaning.absent
    )


def _writer(member: Member) -> Write:
    if member.name.endswith(tuple(_DEGREES)):
        return lambda angle_rad, _: degrees(angle_rad)
    if member.name.endswith("_ns"):
        return lambda t_ns, utc_ns: None if t_ns is None else rfc3339(utc_ns(t_ns))
    if member.type in (str, int, float, bool):
        return lambda value, _: value
    if isinstance(member.type, type) and issubclass(member.type, StrEnum):
        return lambda value, _: None if value is None else str(value)
    return _any


def _any(value: Any, utc_ns: Utc) -> Any:
    """Arrays and tuples as lists, described values within as objects."""
    if value is None or isinstance(value, str | int | float):
        return value
    if isinstance(value, dict):
        return {key: _any(one, utc_ns) for key, one in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list | tuple) and not hasattr(value, "_fields"):
        return [_any(one, utc_ns) for one in value]
    if members(type(value)):
        return as_json(value, utc_ns)
    return str(value)
