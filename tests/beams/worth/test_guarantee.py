"""Guaranteed gains and leakage: valid for every drawn direction, and close to search results."""

import cmath
import itertools
import math

import numpy as np
import pytest
from support import rounds

from companion.beams.array import steering
from companion.beams.array.elements import Element, ElementPattern
from companion.beams.array.geometry import Array, listed, uniform_circular
from companion.beams.array.geometry import uniform_linear as line
from companion.beams.array.geometry import uniform_rectangular as grid
from companion.beams.worth import guarantee
from companion.beams.worth.guarantee import guaranteed_gains_db, leakage_bounds
from companion.beams.worth.patterns import half_power_beamwidths_rad
from companion.values import ComplexArray, FloatArray

EYE = np.eye(3)
GPP = Element(ElementPattern.TR38901)
COSINE = Element(ElementPattern.COSINE, 1.5)
DRAWN = np.random.default_rng(8)
SLANTED = np.outer(np.array([-2.0, -0.7, 0.1, 1.3, 1.9]), [0.004, 0.005, -0.003]) + 0.5
ARRAYS = {
    "line": line(32, 30e9, spacing_wavelengths=0.5, array_from_body=EYE),
    "line of patterns": line(16, 30e9, spacing_wavelengths=0.5, array_from_body=EYE, element=GPP),
    "slanted line": listed(SLANTED, 30e9, array_from_body=EYE, element=COSINE),
    "line that faces apart": listed(
        SLANTED,
        30e9,
        array_from_body=EYE,
        element=GPP,
        lever_arm_m=None,
        outward=np.random.default_rng(6).standard_normal((5, 3)),
    ),
    "one": line(1, 30e9, spacing_wavelengths=0.5, array_from_body=EYE, element=GPP),
    "grid": grid(6, columns=8, frequency_hz=30e9, spacing_wavelengths=0.5, array_from_body=EYE),
    "grid of patterns": grid(
        3,
        columns=4,
        frequency_hz=30e9,
        spacing_wavelengths=0.7,
        array_from_body=EYE,
        element=COSINE,
    ),
    "circle": uniform_circular(16, 30e9, spacing_wavelengths=0.5, array_from_body=EYE, element=GPP),
    "cloud": listed(DRAWN.uniform(-0.02, 0.02, (20, 3)), 30e9, array_from_body=EYE),
    "cloud of patterns": listed(
        DRAWN.uniform(-0.02, 0.02, (12, 3)),
        30e9,
        array_from_body=EYE,
        element=GPP,
        lever_arm_m=None,
        outward=DRAWN.standard_normal((12, 3)),
    ),
}
AHEAD = np.array([[0.96, 0.28, 0.0], [0.8, -0.36, 0.48], [0.6, 0.64, -0.48]])
BOUNDS_DEG = (1e-5, 0.01, 0.3, 1.5, 8.0, 45.0, 180.0)


def weights_for(array: Array, rng: np.random.Generator) -> dict[str, ComplexArray]:
    """Return weights towards ``AHEAD``: matched, zero forcing, two-bit phases, or random."""
    a = steering.steering_matrix(array, AHEAD)
    random = rng.standard_normal((2, array.size, 3)).T @ [1, 1j]
    steps = np.exp(1j * np.pi / 2 * np.round(np.angle(a.conj()) * 2 / np.pi))
    made = {"matched": a.conj(), "two bits": steps, "random": random.T}
    if array.size >= 3:
        made["zero forcing"] = np.linalg.pinv(a.T)
    return made


CASES = [
    (name, kind)
    for name, array in ARRAYS.items()
    for kind in weights_for(array, np.random.default_rng(1))
]
QUICK = {"circle": "zero forcing", "cloud of patterns": "two bits", "line of patterns": "random"}
"""Kind of weights used in `make test` for arrays whose case takes most of a second."""


