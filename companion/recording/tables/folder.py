"""Folder of an export: one file per table, renamed when the export is complete.

A file that is being written is called ``….active``. ``export.json`` lists the contents of the
folder. It is removed before the first table is replaced and written after the last, so that with
it, all tables are of the same export.
"""

import contextlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from io import BufferedWriter
from pathlib import Path
from typing import IO, Any, Final, Protocol, Self

from companion.recording.folders import make_folder
from companion.recording.tables.columns import Table, Value
from companion.recording.tables.csv_file import CsvFile
from companion.recording.tables.parquet_file import ParquetFile
from companion.recording.writer import ACTIVE, open_beside, sync_folder

CONTENTS: Final = "export.json"  # contents of an export; written last


class TableFile(Protocol):
    """Table being written to a file, in any format."""

    def add(self, row: Sequence[Value]) -> None: ...
    def finish(self) -> None: ...
    def abandon(self) -> None: ...


FORMATS: Final[dict[str, Callable[[IO[bytes], Table], TableFile]]] = {
    "csv": CsvFile,
    "parquet": ParquetFile,
}
"""Classes that write a table, by the suffix of its file."""


class TableFolder:
    """Tables of one export, open until ``close`` or the end of the ``with``.

        where   the folder; created if missing
        form    a key of ``FORMATS``
        tables  the tables, each for its own file

    Raises ``UserError`` if a package is missing, ``OSError`` if the folder cannot be written, and
    ``BlockingIOError`` if another process exports to it.
    """

    def __init__(self, where: Path, form: str, tables: Sequence[Table]) -> None:
        self.rows = {table.name: 0 for table in tables}  # rows so far, by table
        self._where, self._form = where, form
        self._tables = {table.name: table for table in tables}
        self._open: dict[str, BufferedWriter] = {}
        self._files: dict[str, TableFile] = {}
        make_folder(where, "--out")
        self._contents = open_beside(where / CONTENTS)  # tables of one form and of another too
        try:
            for table in tables:
                file = self._open[table.name] = open_beside(where / self._name(table.name))
                self._files[table.name] = FORMATS[form](file, table)
        except BaseException:
            self.abandon()
            raise

    def add(self, table: str, item: Any, utc_offset_ns: int = 0) -> None:
        """Write a row for ``item``: see ``Table.row``.

        Raises ``OSError`` if writing fails.
        """
        self._files[table].add(self._tables[table].row(item, utc_offset_ns))
        self.rows[table] += 1

    def close(self, said: Mapping[str, Any]) -> list[Path]:
        """Finish and rename the files, and write ``export.json``; return their paths.

        ``said`` is added to ``export.json``, with the files and their numbers of rows. Raises
        ``OSError``; some files may then be renamed, but there is no ``export.json``.
        """
        for name, file in self._files.items():
            file.finish()
            self._open[name].flush()
            os.fsync(self._open[name].fileno())
        names = {table: self._name(table) for table in self._tables}
        told = {names[table]: rows for table, rows in self.rows.items()}
        contents = {**said, "format": self._form, "rows": told}
        made = self._active(CONTENTS)
        self._contents.write(json.dumps(contents, indent=1).encode() + b"\n")
        self._contents.flush()
        (self._where / CONTENTS).unlink(missing_ok=True)
        for name in names.values():
            self._active(name).rename(self._where / name)
        sync_folder(self._where)
        made.rename(self._where / CONTENTS)
        sync_folder(self._where)
        self._shut()
        return [self._where / name for name in (*names.values(), CONTENTS)]

    def abandon(self) -> None:
        """Remove the files written so far, except those already renamed."""
        if self._open:
            for table in self._files.values():
                table.abandon()
        for name in self._open:
            self._active(self._name(name)).unlink(missing_ok=True)
        if not self._contents.closed:
            self._active(CONTENTS).unlink(missing_ok=True)
        self._shut()

    def _shut(self) -> None:
        for file in (*self._open.values(), self._contents):
            with contextlib.suppress(OSError):  # a full disk: the file is removed anyway
                file.close()
        self._open.clear()

    def _name(self, table: str) -> str:
        return f"{table}.{self._form}"

    def _active(self, name: str) -> Path:
        return self._where / (name + ACTIVE)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.abandon()
