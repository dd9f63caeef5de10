"""Sent messages equal those of pymavlink's generated dialect."""

import itertools

import pytest
from pymavlink.dialects.v10 import all as dialect_v1
from pymavlink.dialects.v20 import all as dialect_v2

from companion.mavlink.wire import encode
from companion.mavlink.wire.framing import Splitter
from companion.values import Frame, Source

OURS, TARGET = Source(5, 191), Source(3, 1)


def reference(dialect: object, seq: int, message: object) -> bytes:
    mav = dialect.MAVLink(None, *OURS)  # type: ignore[attr-defined]
    mav.seq = seq
    return bytes(message.pack(mav))  # type: ignore[attr-defined]


CASES = {
    "heartbeat": (
        encode.heartbeat(OURS),
        lambda d: d.MAVLink_heartbeat_message(
            type=d.MAV_TYPE_ONBOARD_CONTROLLER,
            autopilot=d.MAV_AUTOPILOT_INVALID,
            base_mode=0,
            custom_mode=0,
            system_status=d.MAV_STATE_ACTIVE,
            mavlink_version=3,
        ),
    ),
    "set_message_interval": (
        encode.set_message_interval(OURS, TARGET, 33, 100_000),
        lambda d: d.MAVLink_command_long_message(
            *TARGET, d.MAV_CMD_SET_MESSAGE_INTERVAL, 0, 33, 100_000, 0, 0, 0, 0, 0
        ),
    ),
    "set_message_interval again": (
        encode.set_message_interval(OURS, TARGET, 30, 66_667, confirmation=2),
        lambda d: d.MAVLink_command_long_message(
            *TARGET, d.MAV_CMD_SET_MESSAGE_INTERVAL, 2, 30, 66_667, 0, 0, 0, 0, 0
        ),
    ),
    "request_data_stream": (
        encode.request_data_stream(OURS, TARGET, 6, 10),
        lambda d: d.MAVLink_request_data_stream_message(*TARGET, d.MAV_DATA_STREAM_POSITION, 10, 1),
    ),
    "timesync": (
        encode.timesync(OURS, 1_790_000_000_123_456_789),
        lambda d: d.MAVLink_timesync_message(0, 1_790_000_000_123_456_789),
    ),
}


@pytest.mark.parametrize(
    ("name", "seq", "version"), list(itertools.product(CASES, (0, 255), (1, 2)))
)
def test_encoded_frames_match_the_dialect(name: str, seq: int, version: int) -> None:
    message, build = CASES[name]
    dialect = dialect_v2 if version == 2 else dialect_v1
    packed = encode.pack(message, seq, version)
    assert packed == reference(dialect, seq, build(dialect))


def test_zero_payload_keeps_one_byte() -> None:
    packed = encode.pack(encode.Outgoing(OURS, encode.TIMESYNC, bytes(16)), 7)
    mav = dialect_v2.MAVLink(None, *OURS)
    mav.seq = 7
    assert packed == bytes(dialect_v2.MAVLink_timesync_message(0, 0).pack(mav))
    (frame,) = Splitter("link").feed(0, packed)
    assert isinstance(frame, Frame)
    assert (frame.source, frame.msgid, frame.seq) == (OURS, encode.TIMESYNC, 7)
