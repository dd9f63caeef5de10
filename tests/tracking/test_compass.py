"""Set of attitude errors: whatever UAVs are seen, the true error stays in it."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from companion.tracking import compass
from companion.tracking.compass import ErrorSet, Misalignment, Seen
from companion.tracking.rotations import rotation, rotation_angle_rad
from companion.values import Cap, FloatArray
from tests.sighted_world import direction, tilted

SEEDS = st.integers(0, 2**32 - 1)


def off_rad(error: Misalignment, true: FloatArray) -> float:
    """Return the angle between an estimated and the true error."""
    return rotation_angle_rad(error.center.T @ true)


def seen(rng: np.random.Generator, true: FloatArray, *, position: float, bound: float) -> Seen:
    """Return how a UAV in a random direction is seen, both wrong by the whole bound."""
    at = direction(rng)
    return Seen(
        "1:1",
        Cap(tilted(rng, at, position * 0.999), position),
        Cap(tilted(rng, true @ at, bound * 0.999), bound),
    )


def test_rotation_is_that_of_scipy() -> None:
    rng = np.random.default_rng(0)
    for size in (0.0, 1e-9, 0.1, 1.0, 3.0):
        vector = direction(rng) * size
        found = rotation(vector)
        np.testing.assert_allclose(found, Rotation.from_rotvec(vector).as_matrix(), atol=1e-14)
        assert math.isclose(rotation_angle_rad(found), size, abs_tol=1e-8)


@settings(max_examples=200)
@given(SEEDS, st.integers(1, 6))
def test_true_error_is_in_the_set(seed: int, uavs: int) -> None:
    rng = np.random.default_rng(seed)
    most = float(rng.uniform(0.01, 0.5))
    true = rotation(direction(rng) * most * float(rng.uniform(0.5, 1)))
    known = ErrorSet.within(most)
    for _ in range(4):
        evidence = [
            seen(rng, true, position=float(rng.uniform(0, 0.1)), bound=float(rng.uniform(0, 0.1)))
            for _ in range(uavs)
        ]
        known = known.cut(compass.confined(known, evidence, 0))
        assert not known.is_empty
        error = known.misalignment()
        assert off_rad(error, true) <= error.bound_rad + 1e-9
        known = known.recentred()
        error = known.misalignment()
        assert off_rad(error, true) <= error.bound_rad + 1e-9
        within = known.within_ball(most)
        assert within is not None
        assert off_rad(within, true) <= within.bound_rad + 1e-9
        assert within.bound_rad <= most + 1e-12
        changed = float(rng.uniform(0, 0.05))
        true = rotation(direction(rng) * changed) @ true
        known, most = known.grown(changed), most + changed


@pytest.mark.parametrize("size", [0.05, 0.5])
def test_set_grows_by_the_change_of_the_error(size: float) -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        axis = direction(rng)
        known = ErrorSet(rotation(direction(rng) * 0.3), compass.DIRECTIONS @ axis * size)
        true = rotation(axis * size) @ known.center
        after = rotation(direction(rng) * 0.1) @ true
        error = known.grown(0.1).misalignment()
        assert off_rad(error, after) <= error.bound_rad + 1e-9
        still = known.misalignment()
        assert off_rad(still, true) <= 1e-6


def test_error_is_known_by_two_uavs() -> None:
    rng = np.random.default_rng(0)
    true = rotation(np.radians([1.0, -2.0, 0.5]))
    known = ErrorSet.within(math.radians(5))
    ahead, aside = np.eye(3)[0], np.eye(3)[1]
    one = [
        Seen("1:1", Cap(at, 0.001), Cap(tilted(rng, true @ at, 0.001), 0.002))
        for at in (ahead, aside)
    ]
    found = compass.refined(known, one, 0)
    assert found is not None
    error = found.misalignment()
    assert off_rad(error, true) <= error.bound_rad
    assert error.bound_rad < math.radians(0.6)


def test_error_about_the_line_of_sight_stays_unknown() -> None:
    ahead = np.eye(3)[0]
    known = ErrorSet.within(math.radians(5))
    evidence = [Seen("1:1", Cap(ahead, 0.0), Cap(ahead, 0.0))]
    known = known.cut(compass.confined(known, evidence, 0))
    about = known.corners @ ahead
    assert about.max() >= math.radians(5)
    assert about.min() <= -math.radians(5)


@settings(max_examples=200)
@given(SEEDS, st.integers(3, 8))
def test_one_false_uav_never_moves_the_error_out_of_the_set(seed: int, uavs: int) -> None:
    rng = np.random.default_rng(seed)
    true = rotation(direction(rng) * 0.05)
    known = ErrorSet.within(0.3)
    at = [direction(rng) for _ in range(uavs)]
    for step in range(10):
        evidence = [
            Seen(
                f"{i}:1",
                Cap(tilted(rng, one, 0.02), 0.0201),
                Cap(tilted(rng, true @ one, 0.01), 0.0101),
            )
            for i, one in enumerate(at)
        ]
        lie = tilted(rng, at[0], 0.02 * step)
        evidence[0] = evidence[0]._replace(reported=Cap(lie, 0.0201))
        cut = known.cut(compass.confined(known, evidence, 1))
        assert not cut.is_empty
        known = cut.recentred()
        error = known.misalignment()
        assert off_rad(error, true) <= error.bound_rad + 1e-9
        for one in evidence[1:]:
            assert not compass.contradicts(error, one)


def test_false_position_contradicts_the_others() -> None:
    rng = np.random.default_rng(0)
    true = rotation(np.array([0.0, 0.0, 0.05]))
    known = ErrorSet.within(0.3)
    evidence = [
        Seen(f"{i}:1", Cap(at, 0.01), Cap(tilted(rng, true @ at, 0.009), 0.01))
        for i, at in enumerate([*np.eye(3), np.full(3, math.sqrt(1 / 3))])
    ]
    lie = tilted(rng, evidence[0].reported.center, 0.3)
    evidence[0] = evidence[0]._replace(reported=Cap(lie, 0.01))
    found = compass.refined(known, evidence, 1)
    assert found is not None
    error = found.misalignment()
    assert [compass.contradicts(error, one) for one in evidence] == [True, False, False, False]


def test_error_beyond_the_bound_is_excluded() -> None:
    rng = np.random.default_rng(0)
    true = rotation(np.array([0.0, 0.0, 0.2]))
    known = ErrorSet.within(0.5)
    evidence = [seen(rng, true, position=0.01, bound=0.01) for _ in range(4)]
    found = compass.refined(known, evidence, 0)
    assert found is not None
    assert found.within_ball(0.05) is None
    assert found.within_ball(0.25) is not None
