"""State of a transponder message, as the ADSB_VEHICLE of a MAVLink receiver.

Five bytes are appended to the message's own fields: NACp, NACv and GVA, each 0 if unknown; what the
age exceeds whole seconds by, in 1/256 s; and the largest error of the age in tenths of seconds,
rounded up, 0 if unknown. MAVLink 2 allows such extensions
(https://mavlink.io/en/guide/serialization.html), and other readers ignore them. ``decode`` reads
them from ``SENDER`` only, so that it does not confuse them with a future extension of another
dialect.
"""

import math
import struct
from typing import Final, NamedTuple

from companion.values import Source

ADSB_VEHICLE: Final = 246
SENDER: Final = Source(0, 156)  # sender of the frames: no system, MAV_COMP_ID_ADSB
_LAYOUT: Final = struct.Struct("<IiiiHHhHHB9sBBBBBBB")
_COORDS, _ALTITUDE, _HEADING, _VELOCITY, _CALLSIGN, _VERTICAL = 1, 2, 4, 8, 16, 128  # ADSB_FLAGS
_PRESSURE, _GEOMETRIC = 0, 1  # ADSB_ALTITUDE_TYPE
SPEED_MAX_KT: Final = 1200
"""Limit on a speed. The field of ADSB_VEHICLE ends at 1274 kt; Mode S can state 5781 kt."""
_FOOT_MM: Final = 304.8
_KNOT_CMPS: Final = 1852 / 36
_FPM_CMPS: Final = 30.48 / 60


class AircraftState(NamedTuple):
    """State of one aircraft in aviation's units; None: unknown.

    geometric     the altitude is above the ellipsoid, not pressure altitude
    age_s         seconds since it was true
    time_error_s  largest error of that age; 0: unknown
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
    age_s: float = 0.0
    time_error_s: float = 0.0

    def payload(self) -> bytes | None:
        """Return the payload of the ADSB_VEHICLE; None if nothing is known.

        Raises ``ValueError`` for a speed that does not fit into it.
        """
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
        if self.speed_kt is not None and self.speed_kt > SPEED_MAX_KT:
            raise ValueError(f"speed {self.speed_kt:.0f} kt exceeds {SPEED_MAX_KT} kt")
        age_s = min(255.0, max(0.0, self.age_s))
        whole_s = int(age_s)
        return _LAYOUT.pack(
            self.icao,
            round((self.lat_deg or 0.0) * 1e7) if placed else 0,
            round((self.lon_deg or 0.0) * 1e7) if placed else 0,
            round((self.altitude_ft or 0.0) * _FOOT_MM),
            round((self.track_deg or 0.0) * 100),
            round((self.speed_kt or 0.0) * _KNOT_CMPS),
            round((self.climb_fpm or 0.0) * _FPM_CMPS),
            flags,
            0,  # squawk: not used
            _GEOMETRIC if self.geometric else _PRESSURE,
            self.callsign[:8].encode(),
            0,  # kind of aircraft: unknown
            whole_s,
            *(self.nac_p, self.nac_v, self.gva),
            min(255, round((age_s - whole_s) * 256)),
            min(255, math.ceil(self.time_error_s * 10)),
        )
