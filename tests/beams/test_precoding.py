"""Weights: numpy's pseudo-inverse and condition number as oracles; what is ill-conditioned."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from companion.beams import steering
from companion.beams.arrays import uniform_linear
from companion.beams.precoding import Precoder, gain_db, precode
from companion.config import BeamSettings
from companion.values import ComplexArray, Method

SINES = st.floats(-0.999, 0.999)


def matrix(sines: list[float], elements: int = 16) -> ComplexArray:
    """Steering of a half-wave line for directions in the plane, by their sines."""
    made: ComplexArray = np.exp(1j * np.pi * np.outer(np.arange(elements), sines))
    return made


def apart(seed: int, users: int, elements: int = 16) -> ComplexArray:
    """Directions at random, no two within half a beam of each other."""
    rng = np.random.default_rng(seed)
    while True:
        sines = np.sort(rng.uniform(-0.99, 0.99, users))
        if np.diff(sines).min(initial=2.0) > 1 / elements:
            return matrix(list(rng.permutation(sines)), elements)


@given(st.integers(1, 16), st.data())
def test_zero_forcing_gives_each_its_own_and_nothing_of_the_others(
    users: int, data: st.DataObject
) -> None:
    """Any directions in space, any number up to the elements, wherever it is not a fallback."""
    angles = st.tuples(st.floats(-math.pi, math.pi), st.floats(-1.5, 1.5))
    drawn = np.array(data.draw(st.lists(angles, min_size=users, max_size=users)))
    azimuth, elevation = drawn.T
    level = np.cos(elevation)
    directions = np.array([level * np.cos(azimuth), level * np.sin(azimuth), -np.sin(elevation)]).T
    a = steering.steering_matrix(uniform_linear(16, 30e9, 0.5, np.eye(3)), directions)
    found = precode(a, Precoder())
    assert found.weights.shape == (16, users)
    assert np.all(np.isfinite(found.weights))
    assert found.condition_number is not None
    assert found.condition_number >= 1
    if found.method is Method.ZERO_FORCING:
        assert np.abs(a.T @ found.weights - np.eye(users)).max() < 1e-9
    else:
        assert np.linalg.cond(a) > 10.0 * (1 - 1e-9)


@pytest.mark.parametrize("users", [1, 2, 3, 5])
def test_zero_forcing_is_the_pseudo_inverse(users: int) -> None:
    for seed in range(20):
        a = apart(seed, users)
        found = precode(a, Precoder())
        assert found.method is Method.ZERO_FORCING
        assert found.weights == pytest.approx(np.linalg.pinv(a.T), abs=1e-10)
        assert found.condition_number == pytest.approx(np.linalg.cond(a), rel=1e-9)


@given(SINES, st.floats(-7.0, -1.0), st.floats(1.0, 1e6))
def test_past_the_limit_it_is_regularised_and_says_so(
    sine: float, separation: float, limit: float
) -> None:
    a = matrix([sine, sine + 10**separation])
    true = np.linalg.cond(a)
    found = precode(a, Precoder(limit, 0.01))
    assert found.condition_number == pytest.approx(true, rel=1e-2 if true > 1e4 else 1e-6)
    if not 0.98 < true / limit < 1.02:
        assert (found.method is Method.REGULARISED) == (true > limit)
    if found.method is Method.REGULARISED:
        loaded = a.T @ a.conj() + 0.01 * 16 * np.eye(2)
        assert found.weights == pytest.approx(a.conj() @ np.linalg.inv(loaded), abs=1e-10)


@pytest.mark.parametrize("limit", [10.0, 1e2, 1e3, 1e4, 1e5, 1e6])
def test_zero_forcing_is_exact_at_every_limit_that_settings_allow(limit: float) -> None:
    """A^T F = I to 1e-9 wherever it is not marked as a fallback."""
    try:
        BeamSettings(condition_limit=limit)
    except ValidationError:
        return
    for separation in np.logspace(-9, -1, 200):
        a = matrix([0.3, 0.3 + separation], 64)
        found = precode(a, Precoder(limit, 0.01))
        if found.method is Method.ZERO_FORCING:
            assert np.abs(a.T @ found.weights - np.eye(2)).max() < 1e-9


@pytest.mark.parametrize("sines", [[0.2, 0.2], [0.5, -0.1, 0.5], [0.0] * 5])
def test_identical_directions_are_regularised_and_finite(sines: list[float]) -> None:
    found = precode(matrix(sines), Precoder())
    assert found.method is Method.REGULARISED
    assert np.all(np.isfinite(found.weights))
    assert found.condition_number is not None
    assert 1e6 < found.condition_number < math.inf
    # Identical users share the beam: half of it each, a third of it each.
    response = matrix(sines).T @ found.weights
    assert np.diag(response).real.min() > 0.15


def test_mirror_images_about_the_line_cannot_be_told_apart() -> None:
    """Ahead and behind, above and below: the same to a line along y."""
    array = uniform_linear(64, 30e9, 0.5, np.eye(3))
    for image in ([-0.6, 0.8, 0.0], [0.0, 0.8, 0.6], [0.0, 0.8, -0.6]):
        a = steering.steering_matrix(array, np.array([[0.6, 0.8, 0.0], image]))
        found = precode(a, Precoder())
        assert found.method is Method.REGULARISED
        assert np.all(np.isfinite(found.weights))


def test_more_users_than_elements_are_regularised() -> None:
    found = precode(matrix([-0.8, -0.3, 0.1, 0.4, 0.9], 4), Precoder())
    assert found.method is Method.REGULARISED
    assert np.all(np.isfinite(found.weights))


def test_one_user_gets_the_conjugate_beam() -> None:
    a = matrix([0.37])
    found = precode(a, Precoder())
    assert (found.method, found.condition_number) == (Method.ZERO_FORCING, 1.0)
    assert found.weights == pytest.approx(a.conj() / 16)
    assert gain_db(a, found.weights) == pytest.approx([10 * math.log10(16)])


def test_no_users_no_weights() -> None:
    found = precode(np.empty((16, 0), dtype=complex), Precoder())
    assert found.weights.shape == (16, 0)
    assert found.condition_number is None


@pytest.mark.parametrize("users", [1, 2])
def test_what_is_not_a_number_is_refused(users: int) -> None:
    """Never weights that are not numbers."""
    with pytest.raises(ValueError, match="not a number"):
        precode(np.full((4, users), np.nan + 0j), Precoder())


@given(st.integers(0, 1000), st.integers(1, 5))
def test_the_gain_is_the_power_towards_its_own_direction(seed: int, users: int) -> None:
    a = apart(seed, users)
    weights: ComplexArray = np.random.default_rng(seed).standard_normal(
        (16, users)
    ) * np.complex128(1 + 0.5j)
    found = gain_db(a, weights)
    for n in range(users):
        towards = sum(a[m, n] * weights[m, n] for m in range(16))
        power = sum(abs(weights[m, n]) ** 2 for m in range(16))
        assert found[n] == pytest.approx(10 * math.log10(abs(towards) ** 2 / power), abs=1e-9)
    assert gain_db(a, precode(a, Precoder()).weights).max() <= 10 * math.log10(16) + 1e-9


def test_the_steering_matrix_is_not_written_to() -> None:
    a = matrix([0.1, 0.5])
    before = a.copy()
    precode(a, Precoder())
    assert np.array_equal(a, before)
