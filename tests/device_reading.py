"""Device tables read back from their text: the other side of ``beams.hardware``, for its tests.

The columns must agree among themselves; a reader raises ``ValueError`` that names the line.
"""

import numpy as np

from companion.beams.hardware.calibration import Calibration, fields, real, whole
from companion.beams.hardware.device_text import ADAR1000_HEADER, TMYTEK_HEADER
from companion.beams.hardware.devices import (
    ADAR1000_CHANNELS,
    ADAR1000_GAINS,
    ADAR1000_PHASES,
    LIMITS,
    SETTINGS,
    SIVERS_ANTENNAS,
    SIVERS_OFFSET,
    SIVERS_ROWS,
    TMYTEK_CHANNELS,
    TMYTEK_SETTINGS,
    TMYTEK_STEP_DB,
    Beamformer,
    Mode,
    vector_modulator,
)
from companion.beams.hardware.tables import DeviceTable
from companion.values import IntArray


def parse(device: Beamformer, text: str, calibration: Calibration) -> DeviceTable:
    """The table that a text sets, and what it radiates with this calibration.

    ``ValueError`` where the text is not the device's, or is for another array.
    """
    order = calibration.order
    match device:
        case Beamformer.ADAR1000:
            uavs, codes, order = read_adar1000(text)
        case Beamformer.TMYTEK:
            codes = read_tmytek(text)
            uavs = tuple(str(beam + 1) for beam in range(len(codes)))
        case Beamformer.SIVERS:
            uavs, codes = read_sivers(text)
    if codes.shape[1] != len(calibration.order) or order != calibration.order:
        raise ValueError(
            f"the table drives elements {order} by {codes.shape[1]} channels, "
            f"the calibration {calibration.order}"
        )
    weights = np.empty(codes.shape[:2], dtype=complex).T
    weights[list(order)] = SETTINGS[device].values(codes).T
    weights *= calibration.factors[:, np.newaxis]
    return DeviceTable(
        device=device, uavs=uavs, codes=codes, order=order, weights=weights, loss_db=None
    )


def _beams(rows: dict[tuple[int, int], tuple[int, int]], first: int, channels: int) -> IntArray:
    """Codes (K, M, 2) of rows by (beam, channel); ``ValueError`` where one is missing."""
    count = max((beam for beam, _ in rows), default=first - 1) - first + 1
    wanted = [(beam + first, channel) for beam in range(count) for channel in range(channels)]
    missing = [key for key in wanted if key not in rows]
    if missing or not wanted:
        beam, channel = missing[0] if missing else (first, 0)
        raise ValueError(f"beam {beam} has no line for channel {channel} (counted from 0)")
    return np.array([rows[key] for key in wanted], dtype=np.int64).reshape(count, channels, 2)


def read_adar1000(text: str) -> tuple[tuple[str, ...], IntArray, tuple[int, ...]]:
    """Names, codes and order from ``write_adar1000``; the columns must agree among themselves."""
    names: dict[int, str] = {}
    order: dict[int, int] = {}
    rows: dict[tuple[int, int], tuple[int, int]] = {}
    for number, found in fields(text, ADAR1000_HEADER):
        beam = whole(number, "beam", found[0], 0, LIMITS[Beamformer.ADAR1000].beams - 1)
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
        beam = whole(number, "BeamID", found[1], 1, LIMITS[Beamformer.TMYTEK].beams)
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
