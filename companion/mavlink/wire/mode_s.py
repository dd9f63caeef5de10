"""Decoder of the ADS-B messages of Mode S (extended squitter, 14 bytes) that positions need.

Format and codes: RTCA DO-260B, 2.2.3 (ICAO Doc 9871 has the same tables); the compact position
report (CPR) is its appendix A.1.7. Decoded are identification (type 1-4), airborne positions (9-18
with pressure altitude, 20-22), velocities over ground (19, subtypes 1 and 2), operational status
(31), which has the accuracies, and positions on the ground (5-8): these are relative to a position
of the aircraft some minutes ago at most, and have no height. Not decoded are aircraft that ground
stations rebroadcast (TIS-B: DF18 with a control field other than 0), and the heights of types
20-22, which dump1090 reads in steps of 25 feet and pyModeS in metres.
"""

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from companion.mavlink.wire.transponder import AircraftState

SIZE: Final = 14  # bytes of an extended squitter
PAIR_NS: Final = 10_000_000_000
"""Largest time between the even and the odd half of one position (DO-260B, A.1.7.7)."""
PAIR_SLACK_M: Final = 100.0  # resolution of both halves, and of their times
PAIR_SPEED_MPS: Final = 700.0
"""Largest speed by which the places of two halves may differ: both must be of one aircraft."""
_METRES_PER_DEG: Final = 111_195.0
STATUS_NS: Final = 30_000_000_000
"""Validity of a stated accuracy, which is sent every 2.5 s (DO-260B, 2.2.3.3)."""
AIRCRAFT_MAX: Final = 2000
"""Most aircraft remembered; beyond it the one silent for longest is forgotten."""
GROUND_NS: Final = 240_000_000_000
"""Largest age of the reference of a position on the ground: at 340 m/s the aircraft is 45 nautical
miles away, half the ambiguity of the position."""
_POLYNOMIAL: Final = 0xFFF409
_CPR: Final = 1 << 17
_LETTERS: Final = "?ABCDEFGHIJKLMNOPQRSTUVWXYZ????? ???????????????0123456789??????"
_POLE_DEG: Final = 87.0
_MOVEMENT: Final = (
    (1, 0.0, 0.0), (2, 0.125, 0.125), (9, 1.0, 0.25), (13, 2.0, 0.5), (39, 15.0, 1.0),
    (94, 70.0, 2.0), (109, 100.0, 5.0), (124, 175.0, 0.0),
)  # fmt: skip
"""Ground speed codes: first code, its speed and the step of the following codes, knots."""


def parity(message: bytes) -> int:
    """Return the remainder of a message by the parity polynomial; 0 if it is intact."""
    bits = int.from_bytes(message, "big")
    for at in range(8 * len(message) - 1, 23, -1):
        if bits >> at & 1:
            bits ^= (0x1000000 | _POLYNOMIAL) << (at - 24)
    return bits


@dataclass(slots=True, kw_only=True)
class _AircraftMemory:
    """State of an aircraft for later messages: half positions, accuracies, times."""

    halves: dict[int, tuple[int, int, int]] = field(default_factory=dict)  # odd: t_ns, lat, lon
    nac_p: tuple[int, int] = (0, 0)  # value, t_ns
    gva: tuple[int, int] = (0, 0)
    nac_v: tuple[int, int] = (0, 0)
    place: tuple[int, float, float] | None = None  # the newest: t_ns, lat, lon


