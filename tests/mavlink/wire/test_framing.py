"""Frames are found in any fragments and amid any damage.

The oracle is pymavlink's generated dialect, as a packer and (``scan`` in conftest.py) a parser.
"""

import random
from collections import Counter
from collections.abc import Callable, Iterable
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect
from support import LONGEST_FRAME, examples, rounds

from companion.mavlink.wire import encode, framing
from companion.mavlink.wire.crc_extra import CRC_EXTRA
from companion.mavlink.wire.framing import KNOWN_MAX, SplitLimits, Splitter
from companion.values import Frame, Reason, Rejection, Source
from companion.values.budget import Budget

Scan = Callable[[bytes], list[bytes]]
Found = tuple[list[Frame], Counter[Reason]]
LOGS = (
    "adsb_pymodes_real.tlog",
    "real_bluerobotics_server.tlog",
    "real_devmangrani_flight54.tlog",
    "real_dronekit_flight2015.tlog",
    "real_eagle_c2_gui.tlog",
    "sitl_4circle.tlog",
    "sitl_4circle_wander.tlog",
)
FALSE_STARTS = [0xFD, 0xFE, 0x03] * 84 + [0xFD]
"""253 bytes, two of three of which start a frame."""


def pack(
    message: dialect.MAVLink_message,
    *,
    v1: bool = False,
    signed: bool = False,
    seq: int = 0,
    source: tuple[int, int] = (1, 1),
) -> bytes:
    """Return the frame as pymavlink sends it."""
    mav = dialect.MAVLink(None, *source)
    mav.seq = seq % 256
    if signed:
        mav.signing.secret_key = bytes(range(32))
        mav.signing.link_id = 3
        mav.signing.timestamp = 12345 + seq
        mav.signing.sign_outgoing = True
    return bytes(message.pack(mav, force_mavlink1=v1))


def checked(head: bytes, payload: bytes, seed: int) -> bytes:
    """Return a hand-made frame, ``head`` from the magic byte on, with its correct checksum."""
    body = head[1:] + payload
    crc = dialect.x25crc(body + bytes([seed])).crc
    return head[:1] + body + int(crc).to_bytes(2, "little")


def traffic(count: int) -> list[bytes]:
    """Return distinct frames: both versions, signed and unsigned, short and long, three senders."""
    made = []
    for n in range(count):
        message = (
            dialect.MAVLink_heartbeat_message(2, 3, 81, n, 4, 3),
            dialect.MAVLink_global_position_int_message(
                1000 + n, 473977419 + n, 85455938, 488_000, 25_000, -300, 400, -5, 35_999
            ),
            dialect.MAVLink_attitude_message(1000 + n, 0.1, -0.2, 3.0, 0.0, 0.5, 0.0),
            dialect.MAVLink_ping_message(0, n, 0, 0),
            dialect.MAVLink_statustext_message(6, b"\xfd\xfe\x09\xfd\x01" + b"%d" % n),
            dialect.MAVLink_encapsulated_data_message(n, FALSE_STARTS),
            dialect.MAVLink_request_data_stream_message(0, 0, 0, 0, 0),
        )[n % 7]
        made.append(
            pack(message, v1=n % 3 == 0, signed=n % 5 == 1 and n % 3 > 0, seq=n, source=(n % 3, 1))
        )
    return made


def unknown(v1: bool, payload: bytes = b"\xfe\x01\x02\xfd\x09") -> bytes:
    """Return a frame with an unknown id and false starts in its payload."""
    size = len(payload)
    if v1:
        return checked(bytes([0xFE, size, 0, 1, 1, 255]), payload, 0)
    return checked(bytes([0xFD, size, 0, 0, 0, 1, 1, 0x56, 0x34, 0x12]), payload, 0)


def split(pieces: Iterable[bytes], wanted: frozenset[int] | None = None) -> Found:
    """Return what one splitter finds in the pieces, including the end of the stream."""
    splitter = Splitter("x", wanted)
    found = [item for n, piece in enumerate(pieces) for item in splitter.feed(n, piece)]
    return sort_out([*found, *splitter.finish(-1)])


def sort_out(found: list[Frame | Rejection]) -> Found:
    lost: Counter[Reason] = Counter()
    frames = []
    for item in found:
        if isinstance(item, Frame):
            frames.append(item)
        else:
            assert item.source == "x" and item.count > 0
            lost[item.reason] += item.count
    return frames, lost


