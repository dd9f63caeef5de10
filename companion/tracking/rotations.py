"""Rotations: matrices (3, 3), rotation vectors (3,) in rad, and angles."""

import math
from typing import Final

import numpy as np

from companion.values import FloatArray

_NO_ROTATION: Final = np.eye(3)


def rotation(vector_rad: FloatArray) -> FloatArray:
    """Return exp([w]), (3, 3): the rotation by a rotation vector (3,), Rodrigues' formula."""
    x, y, z = vector_rad.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    if angle == 0.0:
        return np.eye(3)
    x, y, z = x / angle, y / angle, z / angle
    sine, rest = math.sin(angle), 1 - math.cos(angle)
    return np.array(
        [
            [1 - rest * (y * y + z * z), rest * x * y - sine * z, rest * x * z + sine * y],
            [rest * x * y + sine * z, 1 - rest * (x * x + z * z), rest * y * z - sine * x],
            [rest * x * z - sine * y, rest * y * z + sine * x, 1 - rest * (x * x + y * y)],
        ]
    )


def rotation_vector(matrix: FloatArray) -> FloatArray:
    """Return the rotation vector (3,) of a rotation (3, 3) of less than pi/2."""
    off = matrix - matrix.T
    sine = np.array([off[2, 1], off[0, 2], off[1, 0]]) / 2.0
    size = math.sqrt(sine @ sine)
    return sine if size < 1e-12 else sine * (math.asin(min(1.0, size)) / size)


def angle_between_rad(one: FloatArray, other: FloatArray) -> float:
    """Return the angle of the rotation between two rotations (3, 3); exact also if small."""
    off = (one - other).ravel()
    return 2.0 * math.asin(min(1.0, math.sqrt(float(off @ off) / 8.0)))


def rotation_angle_rad(matrix: FloatArray) -> float:
    """Return the angle of a rotation (3, 3)."""
    return angle_between_rad(matrix, _NO_ROTATION)


def cross(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the cross product of two vectors (3,); ``numpy.cross`` takes ten times as long."""
    (x, y, z), (a, b, c) = one.tolist(), other.tolist()
    return np.array([y * c - z * b, z * a - x * c, x * b - y * a])
