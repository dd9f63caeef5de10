"""What a column of an exported table is, and what of a value may stand in it."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

Value = str | int | float | bool | None
"""A value in a table; None: unknown, or not there."""


class Kind(StrEnum):
    """What the values of a column are.

    TEXT     words; empty words are unknown
    NUMBER   64-bit floating point; what is not finite is unknown
    TIME     the value is nanoseconds on the node's timeline, written in UTC with microseconds, cut
             off
    INTEGER  64 bits, always known: programs that read CSV make floats of integers with gaps, and
             nanoseconds since 1970 do not fit into one
    TRUTH    true or false, always known, likewise
    """

    TEXT = "text"
    NUMBER = "number"
    TIME = "time"
    INTEGER = "integer"
    TRUTH = "truth"


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """A column of a table.

    name     unique in its table; ends in the unit where there is one
    kind     what its values are
    unit     as it is written in documents; empty: none
    meaning  what it says
    of       the value, of what a row is made of
    """

    name: str
    kind: Kind
    unit: str
    meaning: str
    of: Callable[[Any], Any]


@dataclass(frozen=True, slots=True)
class Table:
    """A table: its name, what a row is, and its columns in order."""

    name: str
    row_is: str
    columns: tuple[Column, ...]

    def row(self, item: Any, utc_offset_ns: int) -> list[Value]:
        """The values of one row, in the order of the columns.

        ``utc_offset_ns`` is what a time of the node's timeline lacks to be UTC.
        Raises ``TypeError`` where one that is always known is not: a defect of the program.
        """
        values = [_CLEAN[column.kind](column.of(item)) for column in self.columns]
        if utc_offset_ns:
            for i, (column, value) in enumerate(zip(self.columns, values, strict=True)):
                if column.kind is Kind.TIME and isinstance(value, int):
                    values[i] = value + utc_offset_ns
        return values


def _text(value: object) -> str | None:
    """Words that any program can read: what is not Unicode, as of a file's name, is escaped."""
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
        raise TypeError("it is always known whether")
    return bool(value)


_CLEAN: dict[Kind, Callable[[Any], Value]] = {
    Kind.TEXT: _text,
    Kind.NUMBER: _number,
    Kind.TIME: _time,
    Kind.INTEGER: int,
    Kind.TRUTH: _truth,
}