def within(
    direction: FloatArray, bound_rad: float, rng: np.random.Generator, count: int
) -> FloatArray:
    """Return unit directions within an angle of one; every third lies on the rim."""
    aside = np.cross(direction, rng.standard_normal((count, 3)))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    off = bound_rad * np.where(np.arange(count) % 3, np.sqrt(rng.uniform(size=count)), 1.0)
    return np.cos(off)[:, np.newaxis] * direction + np.sin(off)[:, np.newaxis] * aside


def gains(array: Array, directions: FloatArray, weights: ComplexArray) -> FloatArray:
    """Return the linear array gain, (directions, columns)."""
    received = steering.steering_matrix(array, directions).T @ weights
    return np.abs(received) ** 2 / np.sum(np.abs(weights) ** 2, axis=0)


def searched(
    array: Array, direction: FloatArray, bound_rad: float, weights: ComplexArray, sign: int
) -> float:
    """Return the least (``sign`` 1) or largest (-1) gain found by many draws and by ever closer
    draws around the best few."""
    rng = np.random.default_rng(4)
    tried = within(direction, bound_rad, rng, rounds(600, 2000))
    for scale in 0.2 * 0.4 ** np.arange(6):
        values = sign * gains(array, tried, weights[:, np.newaxis])[:, 0]
        starts = tried[np.argsort(values)[:6]]
        near = [within(s, min(scale * bound_rad, math.pi), rng, 50) for s in starts]
        tried = np.concatenate([starts, *near])
        off = np.linalg.norm(tried - direction, axis=1)
        tried = tried[off <= 2 * math.sin(bound_rad / 2) * (1 + 1e-12)]
    return float(sign * values.min())


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        pytest.param(*one, marks=pytest.mark.full if QUICK.get(one[0], one[1]) != one[1] else ())
        for one in CASES
    ],
)
def test_bounds_hold_for_every_direction_within_the_pointing_bound(name: str, kind: str) -> None:
    """Thousands of directions for each array, kind of weights and bound."""
    array, rng = ARRAYS[name], np.random.default_rng(CASES.index((name, kind)))
    weights = weights_for(array, np.random.default_rng(1))[kind]
    bounds = np.repeat(np.radians(BOUNDS_DEG), 3)
    aims, columns = np.tile(AHEAD, (7, 1)), np.tile(weights, 7)
    least = guaranteed_gains_db(array, aims, bounds.tolist(), columns)
    most = leakage_bounds(array, aims, bounds.tolist(), weights)
    for i, direction in enumerate(aims):
        true = gains(array, within(direction, bounds[i], rng, rounds(120, 480)), weights)
        assert (true.max(axis=0) <= most[i] * (1 + 1e-12) + 1e-20).all()
        bound_db = least[i]
        if bound_db is not None:
            assert true[:, i % 3].min() >= 10 ** (bound_db / 10) * (1 - 1e-12)


@pytest.mark.parametrize("name", sorted(ARRAYS))
@pytest.mark.parametrize("kind", ["matched", "random"])
def test_bounds_are_close_to_search_results(name: str, kind: str) -> None:
    """Within 0.1 dB for a gain within 15 dB of the predicted one and a cone of a few beams; within
    1 dB for unequal element patterns, where all work is used up."""
    array = ARRAYS[name]
    weights = weights_for(array, np.random.default_rng(1))[kind]
    width_rad = 1.0 / (array.wavenumber_radpm * max(np.ptp(array.elements_m, axis=0).max(), 1e-3))
    apart = array.element_from_array is not None
    off_db = 1.0 if apart and kind == "random" else 0.2 if name == "one" else 0.1
    seen = 0
    for share in (0.3, 1.5, 5.0):
        bound_rad = min(share * width_rad, 1.0)
        least = guaranteed_gains_db(array, AHEAD, [bound_rad] * 3, weights)
        most = leakage_bounds(array, AHEAD, [bound_rad] * 3, weights)
        nominal = gains(array, AHEAD, weights)
        for i in range(3):
            found = searched(array, AHEAD[i], bound_rad, weights[:, i], 1)
            bound_db = least[i]
            if found > nominal[i, i] * 10**-1.5:
                assert bound_db is not None
                assert bound_db > 10 * math.log10(found) - off_db
                seen += 1
            j = (i + 1) % 3
            leaked = searched(array, AHEAD[i], bound_rad, weights[:, j], -1)
            if leaked > 1e-3 * nominal.max():
                assert most[i, j] < leaked * (10**0.1 if apart else 10**0.01)
    assert seen >= 3


