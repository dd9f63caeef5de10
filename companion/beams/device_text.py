"""Tables of settings as the text that each device's own tools read, and back again.

Settings come as codes (K, M, 2) of K beams and M channels, in the order of the channels, as
``companion.beams.devices`` has them. What is written is read back to equal codes. A reader raises
``ValueError`` that names the line and the value of what it cannot take.
"""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from companion.beams.devices import (
    ADAR1000_CHANNELS,
    ADAR1000_GAINS,
    ADAR1000_PHASES,
    LIMITS,
    SIVERS_ANTENNAS,
    SIVERS_OFFSET,
    SIVERS_ROWS,
    TMYTEK_CHANNELS,
    TMYTEK_SETTINGS,
    TMYTEK_STEP_DB,
    Device,
    Mode,
    vector_modulator,
)
from companion.values import IntArray

ADAR1000_HEADER: Final = (
    "beam,uav,chip,channel,element,phase_code,phase_deg,gain_code,attenuator,vm_i,vm_q"
)
TMYTEK_HEADER: Final = "Mode,BeamID,BeamType,beam_db,beam_theta,beam_phi,ch,ch_sw,ch_db,ch_deg"


def fields(text: str, header: str) -> Iterator[tuple[int, list[str]]]:
    """Line number and fields of each line below ``header``; lines without content are skipped."""
    lines = text.splitlines()
    if not lines or lines[0].strip() != header:
        raise ValueError(f"line 1: {lines[0] if lines else ''!r} is not the header {header!r}")
    columns = header.count(",") + 1
    for number, line in enumerate(lines[1:], start=2):
        if not line.strip(", \t"):
            continue
        found = [field.strip() for field in line.split(",")]
        if len(found) != columns:
            raise ValueError(f"line {number}: {line!r} has {len(found)} fields, not {columns}")
        yield number, found


def whole(number: int, name: str, field: str, least: int, most: int) -> int:
    """A whole number of a line; ``ValueError`` outside ``least`` to ``most``."""
    digits = field.removeprefix("-")
    if not (digits.isascii() and digits.isdecimal()) or not least <= int(field) <= most:
        raise ValueError(
            f"line {number}: {name} {field!r} is not a whole number, {least} to {most}"
        )
    return int(field)


def real(number: int, name: str, field: str) -> float:
    """A finite number of a line; ``ValueError`` for anything else."""
    try:
        value = float(field)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ValueError(f"line {number}: {name} {field!r} is not a finite number")
    return value


def check_name(uav: str) -> str:
    """The name, if it can stand in a line of fields; ``ValueError`` if not."""
    if not uav or uav != uav.strip() or not uav.isprintable() or set(uav) & set(',"'):
        raise ValueError(f"UAV {uav!r}: a name has no comma, quote, line break or outer blank")
    return uav


def _beams(rows: dict[tuple[int, int], tuple[int, int]], first: int, channels: int) -> IntArray:
    """Codes (K, M, 2) of rows by (beam, channel); ``ValueError`` where one is missing."""
    count = max((beam for beam, _ in rows), default=first - 1) - first + 1
    wanted = [(beam + first, channel) for beam in range(count) for channel in range(channels)]
    missing = [key for key in wanted if key not in rows]
    if missing or not wanted:
        beam, channel = missing[0] if missing else (first, 0)
        raise ValueError(f"beam {beam} has no line for channel {channel} (counted from 0)")
    return np.array([rows[key] for key in wanted], dtype=np.int64).reshape(count, channels, 2)


