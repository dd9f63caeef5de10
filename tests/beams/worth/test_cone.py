"""Cells cover their cones, and their bounds hold for random directions and on rims."""

import cmath
import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.beams.array import steering
from companion.beams.array.elements import Element, ElementPattern
from companion.beams.array.geometry import Array, listed, uniform_circular, uniform_linear
from companion.beams.array.geometry import uniform_rectangular as grid
from companion.beams.worth import cone
from companion.beams.worth.cone import Boxes, Cells, DirectionCones
from companion.values import FloatArray

EYE = np.eye(3)
GPP = Element(ElementPattern.TR38901)
COSINE = Element(ElementPattern.COSINE, 1.5)
SLANTED = np.outer(np.array([-2.0, -0.7, 0.1, 1.3, 1.9]), [0.004, 0.005, -0.003]) + 0.02
ARRAYS = {
    "line": uniform_linear(16, 30e9, spacing_wavelengths=0.5, array_from_body=EYE),
    "line of patterns": uniform_linear(
        16, 30e9, spacing_wavelengths=0.5, array_from_body=EYE, element=GPP
    ),
    "slanted line": listed(SLANTED, 30e9, array_from_body=EYE, element=COSINE),
    "line that faces apart": listed(
        SLANTED,
        30e9,
        array_from_body=EYE,
        element=GPP,
        lever_arm_m=None,
        outward=np.random.default_rng(6).standard_normal((5, 3)),
    ),
    "one": uniform_linear(1, 30e9, spacing_wavelengths=0.5, array_from_body=EYE, element=GPP),
    "grid": grid(
        4,
        columns=6,
        frequency_hz=30e9,
        spacing_wavelengths=0.5,
        array_from_body=EYE,
        element=COSINE,
    ),
    "circle": uniform_circular(10, 30e9, spacing_wavelengths=0.5, array_from_body=EYE, element=GPP),
    "cloud": listed(
        np.random.default_rng(5).uniform(-0.02, 0.02, (9, 3)), 30e9, array_from_body=EYE
    ),
}
BOUNDS = st.sampled_from([0.0, 1e-9, 1e-4, 0.02, 0.3, 1.2, math.pi / 2, 2.5, math.pi])


