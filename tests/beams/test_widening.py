"""Beams no narrower than what is known: by what reaches a crowd of directions within the bound."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.beams import widening
from companion.beams.arrays import (
    Array,
    listed,
    uniform_circular,
    uniform_linear,
    uniform_rectangular,
)
from companion.beams.precoding import Precoder, gain_db, precode
from companion.beams.steering import steering_matrix
from companion.values import ComplexArray, FloatArray, Method

EYE = np.eye(3)
LINE = uniform_linear(64, 30e9, 0.5, EYE)
RECTANGLE = uniform_rectangular(8, 8, 30e9, 0.5, EYE)
CIRCLE = uniform_circular(32, 30e9, 0.5, EYE)


def towards(*angles_deg: tuple[float, float]) -> FloatArray:
    azimuth, elevation = np.radians(angles_deg).T
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), -np.sin(elevation)], axis=1)


FOUR = towards((-40, 5), (-10, 2), (15, -3), (50, 0))


def within(direction: FloatArray, bound_rad: float, seed: int = 1, count: int = 3000) -> FloatArray:
    """Directions all over the cone, its rim among them."""
    rng = np.random.default_rng(seed)
    aside = np.cross(direction, rng.standard_normal((count, 3)))
    aside /= np.linalg.norm(aside, axis=1)[:, np.newaxis]
    off = bound_rad * np.sqrt(rng.uniform(0, 1, count))[:, np.newaxis]
    off[: count // 4] = bound_rad
    return np.cos(off) * direction + np.sin(off) * aside


def power_db(array: Array, weights: ComplexArray, directions: FloatArray) -> FloatArray:
    """What columns radiate (D, N), under unit power each."""
    response = np.abs(steering_matrix(array, directions).T @ weights) ** 2
    return 10 * np.log10(response / np.sum(np.abs(weights) ** 2, axis=0) + 1e-30)


def made(array: Array, directions: FloatArray, bounds_rad: FloatArray) -> tuple[ComplexArray, ...]:
    """Weights as they are without widening, and with it."""
    a = steering_matrix(array, directions)
    wide = widening.spread(array, directions, bounds_rad)
    return precode(a, Precoder()).weights, precode(a, Precoder(), wide).weights


@pytest.mark.parametrize("bound_deg", [0.9, 1.2, 1.6, 2.0, 2.7, 4.0, 6.0, 9.0, 14.0])
@pytest.mark.parametrize("azimuth_deg", [0.0, 35.0])
def test_a_beam_is_never_narrower_than_what_is_known_of_its_target(
    bound_deg: float, azimuth_deg: float
) -> None:
    """All of the bound lies within the half-power beam (a ripple of 1 dB granted, and 1 dB more
    where sines are no longer angles); sharp beams fall into their nulls there."""
    directions, bounds = towards((azimuth_deg, 0.0)), np.radians([bound_deg])
    sharp, wide = made(LINE, directions, bounds)
    crowd = within(directions[0], bounds[0])
    reached = power_db(LINE, wide, crowd)
    assert reached.min() > reached.max() - (4.0 if bound_deg < 10 else 5.0)
    assert reached.min() > power_db(LINE, sharp, crowd).min() - 0.9
    # Spread over the bound evenly there would be so much; within 5 dB of that everywhere.
    width = bounds[0] * 32 * math.cos(math.radians(azimuth_deg))
    assert reached.min() > 10 * math.log10(64 * min(1.0, 0.5 / width)) - 5.2


@pytest.mark.parametrize(("array", "natural_deg"), [(LINE, 0.78), (RECTANGLE, 6.2)])
def test_what_is_known_well_enough_keeps_its_sharp_beam(array: Array, natural_deg: float) -> None:
    directions = towards((3.0, 2.0))
    a = steering_matrix(array, directions)
    within_it = widening.spread(array, directions, np.radians([natural_deg]))
    assert within_it is not None
    assert not within_it.broadened.any()
    assert within_it.beams == pytest.approx(a.conj())
    beyond = widening.spread(array, directions, np.radians([1.2 * natural_deg]))
    assert beyond is not None
    assert beyond.broadened.all()


def test_nothing_is_widened_where_all_is_known() -> None:
    assert widening.spread(LINE, FOUR, np.full(4, 1e-5)) is None
    assert widening.spread(LINE, FOUR, np.zeros(4)) is None


@pytest.mark.parametrize("array", [LINE, RECTANGLE, CIRCLE], ids=["line", "rectangle", "circle"])
@pytest.mark.parametrize("bound_deg", [0.8, 2.0, 3.4])
def test_nulls_are_as_wide_as_the_bounds(array: Array, bound_deg: float) -> None:
    """What reaches the others falls by 8 dB at least, what they get of their own does not."""
    bounds = np.radians(np.full(4, bound_deg))
    sharp, wide = made(array, FOUR, bounds)
    leaks: list[list[float]] = [[], []]
    least: list[list[float]] = [[], []]
    for user in range(4):
        crowd = within(FOUR[user], bounds[user])
        for which, weights in enumerate((sharp, wide)):
            reached = power_db(array, weights, crowd)
            least[which].append(reached[:, user].min())
            leaks[which].append(np.delete(reached, user, axis=1).max())
    assert max(leaks[1]) < max(leaks[0]) - 8
    assert min(least[1]) > min(least[0]) - 1.0


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 10), st.integers(0, 2**16), st.floats(1e-3, 0.3))
def test_widening_keeps_the_predicted_directions_and_the_price(
    users: int, seed: int, most_rad: float
) -> None:
    """Any array, any directions, bounds that overlap: exact where it is zero forcing, and no user
    loses more than the limit against its own broadened beam alone."""
    rng = np.random.default_rng(seed)
    array = [LINE, RECTANGLE, CIRCLE, listed(rng.uniform(-0.02, 0.02, (24, 3)), 30e9, EYE)][
        seed % 4
    ]
    directions = rng.standard_normal((users, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, np.newaxis]
    a = steering_matrix(array, directions)
    wide = widening.spread(array, directions, rng.uniform(0, most_rad, users))
    found = precode(a, Precoder(), wide)
    assert np.all(np.isfinite(found.weights))
    assert np.diag(a.T @ found.weights) == pytest.approx(np.ones(users), abs=1e-9)
    if found.method is Method.ZERO_FORCING:
        assert np.abs(a.T @ found.weights - np.eye(users)).max() < 1e-9
    if wide is not None:
        lost_db = gain_db(a, wide.beams) - gain_db(a, found.weights)
        assert lost_db.max() <= 3.0 + 1e-6


def test_a_direction_that_is_not_known_at_all_is_widened_as_far_as_it_goes() -> None:
    a = steering_matrix(LINE, FOUR)
    unknown = widening.spread(LINE, FOUR, np.array([np.inf, 0.01, 0.01, 0.01]))
    assert unknown is not None
    assert np.all(np.isfinite(unknown.beams))
    assert gain_db(a, unknown.beams)[0] < 6.0


def test_points_stay_clear_of_other_users() -> None:
    """Where two bounds overlap neither UAV is nulled in the other's."""
    directions, bounds = towards((0, 0), (4, 0)), np.radians([3.0, 3.0])
    a = steering_matrix(LINE, directions)
    wide = widening.spread(LINE, directions, bounds)
    assert wide is not None
    kept = 0
    for n, point in enumerate(wide.points.T):
        owner, place = divmod(n, wide.each)
        if place > 0 and wide.usable[n]:
            assert abs(np.dot(point, a[:, 1 - owner].conj())) / 64 <= 0.5
            kept += 1
    assert 0 < kept < 2 * (wide.each - 1)
