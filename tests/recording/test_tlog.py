"""Logs of other programs: every intact frame is found, whatever is damaged around it."""

import random
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect
from support import examples

from companion.mavlink.wire.crc_extra import CRC_EXTRA
from companion.recording.reader import LogError, log_kind, read_log, read_settings
from companion.recording.stamps import LARGEST_LEAP_NS
from companion.recording.tlog import read_raw, read_tlog, sniff
from companion.values import Event, Frame, Reason, Rejection

Wire = Callable[..., list[bytes]]
START_US = 1_700_000_000_000_000
UNKNOWN = bytes([0xFD, 4, 0, 0, 9, 7, 1, 0x56, 0x34, 0x12]) + b"\xfe\x01\x02\x03" + b"\xaa\xbb"
"""A MAVLink 2 frame of an id that nobody knows, with a false start in its payload."""


def stamped(frames: list[bytes], step_us: int = 10_000) -> bytes:
    return b"".join(
        struct.pack(">Q", START_US + number * step_us) + frame
        for number, frame in enumerate(frames)
    )


def raws(events: list[Event]) -> list[bytes]:
    return [event.raw for event in events if isinstance(event, Frame)]


def lost(events: list[Event]) -> Counter[Reason]:
    counts: Counter[Reason] = Counter()
    for event in events:
        if isinstance(event, Rejection):
            counts[event.reason] += event.count
    return counts


def pymavlink_frames(data: bytes, gap: int) -> Iterator[bytes]:
    """Frames that pymavlink can decode, from left to right, with ``gap`` bytes before each.

    pymavlink accepts frames with unknown ids unchecked; those are excluded.
    """
    mav = dialect.MAVLink(None)
    at = gap
    while at < len(data):
        size = 0
        if data[at] in (0xFD, 0xFE) and at + 12 <= len(data):
            v2 = data[at] == 0xFD
            size = data[at + 1] + (12 if v2 else 8)
            if v2 and data[at + 2] & 1:
                size += 13
        msgid = int.from_bytes(data[at + 7 : at + 10], "little") if size else 0
        if size and data[at] == 0xFE:
            msgid = data[at + 5]
        known = msgid in dialect.mavlink_map and at + size <= len(data)
        if size and known and not (data[at] == 0xFD and data[at + 2] > 1):
            try:
                mav.decode(bytearray(data[at : at + size]))
            except (dialect.MAVError, struct.error):
                at += 1
                continue
            yield data[at : at + size]
            at += size
        else:
            at += 1


# --- intact -------------------------------------------------------------------------------------


@pytest.mark.parametrize("v1", [False, True])
def test_intact_tlog_yields_every_frame_at_its_timestamp(wire: Wire, v1: bool) -> None:
    frames = wire(100, v1=v1)
    data = stamped(frames)
    assert sniff(data) == "tlog"
    events = list(read_tlog(data, "flight.tlog"))
    assert raws(events) == frames
    assert lost(events) == {}
    assert [event.t_ns for event in events] == [(START_US + n * 10_000) * 1000 for n in range(100)]
    decoded = [dialect.MAVLink(None).decode(bytearray(frame)) for frame in frames]
    for event, message in zip(events, decoded, strict=True):
        assert isinstance(event, Frame)
        assert event.link == "flight.tlog"
        assert event.msgid == message.get_msgId()
        assert event.source == (message.get_srcSystem(), message.get_srcComponent())


def test_unknown_message_id_loses_only_its_frame(wire: Wire) -> None:
    frames = wire(40)
    mixed = [*frames[:10], UNKNOWN, *frames[10:20], UNKNOWN, UNKNOWN, *frames[20:], UNKNOWN]
    events = list(read_tlog(stamped(mixed), "x"))
    assert raws(events) == frames
    assert lost(events) == {Reason.UNKNOWN_MESSAGE: 4}
    after = [event for event in events if isinstance(event, Frame)][10]
    assert after.t_ns == (START_US + 11 * 10_000) * 1000


def test_timestamp_may_contain_magic_bytes(wire: Wire) -> None:
    """Eight bytes that look like a frame header, between two frames that cannot be checked."""
    frames = wire(3)
    false_start = struct.pack(">Q", 0x0006_0AFD_0000_0000)
    data = stamped(frames) + (false_start + UNKNOWN) * 3 + false_start + frames[0]
    assert lost(list(read_tlog(data, "x"))) == {
        Reason.UNKNOWN_MESSAGE: 3,
        Reason.BAD_STAMP: 1,  # the only error: it belongs to another year
    }


# --- damaged ------------------------------------------------------------------------------------


