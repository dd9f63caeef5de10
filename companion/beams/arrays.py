"""Where the elements of the array are.

Array frame: x boresight, y right, z down; metres. So far the uniform linear array along y, with
its first element at the origin, which is the phase reference.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.values import FloatArray

SPEED_OF_LIGHT_MPS: Final = 299_792_458.0


@dataclass(frozen=True, slots=True, eq=False)
class Array:
    """Element positions (M, 3) in the array frame, metres, at a wavelength in metres.

    ``array_from_body`` (3, 3) is the mounting. Elements are isotropic.
    """

    kind: str
    elements_m: FloatArray
    wavelength_m: float
    array_from_body: FloatArray

    @property
    def size(self) -> int:
        """M, the number of elements."""
        return len(self.elements_m)


def uniform_linear(
    elements: int, frequency_hz: float, spacing_wavelengths: float, array_from_body: FloatArray
) -> Array:
    """A uniform linear array along y. ``ValueError`` for what is no array."""
    if elements < 1 or frequency_hz <= 0 or spacing_wavelengths <= 0:
        raise ValueError("an array has at least one element, a frequency and a spacing above 0")
    wavelength_m = SPEED_OF_LIGHT_MPS / frequency_hz
    positions_m = np.zeros((elements, 3))
    positions_m[:, 1] = np.arange(elements) * spacing_wavelengths * wavelength_m
    return Array("ula", positions_m, wavelength_m, array_from_body)


def half_power_beamwidth_rad(array: Array) -> float | None:
    """Full width of the broadside beam at half power; None for a single element.

    Uniform weights on a uniform line of M elements, spacing d: found on the exact array factor
    |sin(M x) / (M sin x)|^2 = 1/2 with x = pi d sin(theta) / wavelength.
    """
    count = array.size
    if count < 2:
        return None
    spacing_m = float(array.elements_m[1, 1] - array.elements_m[0, 1])
    low, high = 0.0, np.pi / count  # full gain; first null
    for _ in range(60):
        x = (low + high) / 2
        power = (np.sin(count * x) / (count * np.sin(x))) ** 2
        low, high = (x, high) if power > 0.5 else (low, x)
    sine = low * array.wavelength_m / (np.pi * spacing_m)
    return float(2 * np.arcsin(sine)) if sine <= 1 else None
