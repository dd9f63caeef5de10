"""Notices about a peer that disagrees with the known peers of a sender."""

from enum import Enum
from typing import Final, NamedTuple

NOTICE_NS: Final = 60_000_000_000  # least time between two notices of a kind about one sender


class Disagreement(Enum):
    """What a peer does that the known ones do not, and what follows from it."""

    CONTRADICTS = "reports from {peer} contradict those from {known} and are rejected"
    REPLACES = "positions are used from {peer}, since {known} sends none"
    IS_NEWER = "messages from {peer} are newer than those from {known}, but not used"
    LEADS = "messages from {peer} arrive earlier than those from {known}, and set its clock"
    FALLS_BEHIND = "messages from {peer} arrive more than 10 s late; those from {known} are used"
    HAS_ATTITUDES = "attitudes from {peer} are not used, although {known} sends none"
    HAS_NO_FIX = "{peer} reports no GNSS fix; not used, although {known} sends no GPS_RAW_INT"


class PeerNotice(NamedTuple):
    """Disagreement of a peer with the known ones of a sender."""

    what: Disagreement
    who: str
    peer: str
    known: tuple[str, ...]

    @property
    def text(self) -> str:
        """The notice for the operator, with what to do."""
        said = self.what.value.format(peer=self.peer, known=" and ".join(self.known))
        return f"{self.who}: {said}; add the trusted peer to `[links] routers`"
