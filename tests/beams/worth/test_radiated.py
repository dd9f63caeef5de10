"""Guarantees for radiated beams: dead elements, coupling and channel errors, drawn at random."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support import rounds

from companion.beams.array.elements import Element, ElementPattern
from companion.beams.array.geometry import Array, listed, uniform_circular
from companion.beams.array.geometry import uniform_linear as line
from companion.beams.array.geometry import uniform_rectangular as grid
from companion.beams.array.steering import phase_factors, steering_matrix
from companion.beams.hardware.calibration import channel_error
from companion.beams.worth.guarantee import guaranteed_gains_db, leakage_bounds
from companion.values import ComplexArray, FloatArray

EYE = np.eye(3)
GPP = Element(ElementPattern.TR38901)
AHEAD = np.array([[0.96, 0.28, 0.0], [0.8, -0.36, 0.48]])
PHASE_RAD, GAIN_DB = math.radians(6.0), 0.7
ARRAYS = {
    "line": line(16, 30e9, spacing_wavelengths=0.5, array_from_body=EYE),
    "grid of patterns": grid(
        4,
        columns=4,
        frequency_hz=30e9,
        spacing_wavelengths=0.6,
        array_from_body=EYE,
        element=Element(ElementPattern.COSINE, 1.5),
    ),
    "circle": uniform_circular(12, 30e9, spacing_wavelengths=0.5, array_from_body=EYE, element=GPP),
    "cloud": listed(
        np.random.default_rng(8).uniform(-0.02, 0.02, (10, 3)), 30e9, array_from_body=EYE
    ),
}
FAULTS = ("dead", "coupling", "off", "all")


def faulty(array: Array, fault: str) -> Array:
    """Return an array with dead elements, coupling, or channel errors."""
    rng, size = np.random.default_rng(3), array.size
    live = np.ones(size, dtype=bool)
    live[[2, 5]] = False
    mixed = rng.standard_normal((2, size, size)).T @ [1, 1j] * 0.06
    error = channel_error(np.full(size, PHASE_RAD), np.full(size, GAIN_DB))
    return replace(
        array,
        live=live if fault in ("dead", "all") else None,
        coupling=np.eye(size) + mixed if fault in ("coupling", "all") else None,
        channel_error=error if fault in ("off", "all") else None,
    )


def drawn(
    array: Array, weights: ComplexArray, directions: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return array gains (directions, columns) of one array within the error bounds.

    From the physics alone: feed, remove dead elements, apply channel errors, couple, radiate.
    """
    pristine = replace(array, live=None, coupling=None, channel_error=None)
    live = np.ones(array.size) if array.live is None else array.live
    fed = weights * live[:, np.newaxis]
    power = np.sum(np.abs(fed) ** 2, axis=0)
    if array.channel_error is not None:
        ends = rng.integers(0, 2) == 0  # errors at their bounds or anywhere within them
        draw = (
            rng.choice([-1.0, 1.0], (2, array.size))
            if ends
            else rng.uniform(-1, 1, (2, array.size))
        )
        off = 10 ** (GAIN_DB * draw[0] / 20) * np.exp(1j * PHASE_RAD * draw[1])
        fed = fed * off[:, np.newaxis]
    carried = fed if array.coupling is None else array.coupling @ fed
    return np.abs(steering_matrix(pristine, directions).T @ carried) ** 2 / power


def within(
    direction: FloatArray, bound_rad: float, rng: np.random.Generator, count: int
) -> FloatArray:
    aside = np.cross(direction, rng.standard_normal((count, 3)))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    off = bound_rad * np.where(np.arange(count) % 3, np.sqrt(rng.uniform(size=count)), 1.0)
    return np.cos(off)[:, np.newaxis] * direction + np.sin(off)[:, np.newaxis] * aside


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("name", sorted(ARRAYS))
def test_bounds_hold_for_every_array_within_its_error_bounds(name: str, fault: str) -> None:
    array, rng = faulty(ARRAYS[name], fault), np.random.default_rng(5)
    matched = steering_matrix(array, AHEAD).conj()
    exact = np.linalg.pinv(steering_matrix(array, AHEAD).T)
    for weights in (matched, exact):
        for bound in np.radians([0.01, 1.0, 4.0]):
            least = guaranteed_gains_db(array, AHEAD, [bound, bound], weights)
            most = leakage_bounds(array, AHEAD, [bound, bound], weights)
            for _ in range(rounds(25, 100)):
                for i, direction in enumerate(AHEAD):
                    true = drawn(array, weights, within(direction, bound, rng, 30), rng)
                    assert (true.max(axis=0) <= most[i] * (1 + 1e-9)).all()
                    if least[i] is not None:
                        assert true[:, i].min() >= 10 ** (least[i] / 10) * (1 - 1e-9)


@pytest.mark.parametrize("name", sorted(ARRAYS))
def test_guarantee_at_a_point_is_close_to_the_worst_case(name: str) -> None:
    """The worst errors are known there: each channel's part opposes the sum or is reduced."""
    array = faulty(ARRAYS[name], "off")
    own = AHEAD[:1]
    weights = steering_matrix(array, own).conj()
    (sure,) = guaranteed_gains_db(array, own, [1e-9], weights)
    pristine = replace(array, channel_error=None)
    (ideal,) = guaranteed_gains_db(pristine, own, [1e-9], weights)
    assert sure is not None
    assert ideal is not None
    assert array.channel_error is not None
    parts = np.abs(weights * steering_matrix(pristine, own))
    share = 1 - float(array.channel_error @ parts[:, 0]) / float(parts.sum())
    assert sure - ideal == pytest.approx(20 * math.log10(share), abs=0.06)


def test_weights_exclude_dead_elements() -> None:
    array = faulty(ARRAYS["line"], "dead")
    assert array.live is not None
    steering = steering_matrix(array, AHEAD)
    assert not steering[~array.live].any()
    np.testing.assert_array_equal(steering[array.live], phase_factors(array, AHEAD)[array.live])


def test_channel_error_bound_is_attained_at_its_corners() -> None:
    rng = np.random.default_rng(2)
    bound = float(channel_error(np.array([PHASE_RAD]), np.array([GAIN_DB]))[0])
    draws = rng.uniform(-1, 1, (2, 100_000))
    off = np.abs(10 ** (GAIN_DB * draws[0] / 20) * np.exp(1j * PHASE_RAD * draws[1]) - 1)
    assert off.max() <= bound
    assert off.max() > 0.98 * bound
    assert channel_error(np.array([4.0]), np.array([0.0])) == pytest.approx(2.0)


@pytest.mark.parametrize("name", sorted(ARRAYS))
def test_steering_vector_equals_response_of_each_channel_alone(name: str) -> None:
    array = faulty(ARRAYS[name], "all")
    fed = np.eye(array.size, dtype=complex)
    carried = array.carried(fed)  # currents for a unit input in each channel
    pristine = replace(array, live=None, coupling=None, channel_error=None)
    heard = steering_matrix(pristine, AHEAD).T @ carried
    np.testing.assert_allclose(steering_matrix(array, AHEAD), heard.T, atol=1e-12)
