"""Names: of senders of frames, and of UAVs."""

from enum import Enum
from functools import lru_cache
from typing import Final, NamedTuple, Self

from companion.values.errors import UserError, shown

DIGITS_MAX: Final = 18
"""Most digits of an id: Python reads thousands, and then raises another error."""


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


class UavKind(Enum):
    """What a UAV's id names, in the order in which one aircraft is best known.

    Its own telemetry comes first, then what it broadcasts of itself, then what others report.

        prefix         what its ids begin with, before a colon; empty for SYSID:COMPID
        pattern        regular expression of its ids
        may_be_manned  whether an aircraft of this kind may carry people
        rank           its place in this order, from 0

    Only a vehicle reports itself: it has a MAVLink source, a link and a clock of its own.
    """

    VEHICLE = "", r"\d{1,3}:\d{1,3}", False
    REMOTE_ID = "rid", r"rid:[A-Za-z0-9._-]{1,64}", False
    ADSB = "icao", r"icao:[0-9A-F]{6}", True
    COT = "cot", r"cot:[A-Za-z0-9._-]{1,64}", True

    def __init__(self, prefix: str, pattern: str, may_be_manned: bool) -> None:
        self.prefix = prefix
        self.pattern = pattern
        self.may_be_manned = may_be_manned
        self.rank = len(type(self).__members__)
        self.reports_itself = not prefix

    def uav(self, name: str) -> str:
        """The id of an aircraft of this kind that is relayed under a name."""
        return f"{self.prefix}:{name}"


_KINDS: Final = {kind.prefix: kind for kind in UavKind}
UAV_FORMS: Final = "SYSID:COMPID, icao:HEX, rid:ID or cot:UID"
"""How the ids of all kinds are written."""


def kind_of(uav: str) -> UavKind:
    """The kind of thing that an id names."""
    return _KINDS.get(uav.partition(":")[0], UavKind.VEHICLE)
