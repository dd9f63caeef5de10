"""Columns of the records in an onboard log."""

import copy
from typing import Self

import numpy as np
from numpy.typing import NDArray

from companion.values import IntArray

Bytes = NDArray[np.uint8]


class Columns:
    """Records of one type, as columns; empty without a layout or without records.

    at  offsets in ``data`` of the records, (N,)

    A column is copied when it is asked for, as a record may have 64 kB.
    """

    def __init__(self, data: Bytes, layout: "np.dtype[np.void] | None", at: IntArray) -> None:
        self._file: NDArray[np.void] = np.zeros(0, dtype=[])
        self._at = np.zeros(0, dtype=np.int64)
        if layout is not None and len(at):
            # A view with a record at every byte of the file, from which the actual ones are taken.
            room = data.size - layout.itemsize + 1
            self._file, self._at = np.ndarray((room,), layout, data, 0, (1,)), at

    def __len__(self) -> int:
        return len(self._at)

    def __contains__(self, column: object) -> bool:
        return self._file.dtype.names is not None and column in self._file.dtype.names

    def values(self, column: str, kinds: str, width: int = 1) -> NDArray[np.generic] | None:
        """Return a column as in the file: (N,), or (N, ``width``) for an array.

        None if missing, of another width, or of none of numpy's ``kinds``.
        """
        if column not in self:
            return None
        of = self._file[column]
        if of.dtype.kind not in kinds or of.shape[1:] != (() if width == 1 else (width,)):
            return None
        return of[self._at]

    def integers(self, column: str) -> IntArray | None:
        """Return a column of integers, (N,); None if missing. Impossible times become 0."""
        values = self.values(column, "iu")
        if values is None:
            return None
        if values.dtype == np.uint64:
            values = np.where(values < np.uint64(1 << 62), values, np.uint64(0))
        return values.astype(np.int64)

    def rows(self, chosen: IntArray | NDArray[np.bool_]) -> Self:
        """Return the same columns of only some of the records."""
        picked = copy.copy(self)
        picked._at = self._at[chosen]
        return picked