def test_gain_without_error_matches_direct_summation() -> None:
    """Without error: sum of weights, patterns in each element's own frame, and phases."""
    array = ARRAYS["cloud of patterns"]
    assert array.element_from_array is not None
    weights = weights_for(array, np.random.default_rng(3))["random"]
    found = guaranteed_gains_db(array, AHEAD, [0.0] * 3, weights)
    leaked = leakage_bounds(array, AHEAD, [0.0] * 3, weights)
    for n, k in itertools.product(range(3), range(3)):
        received = 0j
        for m in range(array.size):
            own = array.element_from_array[m] @ AHEAD[n]
            path = array.elements_m[m] @ AHEAD[n] / array.wavelength_m
            amplitude = float(array.element.amplitude(own))
            received += weights[m, k] * amplitude * cmath.exp(2j * math.pi * path)
        gain = abs(received) ** 2 / sum(abs(w) ** 2 for w in weights[:, k])
        assert leaked[n, k] == pytest.approx(gain, rel=1e-8)
        if n == k:
            assert found[n] == pytest.approx(10 * math.log10(gain), abs=1e-8)


@pytest.mark.parametrize("name", sorted(ARRAYS))
def test_guaranteed_gain_without_error_is_the_nominal_gain(name: str) -> None:
    """To eight digits, and never above it."""
    array = ARRAYS[name]
    aims = within(AHEAD[0], 1.0, np.random.default_rng(2), 40)
    for weights in weights_for(array, np.random.default_rng(1)).values():
        columns = weights[:, np.arange(40) % 3]
        found = guaranteed_gains_db(array, aims, [0.0] * 40, columns)
        nominal = np.diag(gains(array, aims, columns))
        for found_db, true in zip(found, nominal, strict=True):
            assert found_db == pytest.approx(10 * math.log10(true), abs=1e-6)
            assert found_db is not None
            assert 10 ** (found_db / 10) < true


def test_very_low_gain_is_still_guaranteed() -> None:
    """Two elements that almost cancel."""
    weights = np.array([[1.0], [-0.9999]], dtype=complex)
    (found,) = guaranteed_gains_db(
        line(2, 1e9, spacing_wavelengths=0.5, array_from_body=EYE),
        np.array([[1.0, 0, 0]]),
        [0.0],
        weights,
    )
    assert found == pytest.approx(20 * math.log10(1e-4) - 10 * math.log10(1 + 0.9999**2))


def test_leakage_bound_covers_directions_beside_a_null() -> None:
    """The response is exactly zero there: its phase is arbitrary, and the slope still counts."""
    weights = np.array([[1.0], [-1.0]], dtype=complex)
    array = line(2, 1e9, spacing_wavelengths=0.5, array_from_body=EYE)
    ahead = np.array([[1.0, 0, 0]])
    for bound_rad in (0.01, 0.3):
        leaked = leakage_bounds(array, ahead, [bound_rad], weights)[0, 0]
        most = 2 * math.sin(math.pi / 2 * math.sin(bound_rad)) ** 2
        assert most <= leaked < 1.03 * most


