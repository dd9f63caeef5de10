"""Conversion of described values to JSON: degrees, RFC 3339 times in UTC, null for unknown.

Names in the API follow by rule from those inside the program (``companion.values.described``).
"""

import functools
import re
import typing
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any, Final, Literal

import numpy as np

from companion.values import UtcNs, shown
from companion.values.described import (
    Member,
    in_degrees,
    is_described,
    is_in_radians,
    is_vector,
    members,
)

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
"""Deprecated names of values from the previous version, by class; they are still written."""


def as_json(item: Any, utc_ns: Utc) -> Json:
    """Return a described value as JSON."""
    kind: Any = type(item)
    plan, former = _plan(kind)
    shown = {
        name: get(item) if write is None else write(get(item), utc_ns) for name, get, write in plan
    }
    for old, new in former:
        shown[old] = shown[new]
    return shown


_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_RFC3339: Final = re.compile(
    r"([0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2})(?:\.([0-9]{1,9}))?(?:Z|\+00:00)"
)
COORDINATE_DIGITS: Final = 7  # decimals of a rounded latitude or longitude, about a centimetre
DIGITS: Final = 3  # decimals of any other rounded number


def rounded(content: Any, digits: int = DIGITS) -> Any:
    """Return JSON with numbers rounded to what a display can show: they compress to a third."""
    if isinstance(content, float):
        return round(content, digits)
    if isinstance(content, dict):
        return {
            key: rounded(one, COORDINATE_DIGITS if key in ("lat_deg", "lon_deg") else digits)
            for key, one in content.items()
        }
    if isinstance(content, list):
        return [rounded(one, digits) for one in content]
    return content


def name_in_json(name: str) -> str:
    """Return the name of a value in the API, from its name and unit inside the program."""
    return "at" if name == "t_ns" else in_degrees(name).removesuffix("_ns")


def rfc3339(t_ns: UtcNs) -> str:
    """Return a time in UTC with milliseconds, as 2026-11-20T13:00:00.123Z."""
    seconds, milliseconds = divmod(t_ns // 1_000_000, 1000)
    return f"{_to_the_second(seconds)}.{milliseconds:03d}Z"


@functools.lru_cache(maxsize=1024)
def _to_the_second(seconds: int) -> str:
    """Return date and time to the second; cached, as answers have many times within seconds."""
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}"


def parse_rfc3339(text: str) -> UtcNs:
    """Parse a time in UTC, with up to nine decimals of a second. Raises ``ValueError``."""
    found = _RFC3339.fullmatch(text)
    if found is None:
        raise ValueError(f"{shown(text)} is not a time in UTC, such as 2026-11-20T13:00:00.123Z")
    try:
        whole = datetime.fromisoformat(f"{found[1]}+00:00") - _EPOCH
    except ValueError as error:  # such as month 13
        raise ValueError(f"{shown(text)} is not a time: {error}") from error
    seconds = whole.days * 86_400 + whole.seconds
    return UtcNs(seconds * 1_000_000_000 + int((found[2] or "0").ljust(9, "0")))


def degrees(angle_rad: float | None) -> float | None:
    """Convert radians to degrees; None stays None."""
    return None if angle_rad is None else float(np.degrees(angle_rad))


Write = Callable[[Any, Utc], Any]
Plan = tuple[tuple[str, Callable[[Any], Any], Write | None], ...]
_PLAIN: Final = (str, int, float, bool)


@functools.cache
def _plan(kind: Any) -> tuple[Plan, tuple[tuple[str, str], ...]]:
    """Return name, getter and writer of each value of a class, and former names if any.

    Values that are JSON already have no writer.
    """
    plan = tuple(
        (name_in_json(member.name), member.get, _writer(member))
        for member in members(kind)
        if "api" not in member.meaning.absent
    )
    return plan, tuple(FORMER_NAMES.get(kind.__name__, {}).items())


def _writer(member: Member) -> Write | None:
    if is_in_radians(member.name):
        return lambda angle_rad, _: degrees(angle_rad)
    if member.name.endswith("_ns"):
        return lambda t_ns, utc_ns: None if t_ns is None else rfc3339(utc_ns(t_ns))
    kind, inner = member.type, typing.get_args(member.type)
    if kind in _PLAIN or typing.get_origin(kind) is Literal:
        return None
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return None  # it is a str
    copy = typing.get_origin(kind)
    if copy in (dict, list) and inner[-1] in _PLAIN:
        # A copy, since the event loop changes it while a thread encodes.
        return lambda items, _: None if items is None else copy(items)
    if is_vector(kind):
        return lambda array, _: None if array is None else array.tolist()
    if typing.get_origin(kind) is list and is_described(inner[0]):
        return lambda items, utc_ns: [as_json(item, utc_ns) for item in items]
    if is_described(kind):
        return lambda item, utc_ns: None if item is None else as_json(item, utc_ns)
    return _any


def _any(value: Any, utc_ns: Utc) -> Any:
    """Convert arrays and tuples to lists, and described values inside them to objects."""
    if value is None or isinstance(value, str | int | float):
        return value
    if isinstance(value, dict):
        return {key: _any(one, utc_ns) for key, one in list(value.items())}
    if isinstance(value, list | tuple) and not hasattr(value, "_fields"):
        return [_any(one, utc_ns) for one in value]
    return as_json(value, utc_ns) if members(type(value)) else str(value)