def test_flipped_byte_loses_only_its_frame(wire: Wire) -> None:
    """At every byte of a log in turn; a damaged timestamp byte loses no frame."""
    frames = wire(8)
    data = stamped(frames)
    record_of = [n for n, frame in enumerate(frames) for _ in range(8 + len(frame))]
    in_stamp = [at < 8 for frame in frames for at in range(8 + len(frame))]
    for at, record in enumerate(record_of):
        broken = bytearray(data)
        broken[at] ^= 0x5A
        events = list(read_tlog(bytes(broken), "x"))
        expected = frames if in_stamp[at] else [*frames[:record], *frames[record + 1 :]]
        assert raws(events) == expected, at
        if not in_stamp[at]:
            assert lost(events), at


def test_damaged_frames_are_counted_as_on_the_wire(wire: Wire) -> None:
    frames = wire(30)
    bad_crc = bytearray(frames[3])
    bad_crc[-1] ^= 0xFF
    mixed = [*frames[:10], bytes(bad_crc), bytes(bad_crc), *frames[10:]]
    events = list(read_tlog(stamped(mixed), "x"))
    assert raws(events) == frames
    assert lost(events) == {Reason.BAD_CRC: 2}
    times = [event.t_ns for event in events]
    assert times == sorted(times)


def test_removed_section_loses_only_its_frames(wire: Wire) -> None:
    frames = wire(60)
    data = stamped(frames)
    ends, at = [], 0
    for frame in frames:
        at += 8 + len(frame)
        ends.append(at)
    rng = random.Random(7)
    for _ in range(200):
        first, last = sorted(rng.sample(range(len(data)), 2))
        events = list(read_tlog(data[:first] + data[last:], "x"))
        before = [f for f, end in zip(frames, ends, strict=True) if end <= first]
        after = [f for f, end in zip(frames, ends, strict=True) if end - len(f) >= last]
        found = raws(events)
        # Two frames cut at identical bytes join to one of them.
        joined = found[len(before) : len(found) - len(after)]
        assert found == [*before, *joined, *after]
        assert len(joined) <= 1 and set(joined) <= set(frames)
        times = [event.t_ns for event in events]
        assert times == sorted(times)


def test_garbage_between_records_is_counted_in_bytes(wire: Wire) -> None:
    frames = wire(20)
    data = stamped(frames[:10]) + b"\x11" * 33 + stamped(frames[10:])
    events = list(read_tlog(data, "x"))
    assert raws(events) == frames
    assert lost(events)[Reason.GARBAGE] == 33


def test_bad_timestamp_is_reported_and_its_frame_kept(wire: Wire) -> None:
    frames = wire(20)
    data = bytearray(stamped(frames))
    at = sum(8 + len(frame) for frame in frames[:5])
    data[at : at + 8] = struct.pack(">Q", START_US + 10**18)
    events = list(read_tlog(bytes(data), "x"))
    assert raws(events) == frames
    assert lost(events) == {Reason.BAD_STAMP: 1}
    assert isinstance(events[5], Rejection) and "1e+12 s after the log's time" in events[5].detail
    assert [e.t_ns for e in events if isinstance(e, Frame)][5:7] == [
        (START_US + 4 * 10_000) * 1000,
        (START_US + 6 * 10_000) * 1000,
    ]


def test_bad_first_timestamp_leaves_the_others_unchanged(wire: Wire) -> None:
    frames = wire(10)
    data = struct.pack(">Q", START_US + 10**18) + stamped(frames)[8:]
    times = [event.t_ns for event in read_tlog(data, "x") if isinstance(event, Frame)]
    assert times == [(START_US + max(n, 1) * 10_000) * 1000 for n in range(10)]


@settings(max_examples=examples(200))
@given(st.lists(st.binary(max_size=40) | st.sampled_from([UNKNOWN, b"\xfd", b"\xfe\x09"])))
def test_arbitrary_bytes_never_raise_and_time_is_monotonic(pieces: list[bytes]) -> None:
    """Nothing raises, time is monotonic, and no more bytes are lost than were present."""
    data = b"".join(pieces)
    for events in (list(read_tlog(data, "x")), list(read_raw(data, "x"))):
        times = [event.t_ns for event in events]
        assert all(0 <= b - a <= LARGEST_LEAP_NS for a, b in pairwise(times))
        assert lost(events)[Reason.GARBAGE] <= len(data)


# --- raw ----------------------------------------------------------------------------------------


