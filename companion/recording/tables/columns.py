"""Columns of an exported table, derived from the described values of the rows' class."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final

from companion.values.described import Member, in_degrees, is_in_radians, is_vector, members, unit

Value = str | int | float | bool | None  # a value in a table; None: unknown or missing
_AXES: Final = ("north", "east", "down")


class ColumnKind(StrEnum):
    """Kind of the values in a column.

    TEXT     text; an empty text is unknown
    NUMBER   64-bit floating point; a number that is not finite is unknown
    TIME     the value is nanoseconds on the node's timeline, written in UTC with microseconds,
             truncated
    INTEGER  64 bits, always known: programs that read CSV convert integers with gaps to floats,
             which cannot represent nanoseconds since 1970
    TRUTH    true or false, always known for the same reason
    """

    TEXT = "text"
    NUMBER = "number"
    TIME = "time"
    INTEGER = "integer"
    TRUTH = "boolean"


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """Column of a table; ``get`` returns the column's value from a row."""

    name: str
    kind: ColumnKind
    meaning: str
    get: Callable[[Any], Any]

    @property
    def unit(self) -> str:
        """Unit of the column's values; empty without one."""
        return unit(self.name) if self.kind is not ColumnKind.TIME else "UTC"


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Table of an export: its name, what a row is, and its columns in order.

    ``former_names`` are column names of the previous version, which are still written, last.
    """

    name: str
    row_is: str
    row_class: type
    former_names: Mapping[str, str] = field(default_factory=dict)
    columns: tuple[Column, ...] = field(init=False)

    def __post_init__(self) -> None:
        now = {column.name: column for column in _columns(self.row_class)}
        former = [
            Column(
                name=old, kind=now[new].kind, meaning=f"deprecated: use `{new}`", get=now[new].get
            )
            for old, new in self.former_names.items()
        ]
        object.__setattr__(self, "columns", (*now.values(), *former))

    def row(self, item: Any, utc_offset_ns: int) -> list[Value]:
        """Return the values of one row, in the order of the columns.

        ``utc_offset_ns`` is UTC minus the node's timeline. Raises ``TypeError`` if a required value
        is None: a defect of the program.
        """
        values = [_CLEAN[column.kind](column.get(item)) for column in self.columns]
        if utc_offset_ns:
            for i, (column, value) in enumerate(zip(self.columns, values, strict=True)):
                if column.kind is ColumnKind.TIME and isinstance(value, int):
                    values[i] = value + utc_offset_ns
        return values


def _columns(row_class: type) -> Iterator[Column]:
    """Yield the columns of a class: two for a time, three for a vector; angles in degrees."""
    for member in members(row_class):
        name, get, meaning = member.name, member.get, member.meaning.text
        if "export" in member.meaning.absent:
            continue
        if name.endswith("_ns"):
            if not member.optional:
                yield Column(
                    name=name, kind=ColumnKind.INTEGER, meaning=f"{meaning}, since 1970", get=get
                )
            utc = name.removesuffix("_ns") + "_utc"
            yield Column(name=utc, kind=ColumnKind.TIME, meaning=meaning, get=get)
        elif is_vector(member.type):
            for axis, direction in enumerate(_AXES):
                yield Column(
                    name=_along(name, direction),
                    kind=ColumnKind.NUMBER,
                    meaning=f"{meaning}: {direction}",
                    get=_element(get, axis),
                )
        elif is_in_radians(name):
            yield Column(
                name=in_degrees(name), kind=ColumnKind.NUMBER, meaning=meaning, get=_degrees(get)
            )
        else:
            yield Column(name=name, kind=_kind(member), meaning=meaning, get=get)


def _kind(member: Member) -> ColumnKind:
    if member.type is bool:
        return ColumnKind.TRUTH
    if member.type is int and not member.optional:
        return ColumnKind.INTEGER
    return ColumnKind.NUMBER if member.type in (int, float) else ColumnKind.TEXT


def _along(name: str, direction: str) -> str:
    """Return the name of a vector's component, such as ``velocity_north_mps``."""
    stem, _, ending = name.rpartition("_")
    return f"{stem.removesuffix('_ned')}_{direction}_{ending}"


def _element(get: Callable[[Any], Any], axis: int) -> Callable[[Any], float | None]:
    def element(row: Any) -> float | None:
        vector = get(row)
        return None if vector is None else float(vector[axis])

    return element


def _degrees(get: Callable[[Any], Any]) -> Callable[[Any], float | None]:
    def degrees(row: Any) -> float | None:
        angle_rad = get(row)
        return None if angle_rad is None else math.degrees(angle_rad)

    return degrees


def _text(value: object) -> str | None:
    """Return text that any program can read: invalid Unicode is escaped, as in a file name."""
    said = "" if value is None else str(value)
    if not said.isprintable():
        said = said.encode("utf-8", "backslashreplace").decode().replace("\0", "\\0")
    return said or None


def _number(value: float | None) -> float | None:
    return float(value) if value is not None and math.isfinite(value) else None


def _time(value: int | None) -> int | None:
    return None if value is None else int(value)


def _truth(value: object) -> bool:
    if value is None:
        raise TypeError("a truth value may not be None")
    return bool(value)


_CLEAN: dict[ColumnKind, Callable[[Any], Value]] = {
    ColumnKind.TEXT: _text,
    ColumnKind.NUMBER: _number,
    ColumnKind.TIME: _time,
    ColumnKind.INTEGER: int,
    ColumnKind.TRUTH: _truth,
}
