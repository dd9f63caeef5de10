"""Element patterns against the 3GPP table, integrated power, and adversarial amplitude ranges."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.beams.array.elements import ISOTROPIC, Element, ElementPattern
from companion.values import FloatArray

SEEDS = st.integers(0, 2**32 - 1)
TR38901 = Element(ElementPattern.TR38901)
ELEMENTS = [
    ISOTROPIC,
    TR38901,
    *(Element(ElementPattern.COSINE, exponent) for exponent in (0.5, 1.0, 2.0, 6.5)),
]


def towards(azimuth_deg: float, elevation_deg: float) -> FloatArray:
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    level = math.cos(elevation)
    return np.array([level * math.cos(azimuth), level * math.sin(azimuth), -math.sin(elevation)])


def gain_dbi(element: Element, azimuth_deg: float, elevation_deg: float) -> float:
    amplitude = float(element.amplitude(towards(azimuth_deg, elevation_deg)))
    return 20 * math.log10(amplitude)


@pytest.mark.parametrize(
    ("azimuth_deg", "elevation_deg", "dbi"),
    [
        (0, 0, 8.0),
        (32.5, 0, 5.0),  # half-power width of 65 degrees
        (0, -32.5, 5.0),
        (-65, 0, -4.0),
        (65, 32.5, -7.0),
        (0, 90, 8 - 12 * (90 / 65) ** 2),
        (180, 0, -22.0),
        (100, 60, -22.0),
        (-102, 0, 8 - 12 * (102 / 65) ** 2),
        (103, 0, -22.0),
    ],
)
def test_tr38901_element_gains_match_known_values(
    azimuth_deg: float, elevation_deg: float, dbi: float
) -> None:
    assert gain_dbi(TR38901, azimuth_deg, elevation_deg) == pytest.approx(dbi, abs=1e-9)


@given(st.floats(0, 180), st.floats(-180, 180))
def test_tr38901_element_matches_table_7_3_1(zenith_deg: float, phi_deg: float) -> None:
    """3GPP TR 38.901 table 7.3-1 measures theta from the zenith: 90 degrees is level."""
    vertical_db = -min(12 * ((zenith_deg - 90) / 65) ** 2, 30)
    horizontal_db = -min(12 * (phi_deg / 65) ** 2, 30)
    dbi = 8 - min(-(vertical_db + horizontal_db), 30)
    if 0.001 < zenith_deg < 179.999:  # at a pole the vector has no azimuth
        assert gain_dbi(TR38901, phi_deg, 90 - zenith_deg) == pytest.approx(dbi, abs=1e-6)


@pytest.mark.parametrize("exponent", [0.0, 0.5, 1.0, 2.0, 3.7, 8.0])
def test_cosine_element_gain_integrates_to_4_pi(exponent: float) -> None:
    """The integral of the power gain over the sphere is 4 pi."""
    nodes, shares = np.polynomial.legendre.leggauss(400)
    cosine, weight = (nodes + 1) / 2, shares / 2  # ahead; nothing is radiated behind
    across = np.sqrt(1 - cosine**2)
    element = Element(ElementPattern.COSINE, exponent)
    total = 0.0
    for turn in np.linspace(0, 2 * math.pi, 24, endpoint=False):
        directions = np.stack([cosine, across * math.cos(turn), across * math.sin(turn)], axis=1)
        total += 2 * math.pi / 24 * float(weight @ element.amplitude(directions) ** 2)
        assert not element.amplitude(directions * [-1, 1, 1]).any()
    assert total == pytest.approx(4 * math.pi, rel=1e-5)


def test_cosine_element_amplitude_follows_the_cosine() -> None:
    best = gain_dbi(Element(ElementPattern.COSINE, 2.0), 0, 0)
    assert best == pytest.approx(10 * math.log10(6))
    aside = gain_dbi(Element(ElementPattern.COSINE, 2.0), 40, 30)
    cosine = math.cos(math.radians(40)) * math.cos(math.radians(30))
    assert aside - best == pytest.approx(20 * math.log10(cosine))
    assert Element(ElementPattern.COSINE).amplitude(towards(90.001, 0)) == 0


@pytest.mark.parametrize("element", ELEMENTS)
def test_amplitudes_and_ranges_keep_the_shape_of_the_directions(element: Element) -> None:
    rng = np.random.default_rng(3)
    directions = rng.standard_normal((2, 5, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    found = element.amplitude(directions)
    assert found.shape == (2, 5)
    radii = rng.uniform(0, 1, (2, 5))
    least, most = element.amplitude_range(directions, radii)
    assert least.shape == most.shape == (2, 5)
    one_least, one_most = element.amplitude_range(directions[1, 3], float(radii[1, 3]))
    assert one_least == pytest.approx(least[1, 3])
    assert one_most == pytest.approx(most[1, 3])


def about(direction: FloatArray, radius: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return directions at angles ``radius`` (N,) from one: random ones and four at right
    angles."""
    aside = rng.standard_normal((len(radius), 3))
    up = np.array([0, 0, 1.0]) if abs(direction[2]) < 0.9 else np.array([1.0, 0, 0])
    aside[:2], aside[2:4] = [up, -up], [np.cross(direction, up), -np.cross(direction, up)]
    aside -= (aside @ direction)[:, np.newaxis] * direction
    aside /= np.linalg.norm(aside, axis=1)[:, np.newaxis]
    return np.cos(radius)[:, np.newaxis] * direction + np.sin(radius)[:, np.newaxis] * aside


