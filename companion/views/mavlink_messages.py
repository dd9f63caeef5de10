"""Last messages in the format of mavlink2rest (github.com/mavlink/mavlink2rest).

``{"message": {"type": NAME, fields…}, "status": {"time": {…}}}``. An enumeration is ``{"type":
"MAV_…"}``, a bit mask ``{"bits": N}``, and characters are a list. A field named ``type`` is
written as ``mavtype``, since ``type`` is the message's name. NaN is null. ``frequency`` is null
after a single message.

Decoding needs pymavlink's generated dialect, which takes half a second to load on a small computer:
``dialect`` loads it on first use and must not be called on the event loop's thread.
"""

import functools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Final

import numpy as np

from companion.values import Source, UtcNs
from companion.values.described import Meaning
from companion.views.as_json import Json, rfc3339
from companion.views.last_messages import Kept

_PLAIN: Final = {"char", "float", "double"}


@dataclass(frozen=True, slots=True, kw_only=True)
class MessageTime:
    """First and last arrival, number and rate of a message."""

    first_update: Annotated[str, Meaning("arrival of the first of its kind")]
    last_update: Annotated[str, Meaning("arrival of the newest of its kind")]
    counter: Annotated[int, Meaning("messages of this kind so far")]
    frequency: Annotated[float | None, Meaning("mean rate, Hz; null after a single message")]


@dataclass(frozen=True, slots=True)
class MessageStatus:
    """Status of a message, as in mavlink2rest."""

    time: Annotated[MessageTime, Meaning("arrival times, number and rate")]


@dataclass(frozen=True, slots=True)
class MavlinkMessage:
    """Last message of its kind: ``type`` is its name, beside its fields."""

    message: Annotated[
        dict[str, Any],
        Meaning(
            "the message: its name as `type`, beside its fields in MAVLink's units",
            example={"type": "SYSTEM_TIME", "time_unix_usec": 0, "time_boot_ms": 81},
        ),
    ]
    status: Annotated[MessageStatus, Meaning("arrival times, number and rate")]


@dataclass(frozen=True, slots=True)
class MavlinkComponent:
    """Component with its last messages by name."""

    id: Annotated[int, Meaning("component id")]
    messages: Annotated[dict[str, MavlinkMessage], Meaning("last message of each kind, by name")]


@dataclass(frozen=True, slots=True)
class MavlinkVehicle:
    """System with its components by id."""

    id: Annotated[int, Meaning("system id")]
    components: Annotated[dict[str, MavlinkComponent], Meaning("components of the system, by id")]


class Dialect:
    """Names and fields of all messages that pymavlink knows."""

    def __init__(self) -> None:
        from pymavlink.dialects.v20 import all as generated

        self._classes: Final = generated.mavlink_map
        self._enums: Final = generated.enums
        self._ids: Final = {kind.msgname: msgid for msgid, kind in self._classes.items()}

    def msgid(self, name: str) -> int | None:
        """Return the id of a message; None for an unknown name."""
        return self._ids.get(name)

    def message(self, kept: Kept, utc_ns: Callable[[int], UtcNs]) -> Json | None:
        """Return one message with its status; None for an unknown message id."""
        kind = self._classes.get(kept.frame.msgid)
        if kind is None:
            return None
        fields = {
            "mavtype" if field == "type" else field: value
            for field, value in self._fields(kind, kept.frame.payload)
        }
        return {
            "message": {"type": kind.msgname, **fields},
            "status": {
                "time": {
                    "first_update": rfc3339(utc_ns(kept.first_ns)),
                    "last_update": rfc3339(utc_ns(kept.frame.t_ns)),
                    "counter": kept.counter,
                    "frequency": kept.frequency_hz,
                }
            },
        }

    def _fields(self, kind: Any, payload: bytes) -> Iterator[tuple[str, Any]]:
        """Yield names and values of fields, with truncated zeros; skip fields of later dialects."""
        size = kind.unpacker.size
        values = iter(kind.unpacker.unpack(payload[:size].ljust(size, b"\0")))
        types = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
        for field, length in zip(kind.ordered_fieldnames, kind.array_lengths, strict=True):
            if types[field] == "char":
                text = next(values)
                characters = [chr(byte) for byte in text]
                yield field, characters if length else characters[0]
            elif length:
                yield field, [self._value(kind, types, field, next(values)) for _ in range(length)]
            else:
                yield field, self._value(kind, types, field, next(values))

    def _value(self, kind: Any, types: dict[str, str], field: str, value: Any) -> Any:
        if types[field] == "float":
            return np.float32(value)  # so that JSON has no more digits than a float32
        enum = kind.fieldenums_by_name.get(field)
        if enum is None or types[field] in _PLAIN:
            return value
        if kind.fielddisplays_by_name.get(field) == "bitmask":
            return {"bits": value}
        entry = self._enums.get(enum, {}).get(value)
        return {"type": value if entry is None else entry.name}


@functools.cache
def dialect() -> Dialect:
    """Return the dialect of pymavlink; load it once."""
    return Dialect()


def messages(kept: Iterable[Kept], utc_ns: Callable[[int], UtcNs]) -> Json:
    """Return the messages of one component by message name."""
    shown = (dialect().message(one, utc_ns) for one in kept)
    return {one["message"]["type"]: one for one in shown if one is not None}


def vehicles(
    by_sender: Iterable[tuple[Source, list[Kept]]], utc_ns: Callable[[int], UtcNs]
) -> Json:
    """Return all vehicles, their components, and the components' last messages."""
    found: Json = {}
    for source, kept in by_sender:
        vehicle = found.setdefault(str(source.sysid), {"id": source.sysid, "components": {}})
        component = {"id": source.compid, "messages": messages(kept, utc_ns)}
        vehicle["components"][str(source.compid)] = component
    return found