@pytest.mark.parametrize(("elements", "bound_deg"), [(64, 0.79), (128, 0.40)])
def test_golden_beams_lose_3_db_at_half_power_angle(elements: int, bound_deg: float) -> None:
    """docs/math.md golden values. At the exact half-power angle the gain is half, within the
    tolerance."""
    array = line(elements, 30e9, spacing_wavelengths=0.5, array_from_body=EYE)
    ahead = np.array([[1.0, 0, 0]])
    weights = np.ones((elements, 1), dtype=complex)
    full_db = 10 * math.log10(elements)
    (found,) = guaranteed_gains_db(array, ahead, [math.radians(bound_deg)], weights)
    assert found is not None
    assert found - full_db == pytest.approx(-3.0, abs=0.1)
    width_rad, _ = half_power_beamwidths_rad(array, ahead[0])
    assert width_rad is not None
    (exact,) = guaranteed_gains_db(array, ahead, [width_rad / 2], weights)
    assert exact is not None
    assert -guarantee.TOLERANCE_DB <= exact - full_db - 10 * math.log10(0.5) <= 1e-9


def test_no_gain_is_guaranteed_beyond_a_null() -> None:
    """The first null of 64 half-wave elements is at 1.79 degrees."""
    array = line(64, 30e9, spacing_wavelengths=0.5, array_from_body=EYE)
    weights = np.ones((64, 1), dtype=complex)
    ahead = np.array([[1.0, 0, 0]])
    for bound_deg, sure in ((1.6, True), (1.8, False), (5.0, False), (180.0, False)):
        (found,) = guaranteed_gains_db(array, ahead, [math.radians(bound_deg)], weights)
        assert (found is not None) == sure


def test_no_gain_is_guaranteed_without_a_bound() -> None:
    """Also for a single element that radiates equally everywhere."""
    weights = np.ones((1, 1), dtype=complex)
    array = line(1, 1e9, spacing_wavelengths=0.5, array_from_body=EYE)
    assert guaranteed_gains_db(array, AHEAD[:1], [None], weights) == (None,)
    for bound_rad in (math.pi, 7.0, math.inf):
        found = guaranteed_gains_db(array, AHEAD[:1], [bound_rad], weights)
        assert found == (pytest.approx(0.0),)


def test_leakage_without_a_bound_is_the_maximum_over_all_directions() -> None:
    array = ARRAYS["line"]
    weights = weights_for(array, np.random.default_rng(1))["matched"]
    for bound_rad in (None, math.pi, 7.0, math.inf):
        found = leakage_bounds(array, AHEAD[:1], [bound_rad], weights)
        assert found == pytest.approx(np.full((1, 3), 32.0), rel=0.012)


def test_directions_behind_elements_have_no_gain_and_no_leakage() -> None:
    behind = np.array([[-1.0, 0, 0]])
    for array in (
        line(4, 1e9, spacing_wavelengths=0.5, array_from_body=EYE, element=COSINE),
        listed(
            SLANTED,
            1e9,
            array_from_body=EYE,
            element=COSINE,
            lever_arm_m=None,
            outward=np.tile([1.0, 0, 0], (5, 1)),
        ),
    ):
        weights = np.ones((array.size, 1), dtype=complex)
        for bound_rad in (0.0, 1.2):
            assert guaranteed_gains_db(array, behind, [bound_rad], weights) == (None,)
            assert leakage_bounds(array, behind, [bound_rad], weights) == pytest.approx(0.0)
        assert leakage_bounds(array, behind, [1.6], weights)[0, 0] > 0


@pytest.mark.parametrize("name", sorted(ARRAYS))
def test_larger_bound_does_not_raise_the_guaranteed_gain(name: str) -> None:
    """Except for the tolerance, by which either may be off."""
    array = ARRAYS[name]
    weights = weights_for(array, np.random.default_rng(1))["matched"]
    before_db, before = [math.inf] * 3, np.zeros((3, 3))
    for bound_rad in np.concatenate([[0.0], np.logspace(-6, math.log10(math.pi), rounds(7, 12))]):
        least = guaranteed_gains_db(array, AHEAD, [bound_rad] * 3, weights)
        most = leakage_bounds(array, AHEAD, [bound_rad] * 3, weights)
        after_db = [-math.inf if found is None else found for found in least]
        # Below -20 dB the limited work may leave a larger error.
        for i in range(3):
            assert after_db[i] <= max(before_db[i] + 0.06, -20.0)
        assert (most >= before * 10**-0.006).all()
        before_db, before = after_db, most


