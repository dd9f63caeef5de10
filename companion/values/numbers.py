"""Types of vectors and numpy arrays. Arrays in values are never written to."""

from tokenize import TokenError
from typing import Final

import numpy as np
from numpy.typing import NDArray

Vector = tuple[float, float, float]
"""Vector as a tuple of three numbers; several times faster than a small array."""
FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
NPY_ERRORS: Final = (
    ValueError, TypeError, LookupError, OverflowError, MemoryError, SyntaxError, RecursionError,
    TokenError,
)  # fmt: skip
"""What numpy raises for an invalid .npy header, which it reads as Python text; its documentation
does not list them."""


def vector(array: FloatArray) -> Vector:
    """Convert an array of three numbers to a ``Vector``."""
    x, y, z = array.tolist()
    return x, y, z
