"""Sample points of a cone, against steering vectors of directions computed one by one."""

import math

import numpy as np
import pytest

from companion.beams.array.elements import Element, ElementPattern
from companion.beams.array.geometry import Array, uniform_linear, uniform_rectangular
from companion.beams.array.steering import steering_matrix
from companion.beams.weights import shapes
from companion.beams.weights.cones import (
    SAMPLES_PER_WIDTH,
    SAMPLES_PER_WIDTH_IN_PLANE,
    ConeSamples,
    cones,
    cones_on_aperture,
)
from companion.values import FloatArray

EYE = np.eye(3)
GRIDS = {
    "line": uniform_linear(16, 30e9, spacing_wavelengths=0.5, array_from_body=EYE),
    "odd line": uniform_linear(15, 30e9, spacing_wavelengths=0.4, array_from_body=EYE),
    "square": uniform_rectangular(
        6, columns=6, frequency_hz=30e9, spacing_wavelengths=0.5, array_from_body=EYE
    ),
    "oblong": uniform_rectangular(
        3, columns=8, frequency_hz=30e9, spacing_wavelengths=0.5, array_from_body=EYE
    ),
    "patches": uniform_linear(
        16,
        30e9,
        spacing_wavelengths=0.5,
        array_from_body=EYE,
        element=Element(ElementPattern.COSINE),
    ),
}
DIRECTIONS = np.array([[0.8, 0.6, 0.0], [0.6, -0.48, 0.64], [1.0, 0.0, 0.0]])


def sample_directions(array: Array, angles_deg: list[list[float]]) -> ConeSamples:
    across = shapes.aperture(array)
    seen = cones_on_aperture(across, DIRECTIONS, np.radians(angles_deg))
    return cones(array, across, DIRECTIONS, seen, steering_matrix(array, DIRECTIONS))


def offsets(array: Array, found: ConeSamples) -> list[FloatArray]:
    """Return the sample points of each axis, as cosines relative to the predicted direction's."""
    finer = SAMPLES_PER_WIDTH if len(found.waves) == 1 else SAMPLES_PER_WIDTH_IN_PLANE
    across = shapes.aperture(array)
    reaches = [wave.shape[1] // 2 for wave in found.waves]
    return [
        np.arange(-reach, reach + 1) / finer * array.wavelength_m / across.lengths_m[d]
        for d, reach in enumerate(reaches)
    ]


@pytest.mark.parametrize("array", GRIDS.values(), ids=GRIDS.keys())
@pytest.mark.parametrize("wide_deg", [0.0, 3.0, 20.0, 90.0])
def test_fields_match_element_patterns_at_sample_points(array: Array, wide_deg: float) -> None:
    found = sample_directions(array, [[wide_deg, wide_deg / 2, 1.0], [0.5, 0.5, 0.0]])
    rng = np.random.default_rng(1)
    weights = rng.normal(size=(array.size, 3)) + 1j * rng.normal(size=(array.size, 3))
    fields = found.fields(weights)
    across = shapes.aperture(array)
    beside = np.meshgrid(*reversed(offsets(array, found)), indexing="ij")
    aside = np.stack([one.ravel() for one in reversed(beside)], axis=1)
    for user, direction in enumerate(DIRECTIONS):
        cosines = across.axes @ direction + aside
        phases = array.wavenumber_radpm * (array.centred_m @ across.axes.T) @ cosines.T
        expected = np.abs(weights[:, user] @ np.exp(1j * phases))
        assert np.abs(fields[user]) == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("array", GRIDS.values(), ids=GRIDS.keys())
@pytest.mark.parametrize("wide_deg", [0.0, 3.0, 20.0, 90.0])
def test_sample_points_cover_the_cone_with_little_excess(array: Array, wide_deg: float) -> None:
    angles_deg = [[wide_deg, wide_deg / 2, 1.0], [0.5, 0.5, 0.0]]
    found = sample_directions(array, angles_deg)
    beside = offsets(array, found)
    step = [one[1] - one[0] if len(one) > 1 else 2.0 for one in beside]
    axes = shapes.aperture(array).axes
    grid = np.meshgrid(*reversed(beside), indexing="ij")
    places = np.stack([one.ravel() for one in reversed(grid)], axis=1)
    period = [array.wavelength_m / spacing for spacing in spacings(array)]
    rng = np.random.default_rng(2)
    for size, angles in enumerate(np.radians(angles_deg)):
        for user, direction in enumerate(DIRECTIONS):
            inside = places[found.counts[size, user] > 0.5]
            off = angles[user] * np.sqrt(rng.uniform(0, 1, 300))[:, np.newaxis]
            aside = np.cross(direction, rng.normal(size=(300, 3)))
            aside /= np.linalg.norm(aside, axis=1)[:, np.newaxis]
            crowd = (np.cos(off) * direction + np.sin(off) * aside - direction) @ axes.T
            apart = crowd[:, np.newaxis] - inside
            apart -= period * np.rint(apart / period)
            nearest = (np.abs(apart) / step).max(axis=2).min(axis=1)
            # A planar array resolves less of a cone that reaches behind it.
            behind = angles[user] > math.acos(min(float(np.linalg.norm(axes @ direction)), 1.0))
            assert nearest.max() < (1.0 if len(axes) == 1 or not behind else 8.0)
            reach = 2 * math.sin(angles[user] / 2) + np.array(step)
            apart = inside - period * np.rint(inside / period)
            assert (np.abs(apart) <= reach + 1e-9).all()


def spacings(array: Array) -> list[float]:
    across = shapes.aperture(array)
    counts = [max(array.grid or ())] if len(across.axes) == 1 else list(array.grid or ())[::-1]
    return [float(length / count) for length, count in zip(across.lengths_m, counts, strict=True)]