def anywhere(rng: np.random.Generator, count: int) -> FloatArray:
    drawn = rng.standard_normal((count, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def within(
    direction: FloatArray, bound_rad: float, rng: np.random.Generator, count: int
) -> FloatArray:
    """Return unit directions within an angle of one; every third lies on the rim."""
    aside = np.cross(direction, anywhere(rng, count))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    off = bound_rad * np.where(np.arange(count) % 3, np.sqrt(rng.uniform(size=count)), 1.0)
    return np.cos(off)[:, np.newaxis] * direction + np.sin(off)[:, np.newaxis] * aside


def angle_rad(a: FloatArray, b: FloatArray) -> FloatArray:
    found: FloatArray = 2 * np.arcsin(np.minimum(np.linalg.norm(a - b, axis=-1) / 2, 1.0))
    return found


def drawn_cones(
    array: Array, bound_rad: float, seed: int, endfire: bool
) -> tuple[DirectionCones, Boxes]:
    """Draw one cone, in any direction or along the element line, and its cells, split or not."""
    rng = np.random.default_rng(seed)
    direction = anywhere(rng, 1)
    if endfire and array.size > 1:
        along = array.elements_m[-1] - array.elements_m[0]
        direction = (along / np.linalg.norm(along))[np.newaxis]
    weights = np.abs(rng.standard_normal((array.size, 1)))
    cones = cone.cones_around(array, direction, np.array([bound_rad]), weights)
    boxes = cone.first_boxes(cones)
    return cones, cone.split(cones, boxes) if seed % 2 else boxes


def predicted_of(cones: DirectionCones) -> FloatArray:
    tilt_rad, (pole, aside, _) = cones.tilts_rad[0], cones.frames[0]
    predicted: FloatArray = math.cos(tilt_rad) * pole + math.sin(tilt_rad) * aside
    return predicted


def whole(cones: DirectionCones) -> DirectionCones:
    """Return cones with all columns, so that a direction can be compared."""
    return dataclasses.replace(cones, columns=np.arange(3))


def holders(cells: Cells, direction: FloatArray) -> FloatArray:
    """Return which cells contain the direction, by their reaches and by their caps."""
    off = np.einsum("cdb,cb->cd", cells.axes, direction - cells.middles)
    reached = np.abs(off) <= cells.reach + 1e-12
    capped = angle_rad(cells.caps, direction) <= cells.caps_rad + 1e-7
    held: FloatArray = reached.all(axis=1) & capped.any(axis=1)
    return held


@settings(max_examples=examples(150), deadline=None)
@given(st.sampled_from(sorted(ARRAYS)), BOUNDS, st.integers(0, 2**32 - 1), st.booleans())
def test_cells_cover_every_direction_of_the_cone(
    kind: str, bound_rad: float, seed: int, endfire: bool
) -> None:
    cones, boxes = drawn_cones(ARRAYS[kind], bound_rad, seed, endfire)
    cells = cone.cells(whole(cones), boxes, caps=5)
    predicted = predicted_of(cones)
    assert angle_rad(cells.middles, predicted).max() <= bound_rad + 1e-7
    for direction in within(predicted, bound_rad, np.random.default_rng(seed + 1), 30):
        assert holders(cells, direction).any()


@pytest.mark.parametrize("kind", sorted(ARRAYS))
def test_cone_frame_is_right_handed_and_contains_the_predicted_direction(kind: str) -> None:
    """Also 1e-12 off the element line, where a cross product fails."""
    array = ARRAYS[kind]
    rng = np.random.default_rng(2)
    directions = anywhere(rng, 12)
    along = array.elements_m[-1] - array.elements_m[0] if array.size > 1 else np.array([0, 1, 0])
    directions[:8] = along + np.logspace(-18, -4, 8)[:, np.newaxis] * directions[:8]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    cones = cone.cones_around(array, directions, np.full(12, 0.1), np.ones((array.size, 12)))
    for frame, tilt, direction in zip(cones.frames, cones.tilts_rad, directions, strict=True):
        assert frame @ frame.T == pytest.approx(EYE, abs=1e-15)
        assert np.linalg.det(frame) == pytest.approx(1.0)
        made = math.cos(tilt) * frame[0] + math.sin(tilt) * frame[1]
        assert np.abs(made - direction).max() < 3e-15


@settings(max_examples=examples(100), deadline=None)
@given(st.sampled_from(sorted(ARRAYS)), BOUNDS, st.integers(0, 2**32 - 1))
def test_responses_stay_within_the_bounds_of_their_cell(
    kind: str, bound_rad: float, seed: int
) -> None:
    """Compared with direct sums, including the element pattern where it is not a common factor."""
    array = ARRAYS[kind]
    cones, boxes = drawn_cones(array, bound_rad, seed, endfire=False)
    cells = cone.cells(cones, boxes, caps=5)
    rng = np.random.default_rng(seed)
    # At most the magnitudes for which the cones were built: the first draws of that seed.
    anywhere(rng, 1)
    magnitudes = np.abs(rng.standard_normal((array.size, 1)))[:, 0]
    weights = magnitudes * np.exp(1j * rng.uniform(0, 2 * math.pi, array.size))
    received, off = cone.phasors(cones, cells)
    terms = weights[:, np.newaxis] * received
    slack = 0.0 if off is None else magnitudes @ off
    low, high = cone.response_range(cones, cells, terms.sum(axis=0), cones.positions_m.T @ terms)
    assert (low <= high).all()
    for direction in within(predicted_of(cones), bound_rad, rng, 8):
        amplitudes = np.ones(array.size)
        if cone.has_distinct_patterns(array):
            amplitudes = steering.amplitudes(array, direction[np.newaxis])[:, 0]
        response = sum(
            weights[m] * amplitudes[m] * cmath.exp(1j * array.wavenumber_radpm * p @ direction)
            for m, p in enumerate(array.elements_m)
        )
        held = holders(cone.cells(whole(cones), boxes, caps=5), direction)
        assert magnitudes @ amplitudes <= cones.ceilings[0] * (1 + 1e-9)
        if off is not None:
            changed = np.abs(amplitudes[:, np.newaxis] - np.abs(received))
            assert (changed <= off + 1e-9)[:, held].all()
        unsure = 1e-9 * magnitudes.sum()  # rounding
        assert (abs(response) >= (low - slack)[held] - unsure).all()
        assert (abs(response) <= (high + slack)[held] + unsure).all()


@pytest.mark.parametrize("phases_rad", [0.0, 1.0])
def test_cell_bounds_tighten_with_the_square_of_the_cell_size(phases_rad: float) -> None:
    """Quartering the cells cuts the slack to about a sixteenth, also for uneven weights; it is
    never negative."""
    array = ARRAYS["line"]
    rng = np.random.default_rng(3)
    weights = np.exp(-np.arange(16) / 3 + 1j * phases_rad * rng.standard_normal(16))[:, np.newaxis]
    direction = np.array([[1.0, 0, 0]])
    cones = cone.cones_around(array, direction, np.array([0.1]), np.abs(weights))
    boxes = cone.first_boxes(cones)
    losses = []
    for _ in range(3):
        cells = cone.cells(cones, boxes, caps=1)
        received, _ = cone.phasors(cones, cells)
        terms = weights * received
        responses, moments = terms.sum(axis=0), cones.positions_m.T @ terms
        low, high = cone.response_range(cones, cells, responses, moments)
        angles = np.linspace(
            boxes.low[:, 0], boxes.high[:, 0], 50
        )  # from the pole: the element line
        sines = cones.frames[0, 0, 1] * np.cos(angles)
        phase = np.pi * np.arange(16)[:, np.newaxis, np.newaxis] * sines
        true = np.abs(np.sum(weights[:, np.newaxis] * np.exp(1j * phase), axis=0))
        below, above = true.min(axis=0) - low, high - true.max(axis=0)
        assert min(below.min(), above.min()) > 0
        losses.append([below.max(), above.max()])
        # Of the order of the remainder: its phase changes too, which the lower bound ignores.
        half = (boxes.high - boxes.low)[0, 0] / 2
        remainder = cones.curvatures.max() * half**2
        assert (np.array(losses[-1]) <= [5 * remainder, 1.1 * remainder]).all()
        boxes = cone.split(cones, boxes)
    assert (np.divide(losses[:-1], losses[1:]) > 10).all()


def test_zero_response_still_has_a_slope_bound() -> None:
    """The phase of a zero response is arbitrary."""
    array = uniform_linear(2, 30e9, spacing_wavelengths=0.5, array_from_body=EYE)
    cones = cone.cones_around(array, np.array([[1.0, 0, 0]]), np.array([0.1]), np.ones((2, 1)))
    cells = cone.cells(cones, cone.first_boxes(cones), caps=1)
    nothing = np.zeros(len(cells.cone), dtype=complex)
    moments = cones.positions_m.T @ np.array([1.0, -1.0])[:, np.newaxis] * (nothing + 1)
    low, high = cone.response_range(cones, cells, nothing, moments)
    assert (low < 0).all()
    assert (high > 2 * np.sin(math.pi / 2 * cells.reach[:, 0])).all()


@pytest.mark.parametrize(
    ("directions", "bounds", "message"),
    [
        (np.zeros(3), [0.1], "rows of three"),
        (np.zeros((2, 2)), [0.1, 0.1], "rows of three"),
        (np.array([[2.0, 0, 0]]), [0.1], "unit vectors"),
        (np.array([[math.nan, 0, 0]]), [0.1], "unit vectors"),
        (np.array([[1.0, 0, 0]]), [-0.1], "pointing bound"),
        (np.array([[1.0, 0, 0]]), [math.nan], "pointing bound"),
        (np.array([[1.0, 0, 0]]), [0.1, 0.1], "pointing bound"),
    ],
)
def test_invalid_cone_is_rejected(
    directions: FloatArray, bounds: list[float], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        cone.unit_directions(directions, np.array(bounds))


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (np.ones(16), "shape"),
        (np.ones((15, 1)), "shape"),
        (np.full((16, 1), np.nan), "finite"),
        (np.eye(16)[:, :3] * [1, 0, 1], "column 1 .* zero"),
    ],
)
def test_invalid_weights_are_rejected(weights: FloatArray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        cone.unit_power(ARRAYS["line"], weights.astype(complex))


@pytest.mark.parametrize("scale", [1e-300, 1.0, 1e300])
def test_unit_power_normalises_any_scale(scale: float) -> None:
    weights = scale * np.array([[1 + 1j], [0.5], [0]] * 4).astype(complex)
    found = cone.unit_power(
        uniform_linear(12, 1e9, spacing_wavelengths=0.5, array_from_body=EYE), weights
    )
    assert np.sum(np.abs(found) ** 2) == pytest.approx(1.0)
    assert found[0, 0] / found[1, 0] == pytest.approx(2 + 2j)
