"""Table as Parquet, written by pyarrow, which the extra ``parquet`` installs.

The metadata of the schema describe a row; those of a field, its unit and meaning.
"""

from collections.abc import Sequence
from typing import IO, Any, Final

from companion.recording.tables.columns import Column, ColumnKind, Table, Value
from companion.values.extras import needs

BATCH: Final = 8192  # rows per group, which are kept in memory
ALWAYS: Final = (ColumnKind.INTEGER, ColumnKind.TRUTH)


class ParquetFile:
    """Parquet writer of one table's rows, in groups, to an open file.

    Raises ``UserError`` if pyarrow is not installed.
    """

    def __init__(self, file: IO[bytes], table: Table) -> None:
        with needs("pyarrow", "parquet", "--format parquet"):
            import pyarrow
            from pyarrow import parquet
        self._arrow: Any = pyarrow
        fields = [self._field(column) for column in table.columns]
        self._schema = pyarrow.schema(fields, {"row": table.row_is})
        self._waiting: list[Sequence[Value]] = []
        self._times = [i for i, col in enumerate(table.columns) if col.kind is ColumnKind.TIME]
        self._writer: Any = parquet.ParquetWriter(file, self._schema, compression="zstd")

    def _field(self, column: Column) -> Any:
        arrow = self._arrow
        types = {
            ColumnKind.TEXT: arrow.string(),
            ColumnKind.NUMBER: arrow.float64(),
            ColumnKind.TIME: arrow.timestamp("us"),  # UTC without a zone, as in CSV
            ColumnKind.INTEGER: arrow.int64(),
            ColumnKind.TRUTH: arrow.bool_(),
        }
        said = {"unit": column.unit, "meaning": column.meaning}
        return arrow.field(column.name, types[column.kind], column.kind not in ALWAYS, said)

    def add(self, row: Sequence[Value]) -> None:
        """Add a row, and write the group of rows when it is full. Raises ``OSError``."""
        self._waiting.append(row)
        if len(self._waiting) >= BATCH:
            self._write()

    def finish(self) -> None:
        """Write remaining rows and the file's end; the file stays open. Raises ``OSError``."""
        self._write()
        self._writer.close()

    def abandon(self) -> None:
        """Write nothing more: the writer would otherwise end its file when it is collected."""
        self._writer.is_open = False

    def _write(self) -> None:
        if not self._waiting:
            return
        columns: list[Sequence[Any]] = list(zip(*self._waiting, strict=True))
        for i in self._times:
            columns[i] = [None if t_ns is None else t_ns // 1000 for t_ns in columns[i]]
        arrays = [
            self._arrow.array(values, field.type)
            for values, field in zip(columns, self._schema, strict=True)
        ]
        self._writer.write_batch(self._arrow.record_batch(arrays, schema=self._schema))
        self._waiting.clear()
