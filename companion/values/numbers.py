"""Types of vectors and numpy arrays. Arrays held by values are never written to."""

import numpy as np
from numpy.typing import NDArray

Vector = tuple[float, float, float]
"""Tuple of three numbers; arithmetic on it is several times faster than on small arrays."""
FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def vector(array: FloatArray) -> Vector:
    """Convert an array of three numbers to a ``Vector``."""
    x, y, z = array.tolist()
    return x, y, z
