"""Names: of senders of frames, and of UAVs."""

from functools import lru_cache
from typing import Final, NamedTuple, Self

from companion.values.errors import UserError, shown

DIGITS_MAX: Final = 18
"""Most digits of an id: Python reads thousands, and then raises another error."""
_STANDING: Final = {"rid": 1, "icao": 2, "cot": 3}


class Source(NamedTuple):
    """The sender of a frame: MAVLink system and component id, written ``SYSID:COMPID``."""

    sysid: int
    compid: int

    def __str__(self) -> str:
        return f"{self.sysid}:{self.compid}"

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``SYSID:COMPID``. Raises ``UserError`` unless both are numbers from 0 to 255."""
        return cls(*_ids(text))


@lru_cache(maxsize=4096)
def _ids(text: str) -> tuple[int, int]:
    """System and component id. A node reads the same names at every update."""
    sysid, colon, compid = text.partition(":")
    if not (colon and sysid.isdecimal() and compid.isdecimal()):
        raise UserError(f"{shown(text)} is not SYSID:COMPID, such as 5:1")
    if max(len(sysid), len(compid)) > DIGITS_MAX or int(sysid) > 255 or int(compid) > 255:
        raise UserError(f"{shown(text)}: system and component ids are at most 255")
    return int(sysid), int(compid)


def reports_itself(uav: str) -> bool:
    """True if ``uav`` names a vehicle that sends its own position, False for a relayed aircraft.

    Relayed aircraft are named ``icao:HEX`` (ADS-B), ``rid:ID`` (Remote ID) or ``cot:UID`` (Cursor
    on Target).
    """
    return standing(uav) == 0


def standing(uav: str) -> int:
    """The place of a UAV's name among those that one aircraft may have, the best is 0.

    An aircraft is known by its own telemetry before all, then by what it broadcasts of itself, then
    by what others say.
    """
    return _STANDING.get(uav.partition(":")[0], 0)
