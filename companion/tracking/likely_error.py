"""Likely error of a carrier's reported attitudes: an average over measurements, not a bound."""

import math
from typing import Final

import numpy as np

from companion.tracking.rotations import cross
from companion.values import FloatArray

PRIOR: Final = 0.1  # weight of no error, in measurements


class LikelyError:
    """Least squares of two rotation vectors: one fixed in the body, one in the local frame.

    A UAV at u that is seen at u + d has an error w with u x d = (1 - u u') w, w = B' b + c: B is
    body_from_local, b the error of the mount, c that of the compass. While the carrier does not
    turn only their sum is known.

    memory_s  time constant with which measurements are forgotten
    """

    def __init__(self, memory_s: float) -> None:
        self._memory_s = memory_s
        self._normal = np.zeros((6, 6))
        self._sum = np.zeros(6)
        self._t_ns: int | None = None
        self._parts: FloatArray = np.zeros(6, dtype=float)

    def add(
        self,
        t_ns: int,
        *,
        body_from_local: FloatArray,
        reported: FloatArray,
        seen: FloatArray,
        bound_rad: float,
    ) -> None:
        """Add a measurement: a UAV's reported and seen direction (3,), local frame.

        A deviation beyond ``bound_rad`` counts less, by Huber's weight.
        """
        if self._t_ns is not None:
            kept = math.exp(-abs(t_ns - self._t_ns) * 1e-9 / self._memory_s)
            self._normal *= kept
            self._sum *= kept
        self._t_ns = t_ns
        rows: FloatArray = np.empty((3, 6))
        rows[:, 3:] = np.eye(3) - reported[:, np.newaxis] * reported
        rows[:, :3] = rows[:, 3:] @ body_from_local.T
        across = cross(reported, seen)
        off = across - rows @ self._parts
        size = math.sqrt(off @ off)
        weighted = rows * min(1.0, bound_rad / max(size, 1e-12))
        self._normal += weighted.T @ rows
        self._sum += weighted.T @ across

    def solve(self) -> None:
        """Update the estimate by all measurements so far."""
        self._parts = np.asarray(np.linalg.solve(self._normal + PRIOR * np.eye(6), self._sum))

    def vector_rad(self, body_from_local: FloatArray) -> FloatArray:
        """Return the rotation vector (3,) of the error at an attitude, local frame."""
        found: FloatArray = body_from_local.T @ self._parts[:3] + self._parts[3:]
        return found
