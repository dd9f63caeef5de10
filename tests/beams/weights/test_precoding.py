"""Weights against numpy's pseudo-inverse and condition number, including ill-conditioned cases."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from support import examples

from companion.beams.array import steering
from companion.beams.array.elements import Element, ElementPattern
from companion.beams.array.geometry import (
    Array,
    listed,
    uniform_circular,
    uniform_linear,
    uniform_rectangular,
)
from companion.beams.weights.precoding import Precoder, Precoding, Radio, gain_db, precode
from companion.beams.weights.widening import DirectionErrors, spread
from companion.settings.model import BeamSettings
from companion.values import ComplexArray, FloatArray, Method, Normalisation, Policy, Widen

EYE = np.eye(3)
SINES = st.floats(-0.999, 0.999)


def matrix(sines: list[float], elements: int = 16) -> ComplexArray:
    """Return the steering matrix of a half-wave line for directions given by their sines."""
    made: ComplexArray = np.exp(1j * np.pi * np.outer(np.arange(elements), sines))
    return made


def apart(seed: int, users: int, elements: int = 16) -> ComplexArray:
    """Draw directions, no two within half a beam of each other."""
    rng = np.random.default_rng(seed)
    while True:
        sines = np.sort(rng.uniform(-0.99, 0.99, users))
        if np.diff(sines).min(initial=2.0) > 1 / elements:
            return matrix(list(rng.permutation(sines)), elements)


def loss_db(a: ComplexArray, weights: ComplexArray) -> FloatArray:
    """Return each user's loss against a beam for it alone, by direct sums."""
    towards = np.array([abs(np.dot(a[:, n], weights[:, n])) ** 2 for n in range(a.shape[1])])
    own = np.sum(np.abs(a) ** 2, axis=0)
    return 10 * np.log10(own * np.sum(np.abs(weights) ** 2, axis=0) / towards)


def somewhere(data: st.DataObject, users: int) -> FloatArray:
    """Return random unit directions (N, 3)."""
    angles = st.tuples(st.floats(-math.pi, math.pi), st.floats(-1.5, 1.5))
    drawn = np.array(data.draw(st.lists(angles, min_size=users, max_size=users)))
    azimuth, elevation = drawn.T
    level = np.cos(elevation)
    return np.array([level * np.cos(azimuth), level * np.sin(azimuth), -np.sin(elevation)]).T


