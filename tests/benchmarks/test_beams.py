"""Beams against optima and against sharp ones, as ratios within one run: ``make bench``."""

import time

import numpy as np
import pytest
import tracks
from figures import Figures
from scipy.optimize import linprog, minimize

from companion.beams.aim import aim
from companion.beams.array.geometry import uniform_linear, uniform_rectangular
from companion.beams.weights import shapes
from companion.beams.weights.precoding import Precoder, Radio, precode
from companion.values import (
    Carrier,
    ComplexArray,
    FloatArray,
    Method,
    Normalisation,
    Policy,
    Power,
    Track,
    Widen,
)

pytestmark = pytest.mark.benchmark
STILL = np.zeros(3)
AT = Carrier(
    valid_at_ns=0,
    position_ned_m=STILL,
    velocity_ned_mps=STILL,
    body_from_local=np.eye(3),
    body_rates_radps=STILL,
    bound_m=0.0,
    attitude_bound_rad=0.05,
    age_s=None,
)


def most_db(width: float, elements: int) -> float:
    """Upper limit of the minimum gain with free amplitudes: a linear programme over
    autocorrelations."""
    u = np.union1d(np.linspace(0, elements / 2, 8 * elements + 1), np.linspace(0, width, 200))
    cosines = 2 * np.cos(2 * np.pi * np.outer(u, np.arange(1, elements)) / elements)
    rows = np.c_[-cosines, u <= width]
    bounds = [(None, None)] * (elements - 1) + [(0, None)]
    found = linprog(np.r_[np.zeros(elements - 1), -1], rows, np.ones(len(u)), bounds=bounds)
    return 10 * float(np.log10(found.x[-1]))


@pytest.mark.parametrize("elements", [16, 64, 256])
def test_linear_array_beam_shapes_against_free_amplitudes(elements: int) -> None:
    across = shapes.aperture(
        uniform_linear(elements, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3))
    )
    print(f"\nline of {elements}: least gain, less that of the best amplitudes, dB")
    for width in (0.25, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0):
        if width > 0.375 * elements:
            continue
        (phases,) = shapes.phases_rad(across, np.array([[width]]), None)
        u = np.linspace(-width, width, 2001)
        field = np.exp(2j * np.pi * np.outer(u, np.arange(elements) / elements) + 1j * phases)
        least = 10 * np.log10((np.abs(field.sum(axis=1)) ** 2).min() / elements)
        # Optima relative to the element count do not depend on it, except for short arrays.
        best = most_db(width, min(elements, 64)) + 10 * np.log10(elements / min(elements, 64))
        print(f"  w = {width:5}: {least:6.2f}, {least - best:+.2f}")
        assert least > best - 4.5


def climbed(phases: FloatArray, response: ComplexArray) -> FloatArray:
    """Phases at a local maximum of the minimum gain, found with softened minima first."""

    def cost(at: FloatArray, sharpness: float) -> tuple[float, FloatArray]:
        radiated = np.exp(1j * at)
        field = response @ radiated
        gain = np.maximum(np.abs(field) ** 2 / len(at), 1e-12)
        steep = -sharpness * np.log(gain)
        parts = np.exp(steep - steep.max())
        share = -parts / parts.sum() / gain
        slope = 2 / len(at) * np.real(1j * radiated * ((share * field.conj()) @ response))
        return float(steep.max() + np.log(parts.sum())) / sharpness, slope

    for sharpness in (1.0, 3.0, 8.0, 20.0, 60.0, 150.0):
        limits = {"maxiter": 400}
        phases = minimize(cost, phases, sharpness, "L-BFGS-B", jac=True, options=limits).x
    return phases


@pytest.mark.parametrize("elements", [8, 16])
def test_planar_array_beam_shapes_against_a_search(elements: int) -> None:
    across = shapes.aperture(
        uniform_rectangular(
            elements,
            columns=elements,
            frequency_hz=30e9,
            spacing_wavelengths=0.5,
            array_from_body=np.eye(3),
        )
    )
    rng = np.random.default_rng(1)
    print(f"\n{elements} x {elements}: least gain, less that of a search from there, dB")
    for width in (0.25, 0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0):
        if width > 0.375 * elements:
            continue
        side = np.linspace(-width, width, 41)
        inner = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
        turns = np.linspace(0, 2 * np.pi, 120)
        rim = width * np.stack([np.cos(turns), np.sin(turns)], axis=1)
        places = np.concatenate([inner[np.hypot(*inner.T) < width], rim])
        response = np.exp(2j * np.pi * places @ across.placed.T)
        (ours,) = shapes.phases_rad(across, np.array([[width, width]]), None)
        begins = [ours, *(ours + rng.normal(0, 0.3, len(ours)) for _ in range(3))]
        made = [climbed(begin, response) for begin in begins]
        found = [np.abs(response @ np.exp(1j * each)).min() for each in made]
        least = 20 * np.log10(np.abs(response @ np.exp(1j * ours)).min() / elements)
        best = 20 * np.log10(max(found) / elements)
        print(f"  w = {width:5}: {least:6.2f}, {least - best:+.2f}")
        assert least > best - 4.5


def line_users(seed: int, elements: int, users: int) -> ComplexArray:
    sines = np.random.default_rng(seed).uniform(-0.9, 0.9, users)
    made: ComplexArray = np.exp(1j * np.pi * np.outer(np.arange(elements), sines))
    return made


