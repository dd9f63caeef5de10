"""Fields of the recorded messages, derived from the described values of their classes.

A field's number comes from its value's ``Meaning``; a number once written never changes its
meaning.
"""

import functools
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Final, NamedTuple, TypeVar

import numpy as np

from companion.values import (
    Beam,
    BeamSet,
    ClockSet,
    Duty,
    Frame,
    LeftOut,
    Observation,
    Offer,
    Rejection,
    RoundTrip,
    Source,
    Tick,
    Tock,
    Track,
)
from companion.values.described import Inline, Meaning, Member, is_vector, members

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class RecordedRejection:
    """Rejection as recorded, with whether it is an event of the pipeline or its output."""

    rejection: Annotated[Rejection, Inline()]
    is_event: Annotated[bool, Meaning("whether it comes from framing, before the pipeline", 7)]


@dataclass(frozen=True, slots=True)
class RecordedTrack:
    """Track as recorded, with the time of its update."""

    track: Annotated[Track, Inline()]
    t_ns: Annotated[int, Meaning("when the update was computed", 14)]


@dataclass(frozen=True, slots=True)
class RecordedWeights:
    """Beams and weights in single precision: a replay computes them again in double."""

    made: Annotated[BeamSet, Inline()]

    @property
    def uavs(self) -> Annotated[tuple[str, ...], Meaning("the UAV of each column", 3)]:
        return self.made.uavs

    @property
    def elements(self) -> Annotated[int, Meaning("rows of the weights", 4)]:
        return len(self.made.weights)

    @property
    def weights_complex64(
        self,
    ) -> Annotated[
        bytes, Meaning("weights (elements, uavs), row-major, little-endian float32 pairs re, im", 5)
    ]:
        return self.made.weights.astype(np.dtype("<c8")).tobytes("C")

    @property
    def beam(self) -> Annotated[tuple[Beam, ...], Meaning("the beams, one per column", 8)]:
        return self.made.beams

    @property
    def left_out(self) -> Annotated[tuple[LeftOut, ...], Meaning("UAVs without a beam", 9)]:
        return self.made.left_out


CLASSES: Final[dict[str, type]] = {
    "Frame": Frame,
    "Tick": Tick,
    "Tock": Tock,
    "Rejection": RecordedRejection,
    "RoundTrip": RoundTrip,
    "Track": RecordedTrack,
    "Beam": Beam,
    "LeftOut": LeftOut,
    "Weights": RecordedWeights,
    "Duty": Duty,
    "Offer": Offer,
    "ClockSet": ClockSet,
    "Observation": Observation,
}
"""Classes of the values that recordings contain, by the name of their message."""


class Field(NamedTuple):
    """Field of a recorded message: its declaration, and its getter."""

    number: int
    name: str
    declared: str  # its type and its name, as in a .proto file
    get: Callable[[Any], Any]
    meaning: str


@functools.cache
def fields(message: str) -> tuple[Field, ...]:
    """Return the fields of a recorded message, by number.

    The protobuf type follows from the value's type: times are fixed64, other integers uint32,
    vectors and tuples repeated, optional values optional; a ``Source`` is two fields, sysid and
    compid.
    """
    found = (one for member in members(CLASSES[message]) for one in _fields(member))
    return tuple(sorted(found, key=lambda one: one.number))


def _fields(member: Member) -> Iterator[Field]:
    number, name, kind, get = member.meaning.number, member.name, member.type, member.get

    def field(declared: str, read: Callable[[Any], Any], offset: int = 0) -> Field:
        return Field(
            number=(number or 0) + offset,
            name=declared.rpartition(" ")[2],
            declared=declared,
            get=read,
            meaning=member.meaning.text,
        )

    if number is None:
        return
    if kind is Source:
        yield field("uint32 sysid", _part(get, "sysid"))
        yield field("uint32 compid", _part(get, "compid"), 1)
    elif is_vector(kind):
        yield field(f"repeated double {name}", _listed(get))
    elif typing.get_origin(kind) is tuple:
        inner = typing.get_args(kind)[0]
        known = next((named for named, of in CLASSES.items() if of is inner), None)
        read = get if known is None else _messages(known, get)
        yield field(f"repeated {known or _scalar(inner, '')} {name}", read)
    else:
        optional = "optional " if member.optional else ""
        yield field(f"{optional}{member.meaning.wire or _scalar(kind, name)} {name}", get)


def _scalar(kind: Any, name: str) -> str:
    if kind is int:
        return "fixed64" if name.endswith("_ns") else "uint32"
    return {float: "double", bool: "bool", bytes: "bytes"}.get(kind, "string")


def _part(get: Callable[[Any], Any], part: str) -> Callable[[Any], Any]:
    return lambda value: getattr(get(value), part)


def _listed(get: Callable[[Any], Any]) -> Callable[[Any], list[float]]:
    """Return a getter that returns a vector as a list, empty if unknown."""

    def listed(value: Any) -> list[float]:
        vector = get(value)
        return [] if vector is None else vector.tolist()

    return listed


def _messages(name: str, get: Callable[[Any], Any]) -> Callable[[Any], list[dict[str, Any]]]:
    return lambda value: [values(name, one) for one in get(value)]


def values(message: str, value: Any) -> dict[str, Any]:
    """Return the values of the fields of a message, by field name."""
    return {one.name: one.get(value) for one in fields(message)}


def value_of(kind: type[T], found: Any) -> T:
    """Return a value of a class without nested values, from its message."""
    values = {
        member.name: Source(found.sysid, found.compid)
        if member.type is Source
        else None
        if member.optional and not found.HasField(member.name)
        else _native(getattr(found, member.name), member)
        for member in members(kind)
        if member.meaning.number is not None
    }
    return kind(**values)


def _native(value: Any, member: Member) -> Any:
    if typing.get_origin(member.type) is tuple:
        return tuple(value)
    return member.type(value) if isinstance(member.type, type) else value
