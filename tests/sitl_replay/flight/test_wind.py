"""Turbulence against the Dryden forming filters, and the hold against its differential equation."""

import math
from random import Random

import numpy as np
import pytest
from scipy import integrate, signal
from scipy.spatial.transform import Rotation
from support import rounds

from companion.values import FloatArray
from sitl_replay.flight.flights import COPTER_HOLD, PLANE_HOLD
from sitl_replay.flight.wind import (
    Displacement,
    Hold,
    Turbulence,
    displaced,
    gusts,
    low_altitude,
    power_across,
    power_along,
)

TURBULENCE = Turbulence((1.1, 0.9, 0.6), (180.0, 140.0, 50.0), 8.0)


def filter_power(axis: int, omega_radps: FloatArray) -> FloatArray:
    """|H(jω)|² of the forming filters, as MIL-F-8785C's spectra are realised:

    along σ √(2L/πV) / (1 + Ls/V); across σ √(L/πV) (1 + √3 Ls/V) / (1 + Ls/V)².
    """
    sigma, lag_s = TURBULENCE.sigma_mps[axis], TURBULENCE.length_m[axis] / TURBULENCE.airspeed_mps
    if axis == 0:
        numerator, denominator = [sigma * math.sqrt(2 * lag_s / math.pi)], [lag_s, 1.0]
    else:
        gain = sigma * math.sqrt(lag_s / math.pi)
        numerator = [gain * math.sqrt(3) * lag_s, gain]
        denominator = [lag_s**2, 2 * lag_s, 1.0]
    _, response = signal.freqs(numerator, denominator, omega_radps)
    return np.abs(response) ** 2


@pytest.mark.parametrize("axis", range(3))
def test_octave_power_matches_the_forming_filter(axis: int) -> None:
    # Sampled in time, as in a measurement: dozens of winds of 15 minutes each.
    rng = Random(5)
    step_s, steps = 0.05, 2**14
    times_s = step_s * np.arange(steps)
    power = 0.0
    winds = rounds(40, 60)
    for _ in range(winds):
        wind = gusts(TURBULENCE, rng)
        angles = np.outer(times_s, wind.omega_radps[axis]) + wind.phase_rad[axis]
        series = np.sin(angles) @ wind.amplitude[axis]
        f_hz, one = signal.periodogram(series, 1 / step_s, window="hann", detrend=False)
        power += one / math.tau / winds
    omega_radps = math.tau * f_hz
    highest_radps = 100.0 * TURBULENCE.airspeed_mps / TURBULENCE.length_m[axis]
    octaves = [low for low in 2.0 ** np.arange(-4, 4) if 2 * low <= highest_radps]
    assert len(octaves) >= 6
    for low in octaves:
        band = (omega_radps >= low) & (omega_radps < 2 * low)
        fine = np.linspace(low, 2 * low, 200)
        meant = integrate.trapezoid(filter_power(axis, fine), fine)
        assert np.sum(power[band]) * omega_radps[1] == pytest.approx(meant, rel=0.2)


@pytest.mark.parametrize("axis", range(3))
def test_total_power_is_the_squared_intensity(axis: int) -> None:
    wind = gusts(TURBULENCE, Random(1))
    power = float(np.sum(wind.amplitude[axis] ** 2) / 2)
    assert power == pytest.approx(TURBULENCE.sigma_mps[axis] ** 2, rel=0.03)
    assert power < TURBULENCE.sigma_mps[axis] ** 2


@pytest.mark.parametrize("x", [0.1, 1.0, 7.0])
def test_power_shares_are_integrals_of_the_spectra(x: float) -> None:
    along, _ = integrate.quad(lambda u: 2 / math.pi / (1 + u**2), 0, x)
    across, _ = integrate.quad(lambda u: (1 + 3 * u**2) / (1 + u**2) ** 2 / math.pi, 0, x)
    assert power_along(x) == pytest.approx(along)
    assert power_across(x) == pytest.approx(across)
    assert power_along(1e9) == pytest.approx(1.0) == pytest.approx(power_across(1e9))


def test_low_altitude_lengths_and_intensities() -> None:
    # Hand calculation at 100 feet: shape 0.177 + 0.0823 = 0.2593; its powers 1.2 and 0.4.
    calm = low_altitude(30.48, 10.0, 15.0)
    assert calm.length_m == pytest.approx((153.99, 153.99, 30.48), rel=1e-3)
    assert calm.sigma_mps == pytest.approx((1.7159, 1.7159, 1.0), rel=1e-3)
    assert calm.airspeed_mps == 15.0
    # At 1000 feet the three are equal, as they are above.
    high = low_altitude(304.8, 10.0, 15.0)
    assert high.length_m == pytest.approx((304.8,) * 3, rel=1e-3)
    assert low_altitude(900.0, 10.0, 15.0) == high
    assert low_altitude(0.0, 10.0, 15.0) == low_altitude(3.048, 10.0, 15.0)


@pytest.mark.parametrize("hold", [COPTER_HOLD, PLANE_HOLD, Hold(1.5, 0.4, 0.5)])
def test_displacement_solves_the_position_hold_equation(hold: Hold) -> None:
    wind = gusts(TURBULENCE, Random(2))
    moved = displaced(wind, hold)
    start_m, start_mps = moved(0.0)

    def slope(t_s: float, state: FloatArray) -> FloatArray:
        offset, rate = state[:3], state[3:]
        push = (wind(t_s)[0] - rate) / hold.drag_s
        brake = 2 * hold.damping * hold.natural_radps * rate + hold.natural_radps**2 * offset
        return np.concatenate([rate, push - brake])

    solved = integrate.solve_ivp(
        slope, (0.0, 12.0), np.concatenate([start_m, start_mps]), rtol=1e-8, atol=1e-8
    )
    assert np.concatenate(moved(12.0)) == pytest.approx(solved.y[:, -1], abs=1e-5)


@pytest.mark.parametrize("course_deg", [0, 37, 90, 200])
def test_displacement_is_rotated_to_the_wind_direction(course_deg: int) -> None:
    sines = displaced(gusts(TURBULENCE, Random(3)), COPTER_HOLD)
    along_north = Rotation.from_euler("z", course_deg, degrees=True)
    moved = Displacement(sines, math.radians(course_deg))(4.0)
    for read, meant in zip(moved, sines(4.0), strict=True):
        assert read == pytest.approx(along_north.apply(meant))


def test_winds_are_determined_by_the_seed() -> None:
    one, same, other = (gusts(TURBULENCE, Random(seed)) for seed in (1, 1, 2))
    assert np.array_equal(one(3.0), same(3.0))
    assert not np.isclose(one(3.0)[0], other(3.0)[0]).any()