def write_adar1000(uavs: Sequence[str], codes: IntArray, order: Sequence[int]) -> str:
    """CSV, a line for each beam and channel: what the registers of each chip are set to.

    Beams are the RAM positions from 0, chips and elements count from 0, channels of a chip from 1
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


def read_adar1000(text: str) -> tuple[tuple[str, ...], IntArray, tuple[int, ...]]:
    """Names, codes and order from ``write_adar1000``; the columns must agree among themselves."""
    names: dict[int, str] = {}
    order: dict[int, int] = {}
    rows: dict[tuple[int, int], tuple[int, int]] = {}
    for number, found in fields(text, ADAR1000_HEADER):
        beam = whole(number, "beam", found[0], 0, LIMITS[Device.ADAR1000].beams - 1)
        chip = whole(number, "chip", found[2], 0, 9999)
        channel = whole(number, "channel", found[3], 1, ADAR1000_CHANNELS)
        place = chip * ADAR1000_CHANNELS + channel - 1
        element = whole(number, "element", found[4], 0, 9999 * ADAR1000_CHANNELS)
        if names.setdefault(beam, found[1]) != found[1]:
            raise ValueError(f"line {number}: uav {found[1]!r}, where beam {beam} had another")
        if order.setdefault(place, element) != element:
            raise ValueError(f"line {number}: element {element}, where the channel had another")
        if (beam, place) in rows:
            raise ValueError(f"line {number}: beam {beam} has this channel already")
        rows[beam, place] = _adar1000_codes(number, found)
    codes = _beams(rows, 0, max(order, default=0) + 1)
    return (
        tuple(names[beam] for beam in range(len(codes))),
        codes,
        tuple(order[place] for place in range(codes.shape[1])),
    )


def _adar1000_codes(number: int, found: list[str]) -> tuple[int, int]:
    phase = whole(number, "phase_code", found[5], 0, ADAR1000_PHASES - 1)
    if abs(real(number, "phase_deg", found[6]) - phase * 360 / ADAR1000_PHASES) > 1e-3:
        raise ValueError(f"line {number}: phase_deg {found[6]} is not that of code {phase}")
    gain = whole(number, "gain_code", found[7], 0, 127)
    attenuator = whole(number, "attenuator", found[8], 0, 1)
    if (gain, attenuator) not in ADAR1000_GAINS:
        raise ValueError(
            f"line {number}: gain_code {gain} with attenuator {attenuator} is not used"
        )
    i, q = vector_modulator(phase)
    if [field.upper() for field in found[9:]] != [f"{i:02X}", f"{q:02X}"]:
        raise ValueError(f"line {number}: vm_i, vm_q {found[9:]} are not those of phase {phase}")
    return phase, ADAR1000_GAINS.index((gain, attenuator))


def write_tmytek(codes: IntArray, mode: Mode, full_gain_db: float) -> str:
    """CSV for TLKCore, a line for each beam and channel (BeamType 1); beams count from 1.

    ``full_gain_db`` is ``ch_db`` of an element at full gain: the top of the range that the unit
    states for its channels, in half decibels. The format has no room for names.
    """
    if not np.isfinite(full_gain_db) or full_gain_db % TMYTEK_STEP_DB:
        raise ValueError(f"full gain {full_gain_db} dB is not in steps of {TMYTEK_STEP_DB} dB")
    lowest = len(TMYTEK_SETTINGS.levels) - 2
    lines = [TMYTEK_HEADER]
    for beam, row in enumerate(codes.tolist(), start=1):
        for channel, (degrees, level) in enumerate(row, start=1):
            gain_db = full_gain_db - TMYTEK_STEP_DB * min(level, lowest)
            off = int(level > lowest)
            lines.append(f"{mode},{beam},1,,,,{channel},{off},{gain_db:.1f},{degrees}")
    return "\n".join(lines) + "\n"


def read_tmytek(text: str) -> IntArray:
    """Codes from ``write_tmytek``. The loudest element of the table is taken for full gain."""
    modes: set[str] = set()
    found_at: dict[tuple[int, int], tuple[int, int, int, float]] = {}
    for number, found in fields(text, TMYTEK_HEADER):
        mode, kind = found[0], found[2]
        if mode not in tuple(Mode) or modes - {mode}:
            raise ValueError(f"line {number}: Mode {mode!r} is not TX or RX, one for all")
        modes.add(mode)
        if kind != "1" or any(found[3:6]):
            raise ValueError(
                f"line {number}: BeamType {kind!r}: only 1, tables of channels, is read"
            )
        beam = whole(number, "BeamID", found[1], 1, LIMITS[Device.TMYTEK].beams)
        channel = whole(number, "ch", found[6], 1, TMYTEK_CHANNELS) - 1
        if (beam, channel) in found_at:
            raise ValueError(f"line {number}: beam {beam} has channel {channel + 1} already")
        off = whole(number, "ch_sw", found[7], 0, 1)
        degrees = whole(number, "ch_deg", found[9], 0, 359)
        found_at[beam, channel] = number, degrees, off, real(number, "ch_db", found[8])
    loudest_db = max((gain_db for _, _, off, gain_db in found_at.values() if not off), default=0.0)
    rows = {key: _tmytek_codes(*value, loudest_db) for key, value in found_at.items()}
    return _beams(rows, 1, TMYTEK_CHANNELS)


def _tmytek_codes(
    number: int, degrees: int, off: int, gain_db: float, loudest_db: float
) -> tuple[int, int]:
    last = len(TMYTEK_SETTINGS.levels) - 1
    if off:
        return degrees, last
    steps = (loudest_db - gain_db) / TMYTEK_STEP_DB
    if steps != int(steps) or steps >= last:
        raise ValueError(
            f"line {number}: ch_db {gain_db} is not in steps of {TMYTEK_STEP_DB} dB, "
            f"at most {(last - 1) * TMYTEK_STEP_DB} dB below the loudest, {loudest_db}"
        )
    return degrees, int(steps)


def write_sivers(uavs: Sequence[str], codes: IntArray, frequency_hz: float) -> str:
    """An Eder beam book of one table: 64 rows of Q and I bytes, antenna 15 first.

    The maker's loader packs each pair to Q << 6 | I. It looks for ``START_TABLE FREQ:`` (GHz) and
    skips what comes before: there stand the names of the rows. Rows without a beam are silent.
    """
    if not np.isfinite(frequency_hz) or frequency_hz <= 0:
        raise ValueError(f"frequency {frequency_hz} Hz is not above 0")
    table = np.zeros((SIVERS_ROWS, SIVERS_ANTENNAS, 2), dtype=np.int64)
    table[: len(codes)] = codes
    words = (table[:, ::-1, ::-1] + SIVERS_OFFSET).reshape(SIVERS_ROWS, -1)
    names = [f"# row {row}: {check_name(uav)}" for row, uav in enumerate(uavs)]
    rows = [",".join(f"0x{word:02X}" for word in row) for row in words.tolist()]
    start = f"START_TABLE FREQ:{frequency_hz / 1e9:.2f} TEMP:0.0"
    return "\n".join([*names, start, *rows, "END_TABLE"]) + "\n"


def read_sivers(text: str) -> tuple[tuple[str, ...], IntArray]:
    """Names and codes from ``write_sivers``; rows without a name are left out."""
    lines = text.splitlines()
    starts = [at for at, line in enumerate(lines) if line.startswith("START_TABLE FREQ:")]
    if len(starts) != 1 or "END_TABLE" not in lines[starts[0] :]:
        raise ValueError("there must be one table, START_TABLE FREQ: to END_TABLE")
    end = lines.index("END_TABLE", starts[0])
    names: list[str] = []
    for number, line in enumerate(lines[: starts[0]], start=1):
        mark, colon, name = line.partition(": ")
        if mark != f"# row {len(names)}" or not colon:
            raise ValueError(f"line {number}: {line!r} is not the name of row {len(names)}")
        names.append(name)
    rows = lines[starts[0] + 1 : end]
    if len(rows) != SIVERS_ROWS or len(names) > SIVERS_ROWS:
        raise ValueError(f"the table has {len(rows)} rows, not {SIVERS_ROWS}")
    words = [_sivers_row(starts[0] + 2 + at, row) for at, row in enumerate(rows)]
    pairs = np.array(words, dtype=np.int64).reshape(SIVERS_ROWS, SIVERS_ANTENNAS, 2)
    return tuple(names), pairs[: len(names), ::-1, ::-1] - SIVERS_OFFSET


def _sivers_row(number: int, line: str) -> list[int]:
    most = 2 * SIVERS_OFFSET
    allowed = {f"0x{word:02X}": word for word in range(most + 1)}
    found = line.split(",")
    if len(found) != 2 * SIVERS_ANTENNAS:
        raise ValueError(f"line {number}: {len(found)} values, not {2 * SIVERS_ANTENNAS}")
    for field in found:
        if field not in allowed:
            raise ValueError(f"line {number}: {field!r} is not 0x00 to 0x{most:02X}")
    return [allowed[field] for field in found]
