"""Possible gains of a TMYTEK unit: its own limits, from a file for each unit.

A channel's gain is the common gain of its board, four channels, plus an element gain from 0 to the
board's limit. TLKCore gives both at the operating frequency (``getCOMDR``, ``getELEDR``), and
checks each beam against them: the elements of a board differ by at most the element limit, and its
common gain is within its range. The file is TOML:

    mode = "TX"                                 # or "RX"
    common_db = [[-1.0, 9.5], [-1.0, 9.5], [-1.0, 9.5], [-1.0, 9.5]]
    element_db = [4.0, 4.0, 4.0, 4.0]

All boards use one range, that of the weakest: every board reaches its top, and each beam has its
strongest element there.
"""

import math
from dataclasses import dataclass
from typing import Any, Final

from companion.beams.hardware.calibration import is_number
from companion.beams.hardware.devices import TMYTEK_CHANNELS, TMYTEK_RANGE_DB, TMYTEK_STEP_DB, Mode
from companion.beams.hardware.quantise import Resolution, stepped
from companion.values import UserError, read_toml, shown

BOARD_CHANNELS: Final = 4
BOARDS: Final = TMYTEK_CHANNELS // BOARD_CHANNELS
UNIT_MAX_DB: Final = 200.0
"""Largest magnitude of a gain of a TMYTEK unit, dB; each step of the range takes memory."""
KEYS: Final = {"mode", "common_db", "element_db"}


@dataclass(frozen=True, slots=True)
class UnitGains:
    """Gains of all channels of a TMYTEK unit."""

    mode: Mode  # transmission or reception, which have different limits
    full_gain_db: float  # gain of an element at full gain, in steps of TMYTEK_STEP_DB
    range_db: float  # range of an element below that, in such steps

    @property
    def settings(self) -> Resolution:
        """Possible gain and phase settings of one channel."""
        step_db = TMYTEK_STEP_DB if self.range_db else None
        return stepped(360, step_db, self.range_db, off=True)


RELATIVE: Final = UnitGains(Mode.TX, 0.0, TMYTEK_RANGE_DB)
"""Gains relative to the strongest element, for an unknown TMYTEK unit, which may reject them."""


def parse_unit_gains(text: str) -> UnitGains:
    """Parse a TOML file with the gains of a TMYTEK unit. ``UserError`` names the key."""
    told = read_toml(text)
    if set(told) != KEYS:
        raise UserError(f"keys are {', '.join(sorted(told))}; give {', '.join(sorted(KEYS))}")
    if told["mode"] not in tuple(Mode):
        raise UserError(f'mode = {shown(told["mode"])} is not "TX" or "RX"')
    common = [_numbers("common_db", pair, 2) for pair in _by_board("common_db", told["common_db"])]
    element = _numbers("element_db", _by_board("element_db", told["element_db"]), BOARDS)
    if any(low > high for low, high in common) or min(element) < 0:
        raise UserError("common_db: give least and largest per board; element_db: give 0 or more")
    full_db = _floor(min(high + more for (_, high), more in zip(common, element, strict=True)))
    range_db = _floor(min(*element, full_db - max(low for low, _ in common)))
    if range_db < 0:
        raise UserError("boards have no common gain range")
    return UnitGains(Mode(told["mode"]), full_db, range_db)


def _by_board(key: str, given: Any) -> list[Any]:
    if not isinstance(given, list) or len(given) != BOARDS:
        raise UserError(f"{key}: give one entry for each of {BOARDS} boards")
    return given


def _numbers(key: str, given: Any, count: int) -> list[float]:
    if isinstance(given, list) and len(given) == count:
        values = [float(one) for one in given if is_number(one, UNIT_MAX_DB)]
        if len(values) == count:
            return values
    raise UserError(
        f"{key}: {shown(given)} is not {count} finite numbers within {UNIT_MAX_DB:.0f} dB"
    )


def _floor(gain_db: float) -> float:
    return math.floor(gain_db / TMYTEK_STEP_DB + 1e-9) * TMYTEK_STEP_DB