def raws(frames: Iterable[Frame]) -> list[bytes]:
    return [frame.raw for frame in frames]


def bytewise(data: bytes) -> list[bytes]:
    return [data[n : n + 1] for n in range(len(data))]


def damaged(frame: bytes) -> bytes:
    """Return the frame with the last byte before its checksum changed: header and length stay."""
    signature = 13 if frame[0] == 0xFD and frame[2] & 1 else 0
    at = len(frame) - signature - 3
    return frame[:at] + bytes([frame[at] ^ 0x10]) + frame[at + 1 :]


# --- intact frames ------------------------------------------------------------------------------


def test_frame_fields_match_pymavlink() -> None:
    made = traffic(210)
    frames, lost = split(made)
    assert raws(frames) == made
    assert lost == {}
    mav = dialect.MAVLink(None)
    for number, frame in enumerate(frames):
        message = mav.decode(bytearray(frame.raw))
        assert frame.t_ns == number and frame.link == "x"
        assert frame.source == (message.get_srcSystem(), message.get_srcComponent())
        assert isinstance(frame.source, Source)
        assert frame.msgid == message.get_msgId()
        assert frame.seq == message.get_seq()
        assert frame.version == (1 if frame.raw[0] == 0xFE else 2)
        header = 6 if frame.version == 1 else 10
        assert frame.payload == frame.raw[header : header + message.get_header().mlen]
    signed = [frame for frame in frames if frame.version == 2 and frame.raw[2] & 1]
    assert len(signed) > 20 and {frame.version for frame in frames} == {1, 2}


def test_many_frames_in_one_datagram_are_split() -> None:
    made = traffic(70)
    splitter = Splitter("x")
    found = splitter.feed(5, b"".join(made))
    assert [item.raw for item in found if isinstance(item, Frame)] == made
    assert len(found) == len(made) == splitter.frames
    assert {item.t_ns for item in found} == {5}


@pytest.mark.parametrize("tail", [b"", b"\xfd\x09\x00", b"\xfe", b"\x55\x55"])
def test_frame_over_many_reads_is_delivered_once(tail: bytes) -> None:
    """It is delivered once, with its last byte, at that byte's time."""
    for made in traffic(14):
        splitter = Splitter("x")
        for n, byte in enumerate(bytewise(made[:-1])):
            assert splitter.feed(n, byte) == []
        found, _ = sort_out(splitter.feed(777, made[-1:] + tail))
        assert raws(found) == [made]
        assert found[0].t_ns == 777


def test_only_wanted_messages_are_delivered_but_all_are_counted() -> None:
    made = traffic(70)
    wanted = frozenset({0, 33})
    splitter = Splitter("x", wanted)
    found, lost = sort_out([i for frame in made for i in splitter.feed(0, frame)])
    everything, _ = split(made)
    assert raws(found) == [frame.raw for frame in everything if frame.msgid in wanted]
    assert len(found) == 20
    assert splitter.frames == 70
    assert lost == {}


# --- fragments ----------------------------------------------------------------------------------

TRAFFIC = traffic(35)
PIECES = st.lists(
    st.sampled_from(TRAFFIC)
    | st.binary(max_size=30)
    | st.lists(st.sampled_from(b"\xfd\xfe\x00\x01\x05\xff"), max_size=20).map(bytes)
    | st.sampled_from(TRAFFIC).map(damaged)
    | st.sampled_from([unknown(v1=True), unknown(v1=False)])
    | st.tuples(st.sampled_from(TRAFFIC), st.integers(1, 40)).map(lambda cut: cut[0][: cut[1]])
    | st.sampled_from(TRAFFIC).map(lambda frame: frame[:1] + b"\xff" + frame[2:]),
    max_size=12,
)


@settings(max_examples=examples(300), deadline=None)
@given(pieces=PIECES, cuts=st.lists(st.integers(0, 2000), max_size=20))
def test_frames_and_counts_do_not_depend_on_read_sizes(
    scan: Scan, pieces: list[bytes], cuts: list[int]
) -> None:
    """Whole, byte by byte and in random pieces: pymavlink's frames, and equal losses."""
    data = b"".join(pieces)
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    frames, lost = split([data])
    assert raws(frames) == scan(data)
    for way in (bytewise(data), [data[a:b] for a, b in pairwise(edges)]):
        again, lost_again = split(way)
        assert raws(again) == raws(frames)
        assert lost_again == lost
    assert lost[Reason.GARBAGE] <= len(data) - sum(map(len, raws(frames)))


