"""What a transponder message, as the ADSB_VEHICLE that a MAVLink receiver would send of it.

Behind the fields that the message has stand three bytes more: NACp, NACv and GVA, each 0 where it
is unknown. MAVLink 2 lets a message grow so (https://mavlink.io/en/guide/serialization.html):
who does not know them does not read them. ``decode`` reads them from ``SENDER`` alone, so that what
another dialect may add one day is not taken for them.
"""

import struct
from typing import Final, NamedTuple

from companion.values import Source

ADSB_VEHICLE: Final = 246
SENDER: Final = Source(0, 156)  # who says it: no system, MAV_COMP_ID_ADSB
_LAYOUT: Final = struct.Struct("<IiiiHHhHHB9sBBBBB")
_COORDS, _ALTITUDE, _HEADING, _VELOCITY, _CALLSIGN, _VERTICAL = 1, 2, 4, 8, 16, 128  # ADSB_FLAGS
_PRESSURE, _GEOMETRIC = 0, 1  # ADSB_ALTITUDE_TYPE
_FOOT_MM: Final = 304.8
_KNOT_CMPS: Final = 1852 / 36
_FPM_CMPS: Final = 30.48 / 60


class AircraftState(NamedTuple):
    """The state of one aircraft in aviation's units; None: unknown.

    geometric   the altitude is above the ellipsoid, not that of the standard pressure
    age_s       whole seconds since it was true
    """

    icao: int
    lat_deg: float | None = None
    lon_deg: float | None = None
    altitude_ft: float | None = None
    geometric: bool = False
    speed_kt: float | None = None
    track_deg: float | None = None
    climb_fpm: float | None = None
    callsign: str = ""
    nac_p: int = 0
    nac_v: int = 0
    gva: int = 0
    age_s: int = 0

    def payload(self) -> bytes | None:
        """The payload of an ADSB_VEHICLE that says as much; None where that is nothing."""
        placed = self.lat_deg is not None and self.lon_deg is not None
        told = (
            (_COORDS, placed),
            (_ALTITUDE, self.altitude_ft is not None),
            (_HEADING, self.track_deg is not None),
            (_VELOCITY, self.speed_kt is not None),
            (_CALLSIGN, bool(self.callsign)),
            (_VERTICAL, self.climb_fpm is not None),
        )
        flags = sum(flag for flag, there in told if there)
        if not flags:
            return None
        return _LAYOUT.pack(
            self.icao,
            round((self.lat_deg or 0.0) * 1e7) if placed else 0,
            round((self.lon_deg or 0.0) * 1e7) if placed else 0,
            round((self.altitude_ft or 0.0) * _FOOT_MM),
            round((self.track_deg or 0.0) * 100),
            round((self.speed_kt or 0.0) * _KNOT_CMPS),
            round((self.climb_fpm or 0.0) * _FPM_CMPS),
            flags,
            0,  # squawk: nobody here reads it
            _GEOMETRIC if self.geometric else _PRESSURE,
            self.callsign[:8].encode(),
            0,  # kind of aircraft: unknown
            min(255, max(0, self.age_s)),
            *(self.nac_p, self.nac_v, self.gva),
        )
