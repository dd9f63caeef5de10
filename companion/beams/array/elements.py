"""Patterns of a single array element.

Element frame: x outward, y right, z down, as the array frame. An amplitude is the square root of
the power gain over an isotropic element.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np

from companion.values import FloatArray, UserError


class ElementPattern(StrEnum):
    """Shape of an antenna element's pattern."""

    ISOTROPIC = "isotropic"
    COSINE = "cosine"
    TR38901 = "3gpp"


# 3GPP TR 38.901 table 7.3-1: 65 degrees beamwidth, at most 30 dB below the peak of 8 dBi.
WIDTH_DEG: Final = 65.0
FLOOR_DB: Final = 30.0
BEST_DBI: Final = 8.0


@dataclass(frozen=True, slots=True)
class Element:
    """Pattern of an element; ``exponent`` q applies to the cosine only.

        ISOTROPIC  gain 1 everywhere
        COSINE     power gain 2(q + 1) cos^q of the angle from outward, 0 behind; the factor makes
                   the radiated power that of an isotropic element
        TR38901    the antenna element of 3GPP TR 38.901, table 7.3-1

    Raises ``UserError`` for an exponent below 0.
    """

    pattern: ElementPattern = ElementPattern.ISOTROPIC
    exponent: float = 1.0

    def __post_init__(self) -> None:
        if not 0 <= self.exponent < math.inf:
            raise UserError(f"exponent of the cosine pattern is {self.exponent:g}; give 0 or more")

    def amplitude(self, directions: FloatArray) -> FloatArray:
        """Return the amplitude towards unit directions (..., 3) in the element frame.

        Shape (...).
        """
        match self.pattern:
            case ElementPattern.ISOTROPIC:
                return np.ones(directions.shape[:-1])
            case ElementPattern.COSINE:
                return self._cosine(directions[..., 0])
            case ElementPattern.TR38901:
                return _tr38901(*_azimuth_and_elevation(directions))

    def amplitude_range(
        self, directions: FloatArray, radius_rad: float | FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return bounds (...) on the amplitude within ``radius_rad`` of unit directions (..., 3).

        Both bounds are attained, except at the corners of TR 38.901, where the product of the two
        cuts is bounded by the extremes of each.
        """
        match self.pattern:
            case ElementPattern.ISOTROPIC:
                both = np.ones(directions.shape[:-1])
                return both, both
            case ElementPattern.COSINE:
                aside = np.hypot(directions[..., 1], directions[..., 2])
                off = np.arctan2(aside, directions[..., 0])  # arccos has an error of 1e-8 near 0
                least = np.cos(np.minimum(off + radius_rad, np.pi))
                return self._cosine(least), self._cosine(np.cos(np.maximum(off - radius_rad, 0.0)))
            case ElementPattern.TR38901:
                return _tr38901_range(directions, radius_rad)

    def _cosine(self, cosine: FloatArray) -> FloatArray:
        power = 2 * (self.exponent + 1) * np.maximum(cosine, 0.0) ** self.exponent
        amplitude: FloatArray = np.sqrt(np.where(cosine > 0, power, 0.0))
        return amplitude


ISOTROPIC: Final = Element()


def _azimuth_and_elevation(directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return absolute azimuth and elevation of directions; arctan2 is exact up to the poles."""
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    return np.abs(np.arctan2(y, x)), np.arctan2(np.abs(z), np.hypot(x, y))


def _tr38901(azimuth_rad: FloatArray, elevation_rad: FloatArray) -> FloatArray:
    """Amplitude of the 3GPP element (table 7.3-1), for azimuths and elevations of 0 or more."""
    down_db = np.minimum(12 * (np.degrees(elevation_rad) / WIDTH_DEG) ** 2, FLOOR_DB)
    aside_db = np.minimum(12 * (np.degrees(azimuth_rad) / WIDTH_DEG) ** 2, FLOOR_DB)
    gain_db = BEST_DBI - np.minimum(down_db + aside_db, FLOOR_DB)
    amplitude: FloatArray = 10 ** (gain_db / 20)
    return amplitude


def _tr38901_range(
    directions: FloatArray, radius_rad: float | FloatArray
) -> tuple[FloatArray, FloatArray]:
    azimuth, elevation = _azimuth_and_elevation(directions)
    # A cap around elevation e reaches asin(sin(radius) / cos(e)) in azimuth, or over the pole.
    over = elevation + radius_rad >= np.pi / 2
    sine = np.sin(np.minimum(radius_rad, np.pi / 2)) / np.maximum(np.cos(elevation), 1e-300)
    reach = np.where(over, np.pi, np.arcsin(np.clip(sine, 0.0, 1.0)))
    least = _tr38901(np.minimum(azimuth + reach, np.pi), np.minimum(elevation + radius_rad, np.pi))
    most = _tr38901(np.maximum(azimuth - reach, 0.0), np.maximum(elevation - radius_rad, 0.0))
    return least, most