@settings(max_examples=examples(300), deadline=None)
@given(st.lists(st.binary(max_size=600), max_size=5))
def test_random_bytes_never_raise(pieces: list[bytes]) -> None:
    frames, lost = split(pieces)
    size = sum(map(len, pieces))
    assert lost[Reason.GARBAGE] + sum(map(len, raws(frames))) <= size
    assert size == 0 or frames or lost


def test_random_bytes_full_of_magic_never_raise() -> None:
    rng = random.Random(1)
    for _ in range(300):
        data = bytes(rng.choices([0xFD, 0xFE, 0, 1, 30, 33, 255], k=rng.randrange(1, 900)))
        frames, lost = split([data])
        again, lost_again = split(bytewise(data))
        assert raws(frames) == raws(again) and lost == lost_again
        assert frames or lost


def test_pending_bytes_are_bounded_by_the_longest_frame() -> None:
    """Inspects internals: bounded memory is not visible from outside."""
    rng = random.Random(2)
    data = b"".join(traffic(50)) + bytes(rng.choices([0xFD, 0xFE, 0, 1, 33, 255], k=20_000))
    longest = pack(dialect.MAVLink_encapsulated_data_message(1, [255] * 253), signed=True)
    data += longest
    for step in (1, 7, 64, 5000):
        splitter = Splitter("x")
        most = 0
        for at in range(0, len(data), step):
            splitter.feed(0, data[at : at + step])
            most = max(most, len(splitter._pending))
        assert most < LONGEST_FRAME == len(longest) == 280
        if step == 1:
            assert most == LONGEST_FRAME - 1
        splitter.finish(0)
        assert not splitter._pending


# --- damage -------------------------------------------------------------------------------------


def flip(rng: random.Random, data: bytearray, start: int, stop: int) -> None:
    for at in range(start, stop):
        data[at] ^= rng.randrange(1, 256)


@pytest.mark.parametrize("kind", ["flip", "truncate", "splice", "noise"])
def test_every_frame_outside_the_damage_is_found(scan: Scan, kind: str) -> None:
    rng = random.Random(f"damage {kind}")
    made = traffic(30)
    ends = [sum(map(len, made[: n + 1])) for n in range(len(made))]
    whole = b"".join(made)
    for _ in range(rounds(80, 250)):
        data = bytearray(whole)
        start = rng.randrange(len(whole))
        stop = min(len(whole), start + rng.randrange(1, 120))
        match kind:
            case "flip":
                flip(rng, data, start, stop)
            case "truncate":
                del data[start:stop]
            case "splice":
                other = rng.choice(made)
                data[start:stop] = other[rng.randrange(len(other)) :]
            case "noise":
                stop = start
                data[start:start] = rng.randbytes(rng.randrange(1, 300))
        before = [frame for frame, end in zip(made, ends, strict=True) if end <= start]
        after = [f for f, end in zip(made, ends, strict=True) if end - len(f) >= stop]
        frames, lost = split([bytes(data)])
        found = raws(frames)
        assert found[: len(before)] == before
        assert found[len(found) - len(after) :] == after
        assert len(found) >= len(before) + len(after)
        assert found == scan(bytes(data))
        if len(found) < len(made):
            assert lost or kind == "truncate"
        assert raws(split(bytewise(bytes(data)))[0]) == found


def test_damaged_length_loses_no_good_frame() -> None:
    made = [frame for frame in traffic(40) if len(frame) < 60]
    for victim in range(0, 12):
        frame = made[victim]
        pieces = [*made[:victim], frame[:1] + b"\xff" + frame[2:], *made[victim + 1 :]]
        for way in (pieces, [b"".join(pieces)], bytewise(b"".join(pieces))):
            frames, lost = split(way)
            assert raws(frames) == made[:victim] + made[victim + 1 :]
            assert lost == {Reason.BAD_CRC: 1}


