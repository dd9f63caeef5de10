"""Element positions, outward directions, and mirror symmetry."""

import math

import numpy as np
import pytest

from companion.beams.array import geometry
from companion.beams.array.elements import Element, ElementPattern
from companion.values import FloatArray, UserError

EYE = np.eye(3)
LIGHT = geometry.SPEED_OF_LIGHT_MPS
"""Frequency at which the wavelength is one metre."""


def test_linear_array_lies_along_y() -> None:
    array = geometry.uniform_linear(5, 3e9, spacing_wavelengths=0.5, array_from_body=EYE)
    assert array.size == 5
    assert array.wavelength_m == pytest.approx(299_792_458 / 3e9)
    spacing_m = 0.5 * 299_792_458 / 3e9
    expected = [[0, m * spacing_m, 0] for m in range(5)]
    assert array.elements_m == pytest.approx(np.array(expected))
    assert array.array_from_body is EYE


@pytest.mark.parametrize(
    ("elements", "frequency_hz", "spacing"),
    [(0, 1e9, 0.5), (-1, 1e9, 0.5), (4, 0.0, 0.5), (4, -1e9, 0.5), (4, 1e9, 0.0), (4, 1e9, -0.5)],
)
def test_array_without_elements_is_rejected(
    elements: int, frequency_hz: float, spacing: float
) -> None:
    with pytest.raises(ValueError, match="at least one element"):
        geometry.uniform_linear(
            elements, frequency_hz, spacing_wavelengths=spacing, array_from_body=EYE
        )


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_invalid_frequency_or_spacing_is_rejected(bad: float) -> None:
    with pytest.raises(ValueError, match="a frequency and a spacing above 0"):
        geometry.uniform_linear(4, bad, spacing_wavelengths=0.5, array_from_body=EYE)
    with pytest.raises(ValueError, match="a frequency and a spacing above 0"):
        geometry.uniform_circular(4, 1e9, spacing_wavelengths=bad, array_from_body=EYE)


@pytest.mark.parametrize(("rows", "columns"), [(0, 4), (4, 0), (-1, -1)])
def test_rectangle_without_elements_is_rejected(rows: int, columns: int) -> None:
    with pytest.raises(ValueError, match="at least one element"):
        geometry.uniform_rectangular(
            rows, columns=columns, frequency_hz=1e9, spacing_wavelengths=0.5, array_from_body=EYE
        )


def test_rectangle_elements_are_numbered_row_by_row() -> None:
    array = geometry.uniform_rectangular(
        3, columns=4, frequency_hz=LIGHT, spacing_wavelengths=0.6, array_from_body=EYE
    )
    assert (array.kind, array.size, array.grid) == ("ura", 12, (3, 4))
    for row in range(3):
        for column in range(4):
            place = array.elements_m[4 * row + column]
            assert place == pytest.approx([0, 0.6 * column, 0.6 * row])
    assert array.element_from_array is None


def test_single_row_rectangle_equals_linear_array() -> None:
    row, line = (
        geometry.uniform_rectangular(
            1, columns=5, frequency_hz=3e9, spacing_wavelengths=0.5, array_from_body=EYE
        ),
        geometry.uniform_linear(5, 3e9, spacing_wavelengths=0.5, array_from_body=EYE),
    )
    assert row.kind == line.kind == "ula"
    assert row.grid == line.grid == (1, 5)
    assert np.array_equal(row.elements_m, line.elements_m)


@pytest.mark.parametrize("elements", [2, 3, 4, 7, 32])
def test_circle_has_even_spacing_and_starts_at_boresight(elements: int) -> None:
    array = geometry.uniform_circular(elements, LIGHT, spacing_wavelengths=0.5, array_from_body=EYE)
    assert (array.kind, array.size, array.grid) == ("uca", elements, None)
    gaps = np.linalg.norm(array.elements_m - np.roll(array.elements_m, -1, axis=0), axis=1)
    assert gaps == pytest.approx(0.5)
    radii = np.linalg.norm(array.elements_m, axis=1)
    assert radii == pytest.approx(radii[0])
    assert array.elements_m[0] == pytest.approx([radii[0], 0, 0])
    assert not array.elements_m[:, 2].any()
    turn = math.atan2(array.elements_m[1, 1], array.elements_m[1, 0])
    assert turn == pytest.approx(2 * math.pi / elements)  # from x to y


def test_single_element_circle_lies_at_the_origin() -> None:
    assert not geometry.uniform_circular(
        1, 1e9, spacing_wavelengths=0.5, array_from_body=EYE
    ).elements_m.any()


COSINE = Element(ElementPattern.COSINE)


def test_elements_of_a_circle_face_outward_unless_they_are_isotropic() -> None:
    array = geometry.uniform_circular(
        6, 1e9, spacing_wavelengths=0.5, array_from_body=EYE, element=COSINE
    )
    turned = array.element_from_array
    assert turned is not None
    outward = array.elements_m / np.linalg.norm(array.elements_m, axis=1)[:, np.newaxis]
    assert np.einsum("mij,mj->mi", turned, outward) == pytest.approx(np.array([[1, 0, 0]] * 6))
    assert (
        geometry.uniform_circular(
            6, 1e9, spacing_wavelengths=0.5, array_from_body=EYE
        ).element_from_array
        is None
    )