def test_raw_mavlink_uses_the_first_vehicle_clock(wire: Wire) -> None:
    frames = wire(60)  # a heartbeat first; then positions and attitudes of 1:1 and 2:1 alternately
    events = list(read_raw(b"".join(frames), "x"))
    assert sniff(b"".join(frames)) == "mavlink"
    assert raws(events) == frames
    assert lost(events) == {}
    first_ms = 1010  # of 2:1, in the second frame
    times_ms = [event.t_ns // 1_000_000 for event in events]
    expected, now_ms = [], first_ms
    for number in range(60):
        if number % 3 and number % 2:  # has a clock and belongs to 2:1
            now_ms = 1000 + 10 * number
        expected.append(now_ms)
    assert times_ms == expected


def test_raw_mavlink_without_a_clock_starts_at_the_epoch() -> None:
    mav = dialect.MAVLink(None)
    heartbeat = bytes(mav.heartbeat_encode(2, 3, 0, 0, 4).pack(mav))
    assert [event.t_ns for event in read_raw(heartbeat * 3, "x")] == [0, 0, 0]


def test_slightly_reordered_boot_times_are_tolerated() -> None:
    mav = dialect.MAVLink(None)
    boots_ms = [1000, 1010, 1004, 1020, 1015]
    data = b"".join(bytes(mav.attitude_encode(ms, 0, 0, 0, 0, 0, 0).pack(mav)) for ms in boots_ms)
    events = list(read_raw(data, "x"))
    assert [event.t_ns // 1_000_000 for event in events] == [1000, 1010, 1010, 1020, 1020]
    assert lost(events) == {}


def test_raw_mavlink_time_continues_after_a_reboot() -> None:
    mav = dialect.MAVLink(None)
    boots_ms = [90_000, 90_500, 91_000, 200, 700, 1_200, 1_700]
    data = b"".join(bytes(mav.attitude_encode(ms, 0, 0, 0, 0, 0, 0).pack(mav)) for ms in boots_ms)
    times_ms = [e.t_ns // 1_000_000 for e in read_raw(data, "x") if isinstance(e, Frame)]
    assert times_ms == [90_000, 90_500, 91_000, 91_000, 91_000, 92_000, 92_500]


# --- files --------------------------------------------------------------------------------------


def test_log_kind_depends_on_content_not_name(tmp_path: Path, wire: Wire) -> None:
    frames = wire(20)
    tlog, raw = tmp_path / "a.mcap", tmp_path / "b.tlog"
    tlog.write_bytes(stamped(frames))
    raw.write_bytes(b"\x00\x01" + b"".join(frames))
    assert (log_kind(tlog), log_kind(raw)) == ("tlog", "mavlink")
    assert raws(list(read_log(tlog))) == raws(list(read_log(raw))) == frames
    assert read_settings(tlog) is None


@pytest.mark.parametrize("count", [1, 2])
def test_very_short_logs_are_recognised(wire: Wire, count: int) -> None:
    frames = wire(count)
    assert sniff(stamped(frames)) == "tlog"
    assert sniff(b"".join(frames)) == "mavlink"


def test_damaged_start_does_not_hide_the_log_kind(wire: Wire) -> None:
    frames = wire(30)
    assert sniff(stamped(frames)[5:]) == "tlog"
    assert sniff(b"".join(frames)[5:]) == "mavlink"


def test_unusable_log_is_a_one_line_error(tmp_path: Path, wire: Wire) -> None:
    noise = random.Random(3).randbytes(300_000)
    lone = noise[:5000] + wire(1)[0] + noise[5000:9000]
    cases: dict[str, tuple[bytes | None, str]] = {
        "missing": (None, "no such file"),
        "empty": (b"", "is empty"),
        "random": (noise, "no MAVLink frame"),
        "lone": (lone, "no MAVLink frame"),
        "text": (b"hello\n" * 100, "no MAVLink frame"),
        "magic.mcap": (b"\x89MCAP0\r\n", "no MAVLink frame"),
        "torn.mcap": (b"\x89MCAP0\r\n\x01\xff\xff\xff", "no MAVLink frame"),
        "short.mcap": (b"\x89MCAP0", "no MAVLink frame"),
    }
    for name, (content, why) in cases.items():
        path = tmp_path / name
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(LogError, match=why) as caught:
            read_log(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(LogError, match="is a folder"):
        read_log(tmp_path)
    with pytest.raises(LogError, match="is a folder"):
        log_kind(tmp_path)
    with pytest.raises(LogError, match="cannot be read"):
        read_log(tmp_path / "text" / "below a file")


@pytest.mark.full
def test_logs_of_other_programs_yield_the_frames_of_pymavlink(shared_logs: list[Path]) -> None:
    """Every frame that pymavlink finds, and no other, on a monotonic timeline."""
    for path in shared_logs:
        assert log_kind(path) == "tlog"
        events = list(read_log(path))
        expected = [
            frame for frame in pymavlink_frames(path.read_bytes(), 8) if msgid(frame) in CRC_EXTRA
        ]
        assert raws(events) == expected, path.name
        times = [event.t_ns for event in events]
        steps = pairwise(times)
        assert all(0 <= later - earlier <= LARGEST_LEAP_NS for earlier, later in steps)
        assert 60e9 < times[-1] - times[0] < 7200e9, path.name


def msgid(frame: bytes) -> int:
    return frame[5] if frame[0] == 0xFE else int.from_bytes(frame[7:10], "little")
