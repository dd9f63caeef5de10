"""Steering vectors against direct sums; the pointing bound against an adversary."""

import cmath
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.beams.array import steering
from companion.beams.array.elements import Element, ElementPattern
from companion.beams.array.geometry import (
    SPEED_OF_LIGHT_MPS,
    Array,
    listed,
    uniform_circular,
    uniform_linear,
    uniform_rectangular,
)
from companion.values import FloatArray

AZIMUTHS = st.floats(-math.pi + 1e-9, math.pi)
ELEVATIONS = st.floats(-1.57, 1.57)
DIRECTIONS = st.lists(st.tuples(AZIMUTHS, ELEVATIONS), min_size=1, max_size=6)


def unit(azimuth_rad: float, elevation_rad: float) -> tuple[float, float, float]:
    """Return a unit vector; x is boresight, y right, z down."""
    level = math.cos(elevation_rad)
    return (level * math.cos(azimuth_rad), level * math.sin(azimuth_rad), -math.sin(elevation_rad))


def test_steering_vector_matches_golden_values() -> None:
    """Five elements at 0, 0.1, ..., 0.4 m, 1 GHz, 45 degrees."""
    elements = np.array([[0.0, 0.1 * m, 0.0] for m in range(5)])
    array = Array(
        kind="list", elements_m=elements, wavelength_m=299_792_458 / 1e9, array_from_body=np.eye(3)
    )
    found = steering.steering_matrix(array, np.array([unit(math.radians(45), 0)]))
    golden = [1, 0.0887 + 0.9961j, -0.9843 + 0.1767j, -0.2633 - 0.9647j, 0.9376 - 0.3478j]
    assert found.shape == (5, 1)
    assert found[:, 0] == pytest.approx(np.array(golden), abs=6e-5)


@given(DIRECTIONS, st.integers(0, 2**32 - 1))
def test_steering_matches_path_length_phases(angles: list[tuple[float, float]], seed: int) -> None:
    """Elements at arbitrary positions in space."""
    elements = np.random.default_rng(seed).uniform(-0.05, 0.05, (7, 3))
    array = Array(kind="list", elements_m=elements, wavelength_m=0.01, array_from_body=np.eye(3))
    directions = np.array([unit(*pair) for pair in angles])
    found = steering.steering_matrix(array, directions)
    assert found.shape == (7, len(angles))
    for m in range(7):
        for n, direction in enumerate(directions):
            path_m = sum(elements[m, k] * direction[k] for k in range(3))
            assert found[m, n] == pytest.approx(cmath.exp(2j * math.pi * path_m / 0.01), abs=1e-9)


@given(st.floats(-1.5, 1.5))
def test_linear_array_steering_matches_the_published_formula(theta_rad: float) -> None:
    """The formula is exp(j 2 pi / wavelength d m sin theta)."""
    array = uniform_linear(8, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3))
    found = steering.steering_matrix(array, np.array([unit(theta_rad, 0.0)]))[:, 0]
    wavelength_m = SPEED_OF_LIGHT_MPS / 30e9
    phase = 2 * np.pi / wavelength_m * (wavelength_m / 2) * np.arange(8) * np.sin(theta_rad)
    assert found == pytest.approx(np.exp(1j * phase), abs=1e-9)


def written_out(array: Array, direction: FloatArray) -> list[complex]:
    """Return g_m(u) exp(j k p_m . u) for cosine elements of exponent 2 in their own directions."""
    found = []
    for m, place in enumerate(array.elements_m.tolist()):
        ahead = [1.0, 0.0, 0.0]
        if array.element_from_array is not None:
            ahead = array.element_from_array[m, 0].tolist()
        cosine = sum(ahead[k] * direction[k] for k in range(3))
        path_m = sum(place[k] * direction[k] for k in range(3))
        gain = math.sqrt(6.0) * max(cosine, 0.0)
        found.append(gain * cmath.exp(2j * math.pi * path_m / array.wavelength_m))
    return found


OUTWARD = np.random.default_rng(8).standard_normal((7, 3))
PLACES = np.random.default_rng(9).uniform(-0.05, 0.05, (7, 3))
SQUARE = Element(ElementPattern.COSINE, 2.0)
FACING = {
    "line": uniform_linear(
        5, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3), element=SQUARE
    ),
    "rectangle": uniform_rectangular(
        2,
        columns=3,
        frequency_hz=30e9,
        spacing_wavelengths=0.5,
        array_from_body=np.eye(3),
        element=SQUARE,
    ),
    "circle": uniform_circular(
        6, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3), element=SQUARE
    ),
    "list": listed(PLACES, 30e9, array_from_body=np.eye(3), element=SQUARE),
    "list, each facing its way": listed(
        PLACES, 30e9, array_from_body=np.eye(3), element=SQUARE, lever_arm_m=None, outward=OUTWARD
    ),
}