def test_listed_elements_face_their_outward_vector_and_stay_level() -> None:
    rng = np.random.default_rng(2)
    outward = np.concatenate(
        [rng.standard_normal((20, 3)), [[0, 0, 2], [0, 0, -0.5], [1e-13, 0, -1], [-3, 0, 0]]]
    )
    array = geometry.listed(
        rng.uniform(-1, 1, (24, 3)),
        1e9,
        array_from_body=EYE,
        element=Element(ElementPattern.TR38901),
        lever_arm_m=None,
        outward=outward,
    )
    turned = array.element_from_array
    assert turned is not None
    unit = outward / np.linalg.norm(outward, axis=1)[:, np.newaxis]
    for m in range(24):
        assert turned[m] @ turned[m].T == pytest.approx(EYE, abs=1e-12)
        assert np.linalg.det(turned[m]) == pytest.approx(1)
        assert turned[m, 0] == pytest.approx(unit[m])
        assert turned[m, 1, 2] == pytest.approx(0)  # y is level ...
        if m != 20:
            assert turned[m, 2, 2] >= -1e-12  # ... and z down: not upside down
    assert np.array_equal(turned[20, 1], [0, 1, 0])
    assert np.array_equal(turned[21, 1], [0, 1, 0])


def test_listed_array_keeps_its_arguments() -> None:
    places = np.random.default_rng(4).uniform(-1, 1, (6, 3))
    lever = np.array([0.1, -0.2, 0.3])
    array = geometry.listed(places, 2e9, array_from_body=EYE, element=COSINE, lever_arm_m=lever)
    assert (array.kind, array.size, array.grid) == ("list", 6, None)
    assert array.elements_m is places
    assert array.lever_arm_m is lever
    assert array.element is COSINE
    assert array.element_from_array is None  # all on the boresight axis
    assert not geometry.listed(places, 2e9, array_from_body=EYE).lever_arm_m.any()
    for made in (geometry.uniform_linear, geometry.uniform_circular):
        array = made(
            3, 1e9, spacing_wavelengths=0.5, array_from_body=EYE, element=COSINE, lever_arm_m=lever
        )
        assert array.lever_arm_m is lever
        assert array.element is COSINE


PLACES = np.random.default_rng(6).uniform(-1, 1, (5, 3))
TWICE = np.concatenate([PLACES, PLACES[2:3] + 1e-12])


@pytest.mark.parametrize(
    ("places", "outward", "reason"),
    [
        (np.zeros((0, 3)), None, "at least one element"),
        (np.zeros(3), None, "rows of three finite numbers"),
        (np.zeros((2, 2)), None, "rows of three finite numbers"),
        (np.array([[0, 0, math.nan]]), None, "rows of three finite numbers"),
        (np.array([[0, math.inf, 0]]), None, "rows of three finite numbers"),
        (TWICE, None, "two elements have the same position"),
        (PLACES, np.ones((4, 3)), "three finite numbers for each element"),
        (PLACES, np.full((5, 3), math.nan), "three finite numbers for each element"),
        (PLACES, np.zeros((5, 3)), "with a length above 0"),
    ],
)
def test_invalid_element_list_is_rejected(
    places: FloatArray, outward: FloatArray | None, reason: str
) -> None:
    with pytest.raises(ValueError, match=reason):
        geometry.listed(
            places, LIGHT, array_from_body=EYE, element=COSINE, lever_arm_m=None, outward=outward
        )


@pytest.mark.parametrize("rings", [1, 2, 5])
def test_hexagonal_array_is_a_triangular_lattice(rings: int) -> None:
    """Neighbours are a spacing apart, inner elements have six; 60° of rotation change nothing."""
    array = geometry.hexagonal(rings, LIGHT, spacing_wavelengths=0.7, array_from_body=EYE)
    placed = array.elements_m
    assert (array.kind, array.size) == ("hexagonal", 1 + 3 * rings * (rings + 1))
    assert placed[:, 0] == pytest.approx(np.zeros(array.size))
    assert placed.mean(axis=0) == pytest.approx(np.zeros(3))
    apart_m = np.linalg.norm(placed[:, np.newaxis] - placed, axis=2)
    neighbours = (np.abs(apart_m - 0.7) < 1e-9).sum(axis=1)
    assert apart_m[apart_m > 0].min() == pytest.approx(0.7)
    assert (neighbours == 6).sum() == 1 + 3 * (rings - 1) * rings
    assert neighbours.min() == 3
    half, side = 0.5, math.sqrt(3) / 2
    turned = placed @ np.array([[1, 0, 0], [0, half, side], [0, -side, half]])
    order = [np.lexsort(np.round(one[:, 1:], 6).T) for one in (placed, turned)]
    assert turned[order[1]] == pytest.approx(placed[order[0]], abs=1e-9)


def test_hexagon_without_rings_is_rejected() -> None:
    with pytest.raises(UserError, match="at least one element"):
        geometry.hexagonal(0, 1e9, spacing_wavelengths=0.5, array_from_body=EYE)
