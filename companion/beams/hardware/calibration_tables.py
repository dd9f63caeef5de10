"""Calibration files: one table as CSV, or tables of several frequencies as TOML.

    order = [6, 7, 4, 5, 2, 3, 0, 1]          # element of each channel, from 0

    [[table]]
    frequency_hz = 10.0e9
    phase_deg = [0.0, 3.1, ...]               # by channel, as in the CSV
    gain_db = [0.0, -0.4, ...]
    phase_error_deg = [1.0, 1.2, ...]         # if known, in all tables: bounds on their errors
    gain_error_db = [0.1, 0.1, ...]

Between two frequencies phases are interpolated the shorter way, and gains in dB; bounds are the
larger of the two, and do not include deviations between the tables. Frequencies outside of the
tables are rejected.
"""

import itertools
import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from companion.beams.hardware.calibration import (
    CALIBRATION_HEADER,
    GAIN_MAX_DB,
    PHASE_MAX_DEG,
    Calibration,
    is_number,
    parse_calibration,
)
from companion.values import FloatArray, UserError, read_toml, shown

FARTHEST_DEG: Final = 90.0
"""Largest phase change of a channel, relative to channel 0, between adjacent frequencies."""
SAME: Final = 1e-9  # relative difference at which a frequency still equals a table's
FREQUENCY_MAX_HZ: Final = 1e15
LARGEST: Final = 1 << 22  # most characters of a file: 4096 channels at 30 frequencies
REQUIRED: Final = ("phase_deg", "gain_db")
BOUNDS: Final = ("phase_error_deg", "gain_error_db")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Table:
    """Calibration at one frequency: columns (M,) by channel; a bound is None if it is unknown."""

    frequency_hz: float
    phase_deg: FloatArray
    gain_db: FloatArray
    phase_error_deg: FloatArray | None
    gain_error_db: FloatArray | None


def calibration_at(text: str, frequency_hz: float) -> Calibration:
    """Return the calibration for a frequency; a CSV file applies to any. Raises ``UserError``."""
    if text.lstrip().startswith(CALIBRATION_HEADER):
        return parse_calibration(text)
    order, tables = _read(text)
    return _interpolated(order, tables, frequency_hz)


def _read(text: str) -> tuple[list[int], list[_Table]]:
    try:
        told = read_toml(text, LARGEST)
    except UserError as error:
        header = f"CSV must begin with {CALIBRATION_HEADER}"
        raise UserError(f"neither calibration as CSV nor as TOML: {error}; {header}") from error
    order, given = told.get("order"), told.get("table")
    if (
        set(told) != {"order", "table"}
        or not isinstance(order, list)
        or not isinstance(given, list)
    ):
        raise UserError("calibration in TOML: give an order and a [[table]] for each frequency")
    if not all(type(element) is int for element in order):
        raise UserError(f"order {shown(order)} is not a list of whole numbers")
    if sorted(order) != list(range(len(order))) or not order:
        last = max(len(order) - 1, 0)
        raise UserError(f"order {shown(order)} does not contain each of 0 to {last} once")
    tables = sorted((_table(one, len(order)) for one in given), key=lambda one: one.frequency_hz)
    for low, high in itertools.pairwise(tables):
        where = f"{low.frequency_hz:.9g} Hz and {high.frequency_hz:.9g} Hz"
        if low.frequency_hz == high.frequency_hz:
            raise UserError(f"{low.frequency_hz:.9g} Hz has two tables; give one")
        if (low.phase_error_deg is None) != (high.phase_error_deg is None):
            raise UserError(f"tables for {where}: give bounds in all tables, or in none")
    return order, tables


