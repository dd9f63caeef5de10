"""Index of the newest positions of all tracks, searched at once.

Every report of a relayed aircraft looks for better tracks near it. A loop over a thousand tracks
takes milliseconds, so that few receivers of a dense sky, or one that floods, would use all time.
"""

from typing import Final

import numpy as np

from companion.values import BoolArray, FloatArray, Vector, kind_of

ROWS_FIRST: Final = 64


class NewestPositions:
    """Newest local position of each UAV, with the rank of its kind."""

    def __init__(self) -> None:
        self._rows = dict[str, int]()
        self._uavs = list[str]()  # by row; empty: the row is free
        self._free = list[int]()
        self._ned_m: FloatArray = np.zeros((ROWS_FIRST, 3))
        self._rank = np.zeros(ROWS_FIRST)  # infinite: the row is free

    def put(self, uav: str, position_ned_m: Vector) -> None:
        """Set the position of a UAV."""
        row = self._rows.get(uav)
        if row is None:
            row = self._rows[uav] = self._new_row()
            self._uavs[row] = uav
            self._rank[row] = kind_of(uav).rank
        self._ned_m[row] = position_ned_m

    def _new_row(self) -> int:
        if self._free:
            return self._free.pop()
        row = len(self._uavs)
        self._uavs.append("")
        if row == len(self._rank):
            self._ned_m = np.concatenate((self._ned_m, np.zeros_like(self._ned_m)))
            self._rank = np.concatenate((self._rank, np.zeros_like(self._rank)))
        return row

    def forget(self, uav: str) -> None:
        """Remove a UAV."""
        row = self._rows.pop(uav, None)
        if row is not None:
            self._uavs[row] = ""
            self._rank[row] = np.inf
            self._free.append(row)

    def near(self, position_ned_m: Vector, within_m: float, rank: float) -> list[str]:
        """Return the UAVs within a distance of a position whose kind has a rank below ``rank``."""
        used = len(self._uavs)
        off_m = self._ned_m[:used] - np.asarray(position_ned_m)
        is_near: BoolArray = np.einsum("ij,ij->i", off_m, off_m) < within_m * within_m
        return [self._uavs[row] for row in np.flatnonzero(is_near & (self._rank[:used] < rank))]
