"""Requested faults: the values of ``--fault``. Pure.

Syntax: ``NAME=VALUE``, or for one system or component ``NAME@SYSID=VALUE`` or
``NAME@SYSID:COMPID=VALUE``; ``/FROM-TO`` after it limits any fault to a time. ``KINDS`` lists all
kinds in the order of application, which does not depend on the order of the options. ``traffic``
applies them.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Self

from companion.values import Source, UserError
from companion.values.errors import printable, shown

Sender = tuple[int, int]  # system and component id


NAME_SHOWN_MAX: Final = 24  # characters of an unknown name in its error, beside all known names


class FaultError(UserError):
    """Error of an invalid fault request. The message is one line, with what is allowed."""


class Bound(NamedTuple):
    """Limits of one number in a fault's value.

    low, high  limits, inclusive
    """

    letter: str  # placeholder in the help
    low: float
    high: float
    default: float | None = None  # value if it is omitted; None: required
    whole: bool = False  # only whole numbers

    def read(self, text: str) -> float:
        """Parse a number. Raises ``FaultError`` if it is not a number within the limits."""
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if self.low <= number <= self.high and not (self.whole and number % 1.0):
            return number
        kind = "a whole number, " if self.whole else ""
        allowed = f"{kind}{self.low:g} to {self.high:g}"
        raise FaultError(f"{self.letter} is {shown(text)}, allowed: {allowed}")


class Kind(NamedTuple):
    """Kind of fault. ``is_event``: it can be given several times for the same frames."""

    name: str
    bounds: tuple[Bound, ...]
    meaning: str
    example: str
    is_event: bool = False

    @property
    def form(self) -> str:
        """Syntax of the kind of fault, such as ``glitch=T:M[:N]``."""
        letters = [bound.letter for bound in self.bounds if bound.default is None]
        optional = [f"[:{bound.letter}]" for bound in self.bounds if bound.default is not None]
        return f"{self.name}={':'.join(letters)}{''.join(optional)}"

    def read(self, text: str) -> tuple[float, ...]:
        """Parse ``NAME=VALUE``. Raises ``FaultError`` with the cause and what is allowed."""
        numbers = text.partition("=")[2].split(":")
        required = sum(bound.default is None for bound in self.bounds)
        if not required <= len(numbers) <= len(self.bounds):
            raise FaultError(f"{shown(text)} is not {self.form}, for example {self.example}")
        try:
            given = [
                bound.read(number) for bound, number in zip(self.bounds, numbers, strict=False)
            ]
        except FaultError as error:
            raise FaultError(f"{shown(text)}: {error}; for example {self.example}") from None
        defaults = [b.default for b in self.bounds[len(given) :] if b.default is not None]
        return (*given, *defaults)


ALWAYS: Final = (0.0, math.inf)
_SHARE: Final = Bound(letter="P", low=0.0, high=1.0)
_FROM: Final = Bound(letter="T", low=0.0, high=1e6)

KINDS: Final = {
    kind.name: kind
    for kind in (
        Kind(
            name="drift",
            bounds=(Bound(letter="PPM", low=-500_000.0, high=500_000.0),),
            meaning="boot clocks (time_boot_ms) gain PPM parts per million (negative: lose)",
            example="drift=-24000",
        ),
        Kind(
            name="reboot",
            bounds=(_FROM,),
            meaning="at T s boot clocks (time_boot_ms) and sequence numbers restart at 0",
            example="reboot=20",
            is_event=True,
        ),
        Kind(
            name="frozen",
            bounds=(_FROM, Bound(letter="S", low=0.0, high=1e6)),
            meaning="from T s on, for S s, GLOBAL_POSITION_INT repeats the last position",
            example="frozen@3:1=20:5",
            is_event=True,
        ),
        Kind(
            name="glitch",
            bounds=(
                _FROM,
                Bound(letter="M", low=0.0, high=100_000.0),
                Bound(letter="N", low=1.0, high=1e6, default=1.0, whole=True),
            ),
            meaning="from T s on, the next N GLOBAL_POSITION_INT (default 1) are M metres off",
            example="glitch=30:25:4",
            is_event=True,
        ),
        Kind(
            name="spoof",
            bounds=(
                _FROM,
                Bound(letter="MPS", low=0.0, high=300.0),
                Bound(letter="DEG", low=0.0, high=360.0, default=90.0),
            ),
            meaning="from T s on, reported positions and velocities drift away at MPS m/s towards"
            " DEG degrees from north (default 90)",
            example="spoof@3:1=20:2",
            is_event=True,
        ),
        Kind(
            name="compass",
            bounds=(Bound(letter="DEG", low=-180.0, high=180.0), _FROM._replace(default=0.0)),
            meaning="from T s on (default 0), reported headings (ATTITUDE, GLOBAL_POSITION_INT) are"
            " DEG degrees too far clockwise",
            example="compass@5:1=8",
            is_event=True,
        ),
        Kind(
            name="loss",
            bounds=(_SHARE,),
            meaning="a frame is lost with probability P",
            example="loss=0.1",
        ),
        Kind(
            name="duplication",
            bounds=(_SHARE,),
            meaning="with probability P a frame arrives again, 0 to 0.2 s later",
            example="duplication=0.5",
        ),
        Kind(
            name="delay",
            bounds=(Bound(letter="S", low=0.0, high=600.0),),
            meaning="every frame is delayed by S s",
            example="delay=0.3",
        ),
        Kind(
            name="jitter",
            bounds=(Bound(letter="S", low=0.0, high=60.0),),
            meaning="every frame is delayed by a random time, exponential with mean S s; the frames"
            " of one sender stay in order",
            example="jitter=0.05",
        ),
        Kind(
            name="burst",
            bounds=(
                Bound(letter="P", low=0.0, high=0.95),
                Bound(letter="S", low=0.001, high=600.0),
            ),
            meaning="the link is blocked for S s at a time, on average for a share P of the time;"
            " frames of that time arrive together at its end",
            example="burst=0.3:2",
        ),
        Kind(
            name="reordering",
            bounds=(_SHARE,),
            meaning="with probability P a frame is held 0 to 0.2 s and overtaken by later ones",
            example="reordering=0.1",
        ),
        Kind(
            name="bit-errors",
            bounds=(Bound(letter="P", low=0.0, high=0.5),),
            meaning="every bit flips with probability P",
            example="bit-errors=1e-5",
        ),
        Kind(
            name="truncation",
            bounds=(_SHARE,),
            meaning="with probability P a frame is cut short",
            example="truncation=0.01",
        ),
        Kind(
            name="garbage",
            bounds=(_SHARE,),
            meaning="with probability P, 1 to 64 random bytes precede a frame",
            example="garbage=0.01",
        ),
    )
}
"""All kinds of faults by name, in the order of application."""

_ORDER: Final = {name: place for place, name in enumerate(KINDS)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """Requested fault: name, numbers, and what it applies to.

    sysid, compid  system and component; None: all
    during_s  start and end of the time in which frames are concerned (s); the end is excluded
    """

    name: str
    values: tuple[float, ...]
    sysid: int | None = None
    compid: int | None = None
    during_s: tuple[float, float] = ALWAYS

    def __str__(self) -> str:
        """Return the name and the system of a fault, as in ``frozen@3:1``."""
        system = "" if self.sysid is None else f"@{self.sysid}"
        return f"{self.name}{system}" + ("" if self.compid is None else f":{self.compid}")

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse a value of ``--fault``.

        Raises ``FaultError`` with the cause and what is allowed.
        """
        request, slash, window = text.partition("/")
        name, at, system = request.partition("=")[0].partition("@")
        kind = KINDS.get(name)
        if kind is None:
            brief = shown(printable(name)[:NAME_SHOWN_MAX])
            raise FaultError(f"{brief} is not a fault; give {', '.join(KINDS)}")
        try:
            sysid, compid = _system(system) if at else (None, None)
            during_s = _window(window) if slash else ALWAYS
        except FaultError as error:
            raise FaultError(f"{shown(text)}: {error}; for example {kind.example}") from None
        values = kind.read(request)
        return cls(name=name, values=values, sysid=sysid, compid=compid, during_s=during_s)

    def concerns(self, sender: Sender, t_s: float) -> bool:
        """Return whether the fault applies to a frame that a system and component send then."""
        if not self.during_s[0] <= t_s < self.during_s[1]:
            return False
        if self.sysid is None:
            return True
        return self.sysid == sender[0] and self.compid in (None, sender[1])


