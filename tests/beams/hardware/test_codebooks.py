"""Codebooks against direct sums, exact sets for lines, and random draws against the
candidate sets."""

import cmath
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support import examples

from companion.beams.array import steering
from companion.beams.array.elements import Element, ElementPattern
from companion.beams.array.geometry import Array, listed, uniform_circular
from companion.beams.array.geometry import uniform_linear as line
from companion.beams.array.geometry import uniform_rectangular as grid
from companion.beams.hardware import codebooks
from companion.beams.hardware.codebooks import (
    Codebook,
    NextBest,
    best,
    candidates,
    dft,
    next_best,
    strongest_first,
)
from companion.values import FloatArray

EYE = np.eye(3)
GPP = Element(ElementPattern.TR38901)
COSINE = Element(ElementPattern.COSINE, 1.0)
LINE = line(16, 30e9, spacing_wavelengths=0.5, array_from_body=EYE, element=GPP)
GRID = grid(4, columns=6, frequency_hz=30e9, spacing_wavelengths=0.5, array_from_body=EYE)
CIRCLE = uniform_circular(12, 30e9, spacing_wavelengths=0.5, array_from_body=EYE, element=GPP)
CLOUD = listed(np.random.default_rng(8).uniform(-0.015, 0.015, (10, 3)), 30e9, array_from_body=EYE)


def drawn(array: Array, beams: int, seed: int = 1) -> Codebook:
    rng = np.random.default_rng(seed)
    weights = rng.standard_normal((2, array.size, beams)).T @ [1, 1j]
    return codebooks.listed(weights.T, array)


def around(array: Array, beams: int) -> Codebook:
    """Return beams matched to directions all around the horizon."""
    angles = 2 * np.pi * np.arange(beams) / beams
    directions = np.stack([np.cos(angles), np.sin(angles), np.zeros(beams)], axis=1)
    return codebooks.listed(steering.steering_matrix(array, directions).conj(), array)


BOOKS = {
    "line": (LINE, dft(LINE)),
    "line, oversampled": (LINE, dft(LINE, 4)),
    "line, at random": (LINE, drawn(LINE, 40)),
    "grid": (GRID, dft(GRID)),
    "grid, oversampled": (GRID, dft(GRID, 2)),
    "grid, at random": (GRID, drawn(GRID, 40)),
    "circle": (CIRCLE, around(CIRCLE, 24)),
    "circle, at random": (CIRCLE, drawn(CIRCLE, 20)),
    "cloud, at random": (CLOUD, drawn(CLOUD, 30)),
}


def unit(rng: np.random.Generator) -> FloatArray:
    made = rng.standard_normal(3)
    direction: FloatArray = made / np.linalg.norm(made)
    return direction


def within(
    direction: FloatArray, bound_rad: float, rng: np.random.Generator, count: int
) -> FloatArray:
    """Return unit directions within an angle of one; every second one lies on the rim."""
    aside = np.cross(direction, rng.standard_normal((count, 3)))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    off = bound_rad * np.where(np.arange(count) % 2, np.sqrt(rng.uniform(size=count)), 1.0)
    return np.cos(off)[:, np.newaxis] * direction + np.sin(off)[:, np.newaxis] * aside


def in_plane(sine: float) -> FloatArray:
    """Return the horizontal direction whose sine off boresight, to the right, is given."""
    return np.array([math.sqrt(1 - sine * sine), sine, 0.0])


# --- contents of a codebook ----------------------------------------------------------------------


@pytest.mark.parametrize("oversampling", [1, 3])
def test_dft_beams_of_a_line_point_at_their_grid_sines(oversampling: int) -> None:
    """Full gain M at sine 2k/K, wrapped; without oversampling a null at every other grid sine."""
    array = line(8, 30e9, spacing_wavelengths=0.5, array_from_body=EYE)
    book = dft(array, oversampling)
    beams = 8 * oversampling
    assert (book.kind, book.size, book.weights.shape) == ("dft", beams, (8, beams))
    sines = [2 * k / beams - (2 if k > beams / 2 else 0) for k in range(beams)]
    directions = np.array([in_plane(sine) for sine in sines])
    received = np.abs(steering.steering_matrix(array, directions).T @ book.weights) ** 2
    assert np.diag(received) == pytest.approx(np.full(beams, 8.0))
    if oversampling == 1:
        assert received - np.diag(np.diag(received)) == pytest.approx(np.zeros((8, 8)), abs=1e-20)


