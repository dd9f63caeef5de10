"""Directions by powers: none that explains the powers is outside the result."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from companion.beams.array.elements import ISOTROPIC, Element, ElementPattern
from companion.beams.array.geometry import Array, listed, uniform_circular
from companion.beams.array.geometry import uniform_linear as line
from companion.beams.array.geometry import uniform_rectangular as grid
from companion.beams.hardware import codebooks
from companion.beams.worth import directions_by_power
from companion.beams.worth.directions_by_power import possible_directions
from companion.beams.worth.patterns import half_power_beamwidths_rad
from companion.values import Cap, ComplexArray, FloatArray, angle_rad

EYE = np.eye(3)
AHEAD = np.array([1.0, 0.0, 0.0])
GPP = Element(ElementPattern.TR38901)
COSINE = Element(ElementPattern.COSINE, 1.5)


def square(size: int, element: Element = ISOTROPIC) -> Array:
    return grid(
        size,
        columns=size,
        frequency_hz=30e9,
        spacing_wavelengths=0.5,
        array_from_body=EYE,
        element=element,
    )


def coupled(array: Array) -> Array:
    rng = np.random.default_rng(3)
    off = rng.standard_normal((2, array.size, array.size)).T @ [0.02, 0.02j]
    return replace(array, coupling=np.eye(array.size) + off)


def broken(array: Array) -> Array:
    return replace(array, live=np.random.default_rng(4).random(array.size) > 0.2)


ARRAYS = {
    "line of 16": line(16, 30e9, spacing_wavelengths=0.5, array_from_body=EYE),
    "line of 64": line(64, 30e9, spacing_wavelengths=0.5, array_from_body=EYE, element=COSINE),
    "grid of 8": square(8),
    "grid of 16": square(16),
    "patches": square(8, GPP),
    "dead": broken(square(8)),
    "coupled": coupled(broken(square(4, GPP))),
    "narrow elements": listed(
        np.random.default_rng(7).uniform(-0.002, 0.002, (6, 3)),
        30e9,
        array_from_body=EYE,
        element=Element(ElementPattern.COSINE, 12.0),
        lever_arm_m=None,
        outward=np.random.default_rng(8).standard_normal((6, 3)) * [0, 1, 1] + [1, 0, 0],
    ),
    "circle": uniform_circular(16, 30e9, spacing_wavelengths=0.5, array_from_body=EYE, element=GPP),
}
ERROR = 0.05  # largest error of a channel's factor


def turned(rng: np.random.Generator, direction: FloatArray, angles_rad: FloatArray) -> FloatArray:
    """Return directions (N, 3) at angles (N,) from one, each in a random plane."""
    aside = np.cross(direction, rng.standard_normal((len(angles_rad), 3)))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    return np.cos(angles_rad)[:, np.newaxis] * direction + np.sin(angles_rad)[:, np.newaxis] * aside


def received(array: Array, directions: FloatArray) -> ComplexArray:
    """Return what each element receives from directions (N, 3), shape (N, M), without coupling."""
    turns = np.broadcast_to(EYE, (array.size, 3, 3))
    if array.element_from_array is not None:
        turns = array.element_from_array
    amplitude = array.element.amplitude(np.einsum("mij,nj->nmi", turns, directions))
    found: ComplexArray = amplitude * np.exp(
        2j * np.pi / array.wavelength_m * (directions @ array.elements_m.T)
    )
    return found


def ports(array: Array, directions: FloatArray) -> ComplexArray:
    """Return what each port receives, (N, M): coupled, and nothing of dead elements."""
    found = received(array, directions)
    found = found if array.coupling is None else found @ array.coupling
    return found if array.live is None else found * array.live


def gains_db(array: Array, directions: FloatArray, weights: ComplexArray) -> FloatArray:
    """Return the response (N, K), dB."""
    with np.errstate(divide="ignore"):
        return 20 * np.log10(np.abs(ports(array, directions) @ weights))


def weights_of(
    array: Array, rng: np.random.Generator, direction: FloatArray, count: int
) -> ComplexArray:
    """Return beams near a direction, of the codebook or random, with unequal scales."""
    kind = int(rng.integers(3))
    if kind == 0 and array.grid is not None:
        book = codebooks.dft(array).weights
        best = np.argsort(-gains_db(array, direction[np.newaxis], book)[0])
        return book[:, best[:count]]
    if kind == 1:
        random: ComplexArray = rng.standard_normal((2, count, array.size)).T @ [1, 1j]
        return random
    near = turned(rng, direction, rng.uniform(0, 0.2, count))
    scales = 10 ** rng.uniform(-2, 2, count)
    return ports(array, near).conj().T * scales


def sampled(rng: np.random.Generator, cap: Cap, also: FloatArray) -> FloatArray:
    """Return directions of a cap, many of them near others (N, 3)."""
    shares = np.sqrt(rng.uniform(size=3000))
    shares[::5] = 1.0
    found = [turned(rng, cap.center, cap.radius_rad * shares)]
    for one in also:
        for scale in (0.3, 0.1, 0.03, 0.01):
            found.append(turned(rng, one, scale * cap.radius_rad * np.sqrt(rng.uniform(size=300))))
    directions = np.concatenate([also, *found])
    off = 2 * np.arcsin(np.linalg.norm(directions - cap.center, axis=1) / 2)
    return directions[off <= cap.radius_rad]


def is_outside(cap: Cap | None, directions: FloatArray) -> bool:
    if cap is None:
        return len(directions) > 0
    off = 2 * np.arcsin(np.linalg.norm(directions - cap.center, axis=1) / 2)
    return bool((off > cap.radius_rad + 1e-12).any())


@pytest.mark.parametrize("name", sorted(ARRAYS))
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.1, 1.0, 3.0, 10.0]))
@example(1, 0.0)
def test_no_direction_that_explains_the_powers_is_outside(
    name: str, seed: int, bound_db: float
) -> None:
    """Sampled directions that satisfy the condition are in the result, and so is the true one."""
    array, rng = ARRAYS[name], np.random.default_rng(seed)
    direction = turned(rng, AHEAD, rng.uniform(0, 1.0, 1))[0]
    radius_rad = float(rng.choice([0.01, 0.06, 0.2, 0.6, 2.0]))
    (center,) = turned(rng, direction, rng.uniform(0, radius_rad, 1))
    within = Cap(center, radius_rad)
    weights = weights_of(array, rng, direction, int(rng.integers(2, 7)))
    true_db = gains_db(array, direction[np.newaxis], weights)[0]
    errors_db = bound_db * (1 - 1e-9) * rng.choice([-1.0, 1.0, rng.uniform(-1, 1)], len(true_db))
    powers_db = true_db + errors_db - 80.0
    cap = possible_directions(
        array, within, weights=weights, powers_db=powers_db, bound_db=bound_db
    )
    assert not is_outside(cap, direction[np.newaxis])
    assert cap is not None and cap.radius_rad <= radius_rad
    tried = sampled(rng, within, direction[np.newaxis])
    for _ in range(2):  # the second time around the farthest ones that satisfy the condition
        rest_db = powers_db - gains_db(array, tried, weights)
        with np.errstate(invalid="ignore"):  # behind the elements no beam receives anything
            explained = tried[np.ptp(rest_db, axis=1) <= 2 * bound_db]
        assert not is_outside(cap, explained)
        if len(explained) == 0:
            return
        off = np.linalg.norm(explained - cap.center, axis=1)
        tried = sampled(rng, within, explained[np.argsort(-off)[:3]])


@pytest.mark.parametrize("name", sorted(ARRAYS))
@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_true_direction_stays_inside_with_errors_of_channels(name: str, seed: int) -> None:
    """Whatever errors the channels have within their bound; here those that move a beam most."""
    rng = np.random.default_rng(seed)
    bounds = ERROR * rng.random(ARRAYS[name].size)
    array = replace(ARRAYS[name], channel_error=bounds)
    direction = turned(rng, AHEAD, rng.uniform(0, 1.0, 1))[0]
    weights = weights_of(array, rng, direction, 4)
    parts = ports(array, direction[np.newaxis]).T * weights
    column = int(rng.integers(4))
    phases = np.exp(1j * (np.angle(parts[:, column].sum()) - np.angle(parts[:, column])))
    factors = 1 + float(rng.choice([-1, 1])) * bounds * phases
    true_db = 20 * np.log10(np.abs((parts * factors[:, np.newaxis]).sum(axis=0)))
    within = Cap(turned(rng, direction, np.array([0.1]))[0], 0.11)
    cap = possible_directions(array, within, weights=weights, powers_db=true_db, bound_db=0.0)
    assert not is_outside(cap, direction[np.newaxis])


def beams_around(array: Array, direction: FloatArray, count: int, off_rad: float) -> ComplexArray:
    """Return matched beams (M, K) on a circle of angular radius ``off_rad``."""
    right = np.cross([0.0, 0.0, 1.0], direction)
    right /= np.linalg.norm(right)
    turns = np.arange(count) * 2 * np.pi / count + 0.3
    aside = np.outer(np.cos(turns), right) + np.outer(np.sin(turns), np.cross(direction, right))
    return ports(array, np.cos(off_rad) * direction + np.sin(off_rad) * aside).conj().T


@pytest.mark.parametrize(
    ("count", "bound_db", "widths"), [(3, 1.0, 0.125), (3, 0.1, 0.0125), (6, 1.0, 0.105)]
)
def test_beams_a_beamwidth_apart_confine_the_direction(
    count: int, bound_db: float, widths: float
) -> None:
    """To a part of the beamwidth, from a prior of 0.8 beamwidths, whatever the errors."""
    array, rng = square(16), np.random.default_rng(5)
    width_rad = half_power_beamwidths_rad(array, AHEAD)[0]
    assert width_rad is not None
    for _ in range(20):
        direction = turned(rng, AHEAD, rng.uniform(0, 0.5, 1))[0]
        weights = beams_around(array, direction, count, width_rad / math.sqrt(3))
        powers_db = gains_db(array, direction[np.newaxis], weights)[0] + 17
        powers_db += bound_db * rng.uniform(-1, 1, count)
        within = Cap(turned(rng, direction, np.array([0.3 * width_rad]))[0], 0.8 * width_rad)
        cap = possible_directions(
            array, within, weights=weights, powers_db=powers_db, bound_db=bound_db
        )
        assert cap is not None and not is_outside(cap, direction[np.newaxis])
        assert cap.radius_rad < widths * width_rad


def test_no_direction_explains_powers_from_outside_the_prior() -> None:
    array, direction = square(16), AHEAD
    elsewhere = np.array([math.cos(0.3), math.sin(0.3), 0.0])
    weights = beams_around(array, AHEAD, 5, 0.06)
    powers_db = gains_db(array, elsewhere[np.newaxis], weights)[0]
    within = Cap(direction, 0.05)
    args = {"weights": weights, "powers_db": powers_db}
    assert possible_directions(array, within, **args, bound_db=0.5) is None
    assert possible_directions(array, within, **args, bound_db=60.0) is within


def test_a_line_leaves_a_part_of_the_ring_of_one_angle_to_it() -> None:
    """The result is as long as the ring within the prior: no power shows the elevation."""
    array, direction = ARRAYS["line of 16"], np.array([0.8, 0.6, 0.0])
    weights = codebooks.dft(array).weights
    powers_db = gains_db(array, direction[np.newaxis], weights)[0]
    cap = possible_directions(
        array, Cap(direction, 0.1), weights=weights, powers_db=powers_db, bound_db=0.1
    )
    assert cap is not None and 0.09 < cap.radius_rad <= 0.1


def test_zero_in_a_null_excludes_nothing_below() -> None:
    """A power through a beam with a null in the prior may be as low as it likes."""
    array, direction = square(8), AHEAD
    book = codebooks.dft(array).weights
    weights = book[:, [0, 1]]  # the second beam has a null at boresight
    args = {"weights": weights, "powers_db": np.array([0.0, -300.0]), "bound_db": 1.0}
    cap = possible_directions(array, Cap(direction, 0.02), **args)
    assert cap is not None and not is_outside(cap, direction[np.newaxis])
    assert possible_directions(array, Cap(np.array([0.99, math.sqrt(1 - 0.99**2), 0.0]), 0.02),
                               **args) is None  # fmt: skip


def test_beams_of_dead_elements_say_nothing() -> None:
    array = square(4)
    live = np.ones(16, dtype=bool)
    live[0] = False
    array = replace(array, live=live)
    dead = np.zeros((16, 2), dtype=complex)
    dead[0] = 1.0
    within = Cap(AHEAD, 0.3)
    powers_db = np.array([0.0, 90.0])
    assert (
        possible_directions(array, within, weights=dead, powers_db=powers_db, bound_db=0) is within
    )


def test_the_result_is_valid_whenever_the_search_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    array, direction = square(16), AHEAD
    weights = beams_around(array, AHEAD, 3, 0.06)
    powers_db = gains_db(array, direction[np.newaxis], weights)[0]
    radii = []
    for terms in (1, 10**5, 3 * 10**5, 2**23):
        monkeypatch.setattr(directions_by_power, "TERMS_MAX", terms)
        cap = possible_directions(
            array, Cap(direction, 0.1), weights=weights, powers_db=powers_db, bound_db=0.1
        )
        assert cap is not None and not is_outside(cap, direction[np.newaxis])
        radii.append(cap.radius_rad)
    assert radii == sorted(radii, reverse=True) and radii[-1] < 0.1 * radii[0]


@pytest.mark.parametrize(
    "wrong",
    [
        {"powers_db": np.zeros(3)},
        {"powers_db": np.array([0.0, np.nan])},
        {"bound_db": -1.0},
        {"bound_db": math.nan},
        {"weights": np.full((16, 2), np.nan)},
        {"weights": np.ones((15, 2))},
    ],
)
def test_invalid_powers_and_weights_are_refused(wrong: dict[str, object]) -> None:
    array = square(4)
    given = {"weights": np.ones((16, 2)), "powers_db": np.zeros(2), "bound_db": 1.0} | wrong
    with pytest.raises(ValueError):
        possible_directions(array, Cap(AHEAD, 0.1), **given)  # type: ignore[arg-type]


def test_a_small_angle_is_kept() -> None:
    cap = Cap(AHEAD, 1e-6)
    array = square(8)
    weights = beams_around(array, AHEAD, 3, 0.06)
    powers_db = gains_db(array, cap.center[np.newaxis], weights)[0]
    found = possible_directions(array, cap, weights=weights, powers_db=powers_db, bound_db=1.0)
    assert found is not None and angle_rad(found.center, cap.center) <= 1e-6
