"""The rival: a multiplicative extended Kalman filter for the error of reported attitudes.

State: the rotation vector of the error, local frame, a random walk. A measured direction z of a UAV
reported at u gives z - u = w x u, with noise by the receiver and by the position. Source: Markley,
Attitude error representations for Kalman filtering, J. Guidance 26 (2003) 311.
"""

import math
from typing import Final

import numpy as np

from companion.tracking.rotations import rotation
from companion.values import FloatArray

CONFIDENCE: Final = 0.997  # share of errors that the ellipse should contain
_CHI2_2D: Final = -2.0 * math.log(1.0 - CONFIDENCE)  # two degrees of freedom, in closed form
POSITION_SHARE: Final = 1.0 / 3.0  # standard deviation of a position as a share of its bound


class ErrorFilter:
    """Filter of the error of reported attitudes; standard deviations are thirds of bounds.

    bound_rad   bound on the error at first
    drift_radps largest rate of the error, used as that of a random walk per root second
    """

    def __init__(self, bound_rad: float, drift_radps: float) -> None:
        self._error = np.eye(3)
        self._covariance = np.eye(3) * (bound_rad / 3.0) ** 2
        self._drift_radps = drift_radps
        self._t_ns: int | None = None

    def add(self, t_ns: int, reported: FloatArray, seen: FloatArray, deviation_rad: float) -> None:
        """Update by a UAV's reported and seen direction, (3,), local frame."""
        if self._t_ns is not None:
            elapsed_s = abs(t_ns - self._t_ns) * 1e-9
            self._covariance = self._covariance + np.eye(3) * self._drift_radps**2 * elapsed_s
        self._t_ns = t_ns
        expected = self._error @ reported
        axes = _tangent(expected)
        across = axes @ (seen - expected)
        rows = axes @ -_cross_matrix(expected)
        spread = rows @ self._covariance @ rows.T + np.eye(2) * deviation_rad**2
        gain = self._covariance @ rows.T @ np.linalg.inv(spread)
        self._error = rotation(gain @ across) @ self._error
        self._covariance = (np.eye(3) - gain @ rows) @ self._covariance

    def direction(self, reported: FloatArray) -> FloatArray:
        """Return where a UAV is seen, by the estimate."""
        return self._error @ reported

    def contains(self, reported: FloatArray, true: FloatArray, position_rad: float) -> bool:
        """Return whether the ellipse of ``CONFIDENCE`` contains a true direction."""
        expected = self._error @ reported
        axes = _tangent(expected)
        rows = axes @ -_cross_matrix(expected)
        spread = rows @ self._covariance @ rows.T + np.eye(2) * position_rad**2
        off = axes @ (true - expected)
        return bool(off @ np.linalg.solve(spread, off) <= _CHI2_2D)


def _tangent(towards: FloatArray) -> FloatArray:
    """Return two unit vectors (2, 3) across a direction."""
    least = np.eye(3)[int(np.argmin(np.abs(towards)))]
    first = np.cross(towards, least)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(towards, first)])


def _cross_matrix(vector: FloatArray) -> FloatArray:
    x, y, z = vector.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
