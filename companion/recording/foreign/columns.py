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
    """

    def __init__(self, data: Bytes, layout: "np.dtype[np.void] | None", at: IntArray) -> None:
        self._records: NDArray[np.void] = np.zeros(0, dtype=[])
        if layout is not None and len(at):
            # A view with a record at every byte of the file, from which the actual ones are taken.
            room = data.size - layout.itemsize + 1
            self._records = np.ndarray((room,), layout, data, 0, (1,))[at]

    def __len__(self) -> int:
        return len(self._records)

    def __contains__(self, column: object) -> bool:
        return self._records.dtype.names is not None and column in self._records.dtype.names

    def integers(self, column: str) -> IntArray | None:
        """Return a column of integers, (N,); None if missing. Impossible times become 0."""
        if column not in self:
            return None
        values = self._records[column]
        if values.dtype.kind not in "iu" or values.ndim != 1:
            return None
        if values.dtype == np.uint64:
            values = np.where(values < np.uint64(1 << 62), values, np.uint64(0))
        return values.astype(np.int64)

    def rows(self, chosen: IntArray | NDArray[np.bool_]) -> Self:
        """Return the same columns of only some of the records."""
        picked = copy.copy(self)
        picked._records = self._records[chosen]
        return picked
