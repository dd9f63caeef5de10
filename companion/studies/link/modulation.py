"""16-QAM with Gray labels: bits to symbols, symbols to soft bits, and the exact error rate.

Four bits b0 b1 b2 b3 make a symbol of mean energy 1 (3GPP TS 38.211, 5.1.4):

    s = ((1 - 2 b0)(2 - (1 - 2 b2)) + j (1 - 2 b1)(2 - (1 - 2 b3))) / sqrt(10)

b0 and b1 are the signs of the two axes, b2 and b3 their amplitudes (0: inner, 1: outer).
"""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import erfc

from companion.values import BoolArray, ComplexArray, FloatArray

BITS: Final = 4  # bits per symbol
SCALE: Final = 1 / np.sqrt(10.0)  # factor from the levels -3, -1, 1, 3 to symbols of mean energy 1


def modulate(bits: BoolArray) -> ComplexArray:
    """Map bits (..., 4 n) to symbols (..., n).

    Raises ``ValueError`` unless the number of bits is a multiple of 4.
    """
    if bits.shape[-1] % BITS:
        raise ValueError(f"{bits.shape[-1]} bits do not fill symbols of {BITS}; give a multiple")
    signs = 1.0 - 2.0 * bits.reshape(*bits.shape[:-1], -1, BITS)
    levels = signs[..., :2] * (2.0 - signs[..., 2:]) * SCALE
    symbols: ComplexArray = levels[..., 0] + 1j * levels[..., 1]
    return symbols


def soft_bits(received: ComplexArray, noise_power: ArrayLike) -> FloatArray:
    """Return max-log ratios log P(bit 0) / P(bit 1), (..., 4 n), of equalised symbols (..., n).

    ``noise_power`` is the power on both axes together, per symbol energy; it broadcasts to the
    symbols. Max-log keeps only the largest term of each sum over symbols: (min over symbols with
    bit 1 of |y - s|^2 - min over those with bit 0) / noise power. With y in levels of an axis, the
    ratio of the sign is 4 y plus 4 for each level by which |y| exceeds 2; that of the amplitude is
    8 - 4 |y|.
    """
    levels = np.stack([received.real, received.imag], axis=-1) / SCALE
    size = np.abs(levels)
    ratios = np.concatenate(
        [4 * levels + np.copysign(4 * np.maximum(size - 2, 0.0), levels), 8 - 4 * size], axis=-1
    )
    ratios *= (SCALE**2 / np.asarray(noise_power, dtype=float))[..., np.newaxis]
    return ratios.reshape(*received.shape[:-1], -1)


def bit_error_rate(snr: ArrayLike) -> FloatArray:
    """Return the exact bit error rate of hard decisions in white Gaussian noise; ``snr`` is Es/N0.

    The result is the mean over sign bits and amplitude bits; ``snr`` is a power ratio. Source: K.
    Cho and D. Yoon, "On the general BER expression of one- and two-dimensional amplitude
    modulations", IEEE Trans. Communications 50(7), 2002.
    """
    step = np.sqrt(np.asarray(snr, dtype=float) / 10)
    return 3 / 8 * erfc(step) + 1 / 4 * erfc(3 * step) - 1 / 8 * erfc(5 * step)
