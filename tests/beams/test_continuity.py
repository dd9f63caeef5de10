"""Beams are continuous in direction: the largest change of a sweep, refined down to rounding."""

import itertools

import numpy as np
import pytest
import tracks
from support import rounds

from companion.beams.aim import aim
from companion.beams.array import steering
from companion.beams.array.geometry import (
    Array,
    uniform_circular,
    uniform_linear,
    uniform_rectangular,
)
from companion.beams.weights.precoding import Precoder
from companion.values import Carrier, ComplexArray, FloatArray, Track, Widen

STILL, EYE = np.zeros(3), np.eye(3)
AT = Carrier(
    valid_at_ns=0,
    position_ned_m=STILL,
    velocity_ned_mps=STILL,
    body_from_local=EYE,
    body_rates_radps=STILL,
    bound_m=0.0,
    attitude_bound_rad=0.0,
    age_s=None,
)
ARRAYS = {
    "line": uniform_linear(64, 30e9, spacing_wavelengths=0.5, array_from_body=EYE),
    "square": uniform_rectangular(
        8, columns=8, frequency_hz=30e9, spacing_wavelengths=0.5, array_from_body=EYE
    ),
    "oblong": uniform_rectangular(
        8, columns=4, frequency_hz=30e9, spacing_wavelengths=0.5, array_from_body=EYE
    ),
    "circle": uniform_circular(16, 30e9, spacing_wavelengths=0.5, array_from_body=EYE),
}
STEPS, HALVINGS = 24, 18
"""Steps of a sweep, and halvings of its largest step: down to 0.06 microdegrees."""


class Scene:
    """Close UAVs, the first of which moves by 0.4 degrees."""

    def __init__(self, array: Array, widen: Widen, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self._array, self._how = array, Precoder(widen=widen)
        users = int(rng.integers(2, 5))
        self._angles = rng.uniform(-0.5, 0.5, 2) + np.radians(rng.uniform(-12, 12, (users, 2)))
        self._way = np.radians(rng.uniform(-0.4, 0.4, 2))
        self._bounds_m = 100.0 * np.radians(rng.uniform(1.0, 14.0, users))

    def beams(self, share: float) -> ComplexArray:
        """Return normalised columns when the first UAV has covered a share of its path."""
        angles = self._angles.copy()
        angles[0] += share * self._way
        places = 100.0 * steering.unit_directions(*angles.T)
        tracks = [track(*one) for one in zip(places, self._bounds_m.tolist(), strict=True)]
        weights = aim(
            0, valid_at_ns=0, tracks=tracks, carrier=AT, array=self._array, precoder=self._how
        ).weights
        unit: ComplexArray = weights / np.linalg.norm(weights, axis=0)
        return unit


def track(place: FloatArray, bound_m: float) -> Track:
    return tracks.track(place, uav=str(bound_m), bound_m=bound_m, error_p95_m=bound_m / 4)


def least_alike(one: ComplexArray, other: ComplexArray) -> float:
    return float(np.abs(np.einsum("mn,mn->n", one.conj(), other)).min())


@pytest.mark.parametrize("widen", [Widen.LIKELY, Widen.GUARANTEE])
@pytest.mark.parametrize("array", ARRAYS.values(), ids=ARRAYS.keys())
def test_beams_change_continuously_with_direction(array: Array, widen: Widen) -> None:
    for seed in range(rounds(8, 40)):
        scene = Scene(array, widen, seed)
        shares = np.linspace(0, 1, STEPS + 1).tolist()
        made = [scene.beams(share) for share in shares]
        alike = [least_alike(one, other) for one, other in itertools.pairwise(made)]
        worst = int(np.argmin(alike))
        ends = list(zip(shares, made, strict=True))[worst : worst + 2]
        for _ in range(HALVINGS):
            share = (ends[0][0] + ends[1][0]) / 2
            between = (share, scene.beams(share))
            first = least_alike(ends[0][1], between[1]) < least_alike(between[1], ends[1][1])
            ends = [ends[0], between] if first else [between, ends[1]]
        assert least_alike(ends[0][1], ends[1][1]) > 0.9999, seed
