"""Positions that a relayed aircraft reported, by which repeats are recognised."""

import math
import struct
from typing import Final, NamedTuple

from companion.values import AdsbVehicle, AltitudeDatum

POSITIONS_KEPT: Final = 32
"""Reported positions remembered per aircraft.

At two a second, a relay may lag 16 s behind another; 4.8 s have been observed.
"""


class Reported(NamedTuple):
    """What is compared of a reported message."""

    t_ns: int
    true_ns: int
    alt_m: float | None
    alt_datum: AltitudeDatum | None
    velocity_ne_mps: tuple[float, float] | None
    velocity_down_mps: float | None


class ReportedPositions:
    """Newest reported positions of one aircraft, each with what is compared of its message.

    They are packed: 32 positions of each of thousands of aircraft take a third of the memory.
    """

    __slots__ = ("_packed",)
    _PLACE: Final = struct.Struct("<2d")
    _MESSAGE: Final = struct.Struct("<2qdB3d")  # NaN and 0: not sent
    _DATUMS: Final = (None, *AltitudeDatum)

    def __init__(self) -> None:
        self._packed: dict[bytes, bytes] = {}  # oldest first

    def get(self, at_deg: tuple[float, float]) -> Reported | None:
        """Return what was reported last at a position."""
        packed = self._packed.get(self._PLACE.pack(*at_deg))
        if packed is None:
            return None
        t_ns, true_ns, alt_m, datum, north, east, down = self._MESSAGE.unpack(packed)
        return Reported(
            t_ns=t_ns,
            true_ns=true_ns,
            alt_m=None if math.isnan(alt_m) else alt_m,
            alt_datum=self._DATUMS[datum],
            velocity_ne_mps=None if math.isnan(north) else (north, east),
            velocity_down_mps=None if math.isnan(down) else down,
        )

    def put(self, at_deg: tuple[float, float], message: AdsbVehicle) -> None:
        """Store a message under its position, and drop the oldest position beyond the limit."""
        velocity_ne_mps, down_mps = message.velocity_ne_mps, message.velocity_down_mps
        north, east = (math.nan, math.nan) if velocity_ne_mps is None else velocity_ne_mps
        place = self._PLACE.pack(*at_deg)
        self._packed.pop(place, None)
        self._packed[place] = self._MESSAGE.pack(
            message.t_ns,
            message.true_ns,
            math.nan if message.alt_m is None else message.alt_m,
            self._DATUMS.index(message.alt_datum),
            north,
            east,
            math.nan if down_mps is None else down_mps,
        )
        if len(self._packed) > POSITIONS_KEPT:
            del self._packed[next(iter(self._packed))]
