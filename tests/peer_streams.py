"""Reports of one vehicle over several peers, true or forged, as streams in order of arrival."""

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

from companion.mavlink.wire.encode import Outgoing, pack
from companion.mavlink.wire.framing import Splitter
from companion.mavlink.wire.positions import GLOBAL_POSITION_INT
from companion.values import Frame, Source

S = 1_000_000_000
LINK = "udpin:0.0.0.0:14550"
HOME, OTHER = "10.0.0.1:14550", "10.0.0.66:4000"


class Place(NamedTuple):
    """Position of a vehicle, in m north and east of an origin, and its velocity."""

    north_m: float
    east_m: float
    north_mps: float
    east_mps: float


def circle(t_s: float) -> Place:
    """20 m/s, 60 m wide: 13 m/s² of centripetal acceleration, more than most can fly."""
    angle, speed = t_s / 3, 20.0
    return Place(
        north_m=60 * math.cos(angle),
        east_m=60 * math.sin(angle),
        north_mps=-speed * math.sin(angle),
        east_mps=speed * math.cos(angle),
    )


def report(
    t_ns: int, boot_s: float, place: Place, sysid: int = 1, origin_lon_1e7: float = 8e7
) -> Frame:
    source, payload = Source(sysid, 1), bytearray()
    degrees = place.north_m / 111_195.0, place.east_m / 111_195.0 / math.cos(math.radians(47.0))
    payload += round(boot_s * 1000).to_bytes(4, "little")
    east_1e7 = (origin_lon_1e7 + degrees[1] * 1e7 + 180e7) % 360e7 - 180e7
    for value in (47e7 + degrees[0] * 1e7, east_1e7, 488_000, 25_000):
        payload += round(value).to_bytes(4, "little", signed=True)
    for value in (place.north_mps * 100, place.east_mps * 100, 0):
        payload += round(value).to_bytes(2, "little", signed=True)
    raw = pack(Outgoing(source, GLOBAL_POSITION_INT, bytes(payload) + b"\1\0"), 0, 2)
    (frame,) = Splitter("x").feed(t_ns, raw)
    assert isinstance(frame, Frame)
    return frame


Stream = Iterable[tuple[float, float, str, Place]]
"""Arrival time, clock, delivering peer and claimed position."""


def heard(
    peer: str,
    hz: float,
    *,
    lasts_s: float = 60.0,
    delay_s: Callable[[], float] = lambda: 0.05,
    begins_s: float = 0.0,
    told: Callable[[float], Place] = circle,
) -> Stream:
    for number in range(round((lasts_s - begins_s) * hz)):
        t_s = begins_s + number / hz
        yield t_s + delay_s(), 100 + t_s, peer, told(t_s)


def beside(metres: float) -> Callable[[float], Place]:
    return lambda t_s: circle(t_s)._replace(north_m=circle(t_s).north_m + metres)
