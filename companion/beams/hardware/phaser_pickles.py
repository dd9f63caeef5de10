"""Calibration of a CN0566 Phaser: untrusted pickles of numbers, read safely.

``adi.CN0566`` (pyadi-iio) adds ``phase_cal_val.pkl``, degrees, to each element's wanted phase, and
multiplies its gain code by ``gain_cal_val.pkl``; both are lists of eight. The channel errors are
therefore the opposite. A pickle may call any function and take any memory. Here only numbers, lists
and numpy's scalars are read, by an interpreter of the few opcodes that they need.
"""

import math
import pickletools
import struct
from collections.abc import Callable
from typing import Any, Final

from companion.beams.hardware.calibration import PHASE_MAX_DEG, Calibration, is_number
from companion.values import UserError

ELEMENTS: Final = 8
ORDER: Final = (6, 7, 4, 5, 2, 3, 0, 1)
"""Element of each Phaser channel: BEAM0 has 7, 8, 5, 6, and BEAM1 3, 4, 1, 2, counted from 1."""
LARGEST_BYTES: Final = 10_000
_MARK: Final = object()
_CONSTANTS: Final = (
    "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT",
    "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINBYTES", "SHORT_BINBYTES",
)  # fmt: skip
"""Opcodes that push their argument."""
_SCALARS: Final = {"f8": "d", "f4": "f", "i8": "q", "i4": "i"}


def calibration(phases: bytes, gains: bytes) -> Calibration:
    """Return the calibration in two Phaser pickles; ``UserError`` unless each has 8 numbers."""
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
        found = _Numbers().load(data)
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


class _Numbers:
    """Interpreter of the few opcodes that a pickle of numbers needs.

    Python's own unpickler allocates whatever an opcode asks for: a memo index of seven bytes takes
    gigabytes. This one takes no more memory than the data.
    """

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}

    def load(self, data: bytes) -> Any:
        """Return the object. Raises ``UserError`` for any other opcode or name; others: damage."""
        for opcode, argument, _ in pickletools.genops(data):
            if opcode.name == "STOP":
                break
            if opcode.name not in _DO:
                raise UserError(f"the pickle has the opcode {opcode.name}: only numbers are read")
            _DO[opcode.name](self, argument)
        return self.stack.pop()

    def push(self, argument: object) -> None:
        """Push the argument of the opcode."""
        self.stack.append(argument)

    def mark(self, _: object) -> None:
        """Mark the place from which the next list or tuple takes its objects."""
        self.stack.append(_MARK)

    def put(self, index: object) -> None:
        """Remember the topmost object by a number, or by the next one."""
        self.memo[len(self.memo) if index is None else int(str(index))] = self.stack[-1]

    def get(self, index: object) -> None:
        """Push a remembered object."""
        self.stack.append(self.memo[int(str(index))])

    def name(self, names: object) -> None:
        """Push the stand-in for a function, whose names are on the stack or in the opcode."""
        module, name = self._pop(2) if names is None else str(names).split(" ", 1)
        self.stack.append(_stand_in(module, name))

    def call(self, _: object) -> None:
        """Call a stand-in."""
        function, arguments = self._pop(2)
        self.stack.append(function(*arguments))

    def build(self, _: object) -> None:
        """Give a state to the topmost object."""
        (state,) = self._pop(1)
        self.stack[-1].__setstate__(state)

    def append(self, _: object) -> None:
        """Append an object to a list."""
        (one,) = self._pop(1)
        self.stack[-1].append(one)

    def extend(self, _: object) -> None:
        """Append all objects since the mark to a list."""
        several = self._since_mark()
        self.stack[-1].extend(several)

    def make_list(self, _: object) -> None:
        """Push the objects since the mark as a list."""
        self.stack.append(self._since_mark())

    def make_tuple(self, _: object) -> None:
        """Push the objects since the mark as a tuple."""
        self.stack.append((*self._since_mark(),))

    def _pop(self, count: int) -> list[Any]:
        found = self.stack[-count:]
        del self.stack[-count:]
        return found

    def _since_mark(self) -> list[Any]:
        at = len(self.stack) - 1 - self.stack[::-1].index(_MARK)
        return self._pop(len(self.stack) - at)[1:]


_DO: Final[dict[str, Callable[[_Numbers, object], None]]] = {
    **dict.fromkeys(("PROTO", "FRAME"), lambda _, __: None),
    **dict.fromkeys(_CONSTANTS, _Numbers.push),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"), _Numbers.put),
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), _Numbers.get),
    **dict.fromkeys(("GLOBAL", "STACK_GLOBAL"), _Numbers.name),
    "MARK": _Numbers.mark,
    "REDUCE": _Numbers.call,
    "BUILD": _Numbers.build,
    "APPEND": _Numbers.append,
    "APPENDS": _Numbers.extend,
    "LIST": _Numbers.make_list,
    "TUPLE": _Numbers.make_tuple,
    "EMPTY_LIST": lambda numbers, _: numbers.stack.append([]),
    "NONE": lambda numbers, _: numbers.stack.append(None),
    "NEWTRUE": lambda numbers, _: numbers.stack.append(True),
    "NEWFALSE": lambda numbers, _: numbers.stack.append(False),
    "TUPLE1": lambda numbers, _: numbers.stack.append((*numbers._pop(1),)),
    "TUPLE2": lambda numbers, _: numbers.stack.append((*numbers._pop(2),)),
    "TUPLE3": lambda numbers, _: numbers.stack.append((*numbers._pop(3),)),
}


def _stand_in(module: object, name: object) -> Any:
    """Return the stand-in for a name that numpy's scalars need; reject all others."""
    if module in ("numpy.core.multiarray", "numpy._core.multiarray") and name == "scalar":
        return _scalar
    if (module, name) == ("numpy", "dtype"):
        return _Kind
    if (module, name) == ("_codecs", "encode"):  # bytes, up to protocol 2
        return _latin1
    raise UserError(f"the pickle would call {module}.{name}: only numbers are read")


def _latin1(text: object, _: object) -> bytes:
    if not isinstance(text, str):
        raise ValueError("bytes without text")
    return text.encode("latin1")


class _Kind:
    """Stand-in for numpy's dtype in a pickle, by name; its pickled state gives the byte order."""

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
