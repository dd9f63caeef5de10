"""OFDM of the link: carrier plan, and conversion between carriers and samples.

Of 256 carriers 234 are data, 8 pilots and 14 null; a cyclic prefix has 64 samples. Carriers are
numbered from 0 in order of frequency, with 0 Hz in the middle, at 128; the plan in docs/math.md 8.3
counts from 1 (nulls [1:7 129 251:256], pilots [26 54 90 118 140 168 204 232]). Transforms are
unitary: white noise has the same power per sample as per carrier.
"""

from typing import Final

import numpy as np
from scipy.linalg import hadamard

from companion.values import ComplexArray, FloatArray, IntArray

CARRIERS: Final = 256
PREFIX: Final = 64
SAMPLES: Final = CARRIERS + PREFIX  # samples of one OFDM symbol
NULLS: Final = np.array([*range(7), 128, *range(250, 256)], dtype=np.int64)
PILOTS: Final = np.array([26, 54, 90, 118, 140, 168, 204, 232], dtype=np.int64) - 1
DATA: Final[IntArray] = np.setdiff1d(np.arange(CARRIERS), np.concatenate([NULLS, PILOTS]))
STREAMS: Final = len(PILOTS)  # number of streams that pilots can separate
PILOT_SIGNS: Final[FloatArray] = hadamard(STREAMS).astype(float)
"""Signs of the pilots, (8, 8), a row per stream, by Sylvester's construction.

The rows are orthogonal: over a flat channel no stream disturbs the estimate of another.
"""


def carriers(data: ComplexArray, pilots: FloatArray) -> ComplexArray:
    """Assemble carriers (..., 256) from data (..., 234) and pilots (broadcast to (..., 8))."""
    placed: ComplexArray = np.zeros((*data.shape[:-1], CARRIERS), dtype=complex)
    placed[..., DATA] = data
    placed[..., PILOTS] = pilots
    return placed


def samples(placed: ComplexArray) -> ComplexArray:
    """Return the time samples (..., 320) of carriers (..., 256), prefix first."""
    body = np.fft.ifft(np.fft.ifftshift(placed, axes=-1), norm="ortho")
    return np.concatenate([body[..., -PREFIX:], body], axis=-1)


def received_carriers(heard: ComplexArray) -> ComplexArray:
    """Return the carriers (..., 256) of time samples (..., 320), prefix removed."""
    return np.fft.fftshift(np.fft.fft(heard[..., PREFIX:], norm="ortho"), axes=-1)


def frequency_response(taps: ComplexArray) -> ComplexArray:
    """Return the response (256, ...) at each carrier of taps (T, ...), one sample apart."""
    return np.fft.fftshift(np.fft.fft(taps, CARRIERS, axis=0), axes=0)


def flat_estimate(heard: ComplexArray, pilots: FloatArray) -> ComplexArray:
    """Estimate phase and amplitude of a flat channel, (..., 1), from carriers (..., 256).

    The estimate is the mean over the pilots: its noise is an eighth of a carrier's, which costs 0.5
    dB.
    """
    estimate: ComplexArray = (heard[..., PILOTS] * pilots).mean(axis=-1, keepdims=True)
    return estimate
