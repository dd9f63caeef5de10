"""Stored beams as a digital beam table, for a base station with a port per element.

OpenAirInterface reads them from CSV (``dbt_file``, with ``bf_method = "predefined"``): a header,
then a line per beam with its id and a complex weight for each port. It multiplies real and
imaginary parts by 32767 and rounds, as in the PHY API's table (5G FAPI, SCF 222, digital beam
table: 16 bits each, Q15). The values written here are those integers over 32767, so that its
rounding changes nothing. A port's samples are multiplied by its weight: no conjugate, as everywhere
here.
"""

from typing import Final

import numpy as np

from companion.beams.hardware.calibration import Calibration
from companion.beams.hardware.codebooks import Codebook
from companion.values import IntArray, UserError

FULL_SCALE: Final = 32767
MOST_BEAMS: Final = 1 << 16  # ids of beams have 16 bits


def q15(codebook: Codebook, calibration: Calibration) -> IntArray:
    """Return the weights' real and imaginary parts (K, M, 2) by beam and port, 16-bit integers.

    Ports are the calibration's channels, and their errors are compensated. Beams have unit power,
    unless a weak channel requires lower power of all beams to stay within the range. Raises
    ``UserError`` for more beams than ids.
    """
    if codebook.size > MOST_BEAMS:
        raise UserError(f"{codebook.size} beams exceed a digital beam table's {MOST_BEAMS}")
    ports = (codebook.weights / calibration.factors[:, np.newaxis])[list(calibration.order)]
    parts = np.stack([ports.real, ports.imag], axis=-1).transpose(1, 0, 2)
    parts /= max(1.0, float(np.abs(parts).max()))
    rounded: IntArray = np.rint(parts * FULL_SCALE).astype(np.int64)
    return rounded


def write_oai_dbt(codebook: Codebook, calibration: Calibration) -> str:
    """Write OpenAirInterface's CSV; beam ids are the indices of the codebook, as in the API."""
    table = q15(codebook, calibration)
    lines = [",".join(["beam_id", *(f"txru{port}" for port in range(table.shape[1]))])]
    for beam, row in enumerate((table / FULL_SCALE).tolist()):
        lines.append(",".join([str(beam), *(f"{re:.6f}{im:+.6f}i" for re, im in row)]))
    return "\n".join(lines) + "\n"
