"""Types of vectors and numpy arrays. Arrays held by values are never written to."""

import numpy as np
from numpy.typing import NDArray

Vector = tuple[float, float, float]
"""Three numbers, where there are few: arithmetic on them is several times that of small arrays."""
FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def vector(array: FloatArray) -> Vector:
    """An array of three numbers as a vector."""
    x, y, z = array.tolist()
    return x, y, z