class Transponders:
    """Decoder of the Mode S messages of many aircraft. ``read`` takes them in order of arrival."""

    def __init__(self) -> None:
        self._heard: OrderedDict[int, _AircraftMemory] = OrderedDict()

    def read(self, t_ns: int, message: bytes) -> AircraftState | None:
        """Decode a message received at ``t_ns``; None if it has no relevant content.

        Raises ``ValueError`` if its parity is wrong.
        """
        kind, control = message[0] >> 3, message[0] & 7
        if len(message) != SIZE or kind not in (17, 18) or (kind == 18 and control != 0):
            return None
        if parity(message):
            raise ValueError("parity")
        icao, me = int.from_bytes(message[1:4], "big"), int.from_bytes(message[4:11], "big")
        if icao == 0:
            return None
        heard = self._heard.setdefault(icao, _AircraftMemory())
        self._heard.move_to_end(icao)
        if len(self._heard) > AIRCRAFT_MAX:
            self._heard.popitem(last=False)
        type_code, subtype = me >> 51, me >> 48 & 7
        if 1 <= type_code <= 4:
            return AircraftState(icao=icao, callsign=_callsign(me))
        if 9 <= type_code <= 18 or 20 <= type_code <= 22:
            return _position(
                heard, t_ns, icao, me, _altitude_ft(me >> 36 & 0xFFF) if type_code < 20 else None
            )
        if 5 <= type_code <= 8:
            return _on_ground(heard, t_ns, icao, me)
        if type_code == 19 and subtype in (1, 2):
            heard.nac_v = (me >> 43 & 7, t_ns)
            return _velocity(icao, me, 4 if subtype == 2 else 1)
        if type_code == 31 and subtype in (0, 1):
            _status(heard, t_ns, me, airborne=subtype == 0)
        return None


def _callsign(me: int) -> str:
    letters = "".join(_LETTERS[me >> shift & 63] for shift in range(42, -1, -6)).strip()
    return "" if "?" in letters else letters


def _status(heard: _AircraftMemory, t_ns: int, me: int, *, airborne: bool) -> None:
    """Store an operational status's accuracies; version 0 has none, ground positions no GVA."""
    version = me >> 13 & 7
    if version in (1, 2):
        heard.nac_p = (me >> 8 & 15, t_ns)
        known = version == 2 and airborne  # a different quantity in version 1
        heard.gva = (me >> 6 & 3 if known else 0, t_ns)


def _position(
    heard: _AircraftMemory, t_ns: int, icao: int, me: int, altitude_ft: float | None
) -> AircraftState:
    odd = me >> 34 & 1
    heard.halves[odd] = (t_ns, me >> 17 & 0x1FFFF, me & 0x1FFFF)
    other = heard.halves.get(1 - odd)
    place = None
    if other is not None and t_ns - other[0] <= PAIR_NS:
        apart_m = PAIR_SLACK_M + PAIR_SPEED_MPS * (t_ns - other[0]) * 1e-9
        (_, *even), (_, *last) = heard.halves[0], heard.halves[1]
        place = position_deg(even, last, newest_is_odd=odd == 1, apart_m=apart_m)
    lat_deg, lon_deg = place or (None, None)
    if place is not None:
        heard.place = t_ns, *place
    return AircraftState(
        icao=icao,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        altitude_ft=altitude_ft,
        nac_p=_fresh(heard.nac_p, t_ns),
        nac_v=_fresh(heard.nac_v, t_ns),
        gva=_fresh(heard.gva, t_ns),
    )


def _on_ground(heard: _AircraftMemory, t_ns: int, icao: int, me: int) -> AircraftState:
    """Decode a position on the ground, the nearest to the last known position, and its motion."""
    place = None
    if heard.place is not None and t_ns - heard.place[0] <= GROUND_NS:
        half = me >> 17 & 0x1FFFF, me & 0x1FFFF
        place = ground_deg(half, heard.place[1:], odd=me >> 34 & 1)
    lat_deg, lon_deg = place or (None, None)
    if place is not None:
        heard.place = t_ns, *place
    return AircraftState(
        icao=icao,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        speed_kt=ground_speed_kt(me >> 44 & 0x7F),
        track_deg=(me >> 36 & 0x7F) * 360 / 128 if me >> 43 & 1 else None,
        nac_p=_fresh(heard.nac_p, t_ns),
    )


def ground_deg(half: tuple[int, int], near: tuple[float, float], odd: int) -> tuple[float, float]:
    """Return the ground position nearest to ``near`` (DO-260B, A.1.7.6)."""
    lat_deg = _nearest(half[0] / _CPR, near[0], 90 / (60 - odd))
    lon_deg = _nearest(half[1] / _CPR, near[1], 90 / max(zones(lat_deg) - odd, 1))
    return max(-90.0, min(90.0, lat_deg)), (lon_deg + 180) % 360 - 180


