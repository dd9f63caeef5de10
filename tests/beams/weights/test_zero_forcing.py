"""Zero forcing against numpy's pseudo-inverse, and inputs without a solution."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.beams.array import geometry, steering
from companion.beams.array.elements import Element, ElementPattern
from companion.beams.array.geometry import Array
from companion.beams.weights.zero_forcing import ZeroForcingSolution, solve
from companion.values import ComplexArray, FloatArray

EYE = np.eye(3)
COSINE = Element(ElementPattern.COSINE, 1.5)
SIZES = [(64, 32), (64, 8)]
"""Numbers of elements and users."""


def line(sines: FloatArray, size: int) -> ComplexArray:
    """Return the steering matrix of a half-wave line for directions given by their sines."""
    made: ComplexArray = np.exp(1j * np.pi * np.outer(np.arange(size), sines))
    return made


def spread(users: int, rng: np.random.Generator, jitter: float = 0.3) -> FloatArray:
    """Return sines with roughly equal spacing."""
    grid = np.linspace(-1, 1, users, endpoint=False) + 1 / users
    sines: FloatArray = grid + rng.uniform(-jitter, jitter, users) / users
    return sines


def anywhere(users: int, rng: np.random.Generator) -> FloatArray:
    """Return unit directions in front of the array, (N, 3)."""
    drawn = rng.standard_normal((users, 3))
    drawn[:, 0] = np.abs(drawn[:, 0]) + 0.1
    directions: FloatArray = drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    return directions


def mirrored_list(size: int, rng: np.random.Generator) -> Array:
    """Return elements at random positions and in random order, with their mirror images about some
    point."""
    half = rng.uniform(-0.2, 0.2, (size // 2, 3))
    centre = np.zeros((size % 2, 3))
    placed = np.concatenate([half, centre, -half]) + rng.uniform(-1, 1, 3)
    return geometry.listed(rng.permutation(placed), 3e9, array_from_body=EYE)


def any_array(kind: str, rng: np.random.Generator) -> Array:
    """Return an array of 63 to 66 elements."""
    match kind:
        case "ula":
            return geometry.uniform_linear(64, 30e9, spacing_wavelengths=0.5, array_from_body=EYE)
        case "odd ula":
            return geometry.uniform_linear(
                65, 30e9, spacing_wavelengths=0.5, array_from_body=EYE, element=COSINE
            )
        case "ura":
            return geometry.uniform_rectangular(
                8,
                columns=8,
                frequency_hz=30e9,
                spacing_wavelengths=0.5,
                array_from_body=EYE,
                element=COSINE,
            )
        case "odd ura":
            return geometry.uniform_rectangular(
                7, columns=9, frequency_hz=30e9, spacing_wavelengths=0.5, array_from_body=EYE
            )
        case "uca":
            return geometry.uniform_circular(64, 30e9, spacing_wavelengths=0.5, array_from_body=EYE)
        case "odd uca":
            return geometry.uniform_circular(65, 30e9, spacing_wavelengths=0.5, array_from_body=EYE)
        case "outward uca":
            return geometry.uniform_circular(
                64, 30e9, spacing_wavelengths=0.5, array_from_body=EYE, element=COSINE
            )
        case "odd list":
            return mirrored_list(65, rng)
        case _:
            return mirrored_list(66, rng)


KINDS = ["ula", "odd ula", "ura", "odd ura", "uca", "odd uca", "outward uca", "list", "odd list"]


def check(found: ZeroForcingSolution | None, a: ComplexArray, tolerance: float = 1e-12) -> None:
    """Compare with the pseudo-inverse; gains and loss factors by their definitions."""
    assert found is not None
    condition = np.linalg.cond(a)
    tolerance *= condition**2
    expected = np.linalg.pinv(a.T)
    assert np.abs(found.weights - expected).max() <= tolerance * np.abs(expected).max()
    towards = np.abs(np.einsum("mn,mn->n", a, expected)) ** 2
    gains = towards / np.sum(np.abs(expected) ** 2, axis=0)
    alone = np.sum(np.abs(a) ** 2, axis=0)
    assert found.loss_factors == pytest.approx(alone / gains, rel=tolerance)
    assert found.loss_factors.min() > 1 - 1e-9


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("users", [1, 3, 16, 32])
def test_solution_is_the_pseudo_inverse_for_every_array(kind: str, users: int) -> None:
    rng = np.random.default_rng(users)
    a = steering.steering_matrix(any_array(kind, rng), anywhere(users, rng))
    check(solve(a), a)


@pytest.mark.parametrize(("size", "users"), SIZES)
def test_any_memory_order_is_accepted(size: int, users: int) -> None:
    a = line(spread(users, np.random.default_rng(3)), size)
    for given_as in (a, np.asfortranarray(a), np.repeat(a, 2, axis=1)[:, ::2]):
        before = given_as.copy()
        found = solve(given_as)
        check(found, a)
        assert found is not None
        assert found.weights.strides[0] == 16  # the weights of one user are contiguous
        assert np.array_equal(given_as, before)


@given(st.integers(0, 10**6), st.integers(1, 40), st.floats(-6, 6))
@settings(max_examples=examples(30), deadline=None)
def test_loss_factors_are_invariant_to_column_scaling(
    seed: int, users: int, decades: float
) -> None:
    rng = np.random.default_rng(seed)
    a = line(rng.uniform(-1, 1, users), 64)
    scale = 10 ** (decades * rng.uniform(-1, 1, users)) * np.exp(2j * rng.uniform(0, 9, users))
    one, other = solve(a), solve(a * scale)
    if one is None or one.loss_factors.max() > 1e6:
        return
    assert other is not None
    assert other.loss_factors == pytest.approx(one.loss_factors, rel=1e-8)
    assert np.abs((a * scale).T @ other.weights - np.eye(users)).max() < 10 ** (
        2 * abs(decades) - 8
    )


# --- no solution --------------------------------------------------------------------------------


def test_no_users_give_an_empty_solution() -> None:
    for a in (np.empty((8, 0), dtype=complex), np.empty((0, 0), dtype=complex)):
        found = solve(a)
        assert found is not None
        assert found.weights.shape == a.shape
        assert found.loss_factors.shape == (0,)


@pytest.mark.parametrize(("size", "users"), SIZES)
def test_singular_matrix_returns_none_and_non_finite_matrix_raises(size: int, users: int) -> None:
    good = line(spread(users, np.random.default_rng(4)), size)
    dark, twice = good.copy(), good.copy()
    dark[:, 2] = 0.0
    twice[:, 2] = twice[:, 5]
    for hopeless in (dark, twice, np.zeros_like(good), np.ones_like(good)):
        assert solve(hopeless) is None
    for value in (np.nan, np.inf, -np.inf, complex(0, np.inf), complex(np.nan, 1.0)):
        for element in (0, size // 2 - 1, size - 1):
            bad = good.copy()
            bad[element, 1] = value
            with pytest.raises(ValueError, match="is not finite"):
                solve(bad)


@pytest.mark.parametrize("users", [5, 65, 400])
def test_more_users_than_elements_have_no_solution(users: int) -> None:
    rng = np.random.default_rng(5)
    size = 4 if users == 5 else 64
    a = rng.standard_normal((size, users)) + 1j * rng.standard_normal((size, users))
    assert solve(a) is None
    a[1, 1] = np.nan
    with pytest.raises(ValueError, match="is not finite"):
        solve(a)


@given(st.floats(-12, 0), st.sampled_from(SIZES))
@settings(max_examples=examples(60), deadline=None)
def test_loss_factors_grow_for_nearly_singular_matrices(
    separation: float, numbers: tuple[int, int]
) -> None:
    """Two users that approach each other: closed form of the loss, and A^T F = I.

    A user whose normalised inner product with the only other user is c loses 1/(1 - |c|^2).
    """
    size, users = numbers
    sines = spread(users, np.random.default_rng(6))
    sines[1] = sines[0] + 10**separation / size
    a = line(sines, size)
    found = solve(a)
    if found is None:
        assert separation < -5
        return
    pair = solve(a[:, :2])
    # 1 - |c|^2 as the mean of 1 - cos((m - m') phase) over element pairs: no cancellation.
    phase = np.pi * (sines[1] - sines[0]) / 2
    apart = np.subtract.outer(np.arange(size), np.arange(size))
    loss = size**2 / (2 * np.sum(np.sin(apart * phase) ** 2))
    assert found.loss_factors[:2].min() > 0.9 * loss
    if loss < 1e10 and pair is not None:
        assert pair.loss_factors == pytest.approx([loss, loss], rel=1e-13 * loss + 1e-9)
    error = np.abs(a.T @ found.weights - np.eye(users)).max()
    assert error < 20 * np.finfo(float).eps * found.loss_factors.max() + 1e-13
