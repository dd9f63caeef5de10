"""Construction of the array's elements from the settings."""

from typing import Any

import numpy as np

from companion.beams.array import geometry
from companion.beams.array.elements import Element, ElementPattern
from companion.settings.model import Settings
from companion.settings.section import ConfigError
from companion.tracking.carrier import body_from_ned
from companion.values import ArrayKind, FloatArray, UserError


def placed(settings: Settings) -> geometry.Array:
    """Return the array's elements on their mount. Raises ``ConfigError``."""
    given = settings.array
    mount = body_from_ned(
        *np.radians([given.mount_roll_deg, given.mount_pitch_deg, given.mount_yaw_deg])
    )
    element = Element(ElementPattern(given.element), given.element_exponent)
    lever_arm_m = np.array(given.lever_arm_m)
    spacing = given.spacing_wavelengths
    if given.spacing_m is not None:
        spacing = given.spacing_m * given.frequency_hz / geometry.SPEED_OF_LIGHT_MPS
    mounted: dict[str, Any] = {
        "array_from_body": mount, "element": element, "lever_arm_m": lever_arm_m
    }  # fmt: skip
    spaced = mounted | {"spacing_wavelengths": spacing}
    elements, frequency_hz = given.elements, given.frequency_hz
    try:
        match given.kind:
            case ArrayKind.ULA:
                return geometry.uniform_linear(elements, frequency_hz, **spaced)
            case ArrayKind.URA:
                return geometry.uniform_rectangular(
                    given.rows, columns=given.columns, frequency_hz=frequency_hz, **spaced
                )
            case ArrayKind.UCA:
                return geometry.uniform_circular(elements, frequency_hz, **spaced)
            case ArrayKind.HEXAGONAL:
                return geometry.hexagonal(given.rings, frequency_hz, **spaced)
            case ArrayKind.LIST:
                placed = _rows(given.positions_m or ())
                outward = placed[:, 3:6] if placed.shape[1] == 6 else None
                return geometry.listed(placed[:, :3], frequency_hz, outward=outward, **mounted)
    except UserError as error:
        raise ConfigError(f"array: {error}") from error


def _rows(positions_m: tuple[tuple[float, ...], ...]) -> FloatArray:
    lengths = {len(row) for row in positions_m}
    if lengths not in ({3}, {6}):
        raise UserError("positions_m must have rows of 3 numbers each, or of 6 each")
    return np.array(positions_m)
