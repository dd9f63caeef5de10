"""Received data that was not used, with the reason."""

from dataclasses import dataclass
from typing import Annotated

from companion.values.described import DescribedEnum, Meaning


class Reason(DescribedEnum):
    """Why received data was not used."""

    GARBAGE = "garbage", "bytes between frames"
    BAD_CRC = "bad-crc", "frames with a wrong checksum"
    UNKNOWN_MESSAGE = "unknown-message", "frames of unknown messages, which cannot be checked"
    BAD_STAMP = "bad-stamp", "time stamps of a log that step back or jump; the step was clamped"
    MALFORMED = "malformed", "messages with impossible field values"
    UNREACHABLE = "unreachable", "reports farther from the track than the aircraft can have flown"
    ALTITUDE_JUMP = "altitude-jump", "reports at an unreachable height, as after a change of datum"
    FROZEN = "frozen", "new time stamps on an old position, although the reported velocity is not 0"
    SHARED_ID = "shared-id", "reports of two vehicles under one id"
    STRANGER = "stranger", "frames of a peer in the name of a UAV that a known peer reports"
    ZERO_POSITION = "zero-position", "reports near 0° N 0° E, which are sent before a fix"
    NO_POSITION = "no-position", "relayed aircraft without valid coordinates"
    NO_IDENTITY = "no-identity", "Remote ID positions received before the id of their sender"
    NO_ALTITUDE = "no-altitude", "relayed aircraft without an altitude"
    UNPLACED_STAMP = "unplaced-stamp", "reports whose time stamp fits no clock of the sender yet"
    NOT_ALLOWED = "not-allowed", "reports of senders that the allow and deny lists exclude"
    NEWCOMER = (
        "newcomer",
        "frames dropped by an overloaded machine: of new senders, or of senders that flood",
    )
    TOO_MANY = "too-many", "reports of UAVs beyond the number that the settings allow"
    UNSIGNED = "unsigned", "frames without the signature that their link requires"
    BAD_SIGNATURE = "bad-signature", "frames signed with another key, or altered"
    REPLAYED = "replayed", "signed frames no newer than an earlier one"
    SECRET = "secret", "frames that carry a signing key: neither used nor recorded"
    SOCKET_OVERFLOW = "socket-overflow", "frames lost before they were read: buffer full or too old"
    DUPLICATE = "duplicate", "copies of a report received before"
    NO_FIX = (
        "no-fix",
        "reports sent before the receiver had a fix, or while the estimator has no position",
    )
    OUT_OF_ORDER = "out-of-order", "reports older than the window for late reports"
    TOO_FREQUENT = (
        "too-frequent",
        "observations, or messages about other aircraft, beyond what is processed per second",
    )
    UNKNOWN_UAV = "unknown-uav", "observations of a UAV that is not tracked"
    NO_POSE = "no-pose", "observations while the array's position or attitude is unknown"
    WRONG_TIME = "wrong-time", "observations made too long ago, or in the future"
    OUTLIER = (
        "outlier",
        "observations that contradict the others of their UAV, or that no direction explains",
    )
    CONTRADICTED_BY_ARRAY = (
        "contradicted-by-array",
        "observations of a UAV that the array sees elsewhere than it reports",
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Rejection:
    """Received data that was not used, with the reason."""

    t_ns: Annotated[int, Meaning("arrival time of the message", 1)]
    source: Annotated[str, Meaning("UAV, sender, link or log that it came from", 2)]
    reason: Annotated[Reason, Meaning("why the data was not used", 3, example="unreachable")]
    count: Annotated[int, Meaning("number of frames; for garbage, bytes", 4, wire="uint64")] = 1
    msgid: Annotated[int | None, Meaning("MAVLink message id", 5)] = None
    detail: Annotated[str, Meaning("explanation of the rejection, with its numbers", 6)] = ""
