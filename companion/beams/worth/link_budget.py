"""Link budget, SINR and spectral efficiency.

With rows h_i of the channel after combining, power gain g_i of the path and columns f_j of the
weights in square roots of watts (docs/math.md 7),

    SINR_i = g_i |h_i f_i|^2 / ( g_i sum_j |h_i f_j|^2 + noise ),  j != i and in the same group

Groups are served one after the other: they do not interfere with each other, and each has the whole
power in its time slot.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.beams.array.geometry import Array
from companion.beams.array.steering import steering_matrix
from companion.beams.worth.channel import free_space_gain
from companion.values import BeamSet, ComplexArray, FloatArray, IntArray, Normalisation

BOLTZMANN_JPK: Final = 1.380649e-23


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkBudget:
    """Power of the transmitter and noise of a receiver.

    Raises ``ValueError`` for a value that is not finite, a bandwidth or temperature not above 0, or
    a noise figure below 0.
    """

    tx_power_dbm: float  # power of all streams together
    bandwidth_hz: float  # noise bandwidth
    noise_figure_db: float  # over thermal noise at temperature_k
    temperature_k: float = 290.0  # at 290 K thermal noise is -173.98 dBm/Hz

    def __post_init__(self) -> None:
        if not math.isfinite(self.tx_power_dbm):
            raise ValueError(f"tx_power_dbm {self.tx_power_dbm} must be finite")
        if not 0 < self.bandwidth_hz < math.inf:
            raise ValueError(f"bandwidth_hz {self.bandwidth_hz} must be finite and above 0")
        if not 0 <= self.noise_figure_db < math.inf:
            raise ValueError(f"noise_figure_db {self.noise_figure_db} must be finite, at least 0")
        if not 0 < self.temperature_k < math.inf:
            raise ValueError(f"temperature_k {self.temperature_k} must be finite and above 0")

    @property
    def tx_power_w(self) -> float:
        """Transmitted power, watts."""
        return float(10 ** (self.tx_power_dbm / 10 - 3))

    @property
    def noise_power_w(self) -> float:
        """Noise power in the band at one antenna, watts: k T B times the noise figure."""
        thermal_w = BOLTZMANN_JPK * self.temperature_k * self.bandwidth_hz
        return float(thermal_w * 10 ** (self.noise_figure_db / 10))


def isotropic_snr(
    ranges_m: FloatArray, array: Array, budget: LinkBudget, uav_antennas: int = 1
) -> FloatArray:
    """Return the SNR (N,) at UAVs in free space if an isotropic antenna had the whole power."""
    path_gains = uav_antennas * free_space_gain(ranges_m, array.wavelength_m)
    found: FloatArray = path_gains * (budget.tx_power_w / budget.noise_power_w)
    return found


def share_power(
    weights: ComplexArray, power_w: float, groups: IntArray | None = None
) -> ComplexArray:
    """Return weights (M, N) with the power shared equally by the streams of each group.

    Column j becomes f_j / |f_j| sqrt(power / streams of its group), in square roots of watts;
    ``groups`` (N,) numbers each UAV's slot (None: all at once). A column of zeros is an inactive
    stream: it stays zero, and the others share its power. Raises ``ValueError`` for a power not
    above 0.
    """
    if not 0 < power_w < math.inf:
        raise ValueError(f"power_w {power_w} must be finite and above 0")
    norms = np.linalg.norm(weights, axis=0)
    sent = norms > 0
    streams = _together(groups, len(norms)) @ sent
    scales = math.sqrt(power_w) / (np.where(sent, norms, 1.0) * np.sqrt(np.maximum(streams, 1.0)))
    shared: ComplexArray = weights * scales
    return shared


def sinr(
    responses: ComplexArray,
    path_gains: FloatArray,
    noise_power_w: float,
    groups: IntArray | None = None,
) -> FloatArray:
    """Return signal over interference and noise at each UAV, a power ratio: (..., N).

        responses      (..., N, N), h_i f_j: row i the UAV that receives, column j the stream;
                       weights in square roots of watts (``share_power``)
        path_gains     (..., N), power gains of the paths, blockage included
        noise_power_w  after combining with unit norm
        groups         (N,), the slot of each UAV; None: all at once

    Raises ``ValueError`` if shapes disagree or the noise is not above 0.
    """
    users = responses.shape[-1]
    if responses.shape[-2] != users or path_gains.shape[-1:] != (users,):
        raise ValueError(
            f"responses {responses.shape} must be (..., N, N) and path_gains {path_gains.shape} "
            "(..., N)"
        )
    if not 0 < noise_power_w < math.inf:
        raise ValueError(f"noise_power_w {noise_power_w} must be finite and above 0")
    received = path_gains[..., np.newaxis] * np.abs(responses) ** 2
    others = _together(groups, users) - np.eye(users)
    wanted = np.einsum("...ii->...i", received)
    # A mask avoids cancellation: interference is often far below the rounding of the signal.
    interference = np.einsum("...ij,ij->...i", received, others)
    ratio: FloatArray = wanted / (interference + noise_power_w)
    return ratio


def _together(groups: IntArray | None, users: int) -> FloatArray:
    """Return (N, N): 1 if two UAVs are served in the same time slot, else 0."""
    if groups is None:
        return np.ones((users, users))
    if groups.shape != (users,):
        raise ValueError(f"groups {groups.shape} must be one number a UAV, ({users},)")
    same: FloatArray = (groups[:, np.newaxis] == groups).astype(float)
    return same


def spectral_efficiency(ratio: float | FloatArray, slots: int = 1) -> FloatArray:
    """Return log2(1 + SINR) / slots, bit/s/Hz: Shannon's limit for Gaussian interference.

    ``ratio`` is the SINR as a power ratio, any shape; ``slots`` the number of groups served one
    after the other, for equal times. Raises ``ValueError`` for a negative SINR or less than one
    slot.
    """
    ratios = np.asarray(ratio, dtype=float)
    if not (ratios >= 0).all():
        raise ValueError("a SINR must be a number of at least 0")
    if slots < 1:
        raise ValueError(f"slots {slots} must be at least 1")
    efficiency: FloatArray = np.log1p(ratios) / (math.log(2) * slots)
    return efficiency


def transmitted(
    weights: ComplexArray,
    power_w: float,
    groups: IntArray | None = None,
    normalisation: Normalisation = Normalisation.TOTAL,
) -> ComplexArray:
    """Return weights (M, N) as transmitted, in square roots of watts, one factor per group.

        weights        as published
        power_w        power of all streams of a group together
        groups         (N,), the slot of each UAV; None: all at once
        normalisation  ``ANTENNA``: no element sends more than ``power_w`` / M; else the group sends
                       all of it

    The columns' powers are those of the weights.
    """
    if normalisation is Normalisation.ANTENNA:
        return weights * math.sqrt(power_w)
    powers = np.einsum("mn,mn->n", weights, weights.conj()).real
    whole = _together(groups, len(powers)) @ powers
    sent: ComplexArray = weights * np.sqrt(power_w / np.maximum(whole, 1e-300))
    return sent


def predicted_sinr_db(
    array: Array,
    directions: FloatArray,
    *,
    ranges_m: FloatArray,
    sent: ComplexArray,
    groups: IntArray | None,
    budget: LinkBudget,
    uav_antennas: int = 1,
) -> FloatArray:
    """Predict the SINR of each UAV on the line of sight, dB, (N,).

        directions    (N, 3), predicted unit directions, array frame
        ranges_m      (N,), predicted ranges
        sent          (M, N), weights as transmitted (``transmitted``)
        groups        (N,), the slot of each UAV; None: all at once
        budget        noise
        uav_antennas  isotropic antennas of each UAV, combined towards the node

    Assumes free space, no scattering and no blockage; -inf if no element faces the UAV. Time slots
    reduce the rate, not the SINR. Raises ``ValueError`` as its parts do.
    """
    if uav_antennas < 1:
        raise ValueError(f"uav_antennas {uav_antennas} must be at least 1")
    responses = steering_matrix(array, directions).T @ sent
    path_gains = uav_antennas * free_space_gain(ranges_m, array.wavelength_m)
    ratio = sinr(responses, path_gains, budget.noise_power_w, groups)
    with np.errstate(divide="ignore"):
        ratio_db: FloatArray = 10 * np.log10(ratio)
    return ratio_db


def sent_weights(beam_set: BeamSet, budget: LinkBudget) -> ComplexArray:
    """Return weights (M, N) of an update as transmitted, in square roots of watts."""
    slots, normalisation = beam_set.slots, beam_set.normalisation
    return transmitted(beam_set.weights, budget.tx_power_w, slots, normalisation)


def sinr_of_beams_db(
    array: Array,
    beam_set: BeamSet,
    directions: FloatArray,
    budget: LinkBudget,
    uav_antennas: int = 1,
) -> FloatArray:
    """Return the SINR (N,) of the UAVs of an update in given unit directions (N, 3), dB."""
    sent = sent_weights(beam_set, budget)
    ranges_m, slots = beam_set.ranges_m, beam_set.slots
    return predicted_sinr_db(
        array,
        directions,
        ranges_m=ranges_m,
        sent=sent,
        groups=slots,
        budget=budget,
        uav_antennas=uav_antennas,
    )


def least_sinr_db(
    least_gains: FloatArray,
    *,
    leaks: FloatArray,
    users: IntArray,
    farthest_m: FloatArray,
    groups: IntArray,
    powers_w: FloatArray,
    budget: LinkBudget,
    wavelength_m: float,
    uav_antennas: int = 1,
) -> FloatArray:
    """Return the least SINR of some of N UAVs on the line of sight, dB, (K,).

        least_gains  (K,), least array gain of each one's own beam, linear
        leaks        (K, N), largest array gain of each beam towards it, linear
        users        (K,), indices below N of these UAVs
        farthest_m   (K,), largest possible ranges
        groups       (N,), the slot of each UAV
        powers_w     (N,), transmitted power of each beam
        budget       noise

    The SINR falls with range, with leakage and with less gain, so the three worst together give the
    least (docs/math.md 5.4).
    """
    together = _together(groups, len(groups))
    path_gains = uav_antennas * free_space_gain(farthest_m, wavelength_m)
    heard = together[users] * leaks * powers_w
    heard[np.arange(len(users)), users] = 0.0
    wanted = path_gains * least_gains * powers_w[users]
    least: FloatArray = wanted / (path_gains * heard.sum(axis=1) + budget.noise_power_w)
    return 10 * np.log10(least)