@pytest.mark.parametrize(("rows", "columns", "oversampling"), [(3, 4, 1), (2, 3, 2), (5, 1, 2)])
def test_dft_beams_of_a_grid_are_products_of_line_beams(
    rows: int, columns: int, oversampling: int
) -> None:
    """Element (r, c) is r columns + c, beam (kz, ky) is kz Ky + ky; a single column has Ky = 1."""
    book = dft(
        grid(
            rows, columns=columns, frequency_hz=30e9, spacing_wavelengths=0.5, array_from_body=EYE
        ),
        oversampling,
    )
    down = rows * oversampling
    across = columns * oversampling if columns > 1 else 1
    assert book.size == down * across
    for r in range(rows):
        for c in range(columns):
            for kz in range(down):
                for ky in range(across):
                    turns = r * kz / down + c * ky / across
                    expected = cmath.exp(-2j * math.pi * turns) / math.sqrt(rows * columns)
                    found = book.weights[r * columns + c, kz * across + ky]
                    assert found == pytest.approx(expected, abs=1e-12)


def test_beams_have_unit_power() -> None:
    for _, book in BOOKS.values():
        assert np.linalg.norm(book.weights, axis=0) == pytest.approx(np.ones(book.size))


def test_a_listed_beam_keeps_its_direction() -> None:
    weights = np.array([[3, 0, 1e-200j], [4j, 5, 0]])
    book = codebooks.listed(weights, line(2, 1e9, spacing_wavelengths=0.5, array_from_body=EYE))
    assert book.kind == "listed"
    assert book.weights == pytest.approx(np.array([[0.6, 0, 1j], [0.8j, 1, 0]]))


@pytest.mark.parametrize("array", [CIRCLE, CLOUD])
def test_dft_codebook_requires_a_grid_array(array: Array) -> None:
    with pytest.raises(ValueError, match=f"kind {array.kind}"):
        dft(array)


def test_invalid_codebook_is_rejected() -> None:
    with pytest.raises(ValueError, match="oversampling"):
        dft(LINE, 0)
    for weights, message in [
        (np.ones((15, 2)), "shape"),
        (np.ones(16), "shape"),
        (np.ones((16, 0)), "codebook has no beam"),
        (np.full((16, 2), np.inf), "finite"),
        (np.eye(16) * (np.arange(16) != 5), "column 5"),
        (np.eye(16) * 1e305, "not between 1e-300"),
        (np.eye(16) * 5e-324, "not between 1e-300"),
    ]:
        with pytest.raises(ValueError, match=message):
            codebooks.listed(weights.astype(complex), LINE)