@pytest.mark.parametrize("name", FACING)
@given(angles=DIRECTIONS)
@settings(max_examples=examples(30))
def test_steering_includes_each_element_gain(name: str, angles: list[tuple[float, float]]) -> None:
    array = FACING[name]
    directions = np.array([unit(*pair) for pair in angles])
    found = steering.steering_matrix(array, directions)
    gains = steering.amplitudes(array, directions)
    turned = steering.element_directions(array, directions)
    alike = array.element_from_array is None
    assert gains.shape == (1 if alike else array.size, len(angles))
    assert turned.shape == (*gains.shape, 3)
    assert np.linalg.norm(turned, axis=2) == pytest.approx(np.ones(gains.shape))
    for n, direction in enumerate(directions):
        assert found[:, n] == pytest.approx(np.array(written_out(array, direction)), abs=1e-9)
        assert np.abs(found[:, n]) == pytest.approx(gains[:, n].repeat(array.size if alike else 1))


def test_directions_are_rotated_into_the_element_frame() -> None:
    """Array boresight is to the element's left; the array's right is the element's boresight."""
    right = np.array([[0.0, 1.0, 0.0]])
    array = listed(
        np.zeros((1, 3)),
        1e9,
        array_from_body=np.eye(3),
        element=SQUARE,
        lever_arm_m=None,
        outward=right,
    )
    seen = steering.element_directions(array, np.array([unit(0, 0), unit(math.pi / 2, 0)]))
    assert seen[0] == pytest.approx(np.array([[0, -1, 0], [1, 0, 0]]))


@given(DIRECTIONS)
def test_azimuth_and_elevation_invert_unit_directions(angles: list[tuple[float, float]]) -> None:
    azimuths, elevations = steering.angles_rad(np.array([unit(*pair) for pair in angles]))
    assert azimuths == pytest.approx(np.array([pair[0] for pair in angles]), abs=1e-6)
    assert elevations == pytest.approx(np.array([pair[1] for pair in angles]), abs=1e-6)


def test_vertical_directions_have_elevation_of_90_degrees() -> None:
    # Rounding may leave a unit vector a little too long.
    _, elevations = steering.angles_rad(np.array([[0, 0, -1 - 1e-15], [0, 0, 1 + 1e-15]]))
    assert elevations == pytest.approx([math.pi / 2, -math.pi / 2])


def angle_rad(a: FloatArray, b: FloatArray) -> float:
    return math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b))


@given(st.floats(1.0, 5000.0), st.floats(1e-3, 0.999), st.integers(0, 2**32 - 1))
def test_pointing_bound_covers_the_error_ball_and_is_tight(
    range_m: float, share: float, seed: int
) -> None:
    """The tangent attains the bound."""
    rng = np.random.default_rng(seed)
    bound_m = share * range_m
    bound_rad = steering.pointing_bound_rad(bound_m, range_m)
    assert bound_rad is not None
    towards, aside = np.linalg.qr(rng.standard_normal((3, 2)))[0].T
    predicted = range_m * towards
    offsets = rng.standard_normal((20, 3))
    offsets *= (bound_m * rng.uniform(0, 1, 20) ** (1 / 3) / np.linalg.norm(offsets, axis=1))[
        :, np.newaxis
    ]
    for offset in offsets:
        assert angle_rad(predicted + offset, predicted) <= bound_rad + 1e-9
    # The worst case is the tangent from the array to the ball, at a right angle to its radius.
    tangent = bound_m * (-share * towards + math.sqrt(1 - share**2) * aside)
    assert np.linalg.norm(tangent) == pytest.approx(bound_m)
    assert angle_rad(predicted + tangent, predicted) >= 0.999 * bound_rad


@pytest.mark.parametrize("bound_m", [100.0, 100.1, 1e9])
def test_pointing_bound_is_undefined_inside_the_error_ball(bound_m: float) -> None:
    assert steering.pointing_bound_rad(bound_m, 100.0) is None


@pytest.mark.parametrize(
    ("rows", "columns"), [(1, 64), (1, 1024), (8, 8), (64, 1), (5, 33), (1, 1)]
)
@pytest.mark.parametrize("users", [1, 7, 300])
def test_grid_phase_powers_match_exponentials(rows: int, columns: int, users: int) -> None:
    """Any number of users; small and large numbers take different code paths."""
    array = uniform_rectangular(
        rows, columns=columns, frequency_hz=30e9, spacing_wavelengths=0.7, array_from_body=np.eye(3)
    )
    directions = np.random.default_rng(users).standard_normal((users, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, np.newaxis]
    found = steering.steering_matrix(array, directions)
    phase = 2 * np.pi / array.wavelength_m * (array.elements_m @ directions.T)
    assert found.shape == (rows * columns, users)
    assert np.abs(found - np.exp(1j * phase)).max() < 1e-11
    assert found.flags.c_contiguous
