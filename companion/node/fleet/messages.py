"""Messages between nodes: protobuf, with the same descriptions as a recording's messages.

This is version 1 of the contract in docs/fleet.md: fields are added, and the number of a removed
one is never reused. Received messages are parsed with limits; invalid ones raise
``FleetMessageError``.
"""

import math
import struct
from typing import Any, Final

from google.protobuf.message import DecodeError

from companion.recording import fields, schemas
from companion.values import Offer, RoundTrip, Shared, SharedFrame, Standing, shown

FRAMES_MAX: Final = 800  # limit on frames, and on round trips, in one message
CLOCK: Final = struct.Struct("<qq")
"""Format of an answer to a clock request: start of the node, and its present time; ns."""
OFFERS_MAX: Final = 2400  # the largest number of frames or offers fits into a sample
NAME_MAX: Final = 64
PLACE_MAX: Final = (90.0, 180.0, 1e6)  # latitude and longitude in degrees, height in metres
NUMBER_MAX: Final = 1e9  # largest magnitude of other numbers
DB_MAX: Final = 300.0
"""Largest gain or value in dB, and the least with the sign changed; no link budget is near it."""
_LATEST_NS: Final = 1 << 62


class FleetMessageError(ValueError):
    """Error of a fleet message that is malformed or has impossible values."""


def shared(said: Shared) -> bytes:
    """Encode recently received frames. Frames have nanoseconds since the first one."""
    message = schemas.message_class("Shared")()
    first_ns = min((frame.heard_ns for frame in said.frames), default=0)
    message.first_ns, message.told_ns = first_ns, said.told_ns
    for frame in said.frames:
        message.frame.add(after_ns=frame.heard_ns - first_ns, raw=frame.raw)
    message.trip.extend(schemas.message("RoundTrip", trip) for trip in said.trips)
    found: bytes = message.SerializeToString()
    return found


def to_shared(data: bytes) -> Shared:
    """Decode another node's frames. Raises ``FleetMessageError``."""
    message = _parsed(schemas.message_class("Shared"), data, "message of frames")
    if len(message.frame) > FRAMES_MAX or len(message.trip) > FRAMES_MAX:
        raise FleetMessageError("too many frames in one message")
    first_ns = message.first_ns
    frames = tuple(SharedFrame(_time(first_ns + one.after_ns), one.raw) for one in message.frame)
    trips = tuple(fields.value_of(RoundTrip, one) for one in message.trip)
    if any(max(trip.source) > 255 or max(trip.t_ns, trip.sent_ns) > _LATEST_NS for trip in trips):
        raise FleetMessageError("round trip with an invalid source or time")
    return Shared(_time(message.told_ns), frames, trips)


def standing(said: Standing) -> bytes:
    """Encode a node's status message (``Standing``)."""
    message = schemas.message_class("Standing")(
        node=said.node, place=said.place or (), reach_m=said.reach_m, most=said.most
    )
    for uav, worth_db in said.serves:
        message.serves.add(uav=uav, worth_db=worth_db)
    for uav, to in said.handing:
        message.handing.add(uav=uav, to=to)
    found: bytes = message.SerializeToString()
    return found


def to_standing(data: bytes, node: str) -> Standing:
    """Decode a node's ``Standing``, received under its own key. Raises ``FleetMessageError``."""
    message = _parsed(schemas.message_class("Standing"), data, "standing")
    if message.node != node:
        raise FleetMessageError(f"name in the message differs: {shown(message.node)}")
    if len(message.serves) > OFFERS_MAX or len(message.handing) > OFFERS_MAX:
        raise FleetMessageError("too many UAVs in one message")
    place = tuple(message.place)
    limits = zip(place, PLACE_MAX, strict=False)
    if len(place) not in (0, 3) or not all(abs(value) <= most for value, most in limits):
        raise FleetMessageError("invalid place")
    reach_m = message.reach_m if message.HasField("reach_m") else None
    return Standing(
        node=node,
        place=(place[0], place[1], place[2]) if place else None,
        reach_m=None if reach_m is None else _number(reach_m),
        most=min(message.most, OFFERS_MAX),
        serves=tuple((_name(one.uav), _number(one.worth_db, DB_MAX)) for one in message.serves),
        handing=tuple((_name(one.uav), _name(one.to)) for one in message.handing),
    )


def offers(said: dict[str, Offer]) -> bytes:
    """Encode all offers of a node to UAVs."""
    message = schemas.message_class("Offers")()
    message.offer.extend(schemas.message("Offer", one) for one in said.values())
    found: bytes = message.SerializeToString()
    return found


def to_offers(data: bytes) -> tuple[Offer, ...]:
    """Decode another node's offers. Raises ``FleetMessageError``."""
    message = _parsed(schemas.message_class("Offers"), data, "message of offers")
    if len(message.offer) > OFFERS_MAX:
        raise FleetMessageError("too many offers in one message")
    limits = {"sure_db": DB_MAX, "likely_db": DB_MAX, "sinr_db": DB_MAX, "heard_s": NUMBER_MAX}
    return tuple(
        Offer(
            uav=_name(one.uav),
            **{
                name: _number(getattr(one, name), most) if one.HasField(name) else None
                for name, most in limits.items()
            },
        )
        for one in message.offer
    )


def _parsed(kind: Any, data: bytes, what: str) -> Any:
    try:
        return kind.FromString(data)
    except DecodeError as error:
        raise FleetMessageError(f"malformed {what}") from error


def _time(t_ns: int) -> int:
    if t_ns > _LATEST_NS:
        raise FleetMessageError("time out of range")
    return t_ns


def _number(value: float, most: float = NUMBER_MAX) -> float:
    if not math.isfinite(value) or abs(value) > most:
        raise FleetMessageError(f"number {value} is out of range")
    return value


def _name(text: str) -> str:
    if not text or len(text) > NAME_MAX or not (text.isascii() and text.isprintable()):
        raise FleetMessageError("invalid name")
    return text