def any_array(seed: int) -> Array:
    """Draw a line, a rectangle, a circle or elements scattered in space, of 16 elements."""
    rng = np.random.default_rng(seed)
    element = Element([ElementPattern.ISOTROPIC, ElementPattern.TR38901][seed // 4 % 2])
    match seed % 4:
        case 0:
            return uniform_linear(
                16, 30e9, spacing_wavelengths=0.5, array_from_body=EYE, element=element
            )
        case 1:
            return uniform_rectangular(
                4,
                columns=4,
                frequency_hz=30e9,
                spacing_wavelengths=0.5,
                array_from_body=EYE,
                element=element,
            )
        case 2:
            return uniform_circular(
                16, 30e9, spacing_wavelengths=0.5, array_from_body=EYE, element=element
            )
        case _:
            return listed(
                rng.uniform(-0.03, 0.03, (16, 3)), 30e9, array_from_body=EYE, element=element
            )


@settings(max_examples=examples(150))
@given(st.integers(1, 16), st.integers(0, 2**16), st.booleans(), st.data())
def test_zero_forcing_has_unit_own_response_and_exact_nulls(
    users: int, seed: int, widen: bool, data: st.DataObject
) -> None:
    """Any array, any directions, up to as many users as elements, unless marked as regularised."""
    array = any_array(seed)
    directions = somewhere(data, users)
    a = steering.steering_matrix(array, directions)
    bounds = np.random.default_rng(seed).uniform(0, 0.1, users)
    known = DirectionErrors(likely_rad=bounds / 4, bounds_rad=bounds)
    wide = spread(array, directions, known, Widen.GUARANTEE) if widen else None
    found = precode(a, Precoder(), wide)
    assert found.weights.shape == (16, users)
    assert np.all(np.isfinite(found.weights))
    assert found.condition_number is not None
    assert found.condition_number >= 1
    assert np.diag(a.T @ found.weights) == pytest.approx(np.ones(users), abs=1e-9)
    if found.method is Method.ZERO_FORCING:
        assert np.abs(a.T @ found.weights - np.eye(users)).max() < 1e-9
    elif wide is None:
        plain = loss_db(a, np.linalg.pinv(a.T))
        assert np.linalg.cond(a) > 100 * (1 - 1e-9) or plain.max() > 3 - 1e-9


@settings(max_examples=examples(150))
@given(st.integers(1, 16), st.integers(0, 2**16), st.sampled_from([0.5, 3.0, 10.0]), st.data())
def test_default_policy_keeps_every_loss_within_the_limit(
    users: int, seed: int, limit_db: float, data: st.DataObject
) -> None:
    """Default policy, any array, any UAV positions."""
    a = steering.steering_matrix(any_array(seed), somewhere(data, users))
    found = precode(a, Precoder(loss_limit_db=limit_db))
    assert loss_db(a, found.weights).max() <= limit_db + 1e-6


@pytest.mark.parametrize("seed", range(20))
def test_regularisation_is_the_smallest_that_meets_the_limits(seed: int) -> None:
    """Half the loading would exceed a user's loss limit or the condition limit."""
    a = matrix(list(np.random.default_rng(seed).uniform(-0.9, 0.9, 8)))
    found = precode(a, Precoder(condition_limit=1000.0))
    if found.method is Method.ZERO_FORCING:
        assert loss_db(a, np.linalg.pinv(a.T)).max() <= 3.0
        return
    gram = a.T @ a.conj()
    losses = [
        loss_db(a, a.conj() @ np.linalg.inv(gram + x * np.eye(8))).max()
        for x in np.logspace(-9, 3, 2000)
    ]
    assert np.all(np.diff(losses) < 1e-6)  # loss decreases with loading, so the bisection is valid
    assert loss_db(a, found.weights).max() == pytest.approx(3.0, abs=0.1)


@pytest.mark.parametrize("users", [1, 2, 3, 5])
def test_zero_forcing_is_the_pseudo_inverse(users: int) -> None:
    for seed in range(20):
        a = apart(seed, users)
        found = precode(a, Precoder(loss_limit_db=60.0))
        assert found.method is Method.ZERO_FORCING
        assert found.weights == pytest.approx(np.linalg.pinv(a.T), abs=1e-10)
        assert found.condition_number == pytest.approx(np.linalg.cond(a), rel=1e-9)


@pytest.mark.parametrize("normalisation", Normalisation)
def test_regularised_weights_tend_to_zero_forcing_and_maximum_ratio(
    normalisation: Normalisation,
) -> None:
    a = apart(4, 4)

    def made(method: Method, x: float = 0.01) -> ComplexArray:
        how = Precoder(
            method=method,
            policy=Policy.REGULARISE,
            loss_limit_db=60.0,
            condition_limit=100.0,
            regularisation=x,
            normalisation=normalisation,
        )
        return precode(a, how).weights

    assert made(Method.REGULARISED, 1e-12) == pytest.approx(made(Method.ZERO_FORCING), abs=1e-9)
    assert made(Method.REGULARISED, 1e9) == pytest.approx(made(Method.MATCHED), abs=1e-8)
    between = made(Method.REGULARISED, 1.0)
    assert np.abs(between - made(Method.ZERO_FORCING)).max() > 1e-3
    assert np.abs(between - made(Method.MATCHED)).max() > 1e-3
    loaded = a.conj() @ np.linalg.inv(a.T @ a.conj() + 16.0 * np.eye(4))
    ratio = between / loaded  # each column has the same direction
    assert ratio == pytest.approx(np.broadcast_to(ratio[0], ratio.shape))


@given(SINES, st.floats(-7.0, -1.0), st.floats(1.5, 1e3))
def test_weights_are_regularised_above_the_condition_limit(
    sine: float, separation: float, limit: float
) -> None:
    a = matrix([sine, sine + 10**separation])
    true = np.linalg.cond(a)
    found = precode(a, Precoder(condition_limit=limit, loss_limit_db=60.0))
    assert found.condition_number == pytest.approx(true, rel=1e-2 if true > 1e4 else 1e-6)
    if not 0.98 < true / limit < 1.02:
        assert (found.method is Method.REGULARISED) == (true > limit)


@pytest.mark.parametrize("limit", [10.0, 1e2, 1e3, 1e4, 1e5, 1e6])
def test_zero_forcing_is_exact_at_every_allowed_limit(limit: float) -> None:
    """A^T F = I to 1e-9 unless it is marked as a fallback."""
    try:
        BeamSettings(condition_limit=limit, loss_limit_db=60.0)
    except ValidationError:
        return
    for separation in np.logspace(-9, -1, 200):
        a = matrix([0.3, 0.3 + separation], 64)
        found = precode(a, Precoder(condition_limit=limit, loss_limit_db=60.0))
        if found.method is Method.ZERO_FORCING:
            assert np.abs(a.T @ found.weights - np.eye(2)).max() < 1e-9


@pytest.mark.parametrize("policy", Policy)
@pytest.mark.parametrize("sines", [[0.2, 0.2], [0.5, -0.1, 0.5], [0.0] * 5])
def test_identical_directions_give_finite_weights_under_every_policy(
    sines: list[float], policy: Policy
) -> None:
    a = matrix(sines)
    found = precode(a, Precoder(policy=policy))
    assert np.all(np.isfinite(found.weights))
    alike = max(sines.count(sine) for sine in sines)
    assert found.condition_number is not None
    match policy:
        case Policy.REGULARISE:
            assert found.method is Method.REGULARISED
            assert 1e6 < found.condition_number < 1e9
            assert loss_db(a, found.weights).max() <= 3.0 + 1e-6
        case Policy.GROUP:
            assert found.groups.max() + 1 == alike
            assert found.method is Method.ZERO_FORCING
        case Policy.DROP:
            assert len(found.dropped) == alike - 1
            assert list(found.served) == sorted(set(range(len(sines))) - set(found.dropped))


# --- policies -----------------------------------------------------------------------------------


def mirrored(offset: float) -> ComplexArray:
    """Return two UAVs that a line of 64 sees ``offset`` (of the sine) apart, one ahead, one
    behind."""
    sine = 0.5 + offset
    ahead = [math.sqrt(0.75), 0.5, 0.0]
    behind = [-math.sqrt(1 - sine**2), sine, 0.0]
    line = uniform_linear(64, 30e9, spacing_wavelengths=0.5, array_from_body=EYE)
    return steering.steering_matrix(line, np.array([ahead, behind]))


@pytest.mark.parametrize("policy", Policy)
def test_crossing_the_mirror_direction_costs_at_most_3_db(policy: Policy) -> None:
    """Plain zero forcing loses 40 dB there."""
    worst_db, plain_db = 0.0, 0.0
    for offset in [0.0, *np.logspace(-6, -0.7, 120)]:
        for signed in (offset, -offset):
            a = mirrored(signed)
            found = precode(a, Precoder(policy=policy))
            worst_db = max(worst_db, loss_db(a[:, found.served], found.weights).max())
            if offset > 1e-4:
                plain_db = max(plain_db, loss_db(a, np.linalg.pinv(a.T)).max())
    assert worst_db <= 3.0 + 1e-6
    assert plain_db > 40.0


@settings(max_examples=examples(100))
@given(st.integers(1, 20), st.integers(0, 2**16), st.data())
def test_groups_serve_each_uav_once_within_the_limits(
    users: int, seed: int, data: st.DataObject
) -> None:
    a = steering.steering_matrix(any_array(seed), somewhere(data, users))
    found = precode(a, Precoder(policy=Policy.GROUP))
    assert list(found.served) == list(range(users))
    assert found.method is Method.ZERO_FORCING
    assert set(found.groups) == set(range(int(found.groups.max()) + 1))
    for slot in set(found.groups):
        together = a[:, found.groups == slot]
        weights = found.weights[:, found.groups == slot]
        assert np.abs(together.T @ weights - np.eye(together.shape[1])).max() < 1e-9
        assert np.linalg.cond(together) <= 100 * (1 + 1e-9)
        assert loss_db(together, weights).max() <= 3 + 1e-6


def test_separated_uavs_form_one_group() -> None:
    found = precode(apart(3, 3, 64), Precoder(policy=Policy.GROUP))
    assert found.groups.max() == 0
    assert found.dropped == {}


def test_lowest_priority_uav_is_dropped_with_a_reason() -> None:
    a = matrix([0.3, -0.5, 0.305, 0.7])
    found = precode(a, Precoder(policy=Policy.DROP))
    assert list(found.served) == [0, 1, 3]
    assert found.dropped.keys() == {2}
    assert found.dropped[2].startswith("too close to a UAV of higher priority")
    plain_db = loss_db(a, np.linalg.pinv(a.T)).max()
    assert f"{plain_db:.0f} dB" in found.dropped[2]
    other = precode(a, Precoder(policy=Policy.DROP), priorities=[2, 1, 0, 3])
    assert list(other.served) == [1, 2, 3]
    served = a[:, other.served]
    assert np.abs(served.T @ other.weights - np.eye(3)).max() < 1e-9


@pytest.mark.parametrize("policy", Policy)
def test_weak_element_gain_does_not_count_as_closeness(policy: Policy) -> None:
    """Two UAVs 70 degrees apart, one where narrow elements hardly radiate."""
    line = uniform_linear(
        64,
        30e9,
        spacing_wavelengths=0.5,
        array_from_body=EYE,
        element=Element(ElementPattern.COSINE, 10.0),
    )
    azimuth = math.radians(70)
    seen = np.array([[1.0, 0.0, 0.0], [math.cos(azimuth), math.sin(azimuth), 0.0]])
    a = steering.steering_matrix(line, seen)
    assert np.linalg.cond(a) > 200
    found = precode(a, Precoder(policy=policy))
    assert (found.method, found.dropped, found.groups.max()) == (Method.ZERO_FORCING, {}, 0)
    assert found.condition_number == pytest.approx(
        np.linalg.cond(a / np.linalg.norm(a, axis=0)), rel=1e-9
    )
    assert np.abs(a.T @ found.weights - np.eye(2)).max() < 1e-9
    # Beside its mirror image, only the image counts, however weak both are.
    twice = precode(a[:, [0, 1, 1]], Precoder(policy=policy))
    assert twice.method is (Method.REGULARISED if policy is Policy.REGULARISE else found.method)
    assert loss_db(a[:, [0, 1, 1]][:, twice.served], twice.weights).max() <= 3 + 1e-6
    match policy:
        case Policy.GROUP:
            assert twice.groups.tolist() == [0, 0, 1]
        case Policy.DROP:
            assert twice.served.tolist() == [0, 1]
        case Policy.REGULARISE:
            assert loss_db(a[:, [0, 1, 1]], twice.weights)[0] < 0.1


@pytest.mark.parametrize("limit", [2.0, 10.0, 1000.0])
def test_loaded_matrix_meets_the_condition_limit(limit: float) -> None:
    """The loss limit alone would accept it; compared with the weights of the smallest loading."""
    a = matrix([0.3, 0.3 + 1e-5, -0.4])
    found = precode(a, Precoder(condition_limit=limit, loss_limit_db=60.0))
    assert found.method is Method.REGULARISED
    gram = a.T @ a.conj() / 16
    most, least = np.linalg.eigvalsh(gram)[[-1, 0]]
    x = (most - limit**2 * least) / (limit**2 - 1)
    loaded = a.conj() @ np.linalg.inv(gram + x * np.eye(3))
    assert loss_db(a, loaded).max() < 60
    expected = loaded / np.einsum("mn,mn->n", a, loaded)
    assert found.weights == pytest.approx(expected, rel=1e-6)


def test_condition_number_is_the_largest_of_all_groups() -> None:
    a = matrix([0.3, -0.5, 0.305, 0.7, 0.62])
    found = precode(a, Precoder(policy=Policy.GROUP))
    conditions = [np.linalg.cond(a[:, found.groups == t]) for t in range(found.groups.max() + 1)]
    assert max(conditions) > 1.01 * min(conditions)
    assert found.condition_number == pytest.approx(max(conditions), rel=1e-9)


def test_zero_steering_vector_is_rejected() -> None:
    a = matrix([0.3, -0.5])
    a[:, 1] = 0.0
    with pytest.raises(ValueError, match="a steering vector is 0"):
        precode(a, Precoder())


@pytest.mark.parametrize("regularisation", [1e-300, 1e-15, 1e-9])
@pytest.mark.parametrize("sines", [[0.3, 0.3], [0.2, 0.2, -0.4], list(np.linspace(-1, 1, 20))])
def test_weights_are_finite_at_any_regularisation(
    regularisation: float, sines: list[float]
) -> None:
    a = matrix(sines)
    found = precode(a, Precoder(method=Method.REGULARISED, regularisation=regularisation))
    assert np.all(np.isfinite(found.weights))
    assert np.einsum("mn,mn->n", a, found.weights) == pytest.approx(np.ones(len(sines)), abs=1e-9)


def test_drop_reason_of_identical_uavs_contains_no_infinite_loss() -> None:
    found = precode(matrix([0.3, 0.3]), Precoder(policy=Policy.DROP))
    assert found.dropped == {
        1: "too close to a UAV of higher priority: separating all would exceed the limits"
    }


# --- power --------------------------------------------------------------------------------------


@settings(max_examples=examples(100))
@given(
    st.integers(1, 8),
    st.integers(0, 2**16),
    st.sampled_from(list(Method)),
    st.sampled_from(list(Policy)),
    st.data(),
)
def test_normalisations_scale_power_as_named(
    users: int, seed: int, method: Method, policy: Policy, data: st.DataObject
) -> None:
    a = steering.steering_matrix(any_array(seed), somewhere(data, users))

    def made(how: Normalisation) -> Precoding:
        radio = Radio(np.full(users, 0.5), np.ones(users))
        return precode(
            a,
            Precoder(method=method, policy=policy, normalisation=how),
            None,
            priorities=None,
            radio=radio,
        )

    plain, stream, total, antenna = map(made, Normalisation)
    response = np.diag(a[:, plain.served].T @ plain.weights)
    assert response == pytest.approx(np.ones(len(plain.served)), abs=1e-9)
    assert np.sum(np.abs(stream.weights) ** 2, axis=0) == pytest.approx(
        np.ones(len(stream.served)), abs=1e-12
    )
    for slot in set(total.groups):
        assert np.sum(np.abs(total.weights[:, total.groups == slot]) ** 2) == pytest.approx(
            1.0, abs=1e-12
        )
        rows = np.sum(np.abs(antenna.weights[:, antenna.groups == slot]) ** 2, axis=1)
        assert rows.max() == pytest.approx(1 / 16, abs=1e-12)
    for scaled in (stream, total, antenna):
        ratio = scaled.weights / plain.weights
        assert ratio == pytest.approx(np.broadcast_to(ratio[0].real, ratio.shape), rel=1e-6)


def test_mirror_images_about_a_line_are_regularised() -> None:
    """Ahead and behind, above and below: equal for a line along y."""
    array = uniform_linear(64, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3))
    for image in ([-0.6, 0.8, 0.0], [0.0, 0.8, 0.6], [0.0, 0.8, -0.6]):
        a = steering.steering_matrix(array, np.array([[0.6, 0.8, 0.0], image]))
        found = precode(a, Precoder())
        assert found.method is Method.REGULARISED
        assert np.all(np.isfinite(found.weights))


def test_more_users_than_elements_are_regularised() -> None:
    found = precode(matrix([-0.8, -0.3, 0.1, 0.4, 0.9], 4), Precoder())
    assert found.method is Method.REGULARISED
    assert np.all(np.isfinite(found.weights))


def test_single_user_gets_the_conjugate_beam() -> None:
    a = matrix([0.37])
    found = precode(a, Precoder())
    assert (found.method, found.condition_number) == (Method.ZERO_FORCING, 1.0)
    assert found.weights == pytest.approx(a.conj() / 16)
    assert gain_db(a, found.weights) == pytest.approx([10 * math.log10(16)])


def test_no_users_give_no_weights() -> None:
    found = precode(np.empty((16, 0), dtype=complex), Precoder())
    assert found.weights.shape == (16, 0)
    assert found.condition_number is None


@pytest.mark.parametrize("users", [1, 2])
def test_non_finite_steering_is_rejected(users: int) -> None:
    """Weights are always finite."""
    with pytest.raises(ValueError, match="0 or not finite"):
        precode(np.full((4, users), np.nan + 0j), Precoder())


@given(st.integers(0, 1000), st.integers(1, 5))
def test_gain_is_the_normalised_power_towards_its_uav(seed: int, users: int) -> None:
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


def test_steering_matrix_is_not_modified() -> None:
    a = matrix([0.1, 0.5])
    before = a.copy()
    precode(a, Precoder())
    assert np.array_equal(a, before)


def test_subset_of_radio_keeps_snr_and_weights_of_its_users() -> None:
    part = Radio(np.array([1.0, 2.0, 3.0]), np.array([7.0, 8.0, 9.0])).of(np.array([0, 2]))
    assert (part.snr.tolist(), part.rate_weights.tolist()) == ([1.0, 3.0], [7.0, 9.0])
