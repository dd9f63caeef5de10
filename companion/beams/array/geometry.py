"""Array geometry: positions and orientations of the elements, and the mount on the carrier.

Array frame: x boresight, y right, z down; metres. A uniform linear array (ULA) lies along y, a
uniform rectangular one (URA) in the yz plane, a uniform circular one (UCA) in the xy plane; any
list of positions is possible. The origin of the array frame is the phase reference.
"""

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from companion.beams.array.elements import ISOTROPIC, Element, ElementPattern
from companion.values import ArrayKind, BoolArray, ComplexArray, FloatArray, UserError

SPEED_OF_LIGHT_MPS: Final = 299_792_458.0
SAME_PLACE_WAVELENGTHS: Final = 1e-9
"""Distance below which two positions are identical: 1e-8 rad of phase."""
LINE_WAVELENGTHS: Final = 1e-6
"""Root mean square distance from a line below which all elements count as on the line."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Array:
    """Element positions, their wavelength, and the mount of the array.

        elements_m          (M, 3), array frame
        wavelength_m        wavelength
        array_from_body     (3, 3), the mount
        lever_arm_m         (3,), position of the array in the body frame, from the point whose
                            position the carrier reports
        element             pattern of all elements
        element_from_array  (M, 3, 3), rotation from the array frame to each element's frame; None:
                            all face boresight
        grid                rows and columns of a ULA or URA, elements row by row; else None
        live                (M,), whether an element works; None: all do
        coupling            C (M, M): fed with f, the elements carry C f; None: they carry f
        channel_error       (M,), largest error of a channel's factor, |actual / wanted - 1|; None:
                            0

    Computed from these:

        centred_m           (M, 3), positions relative to their centroid
        variance_m2         (3, 3), mean of their outer products
        axis                (3,), the line through all elements; None if they are not on a line
        lever_m             length of the lever arm
    """

    kind: ArrayKind
    elements_m: FloatArray
    wavelength_m: float
    array_from_body: FloatArray
    lever_arm_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    element: Element = ISOTROPIC
    element_from_array: FloatArray | None = None
    grid: tuple[int, int] | None = None
    live: BoolArray | None = None
    coupling: ComplexArray | None = None
    channel_error: FloatArray | None = None
    centred_m: FloatArray = field(init=False)
    variance_m2: FloatArray = field(init=False)
    axis: FloatArray | None = field(init=False)
    lever_m: float = field(init=False)

    def __post_init__(self) -> None:
        centred_m = self.elements_m - self.elements_m.mean(axis=0)
        object.__setattr__(self, "centred_m", centred_m)
        variance_m2 = centred_m.T @ centred_m / self.size
        values, vectors = np.linalg.eigh(variance_m2)
        on_a_line = values[1] <= (LINE_WAVELENGTHS * self.wavelength_m) ** 2
        object.__setattr__(self, "variance_m2", variance_m2)
        object.__setattr__(self, "axis", vectors[:, 2] if on_a_line else None)
        object.__setattr__(self, "lever_m", math.hypot(*self.lever_arm_m.tolist()))

    @property
    def size(self) -> int:
        """M, the number of elements of the array."""
        return len(self.elements_m)

    def fed(self, weights: ComplexArray) -> ComplexArray:
        """Return weights (M, K) with the weights of dead elements set to 0."""
        return weights if self.live is None else weights * self.live[:, np.newaxis]

    def carried(self, weights: ComplexArray) -> ComplexArray:
        """Return the excitation of the elements, (M, K), for ports fed with weights (M, K)."""
        live = self.fed(weights)
        return live if self.coupling is None else self.coupling @ live

    @property
    def wavenumber_radpm(self) -> float:
        """Wavenumber, 2 pi / wavelength."""
        return 2 * np.pi / self.wavelength_m


def uniform_linear(
    elements: int,
    frequency_hz: float,
    *,
    spacing_wavelengths: float,
    array_from_body: FloatArray,
    element: Element = ISOTROPIC,
    lever_arm_m: FloatArray | None = None,
) -> Array:
    """Build a uniform linear array along y, its first element at the origin.

    Raises ``UserError`` for invalid numbers, as do the functions below.
    """
    return uniform_rectangular(
        1,
        columns=elements,
        frequency_hz=frequency_hz,
        spacing_wavelengths=spacing_wavelengths,
        array_from_body=array_from_body,
        element=element,
        lever_arm_m=lever_arm_m,
    )


def uniform_rectangular(
    rows: int,
    *,
    columns: int,
    frequency_hz: float,
    spacing_wavelengths: float,
    array_from_body: FloatArray,
    element: Element = ISOTROPIC,
    lever_arm_m: FloatArray | None = None,
) -> Array:
    """Build a uniform rectangular array of rows downward (z), each to the right (y).

    The first element is at the origin. One row is the uniform linear array.
    """
    wavelength_m = _wavelength_m(min(rows, columns), frequency_hz, spacing_wavelengths)
    spacing_m = spacing_wavelengths * wavelength_m
    row, column = np.divmod(np.arange(rows * columns), columns)
    elements_m = np.stack([np.zeros(rows * columns), column * spacing_m, row * spacing_m], axis=1)
    kind = ArrayKind.ULA if rows == 1 else ArrayKind.URA
    lever = np.zeros(3) if lever_arm_m is None else lever_arm_m
    return Array(
        kind=kind,
        elements_m=elements_m,
        wavelength_m=wavelength_m,
        array_from_body=array_from_body,
        lever_arm_m=lever,
        element=element,
        element_from_array=None,
        grid=(rows, columns),
    )


def uniform_circular(
    elements: int,
    frequency_hz: float,
    *,
    spacing_wavelengths: float,
    array_from_body: FloatArray,
    element: Element = ISOTROPIC,
    lever_arm_m: FloatArray | None = None,
) -> Array:
    """Build a circle around the origin; the spacing is the chord between neighbours.

    The first element is on x, the next ones follow towards y. Elements that are not isotropic face
    outward.
    """
    wavelength_m = _wavelength_m(elements, frequency_hz, spacing_wavelengths)
    angle = 2 * np.pi * np.arange(elements) / elements
    radius_m = spacing_wavelengths * wavelength_m / (2 * np.sin(np.pi / elements))
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros(elements)], axis=1)
    placed = outward * (radius_m if elements > 1 else 0.0)
    return listed(
        placed,
        frequency_hz,
        array_from_body=array_from_body,
        element=element,
        lever_arm_m=lever_arm_m,
        outward=outward,
        kind=ArrayKind.UCA,
    )


def hexagonal(
    rings: int,
    frequency_hz: float,
    *,
    spacing_wavelengths: float,
    array_from_body: FloatArray,
    element: Element = ISOTROPIC,
    lever_arm_m: FloatArray | None = None,
) -> Array:
    """Build rings of hexagons about a middle element, on a triangular lattice in the yz plane.

    1 + 3 R (R + 1) elements for R rings, row by row from the top; neighbours are
    ``spacing_wavelengths`` apart. For the same grating lobes it needs 13 % fewer elements per area
    than a square lattice (Van Trees, Optimum Array Processing, 4.1.7).
    """
    wavelength_m = _wavelength_m(rings, frequency_hz, spacing_wavelengths)
    spacing_m = spacing_wavelengths * wavelength_m
    steps = np.arange(-rings, rings + 1)
    row, column = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    inside = np.abs(row + column) <= rings
    row, column = row[inside], column[inside]
    right, down = column + row / 2, row * math.sqrt(3) / 2
    return listed(
        np.stack([np.zeros(len(row)), right * spacing_m, down * spacing_m], axis=1),
        frequency_hz,
        array_from_body=array_from_body,
        element=element,
        lever_arm_m=lever_arm_m,
        kind=ArrayKind.HEXAGONAL,
    )


def listed(
    elements_m: FloatArray,
    frequency_hz: float,
    *,
    array_from_body: FloatArray,
    element: Element = ISOTROPIC,
    lever_arm_m: FloatArray | None = None,
    outward: FloatArray | None = None,
    kind: ArrayKind = ArrayKind.LIST,
) -> Array:
    """Build an array from positions (M, 3), facing ``outward`` (M, 3) (None: boresight).

    Raises ``UserError`` for two elements at the same position, which would be one element wired
    twice.
    """
    wavelength_m = _wavelength_m(len(elements_m), frequency_hz, 1.0)
    if elements_m.ndim != 2 or elements_m.shape[1] != 3 or not np.isfinite(elements_m).all():
        raise UserError("element positions: give rows of three finite numbers, metres")
    places = np.round(elements_m / (SAME_PLACE_WAVELENGTHS * wavelength_m))
    if len(np.unique(places, axis=0)) < len(places):
        raise UserError("two elements have the same position")
    turned = None
    if outward is not None and element.pattern is not ElementPattern.ISOTROPIC:
        turned = _facing(outward, len(elements_m))
    lever = np.zeros(3) if lever_arm_m is None else lever_arm_m
    return Array(
        kind=kind,
        elements_m=elements_m,
        wavelength_m=wavelength_m,
        array_from_body=array_from_body,
        lever_arm_m=lever,
        element=element,
        element_from_array=turned,
    )


def _wavelength_m(elements: int, frequency_hz: float, spacing: float) -> float:
    if elements < 1 or not (0 < frequency_hz < math.inf and 0 < spacing < math.inf):
        raise UserError("array: give at least one element, a frequency and a spacing above 0")
    return SPEED_OF_LIGHT_MPS / frequency_hz


def _facing(outward: FloatArray, count: int) -> FloatArray:
    """Return element_from_array (M, 3, 3): x outward, y level (right of outward) where possible.

    An element that faces straight up or down keeps the array's y.
    """
    if outward.shape != (count, 3) or not np.isfinite(outward).all():
        raise UserError("element directions: give three finite numbers for each element")
    lengths = np.linalg.norm(outward, axis=1)
    if not (lengths > 0).all():
        raise UserError("element directions: give vectors with a length above 0")
    x = outward / lengths[:, np.newaxis]
    y = np.stack([-x[:, 1], x[:, 0], np.zeros(count)], axis=1)  # down cross outward
    level = np.linalg.norm(y, axis=1)
    y = np.where(
        level[:, np.newaxis] > 1e-9, y / np.maximum(level, 1e-300)[:, np.newaxis], [0, 1, 0]
    )
    return np.stack([x, y, np.cross(x, y)], axis=1)
