"""Directions and steering vectors.

Angles of a unit direction u in the array frame: azimuth = atan2(u_y, u_x), to the right; elevation
= asin(-u_z), up. The steering vector of direction u is

    a(u)_m = g_m(u) exp(+j 2 pi / wavelength  p_m . u)

with p_m the position of element m and g_m its amplitude (docs/math.md 7). For isotropic elements
along y this is exp(j 2 pi / wavelength d m sin theta), paper eq. (2). If elements couple, and
carry C f when fed with f, the vector is C^T a(u), the response of each channel. It is 0 for a dead
element.
"""

import math
from typing import Final

import numpy as np

from companion.beams.array.elements import ElementPattern
from companion.beams.array.geometry import Array
from companion.values import ComplexArray, FloatArray

MIN_ENTRIES_FOR_POWERS: Final = 1000
"""Least entries of a steering matrix for which powers are cheaper than exponentials."""


def angles_rad(directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return azimuth and elevation, (N,) each, of unit directions (N, 3) in the array frame."""
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    return azimuth, np.arcsin(np.minimum(np.maximum(-directions[:, 2], -1.0), 1.0))


def unit_directions(azimuth_rad: FloatArray, elevation_rad: FloatArray) -> FloatArray:
    """Return unit directions (N, 3) in the array frame for azimuths and elevations (N,)."""
    level = np.cos(elevation_rad)
    return np.stack(
        [level * np.cos(azimuth_rad), level * np.sin(azimuth_rad), -np.sin(elevation_rad)], axis=-1
    )


def steering_matrix(array: Array, directions: FloatArray) -> ComplexArray:
    """Return A, (M, N): one steering vector per column, for unit directions (N, 3)."""
    matrix = phase_factors(array, directions)
    if array.element.pattern is not ElementPattern.ISOTROPIC:
        matrix *= amplitudes(array, directions)
    if array.coupling is not None:
        matrix = array.coupling.T @ matrix
    return array.fed(matrix)


def phase_factors(array: Array, directions: FloatArray) -> ComplexArray:
    """Return steering vectors (M, N) without the element pattern, for unit directions (N, 3)."""
    if array.grid is not None and array.size * len(directions) >= MIN_ENTRIES_FOR_POWERS:
        return _on_grid(array, directions, *array.grid)
    return phasors(array.wavenumber_radpm * (array.elements_m @ directions.T))


def phasors(phase_rad: FloatArray) -> ComplexArray:
    """Return exp(j phase), of the same shape; the complex exponential takes twice as long."""
    found: ComplexArray = np.empty(phase_rad.shape, dtype=complex)
    np.cos(phase_rad, out=found.real)
    np.sin(phase_rad, out=found.imag)
    return found


def _on_grid(array: Array, directions: FloatArray, rows: int, columns: int) -> ComplexArray:
    """Return phase factors (M, N) for elements row by row on a grid from the origin.

    Powers of the factor between neighbours are cheaper than exponentials.
    """
    across = _powers(array, array.elements_m[1 % columns], directions, columns)
    if rows == 1:
        return across
    down = _powers(array, array.elements_m[columns], directions, rows)
    found: ComplexArray = (down[:, np.newaxis] * across).reshape(rows * columns, -1)
    return found


def _powers(array: Array, step_m: FloatArray, directions: FloatArray, count: int) -> ComplexArray:
    """Return exp(j k step . u) to the powers 0 to ``count`` - 1, (count, N).

    Computed by doubling, so that rounding does not accumulate along the line.
    """
    found: ComplexArray = np.empty((count, len(directions)), dtype=complex)
    found[0] = 1.0
    if count == 1:
        return found
    found[1] = factor = phasors(array.wavenumber_radpm * (directions @ step_m))
    done = 2
    while done < count:
        factor = factor * factor
        np.multiply(found[: min(done, count - done)], factor, out=found[done : 2 * done])
        done *= 2
    return found


def amplitudes(array: Array, directions: FloatArray) -> FloatArray:
    """Return element amplitudes towards directions (N, 3): (M, N); (1, N) if all face alike."""
    return array.element.amplitude(element_directions(array, directions))


def element_directions(array: Array, directions: FloatArray) -> FloatArray:
    """Unit directions (N, 3) in element frames: (M, N, 3), or (1, N, 3) if all face alike."""
    if array.element_from_array is None:
        return directions[np.newaxis]
    turned: FloatArray = np.einsum("mij,nj->mni", array.element_from_array, directions)
    return turned


def pointing_bound_rad(bound_m: float, range_m: float) -> float | None:
    """Return the largest angle to the true direction for a position error up to ``bound_m``.

    This is the angle of the tangent to the ball of the error, asin(bound / range), with the range
    to the *predicted* position; None if the array lies inside the ball and every direction is
    possible (docs/math.md 5.3).
    """
    return math.asin(bound_m / range_m) if bound_m < range_m else None
