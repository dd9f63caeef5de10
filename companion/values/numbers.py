"""Types of vectors and numpy arrays. Arrays in values are never written to."""

import numpy as np
from numpy.typing import NDArray

Vector = tuple[float, float, float]
"""Vector as a tuple of three numbers; several times faster than a small array."""
FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def vector(array: FloatArray) -> Vector:
    """Convert an array of three numbers to a ``Vector``."""
    x, y, z = array.tolist()
    return x, y, z