def _nearest(part: float, near_deg: float, zone_deg: float) -> float:
    """Return the angle, at a fraction of a zone, that is nearest to another angle."""
    within = near_deg % zone_deg / zone_deg
    return zone_deg * (math.floor(near_deg / zone_deg) + math.floor(0.5 + within - part) + part)


def ground_speed_kt(code: int) -> float | None:
    """Return the ground speed, low end of its step (DO-260B, 2.2.3.2.4.2); None: unknown."""
    if not 1 <= code <= 124:
        return None
    first, speed_kt, step_kt = next(row for row in reversed(_MOVEMENT) if code >= row[0])
    return speed_kt + (code - first) * step_kt


def _fresh(stated: tuple[int, int], t_ns: int) -> int:
    return stated[0] if t_ns - stated[1] <= STATUS_NS else 0


def _altitude_ft(code: int) -> float | None:
    """Return pressure altitude in steps of 25 ft; None if unknown, or in Gillham code.

    Gillham code is used above 50 175 ft.
    """
    if not code & 0x10:
        return None
    return 25.0 * (code >> 5 << 4 | code & 15) - 1000.0


def _velocity(icao: int, me: int, knots: int) -> AircraftState:
    """Decode speed and course over ground, and climb; a field of 0 is unknown."""
    east, north = me >> 32 & 0x3FF, me >> 21 & 0x3FF
    speed_kt = track_deg = None
    if east and north:
        x = knots * (east - 1) * (-1 if me >> 42 & 1 else 1)
        y = knots * (north - 1) * (-1 if me >> 31 & 1 else 1)
        speed_kt, track_deg = math.hypot(x, y), math.degrees(math.atan2(x, y)) % 360.0
    climb = me >> 10 & 0x1FF
    climb_fpm = 64.0 * (climb - 1) * (-1 if me >> 19 & 1 else 1) if climb else None
    return AircraftState(icao=icao, speed_kt=speed_kt, track_deg=track_deg, climb_fpm=climb_fpm)


def position_deg(
    even: Sequence[int], odd: Sequence[int], *, newest_is_odd: bool, apart_m: float = math.inf
) -> tuple[float, float] | None:
    """Return latitude and longitude of the newer of an even and an odd position (DO-260B, A.1.7.7).

    None if their zones differ in width, if the latitude is out of range, or if the two are more
    than ``apart_m`` apart, as those of two aircraft with one address.
    """
    y = [even[0] / _CPR, odd[0] / _CPR]
    x = [even[1] / _CPR, odd[1] / _CPR]
    band = math.floor(59 * y[0] - 60 * y[1] + 0.5)
    lats = [(360 / (60 - i)) * (band % (60 - i) + y[i]) for i in (0, 1)]
    lats = [lat - 360 if lat >= 270 else lat for lat in lats]
    if any(abs(lat) > 90 for lat in lats) or zones(lats[0]) != zones(lats[1]):
        return None
    i = int(newest_is_odd)
    wide = zones(lats[i])
    band = math.floor(x[0] * (wide - 1) - x[1] * wide + 0.5)
    counts = (max(wide, 1), max(wide - 1, 1))
    lons = [(360 / count) * (band % count + part) for count, part in zip(counts, x, strict=True)]
    across = math.remainder(lons[0] - lons[1], 360) * math.cos(math.radians(lats[i]))
    if math.hypot(lats[0] - lats[1], across) * _METRES_PER_DEG > apart_m:
        return None
    return lats[i], (lons[i] + 180) % 360 - 180


def zones(lat_deg: float) -> int:
    """Return the number of longitude zones at a latitude, NL of DO-260B, A.1.7.2."""
    if abs(lat_deg) >= _POLE_DEG:
        return 2 if abs(lat_deg) == _POLE_DEG else 1
    if lat_deg == 0:
        return 59
    across = (1 - math.cos(math.pi / 30)) / math.cos(math.radians(lat_deg)) ** 2
    return math.floor(2 * math.pi / math.acos(1 - across))
