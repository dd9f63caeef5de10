"""The line under all points, held against every line through any two of them."""

import math
import random
import tracemalloc

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.mavlink.clock.envelope import PIECES, SIGNIFICANT, Envelope, Point

MS = 1_000_000
S = 1_000_000_000
WINDOW_NS = 64 * S
PIECE_NS = WINDOW_NS // PIECES
LIMIT = 0.05
UNSURE = 1e-4


def mean_gap(points: list[Point], slope: float) -> float:
    """Of the line of this slope that lies under all points and touches one."""
    x0, y0 = points[0]
    above = [y - y0 - slope * (x - x0) for x, y in points]
    return math.fsum(above) / len(above) - min(above)


def brute_force(points: list[Point]) -> tuple[float, float]:
    """Slope and mean gap of the best line under all points, by the rule of significance."""
    slopes = {-LIMIT, LIMIT}
    for n, (x0, y0) in enumerate(points):
        slopes |= {(y1 - y0) / (x1 - x0) for x1, y1 in points[n + 1 :]}
    best = min((s for s in slopes if abs(s) <= LIMIT), key=lambda s: mean_gap(points, s))
    level, fitted = mean_gap(points, 0.0), mean_gap(points, best)
    gain = len(points) * math.log((level + 1e6) / (fitted + 1e6))
    return (best, fitted) if gain > SIGNIFICANT else (0.0, level)


# One point a piece: each is a sample, each lays the line anew, and the window is the last 16.
TRACKS = st.tuples(
    st.floats(-0.08, 0.08),
    st.lists(st.tuples(st.integers(1, 3), st.integers(0, 2_000)), min_size=2, max_size=50),
)


@settings(max_examples=300)
@given(TRACKS)
def test_the_best_line_under_all_points(track: tuple[float, list[tuple[int, int]]]) -> None:
    drift, steps = track
    envelope, points, x = Envelope(WINDOW_NS, LIMIT, UNSURE), [], 0
    for pieces, late_ms in steps:
        x += pieces * PIECE_NS
        points.append((x, round(drift * x) + late_ms * MS))
        envelope.add(*points[-1])
        window = points[-PIECES:]
        assert all(envelope.at(px) <= py for px, py in window)
        assert any(envelope.at(px) >= py - 1 for px, py in window)
        slope, gap = brute_force(window)
        # Two lines may be equally good, so it is not the slopes that are compared.
        assert mean_gap(window, envelope.drift) == pytest.approx(gap, rel=1e-6, abs=10.0)
        assert (envelope.drift == 0.0) == (slope == 0.0)
        assert envelope.mean_gap_ns == pytest.approx(gap, rel=1e-6, abs=10.0)


# Arrivals in order, latencies of any length: many points a piece, many of them overtaken.
ARRIVALS = st.lists(
    st.tuples(st.integers(0, 500) | st.integers(0, 9_000), st.integers(0, 6_000)),
    min_size=1,
    max_size=120,
)


def arrived(steps: list[tuple[int, int]]) -> list[Point]:
    arrival_ms, out = 100_000, []
    for gap_ms, late_ms in steps:
        arrival_ms += gap_ms
        out.append(((arrival_ms - late_ms) * MS, late_ms * MS))
    return out


@settings(max_examples=300)
@given(ARRIVALS)
def test_under_every_point_of_the_window_overtaken_or_not(steps: list[tuple[int, int]]) -> None:
    envelope, points = Envelope(WINDOW_NS, LIMIT, UNSURE), []
    for point in arrived(steps):
        envelope.add(*point)
        points.append(point)
        newest = envelope.newest_ns
        held = [p for p in points if p[0] > newest - WINDOW_NS + 2 * PIECE_NS]
        assert all(envelope.at(x) <= y for x, y in held)


@settings(max_examples=200)
@given(ARRIVALS)
def test_overtaken_frames_do_not_move_the_line(steps: list[tuple[int, int]]) -> None:
    """With level lines, for what is overtaken still counts as a latency that was seen."""
    whole, advancing = Envelope(WINDOW_NS, 0.0, 0.0), Envelope(WINDOW_NS, 0.0, 0.0)
    newest = -1
    for x, y in arrived(steps):
        whole.add(x, y)
        if x > newest:
            newest = x
            advancing.add(x, y)
        assert whole.at(x) == advancing.at(x)


@settings(max_examples=100)
@given(ARRIVALS, st.integers(-(10**18), 2 * 10**18))
def test_where_the_timelines_begin_does_not_matter(
    steps: list[tuple[int, int]], epoch_ns: int
) -> None:
    near, far = Envelope(WINDOW_NS, LIMIT, UNSURE), Envelope(WINDOW_NS, LIMIT, UNSURE)
    for x, y in arrived(steps):
        near.add(x, y)
        far.add(x, y + epoch_ns)
        assert far.at(x) == pytest.approx(near.at(x) + epoch_ns, abs=1)


def test_old_points_are_forgotten() -> None:
    """The fast frame of the beginning holds for a window, and then no longer."""
    envelope = Envelope(WINDOW_NS, 0.0, 0.0)
    envelope.add(0, 0)
    for second in range(1, 70):
        envelope.add(second * S, 300 * MS)
        held = second * S < WINDOW_NS
        assert envelope.at(second * S) == (0 if held else 300 * MS), second


def test_silence_does_not_count_as_window_but_age_does() -> None:
    envelope = Envelope(WINDOW_NS, 0.0, 0.0)
    envelope.add(0, 0)
    envelope.add(9 * WINDOW_NS, 300 * MS)
    assert envelope.at(0) == 0
    envelope.add(11 * WINDOW_NS, 400 * MS)
    assert envelope.at(0) == 300 * MS


@pytest.mark.full
@pytest.mark.parametrize("rate_hz", [1, 200])
def test_memory_is_bounded(rate_hz: int) -> None:
    """Convex points are the worst case: each stays a vertex."""
    envelope, sizes = Envelope(WINDOW_NS, LIMIT, UNSURE), []
    rng = random.Random(1)
    tracemalloc.start()
    try:
        for n in range(20 * 64 * rate_hz):
            x = n * S // rate_hz
            late = 0 if rng.random() < 0.2 else rng.randrange(2 * S)
            envelope.add(x, (x // 1_000_000) ** 2 // 100_000 + late)
            if n in (2 * 64 * rate_hz, 20 * 64 * rate_hz - 1):
                sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert 1_000 < sizes[0] < 200_000
    assert sizes[1] < 1.3 * sizes[0] + 4_000
    assert envelope.count <= 16 * PIECES
    assert len(envelope.points()) <= 16 * PIECES


def test_a_drift_is_used_only_where_it_is_told() -> None:
    """2.4 % within seconds; 100 ppm never on a link whose latency varies by more than a second."""
    rng = random.Random(3)
    for drift, told in ((0.0246, True), (-0.0234, True), (1e-4, False), (0.0, False)):
        envelope = Envelope(WINDOW_NS, LIMIT, UNSURE)
        for n in range(72):
            x = n * S * 5 // 6
            envelope.add(x, round(drift * x) + rng.randrange(100 * MS, 1_500 * MS))
        assert (envelope.drift != 0.0) is told
        assert abs(envelope.drift - drift) <= (0.006 if told else 1e-4)
        assert envelope.drift_error >= abs(envelope.drift - drift)
