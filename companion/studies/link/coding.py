"""Convolutional code of the link: rate 1/3, constraint length 7, and its Viterbi decoder.

Generators 133, 171, 165 (octal), newest bit in the most significant place; each block ends with
six zeros, which return the encoder to state 0. A state is the last six bits, newest in the most
significant place.

All three generators have their first and their last tap. Therefore the outputs of the two branches
that leave a state, and of the two that enter one, are complements, and states form butterflies: 2j
and 2j + 1 lead to j (after a 0) and j + 32 (after a 1), with branch metrics +g and -g.
(G. D. Forney, "The Viterbi algorithm", Proceedings of the IEEE 61(3), 1973.)
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.values import BoolArray, FloatArray

GENERATORS: Final = (0o133, 0o171, 0o165)
CONSTRAINT: Final = 7
TAIL: Final = CONSTRAINT - 1  # zeros after each block
STATES: Final = 1 << TAIL
BATCH: Final = 128  # blocks decoded at once: their path metrics fit the processor's cache

_TAPS: Final = np.array(
    [[bool(g >> (TAIL - i) & 1) for i in range(CONSTRAINT)] for g in GENERATORS], dtype=np.bool_
)
"""Matrix (3, 7): whether a generator uses the bit of i bits ago."""


def _butterfly_signs() -> NDArray[np.float32]:
    """Return (32, 3), the output of state 2j after a 0 bit, with +1 for a 0 and -1 for a 1."""
    states = 2 * np.arange(STATES // 2)
    held = np.array([states >> (CONSTRAINT - 1 - i) & 1 for i in range(1, CONSTRAINT)])
    sent = _TAPS[:, 1:].astype(int) @ held % 2
    signs: NDArray[np.float32] = (1 - 2 * sent.T).astype(np.float32)
    return signs


_SIGNS: Final = _butterfly_signs()


def encode(bits: BoolArray) -> BoolArray:
    """Encode bits (..., k) to code words (..., 3 (k + 6)): three per bit, tail included."""
    steps = bits.shape[-1] + TAIL
    ends = [(0, 0)] * (bits.ndim - 1)
    padded = np.pad(bits, [*ends, (TAIL, TAIL)])
    coded = np.zeros((*bits.shape[:-1], steps, len(GENERATORS)), dtype=np.bool_)
    for output, taps in enumerate(_TAPS):
        for ago in np.flatnonzero(taps):
            coded[..., output] ^= padded[..., TAIL - ago : TAIL - ago + steps]
    return coded.reshape(*bits.shape[:-1], -1)


def decode(soft: FloatArray) -> BoolArray:
    """Return the most likely blocks of bits (B, k) of soft code words (B, 3 (k + 6)).

    ``soft`` is log P(bit 0) / P(bit 1), up to a positive factor per block. Computed in single
    precision. Raises ``ValueError`` for a length that no code word has.
    """
    blocks, length = soft.shape
    steps = length // len(GENERATORS)
    if length % len(GENERATORS) or steps <= TAIL:
        raise ValueError(
            f"{length} soft bits do not make a code word; give 3 per bit and 18 for the tail"
        )
    bits = np.empty((blocks, steps), dtype=np.bool_)
    for start in range(0, blocks, BATCH):
        some = soft[start : start + BATCH].astype(np.float32)
        by_step = np.ascontiguousarray(some.reshape(len(some), steps, -1).transpose(1, 2, 0))
        bits[start : start + BATCH] = _trace_back(_decisions(by_step)).T
    return bits[:, :-TAIL]


def _decisions(soft: NDArray[np.float32]) -> BoolArray:
    """Return (steps, 64, B): whether the best path into a state comes from its odd predecessor."""
    steps, _, blocks = soft.shape
    half = STATES // 2
    odd_wins = np.empty((steps, STATES, blocks), dtype=np.bool_)
    metrics = np.full((STATES, blocks), -np.inf, dtype=np.float32)
    metrics[0] = 0.0
    after = np.empty_like(metrics)
    for step in range(steps):
        g = _SIGNS @ soft[step]
        even, odd = metrics[0::2], metrics[1::2]
        for states, branch in ((slice(half), g), (slice(half, None), -g)):
            from_even, from_odd = even + branch, odd - branch
            np.greater(from_odd, from_even, out=odd_wins[step, states])
            np.maximum(from_even, from_odd, out=after[states])
        metrics, after = after, metrics
    return odd_wins


def _trace_back(odd_wins: BoolArray) -> BoolArray:
    """Return the bits (steps, B) of the best path, which ends in state 0."""
    steps, _, blocks = odd_wins.shape
    bits = np.empty((steps, blocks), dtype=np.bool_)
    every, state = np.arange(blocks), np.zeros(blocks, dtype=np.int64)
    for step in range(steps - 1, -1, -1):
        bits[step] = state >> (TAIL - 1)
        state = (state << 1 & STATES - 1) | odd_wins[step, state, every]
    return bits
