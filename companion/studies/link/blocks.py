"""Blocks of bits: encoding, transmission, reception, decoding and error counts.

A block is one OFDM symbol: 306 bits and the tail of the code make 936 coded bits, which fill the
234 data carriers exactly. There is no interleaver: after beamforming the line of sight is so much
stronger than all scattered rays that the carriers hardly differ.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np

from companion.studies.link import coding, modulation, ofdm
from companion.values import BoolArray, ComplexArray, FloatArray, IntArray

CODED_BITS: Final = modulation.BITS * len(ofdm.DATA)
BLOCK_BITS: Final = CODED_BITS // len(coding.GENERATORS) - coding.TAIL
"""Number of payload bits in a coded block, without the code's tail."""


class Estimation(StrEnum):
    """How a receiver knows its channel: by a flat estimate from pilots, or exactly."""

    PILOTS = "pilots"
    IDEAL = "ideal"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Sent:
    """Transmitted data: B blocks to each of N UAVs."""

    bits: BoolArray  # (N, B, 306)
    coded: BoolArray  # (N, B, 936), coded bits
    symbols: ComplexArray  # (N, B, 234)
    pilots: FloatArray  # (N, 1, 8)
    samples: ComplexArray  # (N, B, 320)


def send(users: int, blocks: int, rng: np.random.Generator) -> Sent:
    """Draw random bits and encode them into blocks.

    Raises ``ValueError`` for more streams than pilots.
    """
    if users > ofdm.STREAMS:
        raise ValueError(
            f"{users} UAVs at once: the pilots separate at most {ofdm.STREAMS} streams"
        )
    bits = rng.random((users, blocks, BLOCK_BITS)) < 0.5
    coded = coding.encode(bits)
    symbols = modulation.modulate(coded)
    pilots = ofdm.PILOT_SIGNS[:users, np.newaxis]
    return Sent(
        bits=bits,
        coded=coded,
        symbols=symbols,
        pilots=pilots,
        samples=ofdm.samples(ofdm.carriers(symbols, pilots)),
    )


def through(taps: ComplexArray, samples: ComplexArray) -> ComplexArray:
    """Return the noise-free received samples (N, B, 320) of blocks after a channel.

    Blocks are consecutive; every stream passes every delay of ``taps`` (T, N, N).
    """
    stream = samples.reshape(len(samples), -1)
    heard = taps[0] @ stream
    for delay, tap in enumerate(taps[1:], 1):
        heard[:, delay:] += tap @ stream[:, :-delay]
    found: ComplexArray = heard.reshape(samples.shape)
    return found


def noise(users: int, blocks: int, rng: np.random.Generator) -> ComplexArray:
    """Draw white noise of power 1, samples (N, B, 320)."""
    drawn = rng.standard_normal((2, users, blocks, ofdm.SAMPLES)) * np.sqrt(0.5)
    white: ComplexArray = drawn[0] + 1j * drawn[1]
    return white


@dataclass(frozen=True, slots=True, eq=False)
class BlockErrors:
    """Errors of received blocks by UAV and block, (N, B) each."""

    raw_errors: IntArray  # wrong hard decisions on coded bits
    decoded_errors: IntArray  # wrong bits after decoding
    square_error: FloatArray  # mean square error of a symbol, over its energy


def receive(
    sent: Sent, heard: ComplexArray, noise_power: float, taps: ComplexArray, estimation: Estimation
) -> BlockErrors:
    """Decode received carriers (N, B, 256), noise included; count errors.

        noise_power  per carrier, over the energy of a symbol
        taps         (T, N, N), used for the exact channel only
        estimation   channel knowledge of the receiver

    The receiver ignores interference. Where it assumes a flat channel, the noise power does not
    matter, because it scales all soft bits of a block equally.
    """
    if estimation is Estimation.PILOTS:
        gain = ofdm.flat_estimate(heard, sent.pilots)
    else:
        own = np.einsum("tii->ti", taps)
        gain = ofdm.frequency_response(own)[ofdm.DATA].T[:, np.newaxis]
    equalised = heard[..., ofdm.DATA] / gain
    soft = modulation.soft_bits(equalised, noise_power / np.abs(gain) ** 2)
    raw_errors = np.count_nonzero((soft < 0) != sent.coded, axis=-1)
    decoded_errors = np.zeros_like(raw_errors)
    # A code word without a wrong soft bit is the most likely one: decoding would not change it.
    doubtful = raw_errors > 0
    if doubtful.any():
        wrong = coding.decode(soft[doubtful]) != sent.bits[doubtful]
        decoded_errors[doubtful] = np.count_nonzero(wrong, axis=-1)
    square_error = np.mean(np.abs(equalised - sent.symbols) ** 2, axis=-1)
    return BlockErrors(raw_errors, decoded_errors, square_error)
