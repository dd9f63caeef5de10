"""What was received and not used, and why."""

from dataclasses import dataclass
from enum import StrEnum


class Reason(StrEnum):
    """Why something received was not used. The values are shown in recordings and by the API."""

    GARBAGE = "garbage"  # bytes between frames; counted in bytes
    BAD_CRC = "bad-crc"  # framed like a known message, but the checksum is wrong
    UNKNOWN_MESSAGE = "unknown-message"  # an id without a known checksum seed: cannot be trusted
    BAD_STAMP = "bad-stamp"  # a log's own time stamp steps back or leaps; the step was clamped
    MALFORMED = "malformed"  # a checked frame whose fields cannot be what they say
    UNREACHABLE = "unreachable"  # farther from the track than it can have flown since
    ALTITUDE_JUMP = "altitude-jump"  # the same in height alone: the datum has changed
    FROZEN = "frozen"  # a fresh stamp on an old position, while the velocity says it moves
    SHARED_ID = "shared-id"  # two vehicles send under one id: neither can be believed
    ZERO_POSITION = "zero-position"  # within 5 km of 0 N 0 E: what is sent before a fix
    NO_POSITION = "no-position"  # ADSB_VEHICLE whose flags do not vouch for its coordinates
    NO_IDENTITY = "no-identity"  # a Remote ID position whose sender's id was not heard yet
    NO_ALTITUDE = "no-altitude"  # a position in the plane only
    UNPLACED_STAMP = "unplaced-stamp"  # off the sender's clock, and not enough others yet to agree
    NOT_ALLOWED = "not-allowed"  # a sender that the lists of the settings keep out
    TOO_MANY = "too-many"  # another sender, where as many are tracked as the settings allow
    UNSIGNED = "unsigned"  # without a signature, over a link that requires them
    BAD_SIGNATURE = "bad-signature"  # signed with another key, or altered
    REPLAYED = "replayed"  # well signed, but not newer than what was heard before
    SECRET = "secret"  # SETUP_SIGNING carries a key: it is not used, and not recorded
    SOCKET_OVERFLOW = "socket-overflow"  # lost before it was read: a full buffer, or too old
    DUPLICATE = "duplicate"  # the same report again, over this link or another
    NO_FIX = "no-fix"  # the first position of all, whose sender's receiver does not vouch for it
    OUT_OF_ORDER = "out-of-order"  # later than the window for late reports


@dataclass(frozen=True, slots=True, kw_only=True)
class Rejection:
    """Something received that was not used, and why.

    ``count`` is in frames, or in bytes for ``GARBAGE``. ``detail`` is text for the operator.
    """

    t_ns: int
    source: str
    reason: Reason
    count: int = 1
    msgid: int | None = None
    detail: str = ""
