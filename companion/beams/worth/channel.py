"""Channel between the array and a UAV: free-space loss, scattering, blockage.

A UAV with N_U antennas of its own receives, from M elements with weights F and symbols s,

    y = sqrt(g) H F s + n                               H: (N_U, M), paper eq. (1)
    H = sqrt(K/(K+1)) exp(j phi) b a^T  +  sqrt(1/(K+1)) sum_l alpha_l b_l a_l^T

g is the power gain of free space, a and b the steering vectors (paper eq. (2)) of the line of sight
at the node and at the UAV, a_l and b_l those of scattered rays. All are transposed, none
conjugated: a beam at direction u is F = a(u)* (docs/math.md 7). The channel is flat over the band.

Model: rays in clusters, A. Saleh and R. Valenzuela (1987), without their delays; for arrays at
millimetre waves O. El Ayach et al. (2014), M. Akdeniz et al. (2014).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.beams.array.geometry import Array
from companion.beams.array.steering import steering_matrix
from companion.values import ComplexArray, FloatArray


def free_space_gain(ranges_m: float | FloatArray, wavelength_m: float) -> FloatArray:
    """Return the power gain between isotropic antennas, (wavelength / 4 pi r)^2, H. Friis (1946).

    The result has the shape of ``ranges_m``. The gains of elements and arrays are in the steering
    vectors. Raises ``ValueError`` unless ranges and wavelength are finite and above 0.
    """
    ranges = np.asarray(ranges_m, dtype=float)
    if not (np.isfinite(ranges).all() and (ranges > 0).all()):
        raise ValueError(f"ranges_m {ranges_m} must be finite and above 0")
    if not 0 < wavelength_m < math.inf:
        raise ValueError(f"wavelength_m {wavelength_m} must be finite and above 0")
    gain: FloatArray = (wavelength_m / (4 * np.pi * ranges)) ** 2
    return gain


@dataclass(frozen=True, slots=True, kw_only=True)
class SalehValenzuela:
    """Parameters of the scattered channel.

        rician_k_db         power of the line of sight over that of all scattered rays together;
                            inf: only the line of sight, -inf: none. 9 to 15 dB were measured at
                            28 GHz with line of sight (M. Samimi et al. 2016)
        clusters            number of clusters, in uniformly random directions, independent at the
                            node and at the UAV
        rays_per_cluster    number of rays in each, all of the same mean power
        angular_spread_rad  standard deviation of the rays' Laplacian angles about their cluster,
                            along each of two axes across

    The defaults of clusters, rays and spread are those of El Ayach et al. Raises ``ValueError`` for
    invalid numbers.
    """

    rician_k_db: float = 10.0
    clusters: int = 8
    rays_per_cluster: int = 10
    angular_spread_rad: float = math.radians(7.5)

    def __post_init__(self) -> None:
        if math.isnan(self.rician_k_db):
            raise ValueError("rician_k_db is not a number; inf means only the line of sight")
        if self.clusters < 1 or self.rays_per_cluster < 1:
            raise ValueError(
                f"clusters {self.clusters} and rays_per_cluster {self.rays_per_cluster} "
                "must be at least 1"
            )
        if not 0 <= self.angular_spread_rad <= math.pi:
            raise ValueError(f"angular_spread_rad {self.angular_spread_rad} must be 0 to pi")

    @property
    def shares(self) -> tuple[float, float]:
        """K/(K+1) and 1/(K+1): mean power of the line of sight and of the scattered rays."""
        log_k = self.rician_k_db * math.log(10) / 10
        return (
            math.exp(-float(np.logaddexp(0.0, -log_k))),
            math.exp(-float(np.logaddexp(0.0, log_k))),
        )


def draw(
    settings: SalehValenzuela,
    array: Array,
    *,
    uav_array: Array,
    directions_at_node: FloatArray,
    directions_at_uav: FloatArray,
    rng: "np.random.Generator",
) -> ComplexArray:
    """Draw random channels H for N independent UAVs: shape (N, N_U, M).

        directions_at_node  (N, 3), unit directions of the line of sight to the UAVs, array frame
        directions_at_uav   (N, 3), unit directions to the node, in the frame of each UAV's
                            ``uav_array``; all UAVs carry the same
        rng                 seeded generator

    The mean of |H|^2 (Frobenius) is N_U M times the element gains at both ends: towards the line of
    sight in its share of the power, averaged over all directions in the rest. It is N_U M for
    isotropic elements. Raises ``ValueError`` if the numbers of directions differ.
    """
    users = len(directions_at_node)
    if directions_at_node.shape != (users, 3) or directions_at_uav.shape != (users, 3):
        raise ValueError(
            f"directions at node {directions_at_node.shape} and at UAV {directions_at_uav.shape} "
            "must both be (N, 3)"
        )
    sight_share, scattered_share = settings.shares
    rays = settings.clusters * settings.rays_per_cluster
    turn = np.exp(2j * np.pi * rng.random(users))
    alpha = rng.standard_normal((2, users, rays)) * math.sqrt(scattered_share / (2 * rays))
    at_node = _ray_directions(settings, users, rng)
    at_uav = _ray_directions(settings, users, rng)

    a = steering_matrix(array, directions_at_node).T
    b = steering_matrix(uav_array, directions_at_uav).T
    a_rays = steering_matrix(array, at_node).T.reshape(users, rays, array.size)
    b_rays = steering_matrix(uav_array, at_uav).T.reshape(users, rays, uav_array.size)
    b_rays *= (alpha[0] + 1j * alpha[1])[:, :, np.newaxis]
    sight = (math.sqrt(sight_share) * turn[:, np.newaxis] * b)[:, :, np.newaxis]
    channels: ComplexArray = sight * a[:, np.newaxis, :] + b_rays.transpose(0, 2, 1) @ a_rays
    return channels


def _ray_directions(
    settings: SalehValenzuela, users: int, rng: "np.random.Generator"
) -> FloatArray:
    """Return unit directions (N * rays, 3) of rays, user by user and cluster by cluster.

    The axes across a cluster are rotated at random about it, so that no direction is preferred: a
    single ray is uniform on the sphere.
    """
    centres = _unit(rng.standard_normal((users, settings.clusters, 1, 3)))
    across = rng.standard_normal(centres.shape)
    across = _unit(across - np.sum(across * centres, axis=-1, keepdims=True) * centres)
    other = np.cross(centres, across)
    offsets = rng.laplace(
        scale=settings.angular_spread_rad / math.sqrt(2),  # for that standard deviation
        size=(users, settings.clusters, settings.rays_per_cluster, 2),
    )
    away = offsets[..., :1] * across + offsets[..., 1:] * other
    angle = np.linalg.norm(away, axis=-1, keepdims=True)
    directions: FloatArray = np.cos(angle) * centres + np.sinc(angle / np.pi) * away
    return directions.reshape(-1, 3)


def _unit(vectors: FloatArray) -> FloatArray:
    scaled: FloatArray = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return scaled


def combined_rows(channels: ComplexArray, uav_steering: ComplexArray) -> ComplexArray:
    """Return each UAV's response to each element after combining: w_i^H H_i, shape (N, M).

        channels      (N, N_U, M)
        uav_steering  (N_U, N), b_i, one column per UAV

    The combiner is matched to the UAV's own steering vector of the line of sight, w = b / |b|, of
    unit norm: the noise stays that of one antenna, and the line of sight gains |b|^2 in power (N_U
    if isotropic). Raises ``ValueError`` if the shapes disagree or a UAV's antennas receive nothing
    from there.
    """
    users, antennas, _ = channels.shape
    if uav_steering.shape != (antennas, users):
        raise ValueError(
            f"uav_steering {uav_steering.shape} must be {(antennas, users)} for these channels"
        )
    lengths = np.linalg.norm(uav_steering, axis=0)
    if not (lengths > 0).all():
        raise ValueError("uav_steering of a UAV is 0: its antennas do not face the node")
    rows: ComplexArray = np.einsum("un,num->nm", (uav_steering / lengths).conj(), channels)
    return rows


@dataclass(frozen=True, slots=True)
class Blockages:
    """Blockages of the link to one UAV.

        intervals_s  starts and ends, seconds from the start of the study, start included and end
                     excluded; sorted, and merged where they touch
        depth_db     0 or more; attenuates every path equally, in each direction of the link

    Raises ``ValueError`` for an interval that ends before it starts, or a negative depth.
    """

    intervals_s: tuple[tuple[float, float], ...] = ()
    depth_db: float = 25.0

    def __post_init__(self) -> None:
        if not 0 <= self.depth_db < math.inf:
            raise ValueError(f"depth_db {self.depth_db} must be finite and at least 0")
        merged: list[tuple[float, float]] = []
        for start, end in sorted(self.intervals_s):
            if not start <= end:
                raise ValueError(f"interval ({start}, {end}) s must not end before it starts")
            if merged and start <= merged[-1][1]:
                merged[-1] = (merged[-1][0], max(end, merged[-1][1]))
            elif start < end:
                merged.append((start, end))
        object.__setattr__(self, "intervals_s", tuple(merged))

    def blocked(self, t_s: float | FloatArray) -> NDArray[np.bool_]:
        """Return whether the link is blocked at times ``t_s``; shape as ``t_s``."""
        edges = np.array(self.intervals_s, dtype=float).reshape(-1, 2)
        begun = np.searchsorted(edges[:, 0], t_s, side="right")
        return np.asarray(begun > np.searchsorted(edges[:, 1], t_s, side="right"))

    def attenuation_db(self, t_s: float | FloatArray) -> FloatArray:
        """Return the one-way loss at times ``t_s``: the depth or 0 dB; shape as ``t_s``."""
        return np.where(self.blocked(t_s), self.depth_db, 0.0)


def draw_blockages(
    rng: "np.random.Generator",
    duration_s: float,
    rate_hz: float,
    mean_s: float,
    depth_db: float = 25.0,
) -> Blockages:
    """Draw blockages with random starts (Poisson, ``rate_hz``) and exponential durations.

    None is in progress at time 0; the last may outlast ``duration_s``. Long after the start the
    link is blocked for 1 - exp(-rate mean) of the time. Raises ``ValueError`` unless all are
    finite, ``mean_s`` above 0 and the others at least 0.
    """
    if not (0 <= duration_s < math.inf and 0 <= rate_hz < math.inf and 0 < mean_s < math.inf):
        raise ValueError(
            f"duration_s {duration_s} and rate_hz {rate_hz} must be finite and at least 0, "
            f"mean_s {mean_s} finite and above 0"
        )
    count = rng.poisson(rate_hz * duration_s)
    starts = rng.uniform(0.0, duration_s, count)
    ends = starts + rng.exponential(mean_s, count)
    return Blockages(tuple(zip(starts.tolist(), ends.tolist(), strict=True)), depth_db)
