"""Boot stamps that are set when a message is sent.

Excluded are stamps of a measurement or a fix (GPS_RAW_INT), which are older than the message, and
64-bit microseconds, which may be Unix time.
"""

from typing import Final

from companion.mavlink.wire import stamps as wire
from companion.values import Frame

_SENT: Final = frozenset(
    (
        2,  # SYSTEM_TIME
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


def boot_ms(frame: Frame) -> int | None:
    """Return the sending time of a message, milliseconds since boot; None for other messages."""
    return wire.boot_ms(frame) if frame.msgid in _SENT else None
