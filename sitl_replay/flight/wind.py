"""Turbulence, and its effect on a vehicle that holds its position: closed forms in time.

The Dryden spectra of MIL-F-8785C (also MIL-HDBK-1797), one-sided over ω > 0 in rad/s, with σ the
intensity, L the scale length and V the airspeed; along the mean wind, and across it and vertical:

    Φ_u(ω) = 2σ²L/(πV) · 1 / (1 + x²)                       x = Lω/V
    Φ_v(ω) =  σ²L/(πV) · (1 + 3x²) / (1 + x²)²              Φ_w the same

A sum of sines approximates such a spectrum if each sine has the power of its band; with phases from
a seed it is a pure function of time, with exact derivatives.
"""

import cmath
import math
from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from typing import Final, NamedTuple

import numpy as np

from companion.values import FloatArray
from sitl_replay.flight.motion import Motion, Vector

METRES_PER_FOOT: Final = 0.3048
# The low-altitude model is valid from 10 to 1000 feet above the ground.
LOWEST_FT: Final = 10.0
HIGHEST_FT: Final = 1000.0

# One sine in each band between these x = Lω/V. Less than 3 % of the power is outside.
BANDS: Final = 16
LOWEST_X: Final = 0.03
HIGHEST_X: Final = 100.0


class Turbulence(NamedTuple):
    """Turbulence: intensities and scale lengths along the mean wind, across it, and vertical."""

    sigma_mps: Vector
    length_m: Vector
    airspeed_mps: float


class Hold(NamedTuple):
    """Position control of a vehicle in wind: d̈ = (w − ḋ)/drag_s − 2ζω ḋ − ω² d.

    d is the displacement and w the gust, both along one axis; ``drag_s`` is the time constant of
    the drag, ω = ``natural_radps`` and ζ = ``damping`` those of the control loop.
    """

    natural_radps: float
    damping: float
    drag_s: float

    def response(self, omega_radps: float) -> complex:
        """Return the displacement in metres for a gust of 1 m/s at a frequency."""
        s = 1j * omega_radps
        drag_hz = 1.0 / self.drag_s
        loop_hz = 2.0 * self.damping * self.natural_radps
        return drag_hz / (s * s + (loop_hz + drag_hz) * s + self.natural_radps**2)


@dataclass(frozen=True, slots=True, eq=False)
class Sines:
    """Sums of sines for each of three axes, Σ a sin(ωt + φ); arrays of (3, ``BANDS``)."""

    amplitude: FloatArray
    omega_radps: FloatArray
    phase_rad: FloatArray

    def __call__(self, t_s: float) -> tuple[FloatArray, FloatArray]:
        """Return the three sums and their time derivatives."""
        angle_rad = self.omega_radps * t_s + self.phase_rad
        slope = self.amplitude * self.omega_radps
        return (
            (self.amplitude * np.sin(angle_rad)).sum(axis=1),
            (slope * np.cos(angle_rad)).sum(axis=1),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Displacement:
    """Displacement of a vehicle from its path by gusts.

    ``wind_rad``: direction the wind blows to.
    """

    sines: Sines
    wind_rad: float

    def __call__(self, t_s: float) -> Motion:
        """Return the displacement in metres and its rate in m/s, NED."""
        offset_m, rate_mps = self.sines(t_s)
        return Motion(self._ned(offset_m), self._ned(rate_mps))

    def _ned(self, along_across_down: FloatArray) -> Vector:
        along, across, down = map(float, along_across_down)
        cosine, sine = math.cos(self.wind_rad), math.sin(self.wind_rad)
        return (along * cosine - across * sine, along * sine + across * cosine, down)


def low_altitude(height_m: float, wind_mps: float, airspeed_mps: float) -> Turbulence:
    """Return the turbulence at a height above ground, for a mean wind at 20 feet (6 m).

    MIL-F-8785C, with h in feet: L_w = h, L_u = L_v = h / (0.177 + 0.000823 h)^1.2, σ_w = 0.1 of the
    wind, σ_u = σ_v = σ_w / (0.177 + 0.000823 h)^0.4. Heights are limited to 10 to 1000 feet.
    """
    height_ft = min(max(height_m / METRES_PER_FOOT, LOWEST_FT), HIGHEST_FT)
    shape = 0.177 + 0.000823 * height_ft
    vertical_m = height_ft * METRES_PER_FOOT
    level_m = vertical_m / shape**1.2
    vertical_mps = 0.1 * wind_mps
    level_mps = vertical_mps / shape**0.4
    return Turbulence(
        (level_mps, level_mps, vertical_mps), (level_m, level_m, vertical_m), airspeed_mps
    )


def power_along(x: float) -> float:
    """Return the share of the power of Φ_u below x = Lω/V: its integral over σ²."""
    return 2.0 / math.pi * math.atan(x)


def power_across(x: float) -> float:
    """Return the share of the power of Φ_v and Φ_w below x = Lω/V: their integral over σ²."""
    return (2.0 * math.atan(x) - x / (1.0 + x * x)) / math.pi


def gusts(turbulence: Turbulence, rng: Random) -> Sines:
    """Return gust velocities in m/s, along the mean wind, across it, down: a sine per band.

    Each sine has the power of its band, at a frequency drawn from the spectrum within it: the
    average over many draws is the Dryden spectrum.
    """
    ratio = HIGHEST_X / LOWEST_X
    amplitude, omega_radps, phase_rad = np.zeros((3, 3, BANDS))
    for axis, share in enumerate((power_along, power_across, power_across)):
        unit_radps = turbulence.airspeed_mps / turbulence.length_m[axis]
        for band in range(BANDS):
            low_x = LOWEST_X * ratio ** (band / BANDS)
            high_x = LOWEST_X * ratio ** ((band + 1) / BANDS)
            below, power = share(low_x), share(high_x) - share(low_x)
            amplitude[axis, band] = turbulence.sigma_mps[axis] * math.sqrt(2.0 * power)
            x = _where(share, below + power * rng.random(), low_x, high_x)
            omega_radps[axis, band] = unit_radps * x
            phase_rad[axis, band] = rng.uniform(0.0, math.tau)
    return Sines(amplitude, omega_radps, phase_rad)


def _where(share: Callable[[float], float], wanted: float, low_x: float, high_x: float) -> float:
    """Return the x at which an increasing ``share`` is ``wanted``, by bisection to 1e-6."""
    for _ in range(20):
        middle_x = (low_x + high_x) / 2.0
        if share(middle_x) < wanted:
            low_x = middle_x
        else:
            high_x = middle_x
    return low_x


def displaced(wind: Sines, hold: Hold) -> Sines:
    """Return the steady-state displacement in metres of a vehicle with ``hold`` in ``wind``."""
    responses = [[hold.response(float(omega)) for omega in axis] for axis in wind.omega_radps]
    polar = np.array([[cmath.polar(response) for response in axis] for axis in responses])
    return Sines(wind.amplitude * polar[:, :, 0], wind.omega_radps, wind.phase_rad + polar[:, :, 1])
