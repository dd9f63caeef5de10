"""Identifiers: ids of frame senders and of UAVs."""

import re
import sys
from enum import Enum
from functools import lru_cache
from typing import Final, NamedTuple, Self

from companion.values.errors import UserError, shown

DIGITS_MAX: Final = 18
"""Most digits of an id; ``int`` raises another error for thousands of digits."""


class Source(NamedTuple):
    """Sender of a frame: MAVLink system and component id, written ``SYSID:COMPID``."""

    sysid: int
    compid: int

    def __str__(self) -> str:
        return f"{self.sysid}:{self.compid}"

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse ``SYSID:COMPID``. Raises ``UserError`` unless both are numbers from 0 to 255."""
        return cls(*_ids(text))


@lru_cache(maxsize=4096)
def _ids(text: str) -> tuple[int, int]:
    """Parse system and component id; cached, as every update parses the same ids."""
    sysid, colon, compid = text.partition(":")
    if not (colon and sysid.isdecimal() and compid.isdecimal()):
        raise UserError(f"{shown(text)} is not SYSID:COMPID, such as 5:1")
    if max(len(sysid), len(compid)) > DIGITS_MAX or int(sysid) > 255 or int(compid) > 255:
        raise UserError(f"{shown(text)}: system and component ids are at most 255")
    return int(sysid), int(compid)


class UavKind(Enum):
    """Kind of a UAV's id, from the best identification to the worst.

    The aircraft's own telemetry comes first, then its broadcasts, then reports of others.

        prefix         prefix of its ids, before a colon; empty for SYSID:COMPID
        pattern        regular expression of its ids
        may_be_manned  whether an aircraft of this kind may carry people
        rank           its position in this order, from 0

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
        """Return the UAV id of an aircraft of this kind, from its name.

        All reports of an aircraft share one string, of which many are kept.
        """
        return sys.intern(f"{self.prefix}:{name}")


_KINDS: Final = {kind.prefix: kind for kind in UavKind}
UAV_FORMS: Final = "SYSID:COMPID, icao:HEX, rid:ID or cot:UID"
"""Formats of UAV ids of all kinds."""
_UAV: Final = re.compile("|".join(kind.pattern for kind in UavKind), re.ASCII)


def kind_of(uav: str) -> UavKind:
    """Return the kind of a UAV id."""
    return _KINDS.get(uav.partition(":")[0], UavKind.VEHICLE)


def is_uav_id(text: str) -> bool:
    """Return whether a text is the id of a UAV of any kind."""
    if not _UAV.fullmatch(text):
        return False
    return not kind_of(text).reports_itself or max(map(int, text.split(":"))) <= 255
