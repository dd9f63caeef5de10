"""Tables of settings in the text formats of the devices' own tools.

Settings come as codes (K, M, 2) of K beams and M channels, in the order of the channels, as in
``companion.beams.hardware.devices``.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from companion.beams.hardware.devices import (
    ADAR1000_CHANNELS,
    ADAR1000_GAINS,
    ADAR1000_PHASES,
    SIVERS_ANTENNAS,
    SIVERS_OFFSET,
    SIVERS_ROWS,
    TMYTEK_STEP_DB,
    vector_modulator,
)
from companion.beams.hardware.unit_gains import UnitGains
from companion.values import IntArray, UserError

ADAR1000_HEADER: Final = (
    "beam,uav,chip,channel,element,phase_code,phase_deg,gain_code,attenuator,vm_i,vm_q"
)
TMYTEK_HEADER: Final = "Mode,BeamID,BeamType,beam_db,beam_theta,beam_phi,ch,ch_sw,ch_db,ch_deg"


def check_name(uav: str) -> str:
    """Return a name if it is valid in a line of fields; else raise ``UserError``."""
    if not uav or uav != uav.strip() or not uav.isprintable() or set(uav) & set(',"'):
        raise UserError(f"UAV {uav!r}: name has a comma, quote, line break or outer blank")
    return uav


def write_adar1000(uavs: Sequence[str], codes: IntArray, order: Sequence[int]) -> str:
    """Write CSV with a line for each beam and channel: the registers of each chip.

    Beams are the RAM positions from 0; chips and elements count from 0, channels of a chip from 1
    as on the data sheet. ``vm_i`` and ``vm_q`` are the vector modulator's register bytes,
    hexadecimal. Phases are of elements, not the direction cosines of a steering call.
    """
    lines = [ADAR1000_HEADER]
    for beam, uav in enumerate(uavs):
        for place, (phase, level) in enumerate(codes[beam].tolist()):
            chip, channel = divmod(place, ADAR1000_CHANNELS)
            gain, attenuator = ADAR1000_GAINS[level]
            i, q = vector_modulator(phase)
            degrees = f"{phase * 360 / ADAR1000_PHASES:.4f}"
            lines.append(
                f"{beam},{check_name(uav)},{chip},{channel + 1},{order[place]},{phase},{degrees},"
                f"{gain},{attenuator},{i:02X},{q:02X}"
            )
    return "\n".join(lines) + "\n"


def write_tmytek(codes: IntArray, gains: UnitGains) -> str:
    """Write TLKCore's CSV, a line for each beam and channel (BeamType 1); beams count from 1.

    A channel that is off gets the lowest gain of the unit, because TLKCore checks the differences
    within its board. The format has no field for names.
    """
    lowest = round(gains.range_db / TMYTEK_STEP_DB)
    lines = [TMYTEK_HEADER]
    for beam, row in enumerate(codes.tolist(), start=1):
        for channel, (degrees, level) in enumerate(row, start=1):
            gain_db = gains.full_gain_db - TMYTEK_STEP_DB * min(level, lowest)
            off = int(level > lowest)
            lines.append(f"{gains.mode},{beam},1,,,,{channel},{off},{gain_db:.1f},{degrees}")
    return "\n".join(lines) + "\n"


def write_sivers(uavs: Sequence[str], codes: IntArray, frequency_hz: float) -> str:
    """Write an Eder beam book of one table: 64 rows of Q and I bytes, antenna 15 first.

    The manufacturer's loader packs each pair to Q << 6 | I. It searches for ``START_TABLE FREQ:``
    (GHz) and skips the text before, where the names of the rows are written. Rows without a beam
    are silent.
    """
    if not np.isfinite(frequency_hz) or frequency_hz <= 0:
        raise UserError(f"frequency {frequency_hz} Hz is not above 0")
    table = np.zeros((SIVERS_ROWS, SIVERS_ANTENNAS, 2), dtype=np.int64)
    table[: len(codes)] = codes
    words = (table[:, ::-1, ::-1] + SIVERS_OFFSET).reshape(SIVERS_ROWS, -1)
    names = [f"# row {row}: {check_name(uav)}" for row, uav in enumerate(uavs)]
    rows = [",".join(f"0x{word:02X}" for word in row) for row in words.tolist()]
    start = f"START_TABLE FREQ:{frequency_hz / 1e9:.2f} TEMP:0.0"
    return "\n".join([*names, start, *rows, "END_TABLE"]) + "\n"