def random_direction(rng: np.random.Generator) -> FloatArray:
    """Return a direction anywhere, outward, behind, level, at a pole, or very close to one of
    these."""
    drawn = rng.standard_normal(3)
    if rng.random() < 0.6:
        places = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1.0]])
        drawn = places[rng.integers(5)] + rng.choice([0, 1e-9, 1e-4, 0.1]) * drawn
    unit: FloatArray = drawn / np.linalg.norm(drawn)
    return unit


@pytest.mark.parametrize("element", ELEMENTS)
@given(seed=SEEDS)
@settings(max_examples=examples(60), deadline=None)
def test_amplitudes_within_the_radius_stay_within_the_range(element: Element, seed: int) -> None:
    rng = np.random.default_rng(seed)
    direction = random_direction(rng)
    radius = float(rng.choice([0.0, 1e-9, 1e-3, rng.uniform(0, 0.3), rng.uniform(0, math.pi)]))
    least, most = element.amplitude_range(direction, radius)
    share = np.append(np.ones(150), np.sqrt(rng.random(250)))
    found = element.amplitude(about(direction, radius * share, rng))
    # Rounding of 1e-16 in a direction is visible sideways, where a root of the cosine is steep.
    slack = 1e-12
    if element.pattern is ElementPattern.COSINE:
        slack += 3 * (1e-15) ** (element.exponent / 2)
    assert float(least) <= found.min() + slack
    assert found.max() <= float(most) + slack
    now = float(element.amplitude(direction))
    assert float(least) <= now + slack
    assert now <= float(most) + slack


@given(seed=SEEDS)
@settings(max_examples=examples(60), deadline=None)
def test_cosine_amplitude_range_is_attained(seed: int) -> None:
    """The extremes lie straight along the outward direction and straight opposite to it."""
    rng = np.random.default_rng(seed)
    element = Element(ElementPattern.COSINE, float(rng.uniform(1, 4)))
    off, radius, turn = rng.uniform(0, math.pi), rng.uniform(0, math.pi), rng.uniform(0, 6.3)

    def at(angle: float) -> float:
        sine = math.sin(angle)
        place = [math.cos(angle), sine * math.cos(turn), sine * math.sin(turn)]
        return float(element.amplitude(np.array(place)))

    place = [math.cos(off), math.sin(off) * math.cos(turn), math.sin(off) * math.sin(turn)]
    least, most = element.amplitude_range(np.array(place), radius)
    assert least == pytest.approx(at(min(off + radius, math.pi)), abs=1e-7)
    assert most == pytest.approx(at(max(off - radius, 0.0)), abs=1e-7)


@pytest.mark.parametrize("degrees", [-70, -20, 0, 10, 35, 70])
def test_tr38901_amplitude_range_is_tight_in_the_principal_cuts(degrees: float) -> None:
    """The maximum is attained; so is the minimum, except in the corner where both cuts combine."""
    radius = math.radians(15)
    far, near = abs(degrees) + 15, max(abs(degrees) - 15, 0)
    least, most = TR38901.amplitude_range(towards(degrees, 0), radius)
    assert most == pytest.approx(TR38901.amplitude(towards(near, 0)))
    assert least <= TR38901.amplitude(towards(far, 0))
    assert least == pytest.approx(TR38901.amplitude(towards(far, 15)))
    least, most = TR38901.amplitude_range(towards(0, degrees), radius)
    assert most == pytest.approx(TR38901.amplitude(towards(0, near)))
    assert least <= TR38901.amplitude(towards(0, far))
    reach_deg = math.degrees(math.asin(math.sin(radius) / math.cos(math.radians(degrees))))
    assert least == pytest.approx(TR38901.amplitude(towards(reach_deg, far)))


@pytest.mark.parametrize("exponent", [-0.1, -3.0, math.nan, math.inf])
def test_negative_cosine_exponent_is_rejected(exponent: float) -> None:
    with pytest.raises(ValueError, match=r"exponent of the cosine pattern is .*; give 0 or more"):
        Element(ElementPattern.COSINE, exponent)
