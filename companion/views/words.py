"""Times and angles as they are written at the edge of the program."""

from datetime import UTC, datetime
from typing import Final

import numpy as np

from companion.values import Reason, UtcNs

REASONS: Final = {
    Reason.GARBAGE: "bytes between frames that belong to none",
    Reason.BAD_CRC: "frames with a wrong checksum",
    Reason.UNKNOWN_MESSAGE: "frames of messages that are not known",
    Reason.BAD_STAMP: "stamps of the log that step back or leap",
    Reason.MALFORMED: "messages whose fields cannot be what they say",
    Reason.UNREACHABLE: "reports from where the UAV cannot have flown",
    Reason.ALTITUDE_JUMP: "reports from a height that the UAV cannot have reached",
    Reason.FROZEN: "reports of an old position under a new time",
    Reason.SHARED_ID: "reports of two vehicles under one id",
    Reason.ZERO_POSITION: "reports of 0 N 0 E, which are sent before a fix",
    Reason.NO_POSITION: "relayed aircraft without a valid position",
    Reason.NO_IDENTITY: "Remote ID before its id was heard",
    Reason.NO_ALTITUDE: "relayed aircraft without a height",
    Reason.UNPLACED_STAMP: "reports whose time fits no clock so far",
    Reason.NOT_ALLOWED: "reports of senders that the settings keep out",
    Reason.TOO_MANY: "reports of more UAVs than the settings allow",
    Reason.UNSIGNED: "frames without the signature that their link asks for",
    Reason.BAD_SIGNATURE: "frames with a wrong signature",
    Reason.REPLAYED: "signed frames that are not newer than those before",
    Reason.SECRET: "frames that carry a key: not used, not recorded",
    Reason.SOCKET_OVERFLOW: "frames that this machine was too slow to read",
    Reason.DUPLICATE: "reports that had been heard already",
    Reason.NO_FIX: "first reports before the receiver had a fix",
    Reason.OUT_OF_ORDER: "reports that came too late to be put in order",
}
"""What was counted, in plain words: as many of these were not used."""


def rfc3339(t_ns: UtcNs) -> str:
    """A time in UTC with milliseconds: 2026-11-20T13:00:00.123Z."""
    seconds, milliseconds = divmod(t_ns // 1_000_000, 1000)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{milliseconds:03d}Z"


def degrees(angle_rad: float | None) -> float | None:
    """Radians to degrees; None stays null."""
    return None if angle_rad is None else float(np.degrees(angle_rad))