def test_failed_frame_ends_at_the_next_good_frame() -> None:
    """Damage behind that frame counts separately, even within the length first claimed."""
    made = [frame for frame in traffic(40) if len(frame) < 40][:12]
    first = made[0][:1] + b"\xff" + made[0][2:]
    stream = [first, made[1], b"0123456789", damaged(made[2]), *made[3:]]
    for way in (stream, [b"".join(stream)], bytewise(b"".join(stream))):
        frames, lost = split(way)
        assert raws(frames) == [made[1], *made[3:]]
        assert lost == {Reason.BAD_CRC: 2, Reason.GARBAGE: 10}


def test_signature_of_a_damaged_frame_is_not_garbage() -> None:
    made = [frame for frame in traffic(30) if frame[0] == 0xFD and frame[2] & 1]
    frames, lost = split([made[0], damaged(made[1]), made[2]])
    assert raws(frames) == [made[0], made[2]]
    assert lost == {Reason.BAD_CRC: 1}


def test_frames_inside_an_incomplete_frame_are_found_at_the_end() -> None:
    made = [frame for frame in traffic(5) if len(frame) < 60][:3]
    cut_short = made[0][:1] + b"\xff" + made[0][2:]
    splitter = Splitter("x")
    assert splitter.feed(0, cut_short + made[1] + made[2]) == []
    frames, lost = sort_out(splitter.finish(9))
    assert raws(frames) == made[1:]
    assert {frame.t_ns for frame in frames} == {9}
    assert sum(lost.values()) > 0
    assert splitter.finish(10) == []


@pytest.mark.parametrize("v1", [True, False])
def test_damaged_frame_counts_once_despite_false_starts(v1: bool) -> None:
    made = [
        pack(dialect.MAVLink_encapsulated_data_message(n, FALSE_STARTS), v1=v1, seq=n)
        for n in range(20)
    ]
    stream = [damaged(frame) if n in (3, 4, 5, 11, 19) else frame for n, frame in enumerate(made)]
    good = [frame for n, frame in enumerate(made) if n not in (3, 4, 5, 11, 19)]
    for way in (stream, [b"".join(stream)], bytewise(b"".join(stream))):
        frames, lost = split(way)
        assert raws(frames) == good
        assert lost == {Reason.BAD_CRC: 5}


@pytest.mark.parametrize("v1", [True, False])
def test_unknown_message_id_counts_once_and_is_not_delivered(v1: bool) -> None:
    assert 255 not in CRC_EXTRA and 0x123456 not in CRC_EXTRA
    good = traffic(7)
    stranger = unknown(v1)
    stream = [good[0], stranger, good[1], stranger, stranger, *good[2:], stranger]
    for way in (stream, [b"".join(stream)], bytewise(b"".join(stream))):
        frames, lost = split(way)
        assert raws(frames) == good
        assert lost == {Reason.UNKNOWN_MESSAGE: 4}


@pytest.mark.parametrize("flags", [2, 3, 4, 0x80, 0x81, 0xFF])
def test_undefined_incompatibility_flags_are_rejected(flags: int) -> None:
    """Its checksum is correct, but the flag's effect on the frame is unknown."""
    good = traffic(4)
    payload = bytes([1, 2, 3, 4, 5, 6, 7, 8, 9])
    frame = checked(bytes([0xFD, 9, 0, 0, 0, 1, 1, 0, 0, 0]), payload, CRC_EXTRA[0])
    assert raws(split([frame])[0]) == [frame]
    strange = checked(bytes([0xFD, 9, flags, 0, 0, 1, 1, 0, 0, 0]), payload, CRC_EXTRA[0])
    if flags & 1:
        strange += bytes(13)
    frames, lost = split([good[0], strange, *good[1:]])
    assert raws(frames) == good
    assert lost == {Reason.GARBAGE: len(strange)}


def test_compatibility_flags_are_accepted() -> None:
    frame = checked(bytes([0xFD, 1, 0, 0xFF, 0, 1, 1, 0, 0, 0]), b"\x01", CRC_EXTRA[0])
    assert raws(split([frame])[0]) == [frame]


def test_garbage_is_counted_in_bytes() -> None:
    made = traffic(10)
    stream = [b"\x00" * 17, made[0], b"noise", *made[1:9], b"\r\n", made[9], b"\xff" * 40]
    for way in (stream, [b"".join(stream)], bytewise(b"".join(stream))):
        frames, lost = split(way)
        assert raws(frames) == made
        assert lost == {Reason.GARBAGE: 17 + 5 + 2 + 40}


