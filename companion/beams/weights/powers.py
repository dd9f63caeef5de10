"""Power allocation between the beams of one time slot, and the beams that suit it.

With the coupling c_ij = SNR of user i from beam j alone if that had all the power,

    SINR_i = p_i c_ii / (1 + sum_{j != i} p_j c_ij),     sum p = 1.

``max_min`` maximises the least SINR: all are then equal, and p is the fixed point of
p_i = t (1 + sum p_j c_ij) / c_ii (M. Schubert and H. Boche 2004). ``weighted_sum`` maximises the
weighted sum of log2(1 + SINR) by weighted least squares (WMMSE, Q. Shi et al. 2011), here over
powers alone.

The best beams for either are those of the least mean square error in the uplink, with uplink powers
q (uplink-downlink duality): F = A* (A^T A* + X)^-1 with x_i = 1/(q_i SNR_i), up to the lengths of
the columns. ``dual_of_*`` find q. See docs/math.md 7.
"""

from typing import Final

import numpy as np

from companion.values import ComplexArray, FloatArray

ROUNDS: Final = 60  # most iterations of a fixed point
DUAL_ROUNDS: Final = 24  # most iterations that recompute beams
ENOUGH: Final = 1e-4  # relative change of powers at which a search ends
ROUNDING: Final = 1e-13
"""Least loading, relative to the largest power, so that identical vectors can be inverted."""
LEAST_SHARE: Final = 1e-4
"""Least power of a user, relative to an equal share, so that every beam exists."""


def max_min(coupling: FloatArray) -> FloatArray:
    """Return power shares (N,) that maximise the least SINR, for a coupling (N, N)."""
    own = np.maximum(coupling.diagonal(), 1e-300)
    cross = coupling - np.diag(coupling.diagonal())
    share = np.full(len(own), 1.0 / len(own))
    for _ in range(ROUNDS):
        wanted = (1.0 + cross @ share) / own
        found = wanted / wanted.sum()
        done = np.abs(found - share).max() <= ENOUGH * found.min()
        share = found
        if done:
            break
    return _kept(share)


def weighted_sum(coupling: FloatArray, rate_weights: FloatArray) -> FloatArray:
    """Return power shares (N,) at a local maximum of the sum of ``rate_weights`` times rates."""
    direct = np.sqrt(coupling.diagonal())
    sent = np.full(len(direct), (1.0 / len(direct)) ** 0.5)
    for _ in range(2 * ROUNDS):
        heard = 1.0 + coupling @ sent**2
        receiver = direct * sent / heard
        weight = rate_weights / np.maximum(1.0 - receiver * direct * sent, 1e-12)
        pull = weight * receiver**2
        found = weight * receiver * direct / (coupling.T @ pull + pull.sum())
        found *= 1.0 / np.sqrt(found @ found)
        done = np.abs(found - sent).max() <= ENOUGH * found.max()
        sent = found
        if done:
            break
    return _kept(sent**2)


def dual_of_max_min(gram: ComplexArray, snr: FloatArray) -> FloatArray:
    """Return uplink powers (N,) of sum 1 that maximise the least SINR.

    gram  A^T A*, (N, N)
    snr   (N,), of an isotropic antenna with the whole power
    """
    share = np.full(len(snr), 1.0 / len(snr))
    for _ in range(DUAL_ROUNDS):
        alone = _sinr_per_power(gram, snr, share)
        found = 1.0 / alone
        found /= found.sum()
        done = np.abs(found - share).max() <= ENOUGH * found.min()
        share = found
        if done:
            break
    return share


def _sinr_per_power(gram: ComplexArray, snr: FloatArray, share: FloatArray) -> FloatArray:
    """Return the SINR (N,) of each user for a power of 1 while the others keep their shares."""
    # x [(K + X)^-1]_ii is the mean square error, 1 / (1 + SINR).
    error = _inverse(gram, 1.0 / (snr * share)).diagonal().real / (snr * share)
    found: FloatArray = np.maximum(1.0 / np.maximum(error, 1e-15) - 1.0, 1e-15) / share
    return found


def dual_of_weighted_sum(
    gram: ComplexArray, snr: FloatArray, rate_weights: FloatArray
) -> FloatArray:
    """Return uplink powers (N,) of sum 1 for a large weighted sum of rates.

    The search is WMMSE with beams A* Z, whose directions are those of the least mean square error,
    with powers as the receivers' weights.
    """
    root = np.sqrt(snr)
    channel = root[:, np.newaxis] * gram * root  # H^H H, channels h_i = sqrt(snr) a_i
    share = np.full(len(snr), 1.0 / len(snr))
    made = _beams(channel, share)
    for _ in range(DUAL_ROUNDS):
        field = channel.T @ made  # h_i^T f_j
        heard = 1.0 + np.sum(np.abs(field) ** 2, axis=1)
        own = field.diagonal()
        receiver = own.conj() / heard
        weight = rate_weights / np.maximum(1.0 - (receiver * own).real, 1e-12)
        pull = weight * np.abs(receiver) ** 2
        found = np.maximum(pull / pull.sum(), LEAST_SHARE / len(snr))
        scale = weight * receiver.conj() / np.maximum(pull, 1e-300)
        made = _inverse(channel.T, 1.0 / found) * scale
        power = float(np.einsum("in,ij,jn->", made.conj(), channel.T, made).real)  # of beams H* Z
        done = np.abs(found - share).max() <= ENOUGH * found.max()
        share = found
        if done or not power > 0.0:  # vectors identical to rounding: no beams to continue from
            break
        made /= np.sqrt(power)
    return share


def _inverse(gram: ComplexArray, loading: FloatArray) -> ComplexArray:
    """Return (K + X)^-1 for a loading X (N,)."""
    loaded = gram.copy()
    least = ROUNDING * float(gram.diagonal().real.max())
    loaded.flat[:: len(loaded) + 1] += np.maximum(loading, least)
    return np.asarray(np.linalg.inv(loaded), dtype=complex)


def _beams(channel: ComplexArray, share: FloatArray) -> ComplexArray:
    """Return coefficients Z (N, N) of beams H* Z of least mean square error and equal powers."""
    made = _inverse(channel.T, 1.0 / share)
    lengths = np.einsum("in,ij,jn->n", made.conj(), channel.T, made).real
    found: ComplexArray = made / np.sqrt(np.maximum(lengths, 1e-300) * len(share))
    return found


def _kept(share: FloatArray) -> FloatArray:
    found = np.maximum(share, LEAST_SHARE / len(share))
    kept: FloatArray = found / found.sum()
    return kept
