"""The code against a shift register, commpy, brute force and its own distance spectrum."""

import math
from itertools import product

import numpy as np
import pytest
from commpy.channelcoding import Trellis, conv_encode, viterbi_decode  # reference implementation
from scipy.stats import norm
from support import rounds

from companion.studies.link.coding import BATCH, GENERATORS, decode, encode
from companion.studies.link.modulation import modulate, soft_bits
from companion.values import BoolArray, FloatArray


@pytest.fixture(scope="module")
def trellis() -> Trellis:
    """commpy's trellis, with the newest bit most significant."""
    return Trellis(np.array([6]), np.array([[0o133, 0o171, 0o165]]), polynomial_format="Matlab")


def drawn(blocks: int, bits: int, seed: int) -> BoolArray:
    return np.random.default_rng(seed).random((blocks, bits)) < 0.5


def by_shift_register(bits: BoolArray) -> list[int]:
    """Octal digits as taps: 133 is 1 011 011, 171 is 1 111 001, 165 is 1 110 101."""
    wires = ((0, 2, 3, 5, 6), (0, 1, 2, 3, 6), (0, 1, 2, 4, 6))
    register, sent = [0] * 7, []
    for bit in [*bits.astype(int).tolist(), *[0] * 6]:
        register = [bit, *register[:-1]]
        sent += [sum(register[wire] for wire in output) % 2 for output in wires]
    return sent


def test_code_words_match_a_shift_register_and_commpy(trellis: Trellis) -> None:
    bits = drawn(6, 40, 1)
    for block, word in zip(bits, encode(bits), strict=True):
        assert word.astype(int).tolist() == by_shift_register(block)
        assert word.astype(int).tolist() == conv_encode(block.astype(int), trellis).tolist()


def test_impulse_response_equals_the_generators() -> None:
    """Its impulse response, read along the outputs."""
    sent = encode(np.array([True])).reshape(7, 3).astype(int)
    read = [int("".join(map(str, sent[:, output])), 2) for output in range(3)]
    assert read == list(GENERATORS) == [0o133, 0o171, 0o165]


def test_encoder_accepts_blocks_of_any_shape() -> None:
    bits = drawn(6, 9, 2)
    assert (encode(bits.reshape(2, 3, 9)).reshape(6, -1) == encode(bits)).all()
    assert encode(bits).shape == (6, 3 * 15)


def test_noiseless_blocks_decode_without_error() -> None:
    """More blocks than one decoder batch."""
    bits = drawn(BATCH + 3, 50, 3)
    assert (decode(1.0 - 2.0 * encode(bits)) == bits).all()


def test_decoder_matches_brute_force() -> None:
    """Every word of short blocks correlated with the received one, in heavy noise."""
    words = np.array(list(product([False, True], repeat=8)))
    signs = 1.0 - 2.0 * encode(words)
    heard = np.random.default_rng(4).standard_normal((400, signs.shape[1]))
    heard += 0.4 * signs[np.random.default_rng(5).integers(256, size=400)]
    best = words[np.argmax(heard @ signs.T, axis=1)]
    assert (decode(heard) == best).all()


def by_commpy(soft: FloatArray, trellis: Trellis, bits: int) -> BoolArray:
    """Decode with commpy; certain zeros are appended so that it ends in state 0."""
    certain = np.full(3 * 10, -1e3)
    heard = np.concatenate([-soft, certain])
    found = viterbi_decode(heard, trellis, len(heard) // 3, decoding_type="unquantized")
    return found[:bits].astype(bool)


@pytest.mark.full
@pytest.mark.parametrize("snr_db", [1.0, 2.0])
def test_noisy_blocks_decode_as_in_commpy(trellis: Trellis, snr_db: float) -> None:
    """16-QAM at bit error rates of a few per cent: the same errors, bit by bit."""
    bits = drawn(30, 38, 6)
    n0 = 10 ** (-snr_db / 10)
    symbols = modulate(encode(bits))
    noise = np.random.default_rng(7).standard_normal((2, *symbols.shape)) * math.sqrt(n0 / 2)
    soft = soft_bits(symbols + noise[0] + 1j * noise[1], n0)
    found = decode(soft)
    expected = np.array([by_commpy(block, trellis, 38) for block in soft])
    assert (expected != bits).sum() > 5
    assert (found == expected).all()


def test_decoding_is_independent_of_block_scale() -> None:
    soft = np.random.default_rng(8).standard_normal((20, 3 * 46))
    assert (decode(soft) == decode(soft * np.logspace(-3, 3, 20)[:, None])).all()


@pytest.mark.parametrize("length", [0, 18, 20])
def test_invalid_code_word_length_is_rejected(length: int) -> None:
    with pytest.raises(ValueError, match=f"{length} soft bits do not make a code word"):
        decode(np.zeros((1, length)))


def spectrum(most: int) -> FloatArray:
    """Information bits on paths that leave state 0 and return, by weight up to ``most``.

    Computed by a walk over the trellis of ``by_shift_register``, independent of the product.
    """

    def sent(register: int) -> int:
        wires = ((0, 2, 3, 5, 6), (0, 1, 2, 3, 6), (0, 1, 2, 4, 6))
        return sum(sum(register >> (6 - wire) & 1 for wire in output) % 2 for output in wires)

    paths, bits = np.zeros((2, 64, most + 1))
    paths[32, sent(64)] = bits[32, sent(64)] = 1
    found = np.zeros(most + 1)
    for _ in range(200):
        after, after_bits = np.zeros((2, 64, most + 1))
        for state in range(1, 64):
            for bit in (0, 1):
                register = bit << 6 | state
                weight, there = sent(register), register >> 1
                kept = slice(weight, None)
                lost = most + 1 - weight
                after[there, kept] += paths[state, :lost]
                after_bits[there, kept] += bits[state, :lost] + bit * paths[state, :lost]
        found += after_bits[0]
        after[0] = after_bits[0] = 0
        paths, bits = after, after_bits
    return found


def test_coded_error_rate_matches_the_union_bound() -> None:
    """Antipodal symbols: within 0.3 dB of the union bound over the distance spectrum, where the
    bound is tight."""
    weights = spectrum(26)
    assert np.flatnonzero(weights)[0] == 15  # free distance of the best such codes

    def bound(eb_n0_db: float) -> float:
        eb_n0 = 10 ** (eb_n0_db / 10)
        return float(weights @ norm.sf(np.sqrt(2 * np.arange(27) * eb_n0 / 3)))

    at_db, bits = 2.5, drawn(rounds(4_000, 12_000), 306, 9)
    words = 1.0 - 2.0 * encode(bits)
    sigma = math.sqrt(3 / (2 * 10 ** (at_db / 10)))
    heard = words + sigma * np.random.default_rng(10).standard_normal(words.shape)
    rate = np.mean(decode(heard) != bits)
    assert bound(at_db + 0.3) < rate < bound(at_db - 0.3)
