"""Boot stamps of messages that the service does not decode otherwise.

Any message with ``time_boot_ms`` shows its sender's boot clock. The table is that of pymavlink's
generated ``all`` dialect, without the setpoints that ground stations send (82, 84, 86): their time
is not an autopilot's. ``tests/mavlink/wire/test_stamps.py`` compares it with the dialect.
"""

from typing import Final

from companion.values import Frame

STAMPED: Final[dict[int, int]] = {
    **dict.fromkeys(
        (26, 29, 30, 31, 32, 33, 34, 35, 65, 81, 83, 85, 87, 89, 116, 129, 132, 137, 143), 0
    ),
    **dict.fromkeys((251, 252, 254, 257, 259, 260, 261, 262, 265, 271, 277, 280, 281, 285), 0),
    **dict.fromkeys((376, 11037, 11038, 11060, 60040, 60050, 60051, 60052, 60053), 0),
    2: 8,
    263: 8,
    264: 24,
    283: 8,
}
"""Offset of ``time_boot_ms`` in the payload, bytes, by message id."""
WRAP_MS: Final = 1 << 32
"""Period of a boot clock: its 32-bit milliseconds wrap after 49.7 days."""
_NS_PER_MS: Final = 1_000_000


def boot_ms(frame: Frame) -> int:
    """Return the stamp of a message in ``STAMPED``, milliseconds since its sender's boot.

    Bytes that MAVLink 2 truncated are zeros.
    """
    raw = frame.raw
    start = 10 if raw[0] == 0xFD else 6
    at = start + STAMPED[frame.msgid]
    return int.from_bytes(raw[at : min(at + 4, start + raw[1])], "little")


def stamp_step(stamp: int, before: int) -> int:
    """Return how far a stamp of 32 bits is ahead of another one, by the shorter way around.

    All are in the unit of the stamps.
    """
    return (stamp - before + WRAP_MS // 2) % WRAP_MS - WRAP_MS // 2


def unwrapped_ns(boot_ms: int, near_ns: int) -> int:
    """Convert boot milliseconds to ns, unwrapped to the value nearest to ``near_ns``."""
    near_ms = near_ns // _NS_PER_MS
    return (near_ms + stamp_step(boot_ms, near_ms)) * _NS_PER_MS