def test_beams_are_bounded_independently() -> None:
    array = ARRAYS["grid"]
    weights = weights_for(array, np.random.default_rng(1))["zero forcing"]
    bounds = [0.002, None, 0.08]
    together = guaranteed_gains_db(array, AHEAD, bounds, weights)
    leaked = leakage_bounds(array, AHEAD, bounds, weights)
    assert together[1] is None
    for i in range(3):
        alone = guaranteed_gains_db(array, AHEAD[i : i + 1], [bounds[i]], weights[:, i : i + 1])
        assert alone == (pytest.approx(together[i]) if together[i] is not None else None,)
        row = leakage_bounds(array, AHEAD[i : i + 1], [bounds[i]], weights)
        assert row == pytest.approx(leaked[i : i + 1])
    assert guaranteed_gains_db(array, AHEAD[:0], [], weights[:, :0]) == ()
    assert leakage_bounds(array, AHEAD[:0], [], weights).shape == (0, 3)
    assert leakage_bounds(array, AHEAD, bounds, weights[:, :0]).shape == (3, 0)


@pytest.mark.parametrize("name", ["line", "grid of patterns", "circle"])
def test_weight_scale_and_phase_do_not_change_bounds(name: str) -> None:
    array = ARRAYS[name]
    weights = weights_for(array, np.random.default_rng(1))["zero forcing"]
    found = guaranteed_gains_db(array, AHEAD, [0.01] * 3, weights)
    for factor in (1e-200, 1e200j, -3 + 4j):
        scaled = guaranteed_gains_db(array, AHEAD, [0.01] * 3, factor * weights)
        assert scaled == pytest.approx(found, abs=1e-9)


@pytest.mark.parametrize("name", sorted(ARRAYS))
def test_bounds_hold_when_work_is_limited(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    array, rng = ARRAYS[name], np.random.default_rng(6)
    weights = weights_for(array, np.random.default_rng(1))["matched"]
    full = guaranteed_gains_db(array, AHEAD, [0.05] * 3, weights)
    monkeypatch.setattr(guarantee, "MOST_SPLIT", 1)
    monkeypatch.setattr(guarantee, "BLOCK", 64)
    least = guaranteed_gains_db(array, AHEAD, [0.05] * 3, weights)
    most = leakage_bounds(array, AHEAD, [0.05] * 3, weights)
    for i in range(3):
        true = gains(array, within(AHEAD[i], 0.05, rng, 2000), weights)[:, i]
        assert true.max() <= most[i, i]
        early_db, full_db = least[i], full[i]
        if early_db is not None:
            assert full_db is not None
            assert true.min() >= 10 ** (early_db / 10)
            assert early_db <= full_db + 1e-9


def test_zero_forcing_leaks_only_with_pointing_errors() -> None:
    array = ARRAYS["line"]
    weights = weights_for(array, np.random.default_rng(1))["zero forcing"]
    still = leakage_bounds(array, AHEAD, [0.0] * 3, weights)
    moved = leakage_bounds(array, AHEAD, [1e-3] * 3, weights)
    others = ~np.eye(3, dtype=bool)
    assert still[others].max() < 1e-20
    assert 1e-6 < moved[others].max() < 0.1
    assert np.diag(still) == pytest.approx(np.diag(gains(array, AHEAD, weights)))


def test_mismatched_arguments_are_rejected() -> None:
    array = ARRAYS["line"]
    with pytest.raises(ValueError, match="2 columns of weights for 3 directions"):
        guaranteed_gains_db(array, AHEAD, [0.1] * 3, np.ones((32, 2), dtype=complex))
    with pytest.raises(ValueError, match="pointing bound"):
        guaranteed_gains_db(array, AHEAD, [0.1] * 2, np.ones((32, 3), dtype=complex))
    with pytest.raises(ValueError, match="zero"):
        leakage_bounds(array, AHEAD, [0.1] * 3, np.zeros((32, 2), dtype=complex))
