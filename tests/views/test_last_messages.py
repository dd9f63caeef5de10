"""Last messages in the mavlink2rest format, against pymavlink's decoding."""

import json
import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as generated
from support import examples

from companion.server.responses import encode
from companion.values import Frame, Source, UtcNs
from companion.views import mavlink_messages
from companion.views.last_messages import LastMessages, by_sender

SENDER = Source(7, 42)


def packed(message: Any) -> bytes:
    mav = generated.MAVLink(None, SENDER.sysid, SENDER.compid)
    return bytes(message.pack(mav))


def kept(message: Any) -> LastMessages:
    store = LastMessages()
    raw = packed(message)
    store.add(
        Frame(t_ns=1_000_000_000, link="link", source=SENDER, msgid=message.get_msgId(), raw=raw)
    )
    return store


def shown(message: Any) -> Any:
    """Return a message as sent over HTTP."""
    found = kept(message).find(SENDER, message.get_msgId())
    assert found is not None
    return json.loads(encode(mavlink_messages.dialect().message(found, UtcNs)))


def test_heartbeat_matches_the_mavlink2rest_format() -> None:
    heartbeat = generated.MAVLink_heartbeat_message(12, 3, 81, 19, 4, 3)
    assert shown(heartbeat) == {
        "message": {
            "type": "HEARTBEAT",
            "autopilot": {"type": "MAV_AUTOPILOT_ARDUPILOTMEGA"},
            "base_mode": {"bits": 81},
            "custom_mode": 19,
            "mavlink_version": 3,
            "mavtype": {"type": "MAV_TYPE_SUBMARINE"},
            "system_status": {"type": "MAV_STATE_ACTIVE"},
        },
        "status": {
            "time": {
                "first_update": "1970-01-01T00:00:01.000Z",
                "last_update": "1970-01-01T00:00:01.000Z",
                "counter": 1,
                "frequency": None,
            }
        },
    }


def test_unknown_enumeration_value_is_shown_as_a_number() -> None:
    heartbeat = generated.MAVLink_heartbeat_message(250, 3, 0, 0, 0, 3)
    assert shown(heartbeat)["message"]["mavtype"] == {"type": 250}


def test_text_fields_are_character_lists() -> None:
    param = generated.MAVLink_param_value_message(b"SYSID_THISMAV", 0.1, 9, 3, 1)
    message = shown(param)["message"]
    assert message["param_id"] == [*"SYSID_THISMAV", "\0", "\0", "\0"]
    assert message["param_value"] == 0.1  # single precision, with its significant digits
    assert message["param_type"] == {"type": "MAV_PARAM_TYPE_REAL32"}


def test_arrays_are_lists_and_nan_is_null() -> None:
    nan = float("nan")
    attitude = generated.MAVLink_attitude_quaternion_message(5, 1, 0, 0, nan, 0, 0, 0, [0.5] * 4)
    message = shown(attitude)["message"]
    assert message["q4"] is None
    assert message["repr_offset_q"] == [0.5] * 4


@settings(max_examples=examples(200), deadline=None)
@given(data=st.data())
def test_every_message_decodes_like_pymavlink(data: st.DataObject) -> None:
    msgid = data.draw(st.sampled_from(sorted(generated.mavlink_map)))
    kind = generated.mavlink_map[msgid]
    size = kind.unpacker.size
    payload = data.draw(st.binary(min_size=1, max_size=size))
    header = bytes([0xFD, len(payload), 0, 0, 0, 7, 42]) + msgid.to_bytes(3, "little")
    frame = Frame(t_ns=0, link="link", source=SENDER, msgid=msgid, raw=header + payload + b"\0\0")
    store = LastMessages()
    store.add(frame)
    one = store.find(SENDER, msgid)
    assert one is not None
    message = json.loads(encode(mavlink_messages.dialect().message(one, UtcNs)))["message"]
    assert message.pop("type") == kind.msgname
    # its own order, from the same bytes with the zeros that MAVLink 2 truncates
    values = kind.unpacker.unpack(payload.ljust(size, b"\0"))
    assert len(message) == len(kind.fieldnames)
    flat = []
    for name in kind.ordered_fieldnames:
        value = message["mavtype" if name == "type" else name]
        if isinstance(value, list) and value and isinstance(value[0], str):
            flat.append("".join(value).encode("latin-1"))
        else:
            flat += value if isinstance(value, list) else [value]
    for ours, theirs in zip(flat, values, strict=True):
        if isinstance(ours, dict):
            (said,) = ours.values()
            assert said == theirs or getattr(generated, str(said)) == theirs
        elif ours is None:
            assert not math.isfinite(theirs)
        elif isinstance(ours, str):
            assert ours.encode("latin-1") == theirs
        elif isinstance(ours, float):
            assert ours == pytest.approx(theirs, rel=1e-6)
        else:
            assert ours == theirs


def frame(t_ns: int, source: Source, msgid: int = 0) -> Frame:
    return Frame(t_ns=t_ns, link="link", source=source, msgid=msgid, raw=b"")


def test_newest_message_is_kept_and_all_are_counted() -> None:
    store = LastMessages()
    for second in range(11):
        store.add(frame(second * 10**9, SENDER))
    found = store.find(SENDER, 0)
    assert found is not None
    assert (found.frame.t_ns, found.first_ns, found.counter) == (10 * 10**9, 0, 11)
    assert found.frequency_hz == pytest.approx(1.0)
    assert store.find(SENDER, 1) is None


def test_flood_of_senders_uses_bounded_memory() -> None:
    store = LastMessages(most=100)
    store.add(frame(0, Source(1, 1)))
    for number in range(10_000):
        store.add(frame(number, Source(number % 256, number // 256), msgid=5))
        store.add(frame(number, Source(1, 1)))  # received throughout: it is kept
    assert len(store.all()) == 100
    stayed = store.find(Source(1, 1), 0)
    assert stayed is not None
    assert stayed.counter == 10_001


def test_listed_messages_are_snapshots() -> None:
    store = LastMessages()
    store.add(frame(0, SENDER))
    listed = by_sender(store.all())[SENDER][0]
    store.add(frame(5, SENDER))
    assert (listed.frame.t_ns, listed.counter) == (0, 1)
