"""Error rates and confidence intervals from the counts of the link study."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from companion.studies.link.blocks import BLOCK_BITS, CODED_BITS, BlockErrors
from companion.studies.origin import Row
from companion.values import FloatArray

Z95: Final = 1.959963984540054  # half-width of a 95 per cent interval, in standard deviations


def row(
    positions: str, snr_db: float, coded: bool, counted: Sequence[BlockErrors], symbol_s: float
) -> Row:
    """Return one point of an error-rate curve over all UAVs; ``counted`` has one entry per instant.

    ber, bler     shares of wrong bits and of wrong blocks
    evm_percent   median over blocks of the RMS error of equalised symbols, over the RMS of a symbol
                  (a few blocks with missed beams would dominate a mean)
    rate_bps      bits of error-free blocks over time, for one UAV
    confidence    95 per cent intervals of ``ber`` and ``bler``
    """
    bits = BLOCK_BITS if coded else CODED_BITS
    errors = [each.decoded_errors if coded else each.raw_errors for each in counted]
    blocks = np.array([each.size for each in errors], dtype=float)
    wrong_bits = np.array([each.sum() for each in errors], dtype=float)
    wrong_blocks = np.array([np.count_nonzero(each) for each in errors], dtype=float)
    ber = float(wrong_bits.sum() / (bits * blocks.sum()))
    bler = float(wrong_blocks.sum() / blocks.sum())
    square_error = np.concatenate([each.square_error.ravel() for each in counted])
    # Errors of a decoder come in bursts: blocks, not bits, are the independent trials.
    tried = blocks.sum() * (1 if coded else bits)
    return {
        "snr_db": snr_db,
        "positions": positions,
        "coded": coded,
        "ber": ber,
        "bler": bler,
        "evm_percent": 100 * float(np.median(np.sqrt(square_error))),
        "rate_bps": (1 - bler) * bits / symbol_s,
        "n_bits": int(bits * blocks.sum()),
        "n_blocks": int(blocks.sum()),
        "confidence": {
            "ber": interval(wrong_bits, bits * blocks, float(tried)),
            "bler": interval(wrong_blocks, blocks, float(blocks.sum())),
        },
    }


def interval(wrong: FloatArray, tried: FloatArray, independent: float) -> tuple[float, float]:
    """Return the 95 per cent confidence interval of an error share, from clusters (instants).

        wrong        errors by cluster
        tried        trials by cluster
        independent  independent trials, used without errors or with one cluster

    Wilson's score interval, with the number of independent trials that would have the observed
    variance between clusters (E. Korn and B. Graubard, 1998).
    """
    total, clusters = float(tried.sum()), len(tried)
    share = float(wrong.sum() / total)
    count = independent
    if clusters > 1 and 0 < share < 1:
        strays = wrong - share * tried
        variance = clusters / (clusters - 1) * float(strays @ strays) / total**2
        count = min(total, share * (1 - share) / variance) if variance > 0 else total
    z2 = Z95**2 / count
    middle = (share + z2 / 2) / (1 + z2)
    half = math.sqrt(share * (1 - share) * z2 + z2 * z2 / 4) / (1 + z2)
    return max(0.0, middle - half), min(1.0, middle + half)


def crossing_db(rows: Sequence[Row], positions: str, coded: bool, target: float) -> float | None:
    """Return the SNR above which a curve stays below a bit error rate, dB; None without one.

    Interpolated linearly on the logarithm of the rate; a lower point without errors counts as one
    wrong bit.
    """
    curve = [row for row in rows if (row["positions"], row["coded"]) == (positions, coded)]
    above = [i for i, row in enumerate(curve) if row["ber"] > target]
    if not above or above[-1] + 1 == len(curve):
        return None
    high, low = curve[above[-1]], curve[above[-1] + 1]
    least = low["ber"] or min(1 / low["n_bits"], target)
    part = math.log(high["ber"] / target) / math.log(high["ber"] / least)
    crossed: float = high["snr_db"] + part * (low["snr_db"] - high["snr_db"])
    return crossed
