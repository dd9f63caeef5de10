"""Boot stamps against pymavlink: their position in the payload and their decoding."""

import struct

import pymavlink.dialects.v20.all as dialect
import pytest

from companion.mavlink.wire.stamps import STAMPED, boot_ms
from companion.values import Frame, Source

SETPOINTS = {82, 84, 86}
"""Messages that ground stations send to a vehicle: their stamp is not the vehicle's."""
SIZES = {
    "uint64_t": 8, "int64_t": 8, "double": 8, "uint32_t": 4, "int32_t": 4, "float": 4,
    "uint16_t": 2, "int16_t": 2, "uint8_t": 1, "int8_t": 1, "char": 1,
}  # fmt: skip


def place(message: type[dialect.MAVLink_message]) -> int | None:
    """Return where ``time_boot_ms`` starts in the payload; None if there is none."""
    at = 0
    for name, length in zip(message.ordered_fieldnames, message.array_lengths, strict=True):
        if name == "time_boot_ms":
            return at
        at += SIZES[message.fieldtypes[message.fieldnames.index(name)]] * max(1, length)
    return None


def test_stamp_table_matches_the_dialect() -> None:
    found = {number: place(message) for number, message in dialect.mavlink_map.items()}
    stamped = {number: at for number, at in found.items() if at is not None}
    assert {n: at for n, at in stamped.items() if n not in SETPOINTS} == STAMPED


@pytest.mark.parametrize("version", [1, 2])
def test_stamp_decodes_like_pymavlink(version: int) -> None:
    """MAVLink 2 truncates trailing zeros of a payload."""
    sender = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    message = dialect.MAVLink_system_time_message(1_700_000_000_000_000, 70_000)
    raw = message.pack(sender, force_mavlink1=version == 1)
    assert boot_ms(Frame(t_ns=0, link="udp", source=Source(1, 1), msgid=2, raw=raw)) == 70_000


def test_truncated_payload_has_a_stamp_of_zero() -> None:
    payload = struct.pack("<Q", 1)
    raw = bytes((0xFD, len(payload), 0, 0, 0, 1, 1, 2, 0, 0)) + payload + b"\0\0"
    assert boot_ms(Frame(t_ns=0, link="udp", source=Source(1, 1), msgid=2, raw=raw)) == 0
