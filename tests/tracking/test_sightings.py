"""Caps of possible directions: their motion, and what several of them share."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.tracking.moved_caps import Motion
from companion.tracking.sightings import RESTART, WINDOW, Guide, Sightings, possible
from companion.values import Cap, FloatArray, angle_rad
from tests.sighted_world import direction, tilted

SEEDS = st.integers(0, 2**32 - 1)
STILL = Motion(
    moved_ned_m=np.zeros(3),
    error_m=0.0,
    range_m=100.0,
    range_error_m=0.0,
    misalignment_rad=0.0,
    turned_rad=0.0,
)


def turned(vector: FloatArray, axis: FloatArray, angle: float) -> FloatArray:
    """Rotate a vector (3,) about a unit axis."""
    along = axis * (axis @ vector)
    across = vector - along
    return np.asarray(along + math.cos(angle) * across + math.sin(angle) * np.cross(axis, vector))


@settings(max_examples=300)
@given(SEEDS, st.sampled_from(["error", "range", "misalignment", "turned", "spread", "all"]))
def test_moved_cap_contains_the_true_direction(seed: int, what: str) -> None:
    # Each error alone at its largest, in its worst direction among many, and all of them together.
    rng = np.random.default_rng(seed)
    whole = what == "all"
    error_m = float(rng.uniform(0, 5)) if whole or what == "error" else 0.0
    range_error_m = float(rng.uniform(0, 20)) if whole or what == "range" else 0.0
    misalignment = float(rng.uniform(0, 0.3)) if whole or what == "misalignment" else 0.0
    changed = float(rng.uniform(0, 0.1)) if whole or what == "turned" else 0.0
    radius = float(rng.uniform(0, 0.3)) if whole or what == "spread" else 0.0
    center, range_m = direction(rng), float(rng.uniform(40, 100))
    moved_m = direction(rng) * float(rng.uniform(0, 10))
    motion = Motion(
        moved_ned_m=moved_m,
        error_m=error_m,
        range_m=range_m,
        range_error_m=range_error_m,
        misalignment_rad=misalignment,
        turned_rad=changed,
    )
    later = Sightings.of(0, Cap(center, radius)).moved(1, motion)
    for _ in range(20):
        axis, sign = direction(rng), float(rng.choice([-1.0, 1.0]))
        seen = tilted(rng, center, radius)
        truly_m = turned(moved_m, axis, misalignment) + direction(rng) * error_m
        after = seen * (range_m + sign * range_error_m) + truly_m
        after = tilted(rng, after / np.linalg.norm(after), changed)
        off = angle_rad(after, later.caps.centers[0])
        assert off <= later.caps.radii_rad[0] + 1e-9


def test_each_error_of_a_motion_counts() -> None:
    # A cap that grows less than this would lose a UAV that moves straight across.
    ahead, aside = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    known = Sightings.of(0, Cap(ahead, 0.0))

    def grown(**errors: float) -> float:
        motion = {
            "moved_ned_m": 10.0 * aside,
            "error_m": 0.0,
            "range_m": 100.0,
            "range_error_m": 0.0,
            "misalignment_rad": 0.0,
            "turned_rad": 0.0,
        } | errors
        return float(known.moved(1, Motion(**motion)).caps.radii_rad[0])  # type: ignore[arg-type]

    assert grown() == 0.0
    assert grown(error_m=1.0) >= math.atan2(11, 100) - math.atan2(10, 100)
    assert grown(range_error_m=10.0) >= math.atan2(10, 90) - math.atan2(10, 100)
    least = math.atan2(10 * math.cos(0.1), 100 - 10 * math.sin(0.1)) - math.atan2(10, 100)
    assert grown(misalignment_rad=0.1) >= abs(least)
    assert grown(turned_rad=0.1) >= 0.1


@settings(max_examples=200)
@given(SEEDS, st.integers(0, 3))
def test_true_direction_is_possible_although_some_caps_are_wrong(seed: int, wrong: int) -> None:
    rng = np.random.default_rng(seed)
    true, bound = direction(rng), float(rng.uniform(0.001, 0.2))
    known: Sightings | None = None
    bad = set(rng.choice(WINDOW, size=wrong, replace=False).tolist())
    for i in range(WINDOW):
        share = float(rng.choice([1.0, rng.uniform(0, 1)]))
        off = bound * (share * 0.999 if i not in bad else float(rng.uniform(1, 3)))
        cap = Cap(tilted(rng, true, off), bound)
        known = Sightings.of(0, cap) if known is None else known.with_cap(cap)
    assert known is not None
    (found,) = possible([known.caps], wrong)
    assert found is not None
    assert angle_rad(found.center, true) <= found.radius_rad + 1e-9
    within = Cap(tilted(rng, true, bound / 2), bound)
    for likely in (tilted(rng, true, bound / 2), direction(rng)):
        (found,) = possible([known.caps], wrong, [Guide(within, likely)])
        assert found is not None
        assert angle_rad(found.center, true) <= found.radius_rad + 1e-9


def test_possible_directions_are_fewer_than_those_of_one_cap() -> None:
    rng = np.random.default_rng(3)
    true, bound = direction(rng), math.radians(0.5)
    radii = []
    for _ in range(50):
        caps = [Cap(tilted(rng, true, bound * math.sqrt(rng.random())), bound) for _ in range(10)]
        known = Sightings.of(0, caps[0])
        for cap in caps[1:]:
            known = known.with_cap(cap)
        (found,) = possible([known.caps], 0)
        assert found is not None
        radii.append(found.radius_rad / bound)
    assert np.median(radii) < 0.6


def test_none_is_possible_if_caps_exclude_each_other() -> None:
    ahead, aside = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    known = Sightings.of(0, Cap(ahead, 0.1)).with_cap(Cap(tilted_to(ahead, aside, 0.3), 0.1))
    assert possible([known.caps], 0) == [None]


def tilted_to(one: FloatArray, other: FloatArray, angle: float) -> FloatArray:
    """Return a direction at an angle from one towards another, perpendicular one."""
    return np.asarray(math.cos(angle) * one + math.sin(angle) * other)


@settings(max_examples=100)
@given(SEEDS, st.integers(0, 3))
def test_measurement_within_its_bound_is_never_an_outlier(seed: int, wrong: int) -> None:
    rng = np.random.default_rng(seed)
    true, bound = direction(rng), 0.1
    known = Sightings.of(0, Cap(tilted(rng, true, bound * 0.999), bound))
    for i in range(WINDOW - 1):
        off = bound * 0.999 if i >= wrong else float(rng.uniform(0.1, 1))
        known = known.with_cap(Cap(tilted(rng, true, off), bound))
    assert not known.contradicts(Cap(tilted(rng, true, bound * 0.999), bound), wrong)


def test_measurement_apart_from_the_others_is_an_outlier_until_more_agree_with_it() -> None:
    ahead, aside = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    known = Sightings.of(0, Cap(ahead, 0.1))
    for _ in range(5):
        known = known.with_cap(Cap(ahead, 0.1))
    for count in range(1, RESTART + 1):
        assert known.contradicts(Cap(aside, 0.1), 0)
        known = known.against(Cap(aside, 0.1))
        (found,) = possible([known.caps], 0)
        assert found is not None
        new = angle_rad(found.center, aside) < 0.01
        assert new == (count == RESTART)


def test_scattered_outliers_never_replace_the_set() -> None:
    rng = np.random.default_rng(1)
    ahead = np.array([1.0, 0.0, 0.0])
    known = Sightings.of(0, Cap(ahead, 0.02))
    for _ in range(3):
        known = known.with_cap(Cap(ahead, 0.02))
    for _ in range(50):
        known = known.against(Cap(tilted(rng, ahead, float(rng.uniform(0.2, 3.0))), 0.02))
    (found,) = possible([known.caps], 0)
    assert found is not None and angle_rad(found.center, ahead) < 0.01


def test_nothing_is_known_of_a_uav_at_the_array() -> None:
    motion = Motion(
        moved_ned_m=np.array([1.0, 0.0, 0.0]),
        error_m=1.0,
        range_m=5.0,
        range_error_m=4.0,
        misalignment_rad=0.0,
        turned_rad=0.0,
    )
    later = Sightings.of(0, Cap(np.array([0.0, 1.0, 0.0]), 0.1)).moved(1, motion)
    assert later.caps.radii_rad[0] == math.pi


def test_caps_stay_in_place_while_nothing_moves() -> None:
    cap = Cap(np.array([0.0, 1.0, 0.0]), 0.1)
    later = Sightings.of(0, cap).moved(1, STILL)
    np.testing.assert_allclose(later.caps.centers[0], cap.center, atol=1e-15)
    assert math.isclose(later.caps.radii_rad[0], 0.1, rel_tol=1e-12)


@settings(max_examples=100)
@given(SEEDS, st.integers(0, 3))
def test_many_uavs_at_once_are_each_as_alone(seed: int, wrong: int) -> None:
    rng = np.random.default_rng(seed)
    many, guides = [], []
    for _ in range(int(rng.integers(1, 6))):
        true, bound = direction(rng), float(rng.uniform(0.001, 0.9))
        known = Sightings.of(0, Cap(tilted(rng, true, bound), bound))
        for _ in range(int(rng.integers(0, WINDOW))):
            known = known.with_cap(
                Cap(tilted(rng, true, bound * float(rng.uniform(0, 1.2))), bound)
            )
        many.append(known.caps)
        within = Cap(tilted(rng, true, bound / 2), bound)
        guides.append(Guide(within, direction(rng)) if rng.random() < 0.7 else None)
    for cap, caps, guide in zip(possible(many, wrong, guides), many, guides, strict=True):
        (alone,) = possible([caps], wrong, [guide])
        assert (cap is None) == (alone is None)
        if cap is not None and alone is not None:
            np.testing.assert_allclose(cap.center, alone.center, atol=1e-9)
            assert math.isclose(cap.radius_rad, alone.radius_rad, rel_tol=1e-6, abs_tol=1e-9)