def sinr(a: ComplexArray, weights: ComplexArray, snr: FloatArray) -> FloatArray:
    received = snr[:, np.newaxis] * np.abs(a.T @ weights) ** 2
    own = received.diagonal()
    found: FloatArray = own / (1 + received.sum(axis=1) - own)
    return found


def fixed_point(a: ComplexArray, snr: FloatArray) -> float:
    """The max-min optimum of all linear precoders, by duality."""
    users = a.shape[1]
    channels, share = np.sqrt(snr) * a, np.full(users, 1 / users)
    for _ in range(400):
        inverse = np.linalg.inv(np.eye(len(a)) + (channels.conj() * share) @ channels.T)
        seen = np.einsum("mn,mk,kn->n", channels, inverse, channels.conj()).real
        alone = seen / (1 - share * seen)
        share = (1 / alone) / (1 / alone).sum()
    return float((share * alone).min())


def wmmse(a: ComplexArray, snr: FloatArray) -> float:
    """The sum rate reached by WMMSE over whole beams."""
    h = (np.sqrt(snr) * a).T  # rows are channels
    v = h.conj().T / np.linalg.norm(h)
    for _ in range(100):
        field = h @ v
        heard = 1 * np.sum(np.abs(v) ** 2) + np.sum(np.abs(field) ** 2, axis=1)
        u = field.diagonal().conj() / heard
        w = 1 / np.maximum(1 - (u * field.diagonal()).real, 1e-12)
        pull = w * np.abs(u) ** 2
        loaded = (h.conj().T * pull) @ h + pull.sum() * np.eye(h.shape[1])
        v = np.linalg.solve(loaded, h.conj().T * (w * u.conj()))
    return float(np.log2(1 + sinr(a, v / np.linalg.norm(v), snr)).sum())


@pytest.mark.parametrize(("elements", "users"), [(64, 4), (64, 16), (64, 64), (256, 16), (256, 64)])
def test_mmse_against_its_references(elements: int, users: int) -> None:
    a = line_users(elements + users, elements, users)
    print(f"\n{elements} x {users}: worst SINR over the optimum; sums of rates over WMMSE's")
    for snr_db in (-10, 0, 10, 20):
        snr = np.full(users, 10 ** (snr_db / 10) * users / elements)
        radio = Radio(snr, np.ones(users))

        def made(method: Method, power: Power, radio: Radio = radio) -> FloatArray:
            how = Precoder(
                method=method, normalisation=Normalisation.TOTAL, widen=Widen.NO, power=power
            )
            return sinr(a, precode(a, how, None, priorities=None, radio=radio).weights, radio.snr)

        fair = made(Method.MMSE, Power.MAX_MIN).min() / fixed_point(a, snr)
        best = wmmse(a, snr)
        rates = {
            name: float(np.log2(1 + found).sum())
            for name, found in (
                ("zf", made(Method.ZERO_FORCING, Power.EQUAL)),
                ("mmse", made(Method.MMSE, Power.EQUAL)),
                ("weighted", made(Method.MMSE, Power.WEIGHTED_SUM)),
            )
        }
        told = ", ".join(f"{name} {rate / best:.3f}" for name, rate in rates.items())
        print(f"  {snr_db:4} dB: max-min {fair:.3f}; {told}")
        assert fair >= 0.95 or users > 16
        assert rates["mmse"] >= rates["zf"] * (1 - 1e-6)


def flying(users: int, apart_rad: float) -> list[Track]:
    found = []
    for n in range(users):
        angle = (n - (users - 1) / 2) * apart_rad
        place = 100.0 * np.array([np.cos(angle), np.sin(angle), 0.0])
        found.append(
            tracks.track(place, uav=str(n), velocity_ned_mps=STILL, bound_m=5.0, error_p95_m=0.5)
        )
    return found


def took_s(how: Precoder, elements: int, users: int, apart_rad: float, rounds: int) -> float:
    array, tracks = (
        uniform_linear(elements, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3)),
        flying(users, apart_rad),
    )
    best = np.inf
    for _ in range(rounds):
        begin = time.perf_counter()
        aim(0, valid_at_ns=0, tracks=tracks, carrier=AT, array=array, precoder=how)
        best = min(best, time.perf_counter() - begin)
    return best


@pytest.mark.parametrize(("elements", "users", "most"), [(64, 4, 6.0), (256, 32, 9.0)])
def test_widened_beams_against_sharp_ones(
    elements: int, users: int, most: float, figures: Figures
) -> None:
    sharp_s = took_s(Precoder(widen=Widen.NO), elements, users, 0.05, 60)
    for widen in (Widen.LIKELY, Widen.GUARANTEE):
        wide_s = took_s(Precoder(widen=widen), elements, users, 0.05, 60)
        name = f"aim {elements}x{users}, {widen} over sharp"
        assert figures.note(name, wide_s / sharp_s, "times", "less") < most
    figures.note(f"aim {elements}x{users}, sharp", sharp_s * 1e6, "us", "less")


def test_time_slot_update_of_300_uavs(figures: Figures) -> None:
    how = Precoder(policy=Policy.GROUP, widen=Widen.NO)
    seconds = took_s(how, 64, 300, 0.008, 5)
    assert figures.note("an update of 300 UAVs in turns", seconds * 1e3, "ms", "less") < 200
