"""Calibration of an array: the element of each channel, and its errors of phase and gain."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import StringIO
from typing import Final, Self, TypeGuard

import numpy as np

from companion.values import ComplexArray, FloatArray, UserError, shown

CALIBRATION_HEADER: Final = "channel,element,phase_deg,gain_db"
BOUNDED_HEADER: Final = f"{CALIBRATION_HEADER},phase_error_deg,gain_error_db"
"""Header of a calibration table that also states bounds on its errors."""
GAIN_MAX_DB: Final = 1000.0
"""Largest magnitude of a gain, dB; larger ones would overflow the factors."""
DIGITS_MAX: Final = 18
"""Most digits of a whole number; ``int`` raises another error for thousands of digits."""
PHASE_MAX_DEG: Final = 1e6  # largest magnitude of a phase


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Measured calibration of an array of M elements.

        phase_error_rad, gain_error_db
                   by element: bounds on the errors of phase and gain; empty: unknown

    A setting is the wanted value less ``phase_rad`` and ``gain_db``. Raises ``UserError`` for
    lengths that differ, values that are not finite, or an order that is no permutation.
    """

    phase_rad: tuple[float, ...]  # by element: phase that the channel adds to its setting
    gain_db: tuple[float, ...]  # by element: gain that the channel adds to its setting
    order: tuple[int, ...]  # by channel: element that it drives, counted from 0
    phase_error_rad: tuple[float, ...] = ()
    gain_error_db: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        size = len(self.order)
        if not size or len(self.phase_rad) != size or len(self.gain_db) != size:
            raise UserError(
                f"{len(self.phase_rad)} phases, {len(self.gain_db)} gains and an order of {size}: "
                "give one of each for every element"
            )
        if sorted(self.order) != list(range(size)):
            raise UserError(f"order {self.order} does not contain each of 0 to {size - 1} once")
        errors = (self.phase_error_rad, self.gain_error_db)
        if errors != ((), ()) and [len(found) for found in errors] != [size, size]:
            raise UserError(f"bounds on errors: give both for all {size} elements, or none")
        if any(not 0 <= most < math.inf for found in errors for most in found):
            raise UserError("bounds on errors: give finite numbers, 0 or more")
        for name, values in (("phase", self.phase_rad), ("gain", self.gain_db)):
            for element, value in enumerate(values):
                if not math.isfinite(value):
                    raise UserError(f"{name} {value} of element {element} is not finite")
                if name == "gain" and abs(value) > GAIN_MAX_DB:
                    raise UserError(f"gain {value:.4g} dB of element {element} exceeds 1000 dB")

    @classmethod
    def ideal(cls, order: Sequence[int]) -> Self:
        """Return a calibration of ideal channels, with the elements in this order."""
        return cls(phase_rad=(0.0,) * len(order), gain_db=(0.0,) * len(order), order=tuple(order))

    @property
    def factors(self) -> ComplexArray:
        """Complex factor of each element's channel, (M,)."""
        factors: ComplexArray = np.exp(1j * np.array(self.phase_rad))
        factors *= 10 ** (np.array(self.gain_db) / 20)
        return factors


def channel_error(phase_error_rad: FloatArray, gain_error_db: FloatArray) -> FloatArray:
    """Return the largest |actual / wanted - 1| of a channel, for bounds on phase and gain.

    The largest is at a corner: the phase at its bound, the gain at either bound.
    """
    turned = np.exp(1j * np.minimum(phase_error_rad, np.pi))
    ends = [np.abs(10 ** (sign * gain_error_db / 20) * turned - 1) for sign in (1.0, -1.0)]
    most: FloatArray = np.maximum(*ends)
    return most


def parse_calibration(text: str) -> Calibration:
    """Parse CSV with the header ``channel,element,phase_deg,gain_db`` and a line for each channel.

    ``,phase_error_deg,gain_error_db`` may follow: bounds on the errors of phase and gain. Channels
    and elements count from 0; lines may be in any order. Raises ``UserError`` that names the line
    and the value.
    """
    order: dict[int, int] = {}
    measured: dict[int, tuple[float, ...]] = {}
    bounded = text.lstrip().startswith(BOUNDED_HEADER)
    for number, found in fields(text, BOUNDED_HEADER if bounded else CALIBRATION_HEADER):
        channel = whole(number, "channel", found[0], 0, 99_999)
        element = whole(number, "element", found[1], 0, 99_999)
        if channel in order:
            raise UserError(f"line {number}: channel {channel} appears twice")
        if element in measured:
            raise UserError(f"line {number}: element {element} appears twice")
        phase_deg = real(number, "phase_deg", found[2], PHASE_MAX_DEG)
        measured[element] = math.radians(phase_deg), real(number, "gain_db", found[3], GAIN_MAX_DB)
        if bounded:
            off_deg = real(number, "phase_error_deg", found[4], PHASE_MAX_DEG)
            off_db = real(number, "gain_error_db", found[5], GAIN_MAX_DB)
            measured[element] += math.radians(off_deg), off_db
        order[channel] = element
    for name, seen in (("channel", order), ("element", measured)):
        missing = set(range(len(order))) - set(seen)
        if missing:
            raise UserError(f"{name} {min(missing)} of {len(order)} is missing")
    elements = range(len(order))
    return Calibration(
        phase_rad=tuple(measured[m][0] for m in elements),
        gain_db=tuple(measured[m][1] for m in elements),
        order=tuple(order[c] for c in elements),
        phase_error_rad=tuple(measured[m][2] for m in elements) if bounded else (),
        gain_error_db=tuple(measured[m][3] for m in elements) if bounded else (),
    )


def fields(text: str, header: str) -> Iterator[tuple[int, list[str]]]:
    """Yield number and fields of each non-empty line of a CSV text below ``header``."""
    lines = StringIO(text, newline=None)
    first = lines.readline().rstrip("\n")
    if first.strip() != header:
        raise UserError(f"line 1: {shown(first)} is not the header {header!r}")
    columns = header.count(",") + 1
    for number, line in enumerate(lines, start=2):
        if not line.strip(", \t\n"):
            continue
        found = [field.strip() for field in line.split(",")]
        if len(found) != columns:
            raise UserError(
                f"line {number}: {shown(line.rstrip())} has {len(found)} fields, not {columns}"
            )
        yield number, found


def whole(number: int, name: str, field: str, least: int, most: int) -> int:
    """Parse a whole number from a line of a table; ``UserError`` outside ``least`` to ``most``."""
    digits = field.removeprefix("-")
    is_one = digits.isascii() and digits.isdecimal() and len(digits) <= DIGITS_MAX
    if not is_one or not least <= int(field) <= most:
        said = f"{shown(field)} is not a whole number from {least} to {most}"
        raise UserError(f"line {number}: {name} {said}")
    return int(field)


def real(number: int, name: str, field: str, most: float = math.inf) -> float:
    """Parse a number from a line of a table; ``UserError`` if its magnitude exceeds ``most``."""
    try:
        value = float(field)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise UserError(f"line {number}: {name} {shown(field)} is not a finite number")
    if abs(value) > most:
        raise UserError(
            f"line {number}: {name} {shown(field)} is not between -{most:.0f} and {most:.0f}"
        )
    return value


def is_number(given: object, most: float) -> TypeGuard[float]:
    """Return whether a value is a number of magnitude up to ``most``."""
    return type(given) in (int, float) and -most <= given <= most  # type: ignore[operator]
