"""Calibration of a CN0566 Phaser: untrusted pickles of numbers, read safely.

``adi.CN0566`` (pyadi-iio) adds ``phase_cal_val.pkl``, degrees, to each element's wanted phase, and
multiplies its gain code by ``gain_cal_val.pkl``; both are lists of eight. The channel errors are
therefore the opposite. A pickle may call any function: here only numbers, lists and numpy's scalars
are allowed.
"""

import io
import math
import pickle
import struct
from typing import Any, Final

from companion.beams.hardware.calibration import PHASE_MAX_DEG, Calibration, is_number
from companion.values import UserError

ELEMENTS: Final = 8
ORDER: Final = (6, 7, 4, 5, 2, 3, 0, 1)
"""Element of each channel: BEAM0 has 7, 8, 5, 6, and BEAM1 3, 4, 1, 2, counted from 1."""
LARGEST_BYTES: Final = 10_000
_SCALARS: Final = {"f8": "d", "f4": "f", "i8": "q", "i4": "i"}


def calibration(phases: bytes, gains: bytes) -> Calibration:
    """Return the calibration in two pickles; raises ``UserError`` unless each has 8 numbers."""
    added_deg = numbers("phase calibration", phases)
    factors = numbers("gain calibration", gains)
    if not all(factor > 0 for factor in factors):
        raise UserError("gain calibration: a factor is not above 0")
    return Calibration(
        phase_rad=tuple(math.radians(-phase) for phase in added_deg),
        gain_db=tuple(-20 * math.log10(factor) for factor in factors),
        order=ORDER,
    )


def numbers(what: str, data: bytes) -> list[float]:
    """Return the eight numbers in a pickle. Raises ``UserError`` for anything else."""
    if len(data) > LARGEST_BYTES:
        raise UserError(f"{what}: more than a list of {ELEMENTS} numbers")
    try:
        found = _Numbers(io.BytesIO(data)).load()
    except UserError:
        raise
    except Exception as error:  # a damaged pickle can raise anything
        raise UserError(f"{what}: not a pickle of numbers: {error}") from error
    good = isinstance(found, list) and len(found) == ELEMENTS
    if not good or not all(is_number(one, PHASE_MAX_DEG) for one in found):
        raise UserError(
            f"{what}: not a list of {ELEMENTS} finite numbers within {PHASE_MAX_DEG:.0f}"
        )
    return [float(one) for one in found]


class _Numbers(pickle.Unpickler):
    """Unpickler that allows only numbers, and numpy's scalars by its own functions."""

    def find_class(self, module: str, name: str) -> Any:
        """Return stand-ins for the names that numpy's scalars need; reject all others."""
        if module in ("numpy.core.multiarray", "numpy._core.multiarray") and name == "scalar":
            return _scalar
        if (module, name) == ("numpy", "dtype"):
            return _Kind
        raise UserError(f"the pickle would call {module}.{name}: only numbers are read")


class _Kind:
    """Type of number by its name; numpy's state for it only gives the byte order."""

    def __init__(self, name: object, *_: object) -> None:
        self.name = name

    def __setstate__(self, state: object) -> None:
        """Reject numbers that are not little-endian."""
        if not (isinstance(state, tuple) and len(state) > 1 and state[1] == "<"):
            raise UserError("numbers of an unknown byte order")


def _scalar(kind: object, data: object) -> float:
    letter = _SCALARS.get(str(kind.name)) if isinstance(kind, _Kind) else None
    if letter is None or not isinstance(data, bytes):
        raise UserError("the pickle contains a value that is not a number")
    (value,) = struct.unpack("<" + letter, data)
    return float(value)
