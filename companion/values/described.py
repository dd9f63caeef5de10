"""Descriptions of the values that leave the program, each declared once, beside the value.

    age_s: Annotated[float, Meaning("age of the newest accepted report", 4)]

Every output derives from these declarations: the HTTP API and its OpenAPI document
(``companion.server.models``), recordings (``companion.recording.fields``), exported tables
(``companion.recording.tables``), the reference pages of ``docs`` and the labels of the dashboard.

A described class is a dataclass or a ``NamedTuple``. A property is described in its return
annotation. A field without a ``Meaning`` stays inside the program.

The name of a value ends in its unit. Each output converts names and units by rule:

    inside, recording    API          export
    azimuth_rad          azimuth_deg  azimuth_deg
    azimuth_rate_radps   ..._degps    ..._degps
    valid_at_ns          valid_at     valid_at_ns and valid_at_utc
    velocity_ned_mps     unchanged    velocity_north_mps, velocity_east_mps, velocity_down_mps
"""

import functools
import operator
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, field
from enum import StrEnum
from typing import Any, Final, Literal, NamedTuple, Self

Way = Literal["api", "recording", "export"]  # an output of the program
NOWHERE: Final[Mapping[Way, str]] = types.MappingProxyType({})

UNITS: Final = {
    "m": "m", "s": "s", "ms": "ms", "ns": "ns", "deg": "deg", "rad": "rad", "db": "dB",
    "dbm": "dBm", "hz": "Hz", "mps": "m/s", "mps2": "m/s²", "degps": "deg/s", "dps": "deg/s",
    "radps": "rad/s", "ppm": "ppm", "bps": "bit/s", "bytes": "bytes", "utc": "UTC",
}  # fmt: skip
"""Unit symbol for each suffix of a name."""
_DEGREES: Final = {"_rad": "_deg", "_radps": "_degps"}


@dataclass(frozen=True, slots=True)
class Meaning:
    """Description of a value, and how each output of the program writes it.

    text        a phrase in plain English, without the unit; it gives the meaning of None
                if that is more than "unknown"
    number      field number in the recording's protobuf message; None: not recorded
    label       short name for tables and charts of the dashboard
    example     for the OpenAPI document
    wire        protobuf type, if it differs from the rule of ``companion.recording.fields``
    absent      outputs that omit it, each with the reason
    deprecated  replacement; the value is removed in the next version
    """

    text: str
    number: int | None = None
    _: KW_ONLY
    label: str | None = None
    example: Any = None
    wire: str | None = None
    absent: Mapping[Way, str] = field(default_factory=lambda: NOWHERE)
    deprecated: str | None = None


class DescribedEnum(StrEnum):
    """Enumeration whose values are described: ``NAME = "value", "meaning"``."""

    meaning: str

    def __new__(cls, value: str, meaning: str = "") -> Self:
        made = str.__new__(cls, value)
        made._value_ = value
        made.meaning = meaning
        return made


@dataclass(frozen=True, slots=True)
class Inline:
    """Marker of a described value whose own members replace it."""

    prefix: str = ""  # prepended to their names
    omit: tuple[str, ...] = ()  # members left out


class Member(NamedTuple):
    """Described value of a class."""

    name: str  # name inside the program; with the prefix if inlined
    type: Any  # annotation without Annotated and without None
    optional: bool  # whether it may be None
    meaning: Meaning
    get: Callable[[Any], Any]  # getter, called with an instance


def members(described: Any) -> tuple[Member, ...]:
    """Return the described values of a class, in the order of declaration."""
    found = _MEMBERS.get(described)
    if found is None:
        found = _MEMBERS[described] = tuple(_members(described))
    return found


_MEMBERS: Final[dict[Any, tuple[Member, ...]]] = {}


def meaning(described: Any, name: str) -> Meaning:
    """Return the meaning of one value of a class. Raises ``KeyError`` if it is not described."""
    return {member.name: member.meaning for member in members(described)}[name]


def is_described(kind: Any) -> bool:
    """Return whether the values of a class are described."""
    is_class = isinstance(kind, type) and typing.get_origin(kind) is None
    return is_class and not issubclass(kind, str | int) and bool(members(kind))


def bare(annotation: Any) -> tuple[Any, bool]:
    """Return a type without ``Annotated``, ``NewType`` and None, and whether None was allowed."""
    if typing.get_origin(annotation) is typing.Annotated:
        return bare(typing.get_args(annotation)[0])
    if isinstance(annotation, typing.NewType):
        return bare(annotation.__supertype__)
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        kinds = [kind for kind in typing.get_args(annotation) if kind is not types.NoneType]
        optional = len(kinds) < len(typing.get_args(annotation))
        return functools.reduce(operator.or_, (bare(kind)[0] for kind in kinds)), optional
    return annotation, False


def is_vector(kind: Any) -> bool:
    """Return whether a type is a numpy array."""
    return "ndarray" in str(kind)


def in_degrees(name: str) -> str:
    """Convert the name of an angle or rate in radians to degrees; return other names unchanged."""
    for inside, outside in _DEGREES.items():
        if name.endswith(inside):
            return name.removesuffix(inside) + outside
    return name


def is_in_radians(name: str) -> bool:
    """Return whether a value's name is an angle or a rate in radians."""
    return name.endswith(tuple(_DEGREES))


def unit(name: str) -> str:
    """Return the unit that a value's name ends in; empty if it has none."""
    return UNITS.get(name.rpartition("_")[2], "") if "_" in name else ""


def _members(described: type) -> Iterator[Member]:
    for name, annotation in _annotations(described).items():
        said = [one for one in _metadata(annotation) if isinstance(one, Meaning | Inline)]
        if not said:
            continue
        kind, optional = bare(annotation)
        get = operator.attrgetter(name)
        if isinstance(said[0], Meaning):
            yield Member(name=name, type=kind, optional=optional, meaning=said[0], get=get)
            continue
        for inner in members(kind):
            if inner.name not in said[0].omit:
                yield inner._replace(
                    name=said[0].prefix + inner.name,
                    optional=optional or inner.optional,
                    get=_through(get, inner.get) if optional else _chain(name, inner.get),
                )


def _annotations(described: type) -> dict[str, Any]:
    """Return the annotations of fields and properties of a class, base classes first."""
    hints = typing.get_type_hints(described, include_extras=True)
    found: dict[str, Any] = {}
    for base in reversed(described.__mro__):
        found |= {name: hints[name] for name in vars(base).get("__annotations__", ())}
        for name, value in vars(base).items():
            if isinstance(value, property) and value.fget is not None:
                returned = typing.get_type_hints(value.fget, include_extras=True)
                found[name] = returned.get("return")
    return found


def _metadata(annotation: Any) -> tuple[Any, ...]:
    """Return the metadata of ``Annotated`` at any depth of an annotation."""
    if typing.get_origin(annotation) is typing.Annotated:
        inner, *said = typing.get_args(annotation)
        return (*said, *_metadata(inner))
    return ()


def _chain(outer: str, inner: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a getter of an attribute's attribute; one C call if both are plain attributes."""
    if isinstance(inner, operator.attrgetter):
        path = str(inner.__reduce__()[1][0])
        return operator.attrgetter(f"{outer}.{path}")
    get = operator.attrgetter(outer)
    return lambda whole: inner(get(whole))


def _through(outer: Callable[[Any], Any], inner: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def get(whole: Any) -> Any:
        found = outer(whole)
        return None if found is None else inner(found)

    return get
