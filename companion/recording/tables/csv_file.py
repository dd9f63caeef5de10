"""Table as CSV (RFC 4180), UTF-8, with line feeds; unknown values are empty fields."""

import csv
import io
from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import IO, Final

from companion.recording.tables.columns import ColumnKind, Table, Value

_BEGINNING: Final = datetime(1970, 1, 1)  # UTC without a zone, which all readers parse as a time


class CsvFile:
    """CSV writer of one table's rows, to an open file."""

    def __init__(self, file: IO[bytes], table: Table) -> None:
        self._text = io.TextIOWrapper(file, encoding="utf-8", newline="")
        self._rows = csv.writer(self._text, lineterminator="\n")
        self._rows.writerow([column.name for column in table.columns])
        self._times = [i for i, col in enumerate(table.columns) if col.kind is ColumnKind.TIME]
        self._truths = [i for i, col in enumerate(table.columns) if col.kind is ColumnKind.TRUTH]

    def add(self, row: Sequence[Value]) -> None:
        """Write a row. Raises ``OSError`` if writing fails."""
        cells = list(row)
        for i in self._times:
            cells[i] = utc(row[i])
        for i in self._truths:
            cells[i] = "true" if row[i] else "false"
        self._rows.writerow(cells)

    def finish(self) -> None:
        """Flush the remaining rows; the file stays open. Raises ``OSError``."""
        self._text.flush()
        self._text.detach()

    def abandon(self) -> None:
        """Write nothing more; rows that wait are dropped."""


def utc(t_ns: Value) -> str | None:
    """Return a time as ``2026-11-20T13:00:00.123456``; None if unknown or outside the calendar."""
    if not isinstance(t_ns, int):
        return None
    try:
        then = _BEGINNING + timedelta(microseconds=t_ns // 1000)
    except OverflowError:
        return None
    return then.isoformat(timespec="microseconds")
