"""Fast zero forcing: numpy's pseudo-inverse as oracle; what has no answer; updates without end."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.beams import arrays, steering
from companion.beams.arrays import Array
from companion.beams.elements import Element, Pattern
from companion.beams.zero_forcing import Solved, Symmetry, ZeroForcing, border_pays, solve
from companion.values import ComplexArray, FloatArray

EYE = np.eye(3)
COSINE = Element(Pattern.COSINE, 1.5)
# Elements and users: the first makes use of a symmetry, the second is too small to gain by it.
REAL_FORM = (64, 32)
COMPLEX_FORM = (64, 8)


def line(sines: FloatArray, size: int) -> ComplexArray:
    """Steering of a half-wave line for directions in the plane, by their sines."""
    made: ComplexArray = np.exp(1j * np.pi * np.outer(np.arange(size), sines))
    return made


def spread(users: int, rng: np.random.Generator, jitter: float = 0.3) -> FloatArray:
    """Sines that are about equally far apart."""
    grid = np.linspace(-1, 1, users, endpoint=False) + 1 / users
    sines: FloatArray = grid + rng.uniform(-jitter, jitter, users) / users
    return sines


def anywhere(users: int, rng: np.random.Generator) -> FloatArray:
    """Unit directions in front of the array, (N, 3)."""
    drawn = rng.standard_normal((users, 3))
    drawn[:, 0] = np.abs(drawn[:, 0]) + 0.1
    directions: FloatArray = drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    return directions


def mirrored_list(size: int, rng: np.random.Generator) -> Array:
    """Elements anywhere in space, in any order, with their mirror images through some point."""
    half = rng.uniform(-0.2, 0.2, (size // 2, 3))
    centre = np.zeros((size % 2, 3))
    placed = np.concatenate([half, centre, -half]) + rng.uniform(-1, 1, 3)
    return arrays.listed(rng.permutation(placed), 3e9, EYE)


def any_array(kind: str, rng: np.random.Generator) -> Array:
    """With 63 to 66 elements."""
    match kind:
        case "ula":
            return arrays.uniform_linear(64, 30e9, 0.5, EYE)
        case "odd ula":
            return arrays.uniform_linear(65, 30e9, 0.5, EYE, COSINE)
        case "ura":
            return arrays.uniform_rectangular(8, 8, 30e9, 0.5, EYE, COSINE)
        case "odd ura":
            return arrays.uniform_rectangular(7, 9, 30e9, 0.5, EYE)
        case "uca":
            return arrays.uniform_circular(64, 30e9, 0.5, EYE)
        case "odd uca":
            return arrays.uniform_circular(65, 30e9, 0.5, EYE)
        case "outward uca":
            return arrays.uniform_circular(64, 30e9, 0.5, EYE, COSINE)
        case "odd list":
            return mirrored_list(65, rng)
        case _:
            return mirrored_list(66, rng)


SYMMETRIC = ["ula", "odd ula", "ura", "odd ura", "uca", "list", "odd list"]
NOT_SYMMETRIC = ["odd uca", "outward uca"]


def check(found: Solved | None, a: ComplexArray, tolerance: float = 1e-12) -> None:
    """Against the pseudo-inverse; gains and loss factors by their definitions."""
    assert found is not None
    condition = np.linalg.cond(a)
    tolerance *= condition**2
    expected = np.linalg.pinv(a.T)
    assert np.abs(found.weights - expected).max() <= tolerance * np.abs(expected).max()
    towards = np.abs(np.einsum("mn,mn->n", a, expected)) ** 2
    gains = towards / np.sum(np.abs(expected) ** 2, axis=0)
    alone = np.sum(np.abs(a) ** 2, axis=0)
    assert found.power == pytest.approx(alone, rel=1e-12)
    assert found.gains == pytest.approx(gains, rel=tolerance)
    assert found.loss_factors == pytest.approx(alone / gains, rel=tolerance)
    assert found.loss_factors.min() > 1 - 1e-9
    assert found.condition_number() == pytest.approx(condition, rel=1e-9 * condition)
    assert found.condition_bound is not None
    users = a.shape[1]
    assert condition * (1 - 1e-9) <= found.condition_bound <= users * condition * (1 + 1e-9)


# --- in full ------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [*SYMMETRIC, *NOT_SYMMETRIC])
@pytest.mark.parametrize("users", [1, 3, 16, 32])
def test_it_is_the_pseudo_inverse_for_every_array(kind: str, users: int) -> None:
    rng = np.random.default_rng(users)
    array = any_array(kind, rng)
    symmetry = Symmetry.of(array)
    assert (symmetry is not None) == (kind in SYMMETRIC)
    a = steering.steering_matrix(array, anywhere(users, rng))
    check(solve(a), a)
    found = solve(a, symmetry)
    check(found, a)
    assert found is not None
    assert (found.phases is not None) == (kind in SYMMETRIC and users == 32)


@pytest.mark.parametrize("kind", SYMMETRIC)
def test_the_order_of_a_symmetry_puts_mirror_images_at_the_same_distance_from_both_ends(
    kind: str,
) -> None:
    array = any_array(kind, np.random.default_rng(1))
    symmetry = Symmetry.of(array)
    assert symmetry is not None
    every = np.arange(array.size)
    assert (symmetry.order is None) == (kind in ("ula", "odd ula", "ura", "odd ura"))
    order = every if symmetry.order is None else symmetry.order
    centred = array.elements_m - array.elements_m.mean(axis=0)
    assert centred[order] == pytest.approx(-centred[order[::-1]], abs=1e-12)
    if symmetry.place is not None:
        assert np.array_equal(order[symmetry.place], every)


def test_an_array_of_pairs_that_do_not_pair_back_has_no_symmetry() -> None:
    array = arrays.uniform_linear(3, 30e9, 0.5, EYE)
    object.__setattr__(array, "partners", np.array([1, 2, 0]))
    assert Symmetry.of(array) is None


@pytest.mark.parametrize(("size", "users"), [REAL_FORM, COMPLEX_FORM])
def test_any_memory_order_and_any_place_for_the_weights(size: int, users: int) -> None:
    rng = np.random.default_rng(3)
    symmetry = Symmetry.of(arrays.uniform_linear(size, 30e9, 0.5, EYE))
    a = line(spread(users, rng), size)
    room = np.empty((users, size + 7), dtype=complex).T[3 : 3 + size]
    for given_as in (a, np.asfortranarray(a), np.repeat(a, 2, axis=1)[:, ::2]):
        before = given_as.copy()
        for out in (None, room):
            found = solve(given_as, symmetry, out)
            check(found, a)
            assert found is not None
            assert found.weights.strides[0] == 16  # one user's weights lie together
            assert (found.weights is room) == (out is room)
        assert np.array_equal(given_as, before)


@given(st.integers(0, 10**6), st.integers(1, 40), st.floats(-6, 6))
@settings(max_examples=30, deadline=None)
def test_loss_factors_do_not_depend_on_how_columns_are_scaled(
    seed: int, users: int, decades: float
) -> None:
    rng = np.random.default_rng(seed)
    symmetry = Symmetry.of(arrays.uniform_linear(64, 30e9, 0.5, EYE))
    a = line(rng.uniform(-1, 1, users), 64)
    scale = 10 ** (decades * rng.uniform(-1, 1, users)) * np.exp(2j * rng.uniform(0, 9, users))
    one, other = solve(a, symmetry), solve(a * scale, symmetry)
    if one is None or one.loss_factors.max() > 1e6:
        return
    assert other is not None
    assert other.loss_factors == pytest.approx(one.loss_factors, rel=1e-8)
    assert np.abs((a * scale).T @ other.weights - np.eye(users)).max() < 10 ** (
        2 * abs(decades) - 8
    )


@given(st.integers(0, 10**6), st.integers(2, 20))
@settings(max_examples=30, deadline=None)
def test_the_condition_number_is_finite_whatever_the_powers_of_users(seed: int, users: int) -> None:
    rng = np.random.default_rng(seed)
    found = solve(line(spread(users, rng), 64) * np.r_[1.0, 10 ** rng.uniform(-20, -9, users - 1)])
    assert found is not None
    assert found.loss_factors.max() < 3
    condition, bound = found.condition_number(), found.condition_bound
    assert condition is not None
    assert bound is not None
    assert 1e7 < condition < bound * 1.001


# --- where there is no answer -------------------------------------------------------------------


def test_no_users() -> None:
    for a in (np.empty((8, 0), dtype=complex), np.empty((0, 0), dtype=complex)):
        found = solve(a)
        assert found is not None
        assert found.weights.shape == a.shape
        assert found.loss_factors.shape == found.power.shape == found.gains.shape == (0,)
        assert found.condition_number() is None
        assert found.condition_bound is None


@pytest.mark.parametrize(("size", "users"), [REAL_FORM, COMPLEX_FORM])
def test_no_answer_is_none_and_what_is_not_finite_an_error(size: int, users: int) -> None:
    symmetry = Symmetry.of(arrays.uniform_linear(size, 30e9, 0.5, EYE))
    good = line(spread(users, np.random.default_rng(4)), size)
    dark, twice = good.copy(), good.copy()
    dark[:, 2] = 0.0
    twice[:, 2] = twice[:, 5]
    for hopeless in (dark, twice, np.zeros_like(good), np.ones_like(good)):
        assert solve(hopeless) is None
        assert solve(hopeless, symmetry) is None
    for value in (np.nan, np.inf, -np.inf, complex(0, np.inf), complex(np.nan, 1.0)):
        for element in (0, size // 2 - 1, size - 1):
            bad = good.copy()
            bad[element, 1] = value
            for chosen in (None, symmetry):
                with pytest.raises(ValueError, match="not a finite number"):
                    solve(bad, chosen)


@pytest.mark.parametrize("users", [5, 65, 400])
def test_more_users_than_elements_have_no_answer(users: int) -> None:
    rng = np.random.default_rng(5)
    size = 4 if users == 5 else 64
    a = rng.standard_normal((size, users)) + 1j * rng.standard_normal((size, users))
    assert solve(a) is None
    assert solve(a, Symmetry.of(arrays.uniform_linear(size, 30e9, 0.5, EYE))) is None
    a[1, 1] = np.nan
    with pytest.raises(ValueError, match="not a finite number"):
        solve(a)


@given(st.floats(-12, 0), st.booleans())
@settings(max_examples=60, deadline=None)
def test_what_is_nearly_singular_shows_in_the_loss_factors(separation: float, real: bool) -> None:
    """Two users that come together: the closed form of their loss, and A^T F = I as far as it says.

    Alone with another user whose normalised inner product with it is c, a user loses 1/(1 - |c|^2).
    """
    size, users = REAL_FORM if real else COMPLEX_FORM
    sines = spread(users, np.random.default_rng(6))
    sines[1] = sines[0] + 10**separation / size
    a = line(sines, size)
    found = solve(a, Symmetry.of(arrays.uniform_linear(size, 30e9, 0.5, EYE)) if real else None)
    if found is None:
        assert separation < -5
        return
    pair = solve(a[:, :2])
    # 1 - |c|^2, as the mean of 1 - cos((m - m') phase) over pairs of elements: nothing cancels.
    phase = np.pi * (sines[1] - sines[0]) / 2
    apart = np.subtract.outer(np.arange(size), np.arange(size))
    loss = size**2 / (2 * np.sum(np.sin(apart * phase) ** 2))
    assert found.loss_factors[:2].min() > 0.9 * loss
    if loss < 1e10 and pair is not None:
        assert pair.loss_factors == pytest.approx([loss, loss], rel=1e-13 * loss + 1e-9)
    error = np.abs(a.T @ found.weights - np.eye(users)).max()
    assert error < 20 * np.finfo(float).eps * found.loss_factors.max() + 1e-13
    condition = found.condition_number()
    assert condition is not None
    assert math.isfinite(condition)


def test_weights_are_not_mirrored_where_the_symmetry_is_missing() -> None:
    """Calibrated, or of another array: never the weights of one half mirrored for the other."""
    size, users = REAL_FORM
    symmetry = Symmetry.of(arrays.uniform_linear(size, 30e9, 0.5, EYE))
    rng = np.random.default_rng(7)
    a = line(spread(users, rng), size)
    for element in (0, 20, size - 1):
        uneven = a.copy()
        uneven[element] *= 1.01
        with pytest.raises(ValueError, match="symmetry"):
            solve(uneven, symmetry)
    with pytest.raises(ValueError, match="symmetry"):
        solve(rng.standard_normal((size, users)) + 0j, symmetry)
    with pytest.raises(ValueError, match="66 rows is not of 64 elements"):
        solve(line(spread(users, rng), 66), symmetry)


# --- by border update ---------------------------------------------------------------------------


@given(st.integers(0, 10**6), st.integers(1, 24), st.booleans())
@settings(max_examples=40, deadline=None)
def test_updates_of_any_columns_are_a_fresh_solution(seed: int, users: int, real: bool) -> None:
    rng = np.random.default_rng(seed)
    users = REAL_FORM[1] if real else users
    symmetry = Symmetry.of(arrays.uniform_linear(64, 30e9, 0.5, EYE)) if real else None
    a = line(spread(users, rng), 64)
    tracked = ZeroForcing(a, symmetry)
    check(tracked.found, a)
    for _ in range(10):
        count = int(rng.integers(0, min(users, 8) + 1))
        columns = rng.permutation(users)[:count].tolist()
        vectors = line(spread(users, rng)[columns], 64) * rng.uniform(0.1, 3.0, count)
        a[:, columns] = vectors
        found = tracked.update(columns, vectors)
        assert found is tracked.found
        check(found, a)


@pytest.mark.parametrize(("size", "users"), [(32, 8), (64, 32), (16, 16)])
def test_ten_thousand_updates_end_in_a_fresh_solution(size: int, users: int) -> None:
    rng = np.random.default_rng(8)
    a = np.linalg.qr(rng.standard_normal((size, users)) + 1j * rng.standard_normal((size, users)))[
        0
    ]
    tracked = ZeroForcing(a)
    moves = np.sqrt(0.2 / size) * rng.standard_normal((10_000, size, 2)).view(complex)
    start = a.copy()
    for step, n in enumerate(rng.integers(users, size=len(moves)).tolist()):
        a[:, n] = start[:, n] + 0.3 * moves[step, :, 0]
        tracked.update([n], a[:, n : n + 1])
    assert tracked.border_updates == len(moves)
    fresh, found = solve(a), tracked.found
    assert fresh is not None
    assert found is not None
    for one, other in zip(found[:4], fresh[:4], strict=True):
        assert np.abs(one - other).max() <= 1e-12 * np.abs(other).max()


@pytest.mark.parametrize(
    ("separation", "condition", "share"),
    [(0.3, 3, (1.0, 1.0)), (0.1, 10, (0.9, 0.999)), (0.05, 20, (0.5, 0.95)), (0.001, 700, (0, 0))],
)
def test_updates_do_not_drift_where_users_are_close(
    separation: float, condition: float, share: tuple[float, float]
) -> None:
    """Pairs down to a condition number of a thousand: A^T F is I to 1e-9 after every update.

    Full solutions among them are the more, the closer the users.
    """
    rng = np.random.default_rng(9)
    size, users = 64, 16
    middle = np.repeat(spread(users // 2, rng, 0.1), 2)
    offset = np.tile([-separation / size, separation / size], users // 2)
    a = line(middle + offset, size)
    tracked = ZeroForcing(a)
    conditions, by_border = [], 0
    for step in range(600):
        n = int(rng.integers(users))
        a[:, n] = line(middle[[n]] + rng.uniform(0.6, 1.4) * offset[[n]], size)[:, 0]
        found = tracked.update([n], a[:, n : n + 1])
        assert found is not None
        assert np.abs(a.T @ found.weights - np.eye(users)).max() < 1e-9
        by_border += tracked.border_updates > 0
        if step % 50 == 0:
            conditions.append(np.linalg.cond(a))
            assert found.condition_number() == pytest.approx(conditions[-1], rel=1e-4)
    assert max(conditions) > condition
    assert share[0] <= by_border / 600 <= share[1]


def test_after_a_close_encounter_nothing_is_left_of_it() -> None:
    """Users that meet, cross and part: no answer while they are one, an exact one afterwards."""
    size, users = 64, 12
    sines = spread(users, np.random.default_rng(10))
    a = line(sines, size)
    tracked = ZeroForcing(a)
    nones = 0
    for sine in np.r_[np.linspace(sines[0], sines[1], 40), np.linspace(sines[1], sines[0], 31)]:
        a[:, :1] = line(np.array([sine]), size)
        found = tracked.update([0], a[:, :1])
        fresh = solve(a)
        assert (found is None) == (fresh is None)
        assert found is tracked.found
        nones += found is None
        if found is not None and fresh is not None:
            assert found.loss_factors == pytest.approx(fresh.loss_factors, rel=1e-8)
            assert np.abs(a.T @ found.weights - np.eye(users)).max() < 1e-9
    assert nones == 2
    check(tracked.found, a)


@pytest.mark.parametrize("separation", [1e-2, 1e-3, 1e-4, 1e-5])
def test_parting_at_once_leaves_nothing_of_the_encounter(separation: float) -> None:
    size, users = 64, 12
    a = line(spread(users, np.random.default_rng(17)), size)
    close = a.copy()
    close[:, 4] = a[:, 5] * np.exp(1j * separation / size * np.arange(size))
    tracked = ZeroForcing(close)
    assert tracked.found is not None
    assert tracked.found.loss_factors.max() > separation**-2
    check(tracked.update([4], a[:, 4:5]), a, 1e-9)


def test_without_an_answer_the_next_update_knows_of_every_column() -> None:
    a = line(spread(24, np.random.default_rng(18)), 64)
    tracked = ZeroForcing(a)
    moved = line(np.array([-0.97, -0.97, 0.97]), 64)
    assert tracked.update([3, 8, 11], moved) is None
    a[:, [3, 11]] = moved[:, [0, 2]]
    check(tracked.update([8], a[:, 8:9]), a)


def test_two_users_may_change_places_in_one_update() -> None:
    """Though they are in one place half-way."""
    size, users = 64, 24
    a = line(spread(users, np.random.default_rng(11)), size)
    tracked = ZeroForcing(a)
    assert tracked.found is not None
    before = tracked.found.weights.copy()
    found = tracked.update([3, 8], a[:, [8, 3]])
    assert found is not None
    before[:, [3, 8]] = before[:, [8, 3]]
    assert np.abs(found.weights - before).max() < 1e-14


@pytest.mark.parametrize("value", [np.nan, np.inf, complex(0, -np.inf), 0.0])
@pytest.mark.parametrize("users", [1, 12])
def test_a_bad_vector_is_refused_and_the_next_good_one_mends_it(value: complex, users: int) -> None:
    a = line(spread(users, np.random.default_rng(12)), 32)
    tracked = ZeroForcing(a)
    bad = np.full((32, 1), value, dtype=complex)
    if value == 0:
        assert tracked.update([0], bad) is None
    else:
        with pytest.raises(ValueError, match="not a finite number"):
            tracked.update([0], bad)
    assert tracked.found is None
    check(tracked.update([0], a[:, :1]), a)


def test_it_may_begin_without_an_answer() -> None:
    a = line(spread(12, np.random.default_rng(13)), 32)
    twins = a.copy()
    twins[:, 7] = twins[:, 2]
    tracked = ZeroForcing(twins)
    assert tracked.found is None
    check(tracked.update([7], a[:, 7:8]), a)


def test_what_is_no_update_is_refused_before_anything_changes() -> None:
    a = line(spread(12, np.random.default_rng(14)), 32)
    tracked = ZeroForcing(a)
    for columns, vectors in [([0], a[:, :2]), ([0, 1], a[:, :1]), ([0], a[:5, :1])]:
        with pytest.raises(ValueError, match=r"columns of 32 numbers, not \("):
            tracked.update(columns, vectors)
    for column in (-1, 12):
        with pytest.raises(ValueError, match="columns are numbered from 0 to 11"):
            tracked.update([0, column], a[:, [3, 4]])
    check(tracked.found, a)
    check(tracked.update([0], a[:, :1]), a)


def test_weights_are_a_view_until_the_next_update_and_the_rest_is_not() -> None:
    a = line(spread(12, np.random.default_rng(15)), 32)
    tracked = ZeroForcing(a)
    first = tracked.found
    assert first is not None
    losses, power = first.loss_factors.copy(), first.power.copy()
    second = tracked.update([0], 2 * line(np.array([-0.93]), 32))
    assert second is not None
    assert np.shares_memory(first.weights, second.weights)
    assert np.array_equal(first.loss_factors, losses)
    assert np.array_equal(first.power, power)
    assert second.power[0] == pytest.approx(4 * power[0])
    a[:, 0] = 0  # the caller's own
    check(second, np.c_[2 * line(np.array([-0.93]), 32), a[:, 1:]])


def test_the_cheaper_way_is_chosen() -> None:
    size, users = REAL_FORM
    symmetry = Symmetry.of(arrays.uniform_linear(size, 30e9, 0.5, EYE))
    a = line(spread(users, np.random.default_rng(16)), size)
    for chosen, most in ((None, 5), (symmetry, 4)):
        for count in range(users + 1):
            assert border_pays(count, users, chosen) == (count <= most)
            tracked = ZeroForcing(a, chosen)
            tracked.update(list(range(count)), a[:, :count])
            assert tracked.border_updates == (count if count <= most else 0)
    assert not border_pays(1, 4, None)  # calls cost more than arithmetic