def in_order(faults: Sequence[Fault]) -> list[Fault]:
    """Return the faults in the order of application.

    Raises ``FaultError`` if a fault that is not an event is given twice for the same frames.
    """
    lasting = [fault for fault in faults if not KINDS[fault.name].is_event]
    for fault in lasting:
        times = sum(str(f) == str(fault) and _overlap(f.during_s, fault.during_s) for f in lasting)
        if times > 1:
            raise FaultError(f"{fault} is given {times} times; allowed: once per system and time")
    whose = ((_ORDER[f.name], f.sysid or 0, f.compid or 0, f.values, f.during_s) for f in faults)
    return [fault for _, fault in sorted(zip(whose, faults, strict=True), key=lambda pair: pair[0])]


def described(kinds: Iterable[Kind] = KINDS.values()) -> str:
    """Return the help text of kinds of faults, a paragraph each."""
    return "\n\n".join(f"{k.form}: {k.meaning}. Example: {k.example}" for k in kinds)


def _overlap(first_s: tuple[float, float], second_s: tuple[float, float]) -> bool:
    return max(first_s[0], second_s[0]) < min(first_s[1], second_s[1])


def _window(text: str) -> tuple[float, float]:
    start, dash, end = text.partition("-")
    try:
        found_s = _FROM.read(start), _FROM.read(end)
    except FaultError:
        found_s = (0.0, 0.0)
    if not dash or found_s[0] >= found_s[1]:
        raise FaultError(f"{shown(text)} is not FROM-TO, in seconds, such as 20-50")
    return found_s


def _system(text: str) -> tuple[int, int | None]:
    try:
        source = Source.parse(text if ":" in text else f"{text}:0")
    except ValueError:
        raise FaultError(f"{shown(text)} is not SYSID or SYSID:COMPID, each 0 to 255") from None
    return source.sysid, source.compid if ":" in text else None