def test_truncated_datagram_does_not_affect_other_peers() -> None:
    made = traffic(12)
    peers = [Splitter("x") for _ in range(2)]
    found: list[list[Frame | Rejection]] = [[], []]
    for frame in made:
        found[0] += peers[0].feed(0, frame[: len(frame) // 2])
        found[1] += peers[1].feed(0, frame)
    assert raws(sort_out(found[1])[0]) == made
    assert sort_out(found[1])[1] == {}


# --- whole logs ---------------------------------------------------------------------------------


def test_log_frames_match_a_streaming_parser(cut_frames: list[bytes]) -> None:
    """pymavlink's own ``parse_buffer`` over the frames in order."""
    assert len(cut_frames) == 7698
    stream = b"".join(cut_frames)
    messages = dialect.MAVLink(None).parse_buffer(stream)
    expected = [
        (m.get_srcSystem(), m.get_srcComponent(), m.get_msgId(), bytes(m.get_msgbuf()))
        for m in messages
    ]
    rng = random.Random(4)
    edges = [0, *sorted(rng.sample(range(len(stream)), 3000)), len(stream)]
    frames, lost = split(stream[a:b] for a, b in pairwise(edges))
    assert [(*frame.source, frame.msgid, frame.raw) for frame in frames] == expected
    assert lost == {}


def test_log_stamps_count_as_garbage(cut_log: bytes, cut_frames: list[bytes]) -> None:
    frames, lost = split([cut_log])
    assert raws(frames) == cut_frames
    assert len(cut_log) == 8 * len(cut_frames) + sum(map(len, cut_frames))
    assert 0.9 < lost[Reason.GARBAGE] / (8 * len(cut_frames)) <= 1.0


@pytest.mark.full
@pytest.mark.parametrize("name", LOGS)
def test_whole_logs_are_split_like_pymavlink(
    scan: Scan, shared_log: Callable[[str], bytes], name: str
) -> None:
    data = shared_log(name)
    expected = scan(data)
    assert len(expected) > 900
    frames, _ = split(data[at : at + 4096] for at in range(0, len(data), 4096))
    assert raws(frames) == expected
    mav = dialect.MAVLink(None)
    for frame in frames[::50]:
        message = mav.decode(bytearray(frame.raw))
        assert frame.source == (message.get_srcSystem(), message.get_srcComponent())
        assert frame.msgid == message.get_msgId()


def test_more_senders_than_the_cache_holds_are_all_received() -> None:
    """The state per sender is a cache, cleared when full."""
    sent = [Source(n % 255 + 1, n // 255) for n in range(KNOWN_MAX + 300)]
    splitter = Splitter("x")
    for _ in range(2):
        heard = [splitter.feed(0, encode.pack(encode.heartbeat(source), 0))[0] for source in sent]
        assert [frame.source for frame in heard if isinstance(frame, Frame)] == sent


# --- work on bytes that are no frames -------------------------------------------------------------


@pytest.mark.parametrize(
    "start", [b"\xfe\x01", b"\xfe\x00\xfd", b"\xfe", b"\xfd\xff\0\0\1\1\1\4\0\0"]
)
def test_false_starts_are_examined_within_a_budget(
    start: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bytes of which every second one may start a frame must not take the time of others."""
    examined, examine = 0, framing.examine

    def counting(buffer: bytes, at: int, end: int) -> int:
        nonlocal examined
        examined += 1
        return examine(buffer, at, end)

    monkeypatch.setattr(framing, "examine", counting)
    splitter = Splitter("x", limits=SplitLimits(search=framing.search_budget()))
    flood = start * (60_000 // len(start))
    for number in range(100):
        splitter.feed(number * 10_000_000, flood)  # 6 MB in a second
    assert 0 < examined <= framing.FALSE_STARTS_SAVED + framing.FALSE_STARTS_PER_S + 100
    frames = traffic(7)
    found = splitter.feed(1_000_000_000, b"".join(frames) + flood)
    assert [one.raw for one in found if isinstance(one, Frame)] == frames


def test_bytes_beyond_the_budget_are_counted_as_garbage() -> None:
    splitter = Splitter("x", limits=SplitLimits(search=Budget(per_s=0.0, most=1.0)))
    sent = b"\x55" * 1000
    found = [one for _ in range(3) for one in splitter.feed(0, sent)]
    assert sum(one.count for one in found if isinstance(one, Rejection)) == 3000