# --- best beam -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(BOOKS))
def test_best_beam_maximises_received_power(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compared with direct sums, also when computed in blocks."""
    array, book = BOOKS[name]
    rng = np.random.default_rng(3)
    directions = np.array([unit(rng) for _ in range(9)])
    indices, gains = best(book, array, directions)
    for n, direction in enumerate(directions):
        a = steering.steering_matrix(array, direction[np.newaxis])[:, 0]
        powers = [
            abs(sum(a[m] * book.weights[m, k] for m in range(array.size))) ** 2
            for k in range(book.size)
        ]
        assert indices[n] == np.argmax(powers)
        assert gains[n] == pytest.approx(max(powers))
    monkeypatch.setattr(codebooks, "BLOCK", 2 * book.size)
    again, same = best(book, array, directions)
    assert (again == indices).all()
    assert same == pytest.approx(gains)


def test_beams_behind_elements_are_ranked_without_the_element_pattern() -> None:
    array = line(8, 30e9, spacing_wavelengths=0.5, array_from_body=EYE, element=COSINE)
    indices, gains = best(dft(array), array, np.array([[-0.8, 0.6, 0.0], [0.8, 0.6, 0.0]]))
    assert indices[0] == indices[1] == 2
    assert gains[0] == 0 < gains[1]


# --- candidates ----------------------------------------------------------------------------------


@settings(max_examples=examples(180), deadline=None)
@given(
    st.sampled_from(sorted(BOOKS)),
    st.floats(math.log(1e-6), math.log(60)).map(math.exp),
    st.integers(0, 2**32 - 1),
)
@example("line", 180.0, 0)
@example("circle", 120.0, 1)
@example("grid", 0.0, 2)
def test_candidates_include_the_best_beam_of_every_direction_in_bound(
    name: str, bound_deg: float, seed: int
) -> None:
    """Bounds up to 60 degrees and beyond; 80 directions each, half of them on the rim."""
    array, book = BOOKS[name]
    rng = np.random.default_rng(seed)
    direction, bound_rad = unit(rng), math.radians(bound_deg)
    found = candidates(book, array, direction, bound_rad)
    assert (np.diff(found) > 0).all()
    true, _ = best(book, array, within(direction, bound_rad, rng, 80))
    assert set(true) <= set(found)


@settings(max_examples=examples(80), deadline=None)
@given(st.sampled_from(sorted(BOOKS)), st.floats(-9, -1), st.integers(0, 2**32 - 1))
def test_candidates_include_beam_that_is_best_only_at_the_rim(
    name: str, exponent: float, seed: int
) -> None:
    """The rim lies just past the border between two beams, found by bisection."""
    array, book = BOOKS[name]
    rng = np.random.default_rng(seed)
    start, end = unit(rng), unit(rng)

    def along(share: float) -> FloatArray:
        mixed = (1 - share) * start + share * end
        direction: FloatArray = mixed / np.linalg.norm(mixed)
        return direction

    low, high = 0.0, 1.0
    first = best(book, array, along(low)[np.newaxis])[0][0]
    if best(book, array, along(high)[np.newaxis])[0][0] == first:
        return
    for _ in range(40):
        middle = (low + high) / 2
        same = best(book, array, along(middle)[np.newaxis])[0][0] == first
        low, high = (middle, high) if same else (low, middle)
    other = best(book, array, along(high)[np.newaxis])[0][0]
    predicted = along(high - 10**exponent)
    bound_rad = 2 * math.asin(np.linalg.norm(along(high) - predicted) / 2) * (1 + 1e-9)
    assert other in candidates(book, array, predicted, bound_rad)


@pytest.mark.parametrize("oversampling", [1, 2, 4])
@pytest.mark.parametrize("bound_deg", [0.01, 0.5, 3.0, 12.0, 50.0])
def test_linear_array_candidates_are_nearly_minimal(oversampling: int, bound_deg: float) -> None:
    """A line needs the beams nearest to some sine in the cone. At most one extra beam at each end
    is swept; for most directions none is."""
    book = dft(LINE, oversampling)
    more = []
    rng = np.random.default_rng(7)
    for _ in range(20):
        direction = unit(rng)
        off, bound_rad = math.acos(direction[1]), math.radians(bound_deg)
        sines = np.cos(np.linspace(max(off - bound_rad, 0), min(off + bound_rad, np.pi), 40000))
        needed = set((np.round(sines * book.size / 2) % book.size).astype(int).tolist())
        found = set(candidates(book, LINE, direction, bound_rad).tolist())
        assert needed <= found
        more.append(len(found) - len(needed))
    assert max(more) <= 2
    assert np.median(more) == 0


@pytest.mark.parametrize("name", ["grid", "grid, oversampled", "circle", "cloud, at random"])
def test_candidates_of_other_arrays_are_nearly_minimal(name: str) -> None:
    array, book = BOOKS[name]
    rng = np.random.default_rng(9)
    for bound_deg in (0.5, 4.0, 15.0):
        direction, bound_rad = unit(rng), math.radians(bound_deg)
        seen = set(best(book, array, within(direction, bound_rad, rng, 20000))[0].tolist())
        found = set(candidates(book, array, direction, bound_rad).tolist())
        assert seen <= found
        assert len(found) <= len(seen) + 2


def test_unbounded_direction_makes_every_beam_a_candidate() -> None:
    found = candidates(dft(LINE), LINE, np.array([1.0, 0, 0]), None)
    assert (found == np.arange(16)).all()


def test_common_element_pattern_does_not_change_candidates() -> None:
    plain = line(16, 30e9, spacing_wavelengths=0.5, array_from_body=EYE)
    rng = np.random.default_rng(2)
    for bound_rad in (0.01, 0.3):
        direction = unit(rng)
        found = candidates(dft(LINE), LINE, direction, bound_rad)
        assert (found == candidates(dft(plain), plain, direction, bound_rad)).all()


def test_candidates_include_sharp_beam_beside_broad_beam() -> None:
    """One beam uses all elements, the other only the middle one. At the predicted direction the
    sharp beam is weaker and flat, on top of a side lobe: only its curvature shows that it is
    best elsewhere in the cone."""
    sharp = steering.steering_matrix(LINE, in_plane(0.37)[np.newaxis]).conj()
    broad = np.eye(16)[:, 7:8]
    book = codebooks.listed(np.concatenate([broad, sharp], axis=1), LINE)
    for lobe in (1.4303, 2.459, 3.4709):  # distance from the peak, in peak-to-null widths
        sine = 0.37 - 2 * lobe / 16
        bound_rad = math.asin(0.37) - math.asin(sine)
        assert list(candidates(book, LINE, in_plane(sine), bound_rad)) == [0, 1]


@pytest.mark.parametrize("name", BOOKS)
def test_sweep_order_starts_with_the_strongest_beam(name: str) -> None:
    """Also behind the elements, where their pattern is practically zero."""
    array, book = BOOKS[name]
    rng = np.random.default_rng(4)
    for _ in range(20):
        towards = unit(rng)
        held = candidates(book, array, towards, 0.2)
        order = strongest_first(book, array, towards, held)
        assert sorted(order) == held.tolist()
        assert order[0] == best(book, array, towards[np.newaxis])[0][0]
        gains = np.abs(book.weights.T @ steering.steering_matrix(array, towards[np.newaxis])) ** 2
        assert (np.diff(gains[order, 0]) <= 1e-12 + 1e-9 * gains.max()).all()


def test_duplicate_beams_are_all_candidates_within_bounded_work() -> None:
    weights = np.repeat(dft(GRID).weights, 2, axis=1)
    twice = codebooks.listed(weights, GRID)
    found = candidates(twice, GRID, in_plane(0.3), 0.05)
    once = candidates(dft(GRID), GRID, in_plane(0.3), 0.05)
    assert set(found) == {2 * k + i for k in once for i in (0, 1)}


def test_candidates_are_a_superset_when_work_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    full = {name: candidates(book, a, in_plane(0.4), 0.2) for name, (a, book) in BOOKS.items()}
    monkeypatch.setattr(codebooks, "RESPONSES_MAX", 1)
    monkeypatch.setattr(codebooks, "BLOCK", 64)
    for name, (array, book) in BOOKS.items():
        assert set(full[name]) <= set(candidates(book, array, in_plane(0.4), 0.2))


def test_invalid_cone_is_rejected() -> None:
    for direction, bound_rad, message in [
        (np.array([1.0, 1, 0]), 0.1, "unit"),
        (np.array([1.0, 0]), 0.1, "three"),
        (np.array([1.0, 0, 0]), -0.1, "pointing bound"),
    ]:
        with pytest.raises(ValueError, match=message):
            candidates(dft(LINE), LINE, direction, bound_rad)


# --- next beam -----------------------------------------------------------------------------------


def turning(from_rad: float, rate_radps: float) -> Callable[[FloatArray], FloatArray]:
    """Return horizontal directions whose azimuth grows with time."""

    def directions_at(times_s: FloatArray) -> FloatArray:
        azimuth = from_rad + rate_radps * times_s
        return np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(len(azimuth))], axis=1)

    return directions_at


@pytest.mark.parametrize("oversampling", [1, 4])
@pytest.mark.parametrize("rate_radps", [0.05, -0.05, 0.7])
def test_next_beam_time_matches_closed_form_of_a_line(oversampling: int, rate_radps: float) -> None:
    """Beams of a half-wave line change at sines (2k + 1) / K, so the time has a closed form."""
    book = dft(LINE, oversampling)
    start_rad = 0.3
    k = round(math.sin(start_rad) * book.size / 2)
    border = (2 * k + math.copysign(1, rate_radps)) / book.size
    after_s = (math.asin(border) - start_rad) / rate_radps
    step_s = codebooks.sampling_step_s(book, LINE, rate_radps)
    assert step_s is not None
    found = next_best(book, LINE, turning(start_rad, rate_radps), 10.0, step_s)
    assert found.index == k
    assert found.next_index == k + int(math.copysign(1, rate_radps))
    assert found.after_s is not None
    assert 0 <= found.after_s - after_s <= 1.001e-3


def test_no_next_beam_is_reported_beyond_the_horizon() -> None:
    book = dft(LINE)
    assert next_best(book, LINE, turning(0.0, 0.01), 1.0, 0.1) == NextBest(0, None, None)
    # The border at sine 1/16 is crossed after 0.06254 s: the horizon itself is included.
    assert next_best(book, LINE, turning(0.0, 1.0), 0.0620, 1.0) == NextBest(0, None, None)
    found = next_best(book, LINE, turning(0.0, 1.0), 0.0630, 1.0)
    assert found.next_index == 1
    assert found.after_s == pytest.approx(0.06254, abs=1e-3)


def test_too_long_sampling_step_skips_beams() -> None:
    """The documented limit: with the sampling step for its rate, no beam is skipped."""
    book, path = dft(LINE, 2), turning(-1.0, 0.5)
    step_s = codebooks.sampling_step_s(book, LINE, 0.5)
    assert step_s is not None
    short, long = (next_best(book, LINE, path, 3.0, s) for s in (step_s, 2.5))
    now = best(book, LINE, path(np.array([0.0])))[0][0]
    assert short.index == long.index == now
    assert short.next_index == now + 1
    assert short.after_s is not None
    assert long.after_s is not None
    assert short.after_s <= long.after_s
    there = best(book, LINE, path(np.array([long.after_s])))[0][0]
    assert long.next_index == there != now


def test_sampling_step_is_a_quarter_beam() -> None:
    """Sixteen half-wave elements span 7.5 wavelengths."""
    assert codebooks.sampling_step_s(dft(LINE), LINE, -0.5) == pytest.approx(1 / 7.5 / 0.5 / 4)
    assert codebooks.sampling_step_s(dft(LINE, 4), LINE, 0.5) == pytest.approx(1 / 30 / 0.5 / 4)
    assert codebooks.sampling_step_s(dft(LINE), LINE, 0.0) is None
    one = line(1, 1e9, spacing_wavelengths=0.5, array_from_body=EYE)
    assert codebooks.sampling_step_s(dft(one), one, 1.0) is None


@pytest.mark.parametrize(
    ("horizon_s", "step_s"), [(0.0, 0.1), (1.0, 0.0), (math.inf, 0.1), (math.nan, 0.1), (1, -1)]
)
def test_invalid_horizon_or_step_is_rejected(horizon_s: float, step_s: float) -> None:
    with pytest.raises(ValueError, match="horizon"):
        next_best(dft(LINE), LINE, turning(0.0, 1.0), horizon_s, step_s)
