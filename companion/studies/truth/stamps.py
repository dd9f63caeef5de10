"""Boot stamps that are set when a message is sent; only the stamp is read.

Left out are stamps of a measurement or a fix (GPS_RAW_INT), which are older than the message, and
64-bit microseconds, which may be Unix time. Layouts: https://mavlink.io/en/messages/common.html.
"""

import struct
from typing import Final

from companion.values import Frame

_SYSTEM_TIME: Final = 2
_FIRST: Final = frozenset(
    (
        26,  # SCALED_IMU
        29,  # SCALED_PRESSURE
        30,  # ATTITUDE
        31,  # ATTITUDE_QUATERNION
        32,  # LOCAL_POSITION_NED
        33,  # GLOBAL_POSITION_INT
        65,  # RC_CHANNELS
        83,  # ATTITUDE_TARGET
        85,  # POSITION_TARGET_LOCAL_NED
        87,  # POSITION_TARGET_GLOBAL_INT
        116,  # SCALED_IMU2
        129,  # SCALED_IMU3
        137,  # SCALED_PRESSURE2
        143,  # SCALED_PRESSURE3
    )
)
"""Messages that begin with ``time_boot_ms``."""
_STAMP: Final = struct.Struct("<I")


def payload(msgid: int, boot_ms: int) -> bytes:
    """The payload of such a message with nothing but its stamp; what follows is cut as zeros."""
    return (b"\0" * 8 if msgid == _SYSTEM_TIME else b"") + _STAMP.pack(boot_ms)


def boot_ms(frame: Frame) -> int | None:
    """When a message was sent, milliseconds since boot; None where it does not say."""
    if frame.msgid in _FIRST:
        at = 0
    elif frame.msgid == _SYSTEM_TIME:
        at = 8
    else:
        return None
    stamp: int = _STAMP.unpack(frame.payload[at : at + 4].ljust(4, b"\0"))[0]
    return stamp
