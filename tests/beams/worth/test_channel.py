"""Propagation: Friis by hand, moments of random draws, blockage against a linear scan."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.beams.array import steering
from companion.beams.array.elements import Element, ElementPattern
from companion.beams.array.geometry import (
    SPEED_OF_LIGHT_MPS,
    Array,
    listed,
    uniform_circular,
    uniform_linear,
    uniform_rectangular,
)
from companion.beams.worth.channel import (
    Blockages,
    SalehValenzuela,
    combined_rows,
    draw,
    draw_blockages,
    free_space_gain,
)
from companion.values import FloatArray

NODE = uniform_rectangular(
    2, columns=4, frequency_hz=30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3)
)
UAV = uniform_linear(4, 30e9, spacing_wavelengths=0.5, array_from_body=np.eye(3))
SIGHT_ONLY = SalehValenzuela(rician_k_db=math.inf)


def directions(seed: int, count: int) -> FloatArray:
    drawn = np.random.default_rng(seed).standard_normal((count, 3))
    made: FloatArray = drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    return made


# --- free space ---------------------------------------------------------------------------------


def test_free_space_gain_matches_friis() -> None:
    """20 log10(4 pi 100 m / 9.993 mm) = 102.0 dB at 30 GHz; 6 dB more at twice the range."""
    gains = free_space_gain(np.array([100.0, 200.0]), SPEED_OF_LIGHT_MPS / 30e9)
    assert 10 * np.log10(gains) == pytest.approx([-101.99, -108.01], abs=0.01)
    assert free_space_gain(100.0, 0.01).shape == ()


@pytest.mark.parametrize("range_m", [0.0, -1.0, math.inf, math.nan])
def test_invalid_range_is_rejected(range_m: float) -> None:
    with pytest.raises(ValueError, match="ranges_m"):
        free_space_gain(np.array([100.0, range_m]), 0.01)


@pytest.mark.parametrize("wavelength_m", [0.0, -0.01, math.inf, math.nan])
def test_invalid_wavelength_is_rejected(wavelength_m: float) -> None:
    with pytest.raises(ValueError, match="wavelength_m"):
        free_space_gain(100.0, wavelength_m)


# --- Saleh-Valenzuela ---------------------------------------------------------------------------


def test_line_of_sight_channel_is_the_outer_product() -> None:
    """Unconjugated at both ends, unit magnitude, one random phase per UAV."""
    at_node, at_uav = directions(1, 3), directions(2, 3)
    channels = draw(
        SIGHT_ONLY,
        NODE,
        uav_array=UAV,
        directions_at_node=at_node,
        directions_at_uav=at_uav,
        rng=np.random.default_rng(3),
    )
    assert channels.shape == (3, 4, 8)
    k = 2 * math.pi / NODE.wavelength_m
    turns = []
    for n in range(3):
        first = k * (UAV.elements_m[0] @ at_uav[n] + NODE.elements_m[0] @ at_node[n])
        turns.append(channels[n, 0, 0] * np.exp(-1j * first))
        for u in range(4):
            for m in range(8):
                path_m = UAV.elements_m[u] @ at_uav[n] + NODE.elements_m[m] @ at_node[n]
                assert channels[n, u, m] == pytest.approx(
                    turns[n] * np.exp(1j * k * path_m), abs=1e-9
                )
        assert np.linalg.matrix_rank(channels[n]) == 1
    assert np.abs(turns) == pytest.approx(np.ones(3))
    assert len(np.unique(np.round(np.angle(turns), 6))) == 3


@pytest.mark.parametrize("rician_k_db", [math.inf, 10.0, 0.0, -math.inf])
@pytest.mark.parametrize(
    ("node", "uav"),
    [
        (NODE, UAV),
        # A cosine element radiates all its power, so its mean gain over all directions is 1.
        (
            uniform_circular(
                6,
                30e9,
                spacing_wavelengths=0.5,
                array_from_body=np.eye(3),
                element=Element(ElementPattern.COSINE, 2.0),
            ),
            UAV,
        ),
        (
            uniform_linear(
                3,
                30e9,
                spacing_wavelengths=0.5,
                array_from_body=np.eye(3),
                element=Element(ElementPattern.COSINE),
            ),
            NODE,
        ),
    ],
    ids=["isotropic", "outward", "forward"],
)
def test_mean_channel_energy_matches_antennas_and_elements(
    rician_k_db: float, node: Array, uav: Array
) -> None:
    many = 4000
    model = SalehValenzuela(rician_k_db=rician_k_db, clusters=4, rays_per_cluster=2)
    at_node = np.tile([0.6, 0.8, 0.0], (many, 1))
    at_uav = np.tile([1.0, 0.0, 0.0], (many, 1))
    channels = draw(
        model,
        node,
        uav_array=uav,
        directions_at_node=at_node,
        directions_at_uav=at_uav,
        rng=np.random.default_rng(5),
    )
    a = steering.steering_matrix(node, at_node[:1])
    b = steering.steering_matrix(uav, at_uav[:1])
    sight = float(np.sum(np.abs(a) ** 2) * np.sum(np.abs(b) ** 2))
    share = {math.inf: 1.0, 10.0: 10 / 11, 0.0: 0.5, -math.inf: 0.0}[rician_k_db]
    wanted = share * sight + (1 - share) * node.size * uav.size
    energy = np.sum(np.abs(channels) ** 2, axis=(1, 2))
    error = float(energy.std() / math.sqrt(many))
    assert energy.mean() == pytest.approx(wanted, rel=1e-9, abs=4 * error)
    assert error < 0.05 * wanted


@pytest.mark.parametrize("k_db", [-5.0, 3.0, 12.0])
def test_single_antenna_pair_has_rician_moments(k_db: float) -> None:
    """Moments of a Rician amplitude: E x^2 = 1, E x^4 = 1 + (1 + 2 K) / (1 + K)^2. Exact for any
    number of rays, because ray amplitudes are Gaussian."""
    single = listed(np.zeros((1, 3)), 30e9, array_from_body=np.eye(3))
    many = 40_000
    ahead = np.tile([1.0, 0.0, 0.0], (many, 1))
    model = SalehValenzuela(rician_k_db=k_db, clusters=2, rays_per_cluster=2)
    power = (
        np.abs(
            draw(
                model,
                single,
                uav_array=single,
                directions_at_node=ahead,
                directions_at_uav=ahead,
                rng=np.random.default_rng(7),
            )
        )
        ** 2
    )
    k = 10 ** (k_db / 10)
    assert power.shape == (many, 1, 1)
    assert power.mean() == pytest.approx(1.0, abs=0.02)
    assert np.mean(power**2) == pytest.approx(1 + (1 + 2 * k) / (1 + k) ** 2, abs=0.06)


def test_line_of_sight_phase_is_uniform() -> None:
    ahead = np.tile([1.0, 0.0, 0.0], (4000, 1))
    turns = draw(
        SIGHT_ONLY,
        UAV,
        uav_array=UAV,
        directions_at_node=ahead,
        directions_at_uav=ahead,
        rng=np.random.default_rng(11),
    )[:, 0, 0]
    assert abs(turns.mean()) < 0.06
    assert abs(np.mean(turns**2)) < 0.06


def test_cluster_without_spread_has_rank_one() -> None:
    """Without spread the rays of a cluster coincide and the channel has rank 1; with spread it has
    not."""
    ahead = np.array([[1.0, 0.0, 0.0]])
    rank_one = SalehValenzuela(
        rician_k_db=-math.inf, clusters=1, rays_per_cluster=20, angular_spread_rad=0.0
    )
    drawn = draw(
        rank_one,
        NODE,
        uav_array=UAV,
        directions_at_node=ahead,
        directions_at_uav=ahead,
        rng=np.random.default_rng(1),
    )[0]
    singular = np.linalg.svd(drawn, compute_uv=False)
    assert singular[1] < 1e-9 * singular[0]
    spread = SalehValenzuela(
        rician_k_db=-math.inf, clusters=1, rays_per_cluster=20, angular_spread_rad=0.3
    )
    drawn = draw(
        spread,
        NODE,
        uav_array=UAV,
        directions_at_node=ahead,
        directions_at_uav=ahead,
        rng=np.random.default_rng(1),
    )[0]
    singular = np.linalg.svd(drawn, compute_uv=False)
    assert singular[1] > 1e-2 * singular[0]


def test_angular_spread_is_the_standard_deviation_of_a_cluster() -> None:
    """Correlation of two elements 2 wavelengths apart. A Laplacian angle of deviation s has the
    characteristic function 1 / (1 + (x s)^2 / 2). Two of them, across a cluster rotated by psi
    at cosine c from the pair, give rho below. Ray amplitudes are Gaussian, so E |h0 h1|^2 = 1 +
    |correlation|^2, of which L rays contribute 1/L by chance."""
    rays, spread, apart = 30, 0.05, 2.0
    pair = listed(
        np.array([[0, 0, 0], [apart * 0.01, 0, 0]]),
        SPEED_OF_LIGHT_MPS / 0.01,
        array_from_body=np.eye(3),
    )
    single = listed(np.zeros((1, 3)), 30e9, array_from_body=np.eye(3))
    ahead = np.tile([1.0, 0.0, 0.0], (8000, 1))
    model = SalehValenzuela(
        rician_k_db=-math.inf, clusters=1, rays_per_cluster=rays, angular_spread_rad=spread
    )
    h = draw(
        model,
        pair,
        uav_array=single,
        directions_at_node=ahead,
        directions_at_uav=ahead,
        rng=np.random.default_rng(2),
    )[:, 0, :]
    cosine, psi = np.meshgrid(np.linspace(-1, 1, 801), np.linspace(0, 2 * np.pi, 200, False))
    x = 2 * np.pi * apart * spread * np.sqrt(1 - cosine**2)
    rho = 1 / ((1 + (x * np.cos(psi)) ** 2 / 2) * (1 + (x * np.sin(psi)) ** 2 / 2))
    wanted = 1 + 1 / rays + (1 - 1 / rays) * np.mean(rho**2)
    assert 1.5 < wanted < 1.9  # far enough from 1 and 2 to reveal a wrong spread
    assert np.mean(np.abs(h[:, 0] * h[:, 1]) ** 2) == pytest.approx(wanted, abs=0.08)


def test_seed_is_reproducible_and_k_only_changes_the_mix() -> None:
    at_node, at_uav = directions(1, 2), directions(2, 2)
    first, again, other = (
        draw(
            SalehValenzuela(),
            NODE,
            uav_array=UAV,
            directions_at_node=at_node,
            directions_at_uav=at_uav,
            rng=np.random.default_rng(seed),
        )
        for seed in (9, 9, 10)
    )
    assert np.array_equal(first, again)
    assert not np.allclose(first, other)
    sight, rest, mixed = (
        draw(
            SalehValenzuela(rician_k_db=k),
            NODE,
            uav_array=UAV,
            directions_at_node=at_node,
            directions_at_uav=at_uav,
            rng=np.random.default_rng(9),
        )
        for k in (math.inf, -math.inf, 0.0)
    )
    assert mixed == pytest.approx((sight + rest) / math.sqrt(2), abs=1e-12)


@given(st.floats(-4000, 4000))
def test_power_shares_match_the_k_factor(k_db: float) -> None:
    sight, scattered = SalehValenzuela(rician_k_db=k_db).shares
    assert sight + scattered == pytest.approx(1.0)
    if abs(k_db) < 1000:
        assert 10 * math.log10(sight / scattered) == pytest.approx(k_db, abs=1e-6)


@pytest.mark.parametrize(
    ("bad", "name"),
    [
        ({"rician_k_db": math.nan}, "rician_k_db"),
        ({"clusters": 0}, "clusters"),
        ({"rays_per_cluster": 0}, "rays_per_cluster"),
        ({"angular_spread_rad": -0.1}, "angular_spread_rad"),
        ({"angular_spread_rad": math.nan}, "angular_spread_rad"),
        ({"angular_spread_rad": 4.0}, "angular_spread_rad"),
    ],
)
def test_invalid_channel_settings_are_rejected(bad: dict[str, float], name: str) -> None:
    with pytest.raises(ValueError, match=name):
        SalehValenzuela(**bad)  # type: ignore[arg-type]


@pytest.mark.parametrize(("nodes", "uavs"), [(2, 3), (1, 2)])
def test_directions_of_wrong_shape_are_rejected(nodes: int, uavs: int) -> None:
    with pytest.raises(ValueError, match=r"\(N, 3\)"):
        draw(
            SIGHT_ONLY,
            NODE,
            uav_array=UAV,
            directions_at_node=directions(1, nodes),
            directions_at_uav=directions(2, uavs),
            rng=np.random.default_rng(1),
        )


# --- combining ----------------------------------------------------------------------------------


def test_the_combiner_is_matched_and_of_unit_norm() -> None:
    """N_U times the power of one antenna, noise as at one; no other unit combiner is better."""
    at_node, at_uav = directions(1, 5), directions(2, 5)
    rng = np.random.default_rng(4)
    channels = draw(
        SIGHT_ONLY,
        NODE,
        uav_array=UAV,
        directions_at_node=at_node,
        directions_at_uav=at_uav,
        rng=rng,
    )
    b = steering.steering_matrix(UAV, at_uav)
    rows = combined_rows(channels, b)
    assert rows.shape == (5, 8)
    best = np.linalg.svd(channels, compute_uv=False)[:, 0]
    assert np.linalg.norm(rows, axis=1) == pytest.approx(best)
    assert np.abs(rows) ** 2 == pytest.approx(4 * np.abs(channels[:, 0, :]) ** 2)
    # Noise passed through the combiner keeps unit variance.
    noise = rng.standard_normal((5, 4, 20_000)) + 1j * rng.standard_normal((5, 4, 20_000))
    through = combined_rows(noise / math.sqrt(2), b)
    assert np.mean(np.abs(through) ** 2, axis=1) == pytest.approx(np.ones(5), abs=0.04)


def test_conjugate_beam_matches_the_combined_channel() -> None:
    """F = a* and w^H H = |b| a^T add in phase: M^2 N_U."""
    at_node, at_uav = directions(3, 4), directions(4, 4)
    channels = draw(
        SIGHT_ONLY,
        NODE,
        uav_array=UAV,
        directions_at_node=at_node,
        directions_at_uav=at_uav,
        rng=np.random.default_rng(4),
    )
    rows = combined_rows(channels, steering.steering_matrix(UAV, at_uav))
    f = steering.steering_matrix(NODE, at_node).conj()
    met = np.abs(np.einsum("nm,mn->n", rows, f)) ** 2
    assert met == pytest.approx(np.full(4, 8**2 * 4.0))


def test_uav_that_faces_away_is_rejected() -> None:
    channels = np.ones((2, 4, 8), dtype=complex)
    with pytest.raises(ValueError, match="face the node"):
        combined_rows(channels, np.array([[1, 0]] * 4, dtype=complex))
    with pytest.raises(ValueError, match="uav_steering"):
        combined_rows(channels, np.ones((2, 4), dtype=complex))


# --- blockage -----------------------------------------------------------------------------------


def test_blockage_interval_is_half_open() -> None:
    blockages = Blockages(((1.0, 2.0), (4.0, 5.0)), 20.0)
    times = np.array([0.0, 1.0, 1.999, 2.0, 3.0, 4.0, 4.5, 5.0, 9.0])
    assert blockages.attenuation_db(times).tolist() == [0, 20, 20, 0, 0, 20, 20, 0, 0]
    assert float(blockages.attenuation_db(1.5)) == 20.0
    assert Blockages().attenuation_db(times).tolist() == [0.0] * 9


def test_overlapping_or_adjacent_blockages_are_merged() -> None:
    given_s = ((4.0, 5.0), (1.0, 3.0), (2.0, 2.5), (3.0, 3.5), (7.0, 7.0))
    assert Blockages(given_s).intervals_s == ((1.0, 3.5), (4.0, 5.0))
    assert Blockages(((2.0, math.inf), (1.0, 2.0))).intervals_s == ((1.0, math.inf),)


TIMES = st.integers(0, 40).map(lambda q: q / 4)


@settings(max_examples=examples(60))
@given(st.lists(st.tuples(TIMES, TIMES).map(lambda p: (min(p), max(p))), max_size=8))
def test_blocked_matches_a_linear_scan(intervals: list[tuple[float, float]]) -> None:
    blockages = Blockages(tuple(intervals))
    times = np.arange(0, 11, 0.125)
    wanted = [any(start <= t < end for start, end in intervals) for t in times]
    assert blockages.blocked(times).tolist() == wanted
    flat = [edge for interval in blockages.intervals_s for edge in interval]
    assert flat == sorted(set(flat))


@pytest.mark.parametrize(
    ("intervals", "depth", "message"),
    [
        (((2.0, 1.0),), 20.0, "before it starts"),
        (((math.nan, 1.0),), 20.0, "before it starts"),
        ((), -1.0, "depth_db"),
        ((), math.inf, "depth_db"),
        ((), math.nan, "depth_db"),
    ],
)
def test_invalid_blockage_is_rejected(
    intervals: tuple[tuple[float, float], ...], depth: float, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Blockages(intervals, depth)


def test_random_blockages_follow_the_m_m_infinity_probability() -> None:
    """P(blocked at t) = 1 - exp(-rate mean (1 - exp(-t/mean))): M/M/infinity, empty at the
    start."""
    rng = np.random.default_rng(8)
    rate_hz, mean_s = 0.8, 0.5
    times = np.array([0.0, 0.25, 0.5, 1.0, 3.0, 9.9])
    runs = [draw_blockages(rng, 10.0, rate_hz, mean_s).blocked(times) for _ in range(4000)]
    wanted = 1 - np.exp(-rate_hz * mean_s * (1 - np.exp(-times / mean_s)))
    assert np.mean(runs, axis=0) == pytest.approx(wanted, abs=0.025)


def test_random_blockages_are_reproducible_by_seed() -> None:
    def drawn(seed: int) -> Blockages:
        return draw_blockages(np.random.default_rng(seed), 60.0, 0.2, 1.0, 30.0)

    assert drawn(1) == drawn(1)
    assert drawn(1) != drawn(2)
    assert drawn(1).depth_db == 30.0
    assert all(0 <= start < 60 for start, _ in drawn(1).intervals_s)
    assert draw_blockages(np.random.default_rng(1), 60.0, 0.0, 1.0).intervals_s == ()


@pytest.mark.parametrize(
    ("duration_s", "rate_hz", "mean_s"),
    [
        (-1.0, 1.0, 1.0),
        (math.inf, 1.0, 1.0),
        (1.0, -1.0, 1.0),
        (1.0, math.nan, 1.0),
        (1.0, 1.0, 0.0),
    ],
)
def test_invalid_random_blockage_parameters_are_rejected(
    duration_s: float, rate_hz: float, mean_s: float
) -> None:
    with pytest.raises(ValueError, match="duration_s"):
        draw_blockages(np.random.default_rng(1), duration_s, rate_hz, mean_s)