def _table(given: Any, size: int) -> _Table:
    if not isinstance(given, dict):
        raise UserError("[[table]] is not a table")
    bounded = bool(set(given) & set(BOUNDS))
    names = (*REQUIRED, *(BOUNDS if bounded else ()))
    if set(given) != {"frequency_hz", *names}:
        raise UserError(f"table has {', '.join(given)}; give frequency_hz, {', '.join(names)}")
    frequency = given["frequency_hz"]
    if not is_number(frequency, FREQUENCY_MAX_HZ) or frequency <= 0:
        raise UserError(
            f"frequency_hz = {shown(frequency)} is out of range; give a number above 0, up to 1e15"
        )
    columns: dict[str, FloatArray] = {}
    for name in names:
        column = given[name]
        most = GAIN_MAX_DB if name.startswith("gain") else PHASE_MAX_DEG
        numbers = isinstance(column, list) and all(is_number(one, most) for one in column)
        if not numbers or len(column) != size:
            raise UserError(
                f"{name} at {frequency:.9g} Hz is not {size} finite numbers within {most:.0f}"
            )
        columns[name] = np.array(column, dtype=float)
    return _Table(
        frequency_hz=float(frequency),
        phase_deg=columns["phase_deg"],
        gain_db=columns["gain_db"],
        phase_error_deg=columns.get("phase_error_deg"),
        gain_error_db=columns.get("gain_error_db"),
    )


def _interpolated(order: list[int], tables: list[_Table], frequency_hz: float) -> Calibration:
    if not tables:
        raise UserError("[[table]] is missing")
    low = tables[0].frequency_hz * (1 - SAME)
    if not low <= frequency_hz <= tables[-1].frequency_hz * (1 + SAME):
        known = f"{tables[0].frequency_hz:.9g} to {tables[-1].frequency_hz:.9g} Hz"
        raise UserError(f"{frequency_hz:.9g} Hz is outside the range of the tables, {known}")
    for one in tables:
        if abs(one.frequency_hz - frequency_hz) <= SAME * frequency_hz:
            return _calibration(order, one)
    above = next(n for n, one in enumerate(tables) if one.frequency_hz > frequency_hz)
    return _calibration(order, _between(tables[above - 1], tables[above], frequency_hz))


def _between(low: _Table, high: _Table, frequency_hz: float) -> _Table:
    share = (frequency_hz - low.frequency_hz) / (high.frequency_hz - low.frequency_hz)
    turned_deg = (high.phase_deg - low.phase_deg + 180) % 360 - 180
    apart_deg = (turned_deg - turned_deg[0] + 180) % 360 - 180
    if np.abs(apart_deg).max() > FARTHEST_DEG:
        worst = int(np.abs(apart_deg).argmax())
        raise UserError(
            f"phase of channel {worst} over channel 0 changes by {apart_deg[worst]:.0f} degrees"
            f" from {low.frequency_hz:.9g} to {high.frequency_hz:.9g} Hz; add a table in between"
        )
    phase_error, gain_error = None, None
    if low.phase_error_deg is not None and high.phase_error_deg is not None:
        phase_error = np.maximum(low.phase_error_deg, high.phase_error_deg)
    if low.gain_error_db is not None and high.gain_error_db is not None:
        gain_error = np.maximum(low.gain_error_db, high.gain_error_db)
    return _Table(
        frequency_hz=frequency_hz,
        phase_deg=low.phase_deg + share * (turned_deg[0] + apart_deg),
        gain_db=low.gain_db + share * (high.gain_db - low.gain_db),
        phase_error_deg=phase_error,
        gain_error_db=gain_error,
    )


def _calibration(order: list[int], table: _Table) -> Calibration:
    def by_element(column: FloatArray | None) -> tuple[float, ...]:
        if column is None:
            return ()
        return tuple(float(column[order.index(element)]) for element in range(len(order)))

    off_deg = by_element(table.phase_error_deg)
    return Calibration(
        phase_rad=tuple(math.radians(phase) for phase in by_element(table.phase_deg)),
        gain_db=by_element(table.gain_db),
        order=tuple(order),
        phase_error_rad=tuple(math.radians(phase) for phase in off_deg),
        gain_error_db=by_element(table.gain_error_db),
    )
