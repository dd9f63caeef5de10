"""Beams no narrower than what is known: by what reaches a crowd of directions within the bound."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.beams.array.elements import Element, Pattern
from companion.beams.array.geometry import (
    Array,
    listed,
    uniform_circular,
    uniform_linear,
    uniform_rectangular,
)
from companion.beams.array.steering import steering_matrix
from companion.beams.weights import widening
from companion.beams.weights.precoding import Precoder, gain_db, precode
from companion.beams.weights.widening import power_gains
from companion.values import ComplexArray, FloatArray, Method, Policy

EYE = np.eye(3)
LINE = uniform_linear(64, 30e9, 0.5, EYE)
RECTANGLE = uniform_rectangular(8, 8, 30e9, 0.5, EYE)
CIRCLE = uniform_circular(32, 30e9, 0.5, EYE)
SHORT = uniform_linear(3, 30e9, 8.0, EYE)
"""With fewer elements than directions that are nulled."""


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
    # Bounds apart, but hardly told apart by a line of 64: the points between them are left out.
    close = towards((0, 0), (1.6, 0))
    a = steering_matrix(LINE, close)
    wide = widening.spread(LINE, close, np.radians([0.75, 0.75]))
    assert wide is not None
    around = np.abs(wide.points.T @ a.conj()).reshape(2, wide.each, 2)[:, 1:] / 64
    usable = wide.usable.reshape(2, wide.each)[:, 1:]
    for owner in (0, 1):
        assert around[owner, usable[owner], 1 - owner].max(initial=0.0) <= 0.5
    assert usable.any()
    assert not usable.all()


def test_points_fill_the_bound_in_space_and_no_more_than_can_be_spared() -> None:
    for array, directions, beside in (
        (RECTANGLE, FOUR, 6),  # (64 - 4) // 4 = 15: one ring
        (RECTANGLE, FOUR[[0, 3]], 18),
        (uniform_linear(5, 30e9, 0.5, EYE), FOUR, 0),
        (RECTANGLE, FOUR[:1], 0),  # nobody to be kept from
    ):
        wide = widening.spread(array, directions, np.full(len(directions), 0.2))
        assert wide is not None
        assert wide.each == 1 + beside
        assert wide.centres == pytest.approx(steering_matrix(array, directions))


@pytest.mark.parametrize("array", [LINE, RECTANGLE, CIRCLE, SHORT])
@pytest.mark.parametrize("loading", [0.0, 3.0])
@pytest.mark.parametrize("soft", [None, 0.01, 1.0])
def test_nulls_are_those_of_least_squares_user_by_user(
    array: Array, loading: float, soft: float | None
) -> None:
    """The least change of each beam, weighed against what is left at the others and what is
    changed at its own directions: by QR over the elements."""
    if array is SHORT:
        loading += 0.5  # nothing can null more directions than it has elements
    a = steering_matrix(array, FOUR)
    wide = widening.spread(array, FOUR, np.radians([2.0, 9.0, 1.0, 6.0]))
    assert wide is not None
    found = widening.nulled(wide, loading, soft)
    assert array is not SHORT or len(wide.usable) > array.size
    owners = np.repeat(np.arange(4), wide.each)
    used = (np.arange(len(owners)) % wide.each > 0) & wide.usable
    for user in range(4):
        points, whose, loads = a, np.arange(4), np.full(4, max(loading, 1e-9))
        if soft is not None:
            beside = wide.points[:, used]
            points, whose = np.concatenate([points, beside], axis=1), np.append(whose, owners[used])
            loads = np.append(loads, soft * np.sum(np.abs(beside) ** 2, axis=0))
        own = wide.beams[:, user]
        wanted = np.where(whose == user, 0.0, -(points.T @ own))
        weighed = np.sqrt(1 / loads)
        rows = np.concatenate([np.eye(array.size), weighed[:, np.newaxis] * points.T])
        target = np.concatenate([np.zeros(array.size), weighed * wanted])
        change = np.linalg.lstsq(rows, target, rcond=None)[0]
        assert found[:, user] == pytest.approx(own + change, abs=1e-5)


def test_what_concerns_some_users_is_theirs_in_their_order() -> None:
    bounds = np.radians([2.0, 9.0, 1.0, 16.0])
    wide = widening.spread(RECTANGLE, FOUR, bounds)
    assert wide is not None
    assert wide.of(np.arange(4)) is wide
    some = wide.of(np.array([0, 2, 3]))
    assert some.each == wide.each
    assert np.array_equal(some.beams, wide.beams[:, [0, 2, 3]])
    assert some.broadened.tolist() == wide.broadened[[0, 2, 3]].tolist()
    assert some.gram == pytest.approx(some.points.T @ some.points.conj())
    assert some.reached == pytest.approx(some.points.T @ some.beams)
    for place, user in enumerate([0, 2, 3]):
        mine, theirs = (slice(n * wide.each, (n + 1) * wide.each) for n in (user, place))
        assert np.array_equal(some.points[:, theirs], wide.points[:, mine])
        assert np.array_equal(some.usable[theirs], wide.usable[mine])


def test_nulls_are_widened_even_where_the_limit_is_passed_without() -> None:
    """What a user has lost already is no reason against wide nulls."""
    a = steering_matrix(LINE, FOUR)
    wide = widening.spread(LINE, FOUR, np.radians([1.0, 1.0, 1.0, 1.0]))
    assert wide is not None
    centred = widening.nulled(wide, 0.0)
    found = widening.widen_nulls(wide, 0.0, centred, 0.999 * power_gains(a, centred))
    more = widening.widen_nulls(wide, 0.0, 0.5 * found, 1e9 * power_gains(a, found))
    assert more == pytest.approx(found, abs=1e-9)
    # Where nothing may be lost against the centred nulls, they stay.
    kept = widening.widen_nulls(wide, 0.0, centred, 1.001 * power_gains(a, centred))
    assert (power_gains(a, kept) >= power_gains(a, centred) * (1 - 1e-8)).all()


@pytest.mark.parametrize("policy", [Policy.GROUP, Policy.DROP])
@pytest.mark.parametrize("seed", range(8))
def test_groups_of_broadened_beams_are_within_the_price(policy: Policy, seed: int) -> None:
    """Each against its broadened beam alone; all exact."""
    rng = np.random.default_rng(seed)
    directions = towards(*((azimuth, 0.0) for azimuth in rng.uniform(-6, 6, 7)))
    a = steering_matrix(LINE, directions)
    wide = widening.spread(LINE, directions, rng.uniform(0, 0.12, 7))
    assert wide is not None
    found = precode(a, Precoder(policy=policy), wide)
    assert found.method is Method.ZERO_FORCING
    assert found.groups.max() > 0 or found.dropped
    lost_db = gain_db(a, wide.beams)[found.served] - gain_db(a[:, found.served], found.weights)
    assert lost_db.max() <= 3 + 1e-6
    for turn in range(found.groups.max() + 1):
        now = found.groups == turn
        response = a[:, found.served[now]].T @ found.weights[:, now]
        assert np.abs(response - np.eye(now.sum())).max() < 1e-9


def test_maximum_ratio_takes_the_broadened_beams_as_they_are() -> None:
    a = steering_matrix(LINE, FOUR)
    wide = widening.spread(LINE, FOUR, np.full(4, 0.1))
    assert wide is not None
    found = precode(a, Precoder(Method.MATCHED), wide).weights
    ratio = found / wide.beams
    assert ratio == pytest.approx(np.broadcast_to(ratio[0], ratio.shape))


SCATTERED = listed(np.random.default_rng(3).uniform(-0.04, 0.04, (64, 3)), 30e9, EYE)
SPARSE = uniform_linear(4, 30e9, 3.0, EYE)
FACING = listed(
    np.random.default_rng(3).uniform(-0.04, 0.04, (64, 3)),
    30e9,
    EYE,
    Element(Pattern.COSINE, 4.0),
    None,
    np.random.default_rng(4).standard_normal((64, 3)),
)
EVERY = {
    "line": LINE, "rectangle": RECTANGLE, "circle": CIRCLE, "scattered": SCATTERED,
    "sparse": SPARSE, "facing": FACING,
}  # fmt: skip


@pytest.mark.parametrize("array", EVERY.values(), ids=EVERY)
@pytest.mark.parametrize("angles_deg", [(0, 0), (30, 20), (80, 0), (90, 0), (0, 60), (0, 90)])
def test_a_broadened_beam_has_no_hole_whatever_the_array(
    array: Array, angles_deg: tuple[float, float]
) -> None:
    """From every side, along the line too, and for bounds up to anywhere: not much below one
    element alone, and never much below the sharp beam."""
    directions = towards(angles_deg)
    a = steering_matrix(array, directions)
    strongest_db = 20 * np.log10(np.abs(a).max())
    for bound_deg in (1.0, 3.0, 5.0, 8.0, 12.0, 15.0, 20.0, 30.0, 45.0, 60.0):
        bounds = np.radians([bound_deg])
        wide = widening.spread(array, directions, bounds)
        if array is FACING and bound_deg > 30:
            continue  # one that faces elsewhere sees what the part does not
        crowd = within(directions[0], bounds[0], count=600)
        beams = a.conj() if wide is None else wide.beams
        broad = power_db(array, beams, crowd).min()
        sharp = power_db(array, a.conj(), crowd).min()
        if array is not FACING:  # whose elements may not see all of the bound
            assert broad > -6.0, bound_deg
        assert broad > sharp - 3.5, bound_deg
        assert gain_db(a, beams)[0] > strongest_db - 4.0, bound_deg


@pytest.mark.parametrize("array", [CIRCLE, RECTANGLE, SCATTERED])
def test_the_part_that_serves_is_as_large_as_the_bound_lets_it(array: Array) -> None:
    """The wider the bound, the fewer elements; those that are left keep their phase."""
    directions = towards((10, 50))
    a = steering_matrix(array, directions)
    counts = []
    for bound_deg in (9.0, 12.0, 18.0, 30.0, 60.0):
        wide = widening.spread(array, directions, np.radians([bound_deg]))
        assert wide is not None
        on = np.abs(wide.beams[:, 0]) > 0
        assert wide.beams[on, 0] == pytest.approx(a[on, 0].conj())
        counts.append(int(on.sum()))
    assert counts == sorted(counts, reverse=True)
    assert array.size > counts[0] > counts[-1] >= 1


def test_only_who_is_not_known_is_served_by_a_part() -> None:
    a = steering_matrix(CIRCLE, FOUR)
    wide = widening.spread(CIRCLE, FOUR, np.radians([3.3, 20.0, 3.3, 20.0]))
    assert wide is not None
    assert wide.broadened.tolist() == [False, True, False, True]
    assert wide.beams[:, 0::2] == pytest.approx(a[:, 0::2].conj())
    assert (np.abs(wide.beams[:, 1::2]) == 0).any(axis=0).all()


def test_a_part_is_found_where_few_elements_see_the_user() -> None:
    """One element of 200 faces it: that one serves."""
    outward = np.tile([-1.0, 0.0, 0.0], (200, 1))
    outward[77] = [1.0, 0.0, 0.0]
    places = np.random.default_rng(1).uniform(-5, 5, (200, 3))
    array = listed(places, 30e9, EYE, Element(Pattern.COSINE), None, outward)
    directions = towards((0, 0))
    wide = widening.spread(array, directions, np.array([0.3]))
    assert wide is not None
    assert np.flatnonzero(np.abs(wide.beams[:, 0])).tolist() == [77]


@pytest.mark.parametrize("seed", range(6))
def test_exact_to_the_last_digits_at_the_widest_limits(seed: int) -> None:
    """Points nulled beside the others leave no more of the rest than plain zero forcing does."""
    rng = np.random.default_rng(seed)
    array = uniform_linear(16, 30e9, 0.1, EYE)
    angles = np.stack([np.sort(rng.uniform(-70, 70, 5)), np.zeros(5)], axis=1)
    directions = towards(*map(tuple, angles))
    a = steering_matrix(array, directions)
    wide = widening.spread(array, directions, np.full(5, 0.05))
    found = precode(a, Precoder(loss_limit_db=60.0, condition_limit=1000.0), wide)
    if found.method is Method.ZERO_FORCING:
        assert np.abs(a.T @ found.weights - np.eye(5)).max() < 1e-9
    some = widening.spread(array, directions[[0, 0]], np.full(2, 0.05))
    for regularisation in (1e-300, 1e-12, 1e-6):
        how = Precoder(Method.REGULARISED, regularisation=regularisation)
        twins = precode(a[:, [0, 0]], how, some).weights
        assert np.all(np.isfinite(twins))
        assert np.einsum("m,mn->n", a[:, 0], twins) == pytest.approx(np.ones(2), abs=1e-9)


@pytest.mark.parametrize("seed", [1, 2, 3, 6, 11])
def test_points_nulled_beside_the_others_leave_nothing_at_them(seed: int) -> None:
    """On arrays so dense that rounding costs ten digits of the nulls, if it is not taken away."""
    for spacing in (0.05, 0.1):
        rng = np.random.default_rng(seed)
        array = uniform_linear(32, 30e9, spacing, EYE)
        azimuths = np.sort(rng.uniform(-70, 70, 3 + seed % 4))
        directions = towards(*((azimuth, 0.0) for azimuth in azimuths.tolist()))
        a = steering_matrix(array, directions)
        wide = widening.spread(array, directions, np.full(len(directions), 0.2))
        found = precode(a, Precoder(loss_limit_db=60.0, condition_limit=1000.0), wide)
        if found.method is Method.ZERO_FORCING:
            assert np.abs(a.T @ found.weights - np.eye(len(directions))).max() <= 1e-11


def test_where_wide_nulls_cost_too_much_the_exact_ones_stay() -> None:
    """The softest points at once would cost 6 dB, the predicted directions alone 2."""
    rng = np.random.default_rng(27)
    directions = towards(*((azimuth, 0.0) for azimuth in rng.uniform(-60, 60, 4)))
    a = steering_matrix(LINE, directions)
    wide = widening.spread(LINE, directions, np.radians(rng.uniform(0.5, 3, 4)))
    assert wide is not None
    alone = gain_db(a, wide.beams)
    assert (alone - gain_db(a, widening.nulled(wide, 0.0, 0.01))).max() > 6
    found = precode(a, Precoder(), wide)
    assert found.method is Method.ZERO_FORCING
    assert (alone - gain_db(a, found.weights)).max() <= 3.0 + 1e-6


@pytest.mark.parametrize("seed", [1, 6, 8, 12, 13, 85])
def test_no_more_is_loaded_than_broadened_beams_need(seed: int) -> None:
    """What sharp beams need costs these 5 to 7 dB; with more, some of the limit is used still."""
    rng = np.random.default_rng(seed)
    directions = towards(*((azimuth, 0.0) for azimuth in rng.uniform(-8, 8, 4)))
    a = steering_matrix(LINE, directions)
    wide = widening.spread(LINE, directions, np.radians(rng.uniform(0, 6, 4)))
    assert wide is not None
    found = precode(a, Precoder(), wide)
    assert found.method is Method.REGULARISED
    assert 1.0 < (gain_db(a, wide.beams) - gain_db(a, found.weights)).max() <= 3.0 + 1e-6


@pytest.mark.parametrize("policy", Policy)
def test_finite_where_one_element_is_all_that_two_users_have(policy: Policy) -> None:
    """The one sees no other element; all of what the other is served by would be nulled."""
    outward = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    places = np.array([[0.0, 0.02, 0.0], [0.0, -0.02, 0.0]])
    array = listed(places, 30e9, EYE, Element(Pattern.COSINE), None, outward)
    directions = towards((90.0, 0.0), (50.0, 0.0))
    a = steering_matrix(array, directions)
    wide = widening.spread(array, directions, np.full(2, np.inf))
    assert wide is not None
    assert np.flatnonzero(wide.beams[:, 1]).tolist() == [0]
    assert power_gains(a, np.zeros_like(a)).tolist() == [0.0, 0.0]
    found = precode(a, Precoder(policy=policy), wide)
    assert np.all(np.isfinite(found.weights))
    assert len(found.served) == (1 if policy is Policy.DROP else 2)
    lost_db = gain_db(a, wide.beams)[found.served] - gain_db(a[:, found.served], found.weights)
    assert lost_db.max() <= 3 + 1e-6
