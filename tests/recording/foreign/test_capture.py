"""MAVLink in packet captures: captured on loopback, synthetic of every kind, and hostile."""

import contextlib
import os
import random
import socket
import struct
import tempfile
import threading
import time
import tracemalloc
from collections.abc import Iterable, Iterator
from itertools import islice, pairwise
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from support import HANG_S

from companion.mavlink.wire.encode import heartbeat, pack
from companion.recording.foreign.capture import read_capture
from companion.recording.foreign.packets import PCAP, Fragment, Packet, packets, segment
from companion.recording.reader import LogError, log_kind, read_flight, read_log
from companion.values import Event, Frame, Reason, Rejection, Source

FRAMES = [pack(heartbeat(Source(1 + n % 3, 1)), n & 255) for n in range(60)]
START_NS = 1_795_000_000_000_000_000
STEP_NS = 20_000_000


def raws(events: Iterable[Event]) -> list[bytes]:
    return [event.raw for event in events if isinstance(event, Frame)]


# --- synthetic packets -------------------------------------------------------------------------


def udp(payload: bytes, ports: tuple[int, int] = (14555, 14550)) -> bytes:
    return struct.pack(">4H", *ports, 8 + len(payload), 0) + payload


def tcp(payload: bytes, seq: int, flags: int = 0x10) -> bytes:
    return struct.pack(">2H2I2B3H", 5760, 50_000, seq, 0, 5 << 4, flags, 1000, 0, 0) + payload


def v4(body: bytes, kind: int = 17, fragment: int = 0) -> bytes:
    head = struct.pack(">2B3H2BH4s4s", 0x45, 0, 20 + len(body), 7, fragment, 64, kind, 0,
                       bytes((10, 0, 0, 2)), bytes((10, 0, 0, 1)))  # fmt: skip
    return head + body


def v6(body: bytes, kind: int = 17) -> bytes:
    extension = struct.pack(">2B6x", kind, 0)  # hop-by-hop options
    head = struct.pack(">IHBB", 6 << 28, len(extension) + len(body), 0, 64)
    return head + bytes(15) + b"\x01" + bytes(15) + b"\x01" + extension + body


LINKS = {
    1: lambda ip: bytes(12) + (b"\x08\x00" if ip[0] >> 4 == 4 else b"\x86\xdd") + ip,
    0: lambda ip: struct.pack("<I", 2) + ip,
    101: lambda ip: ip,
    113: lambda ip: bytes(14) + (b"\x08\x00" if ip[0] >> 4 == 4 else b"\x86\xdd") + ip,
    276: lambda ip: (b"\x08\x00" if ip[0] >> 4 == 4 else b"\x86\xdd") + bytes(18) + ip,
}


def pcap(
    rows: list[tuple[int, bytes]], link_type: int = 1, magic: bytes = b"\xd4\xc3\xb2\xa1"
) -> bytes:
    order, unit_ns = PCAP[magic]
    out = magic + struct.pack(f"{order}2HiIII", 2, 4, 0, 0, 65535, link_type)
    for t_ns, data in rows:
        seconds, rest = divmod(t_ns, 1_000_000_000)
        out += struct.pack(f"{order}4I", seconds, rest // unit_ns, len(data), len(data)) + data
    return out


def block(kind: int, body: bytes, order: str = "<") -> bytes:
    body += bytes(-len(body) % 4)
    size = struct.pack(f"{order}I", 12 + len(body))
    return struct.pack(f"{order}I", kind) + size + body + size


def pcapng(rows: list[tuple[int, bytes]], order: str = "<", resolution: int = 9) -> bytes:
    magic = struct.pack(f"{order}I", 0x1A2B3C4D)
    out = block(0x0A0D0D0A, magic + struct.pack(f"{order}2Hq", 1, 0, -1), order)
    option = struct.pack(f"{order}2HB3x2H", 9, 1, resolution, 0, 0)
    out += block(1, struct.pack(f"{order}2HI", 1, 0, 65535) + option, order)
    for t_ns, data in rows:
        stamp = t_ns // 10 ** (9 - resolution)
        head = struct.pack(f"{order}5I", 0, stamp >> 32, stamp & 0xFFFFFFFF, len(data), len(data))
        out += block(5, b"x" * 12, order)  # statistics block: skipped
        out += block(6, head + data, order)
    return out


def rows(link_type: int = 1, version: int = 4) -> list[tuple[int, bytes]]:
    wrap = v4 if version == 4 else v6
    return [
        (START_NS + n * STEP_NS, LINKS[link_type](wrap(udp(frame))))
        for n, frame in enumerate(FRAMES)
    ]


def events_of(data: bytes, tmp_path: Path) -> list[Event]:
    path = tmp_path / "net"
    path.write_bytes(data)
    assert log_kind(path) == "capture"
    return list(read_log(path))


@pytest.mark.parametrize("link_type", LINKS)
@pytest.mark.parametrize("version", [4, 6])
def test_capture_reads_every_link_type_and_ip_version(
    link_type: int, version: int, tmp_path: Path
) -> None:
    found = events_of(pcap(rows(link_type, version), link_type), tmp_path)
    assert raws(found) == FRAMES
    assert [event.t_ns - START_NS for event in found] == [n * STEP_NS for n in range(60)]
    (link,) = {event.link for event in found if isinstance(event, Frame)}
    assert link.startswith("udp:10.0.0.2:14555>" if version == 4 else "udp:[0000:")


@pytest.mark.parametrize("magic", PCAP)
def test_pcap_reads_both_byte_orders_and_time_units(magic: bytes, tmp_path: Path) -> None:
    assert raws(events_of(pcap(rows(), magic=magic), tmp_path)) == FRAMES


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("resolution", [6, 9])
def test_pcapng_frames_and_timestamps_are_read(order: str, resolution: int, tmp_path: Path) -> None:
    found = events_of(pcapng(rows(), order, resolution), tmp_path)
    assert raws(found) == FRAMES
    assert found[-1].t_ns == START_NS + 59 * STEP_NS


def test_packet_without_timestamp_inherits_the_previous_one(tmp_path: Path) -> None:
    first, (_, data) = rows()[:1], rows()[1]
    simple = block(3, struct.pack("<I", len(data)) + data)
    found = events_of(pcapng(first) + simple, tmp_path)
    assert raws(found) == FRAMES[:2]
    assert [event.t_ns for event in found] == [START_NS, START_NS]


def test_vlan_tag_and_ethernet_padding_are_stripped(tmp_path: Path) -> None:
    tagged = [
        (t_ns, data[:12] + b"\x81\x00\x00\x05" + data[12:] + bytes(9)) for t_ns, data in rows()
    ]
    found = events_of(pcap(tagged), tmp_path)
    assert raws(found) == FRAMES and not [e for e in found if isinstance(e, Rejection)]


def test_each_direction_has_its_own_frame_splitter(tmp_path: Path) -> None:
    """Frames split in halves, two directions interleaved: halves of different directions do not
    mix."""
    halves = []
    for n, frame in enumerate(FRAMES):
        for part in (frame[:9], frame[9:]):
            ip = v4(udp(part, (14555 + n % 2, 14550)))
            halves.append((n % 2, START_NS, LINKS[1](ip)))
    one, other = ([row[1:] for row in halves if row[0] == way] for way in (0, 1))
    mixed = [row for pair in zip(one, other, strict=True) for row in pair]
    found = events_of(pcap(mixed), tmp_path)
    assert sorted(raws(found)) == sorted(FRAMES)


@given(st.integers(0, 2**32), st.integers(0, 2**32 - 1))
def test_reordered_and_duplicate_tcp_segments_are_reassembled(seed: int, begins: int) -> None:
    rng = random.Random(seed)
    stream = b"".join(FRAMES)
    cuts = sorted({0, len(stream), *(rng.randrange(len(stream)) for _ in range(40))})
    parts = [(cut, stream[cut:end]) for cut, end in pairwise(cuts)]
    sent = parts + rng.sample(parts, 5)
    order = sorted(range(len(sent)), key=lambda n: n + rng.uniform(0, 8))
    segments = [tcp(b"", begins - 1 & 0xFFFFFFFF, 0x02)]
    segments += [tcp(sent[n][1], begins + sent[n][0] & 0xFFFFFFFF) for n in order]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        found = events_of(pcap([(START_NS, LINKS[1](v4(each, 6))) for each in segments]), folder)
    assert raws(found) == FRAMES
    assert not [event for event in found if isinstance(event, Rejection)]


def test_missing_tcp_segment_loses_only_its_frames(tmp_path: Path) -> None:
    stream = b"".join(FRAMES * 20)
    parts = [(at, stream[at : at + 100]) for at in range(0, len(stream), 100)]
    lost = parts.pop(20)
    packed = [tcp(b"", 999, 0x02), *(tcp(part, 1000 + at) for at, part in parts)]
    found = events_of(pcap([(START_NS, LINKS[1](v4(each, 6))) for each in packed]), tmp_path)
    assert lost and len(FRAMES) * 20 - 12 <= len(raws(found)) < len(FRAMES) * 20
    rejected = [event for event in found if isinstance(event, Rejection)]
    (gap,) = [one for one in rejected if one.detail == "missing in the capture"]
    assert gap.count == len(lost[1])


def test_capture_without_mavlink_is_rejected(tmp_path: Path) -> None:
    rng = random.Random(5)
    others = [(START_NS, LINKS[1](v4(udp(rng.randbytes(300), (53, 4000))))) for _ in range(50)]
    icmp = [(START_NS, LINKS[1](v4(b"\x08" + bytes(30), kind=1)))] * 5
    found = events_of(pcap([*others, *icmp, *rows()]), tmp_path)
    assert raws(found) == FRAMES and len(found) == len(FRAMES)
    path = tmp_path / "quiet"
    path.write_bytes(pcap(others))
    with pytest.raises(LogError, match="a capture, but no MAVLink frame in it"):
        read_log(path)


@pytest.mark.parametrize("version", [4, 6])
def test_fragments_of_packets_are_counted(version: int, tmp_path: Path) -> None:
    """They are not put together: datagrams of frames are small, and others do not matter."""
    body = udp(FRAMES[0])
    if version == 4:
        ip = v4(body, fragment=0x2000)
    else:
        ip = v6(struct.pack(">2BHI", 17, 0, 1, 7) + body, kind=44)
    fragments = [(START_NS, LINKS[1](ip))] * 5
    *frames, lost = events_of(pcap([*fragments, *rows()]), tmp_path)
    assert raws(frames) == FRAMES
    assert isinstance(lost, Rejection) and lost.detail == "fragments of IP packets"
    assert (lost.reason, lost.count) == (Reason.GARBAGE, 5 * len(body))


def test_truncated_capture_is_read_up_to_the_cut(tmp_path: Path) -> None:
    for data in (pcap(rows()), pcapng(rows())):
        found = events_of(data[: len(data) * 2 // 3], tmp_path)
        whole = raws(found)
        assert whole == FRAMES[: len(whole)] and 38 <= len(whole) <= 41


def test_absurd_packet_length_ends_reading_and_is_counted(tmp_path: Path) -> None:
    data = pcap(rows()) + struct.pack("<4I", 0, 0, 0xFFFFFFF0, 0) + bytes(5000)
    found = events_of(data, tmp_path)
    assert raws(found) == FRAMES
    refused = found[-1]
    assert isinstance(refused, Rejection)
    assert (refused.reason, refused.count) == (Reason.GARBAGE, 5016)


@given(st.binary(max_size=200), st.integers(0, 300))
@example(b"E\0\xff\xff\0\0\0\1" + bytes(12), 101)  # a fragment that claims 64 kB
def test_arbitrary_packet_bytes_never_raise(data: bytes, link_type: int) -> None:
    for kind in (link_type, *LINKS):
        found = segment(Packet(0, kind, data))
        if isinstance(found, Fragment):
            assert 0 <= found.size_bytes <= len(data)
        else:
            assert found is None or len(found.payload) <= len(data)


@pytest.mark.parametrize("whole", [pcap(rows()), pcapng(rows()), pcap(rows(101, 6), 101)])
def test_damaged_captures_yield_only_sent_frames_in_time_order(
    whole: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "net"
    for seed in range(150):
        rng = random.Random(seed)
        data = bytearray(whole)
        for _ in range(rng.randint(1, 8)):
            at = rng.randrange(24, len(data))
            data[at : at + rng.choice((0, 1, 4))] = rng.randbytes(rng.choice((0, 1, 4, 40)))
        path.write_bytes(data)
        found = list(read_capture(path))
        times = [event.t_ns for event in found]
        assert times == sorted(times)
        assert set(raws(found)) <= set(FRAMES)


def test_flows_beyond_the_tracking_limit_lose_no_frame(tmp_path: Path) -> None:
    many = [(START_NS + n, LINKS[1](v4(udp(FRAMES[n % 60], (n + 1, 14550))))) for n in range(3000)]
    assert len(raws(events_of(pcap(many), tmp_path))) == 3000


# --- bounded memory ------------------------------------------------------------------------------

SHORT = bytes.fromhex("fd010000000101000000010d35")


@contextlib.contextmanager
def memory_below(most_mb: float) -> Iterator[None]:
    """Measure the allocations of a block."""
    tracemalloc.start()
    try:
        yield
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < most_mb * 1e6


def test_segments_of_many_flows_that_wait_take_bounded_memory(tmp_path: Path) -> None:
    """Each flow lacks a segment; the file itself is sparse."""
    path, size = tmp_path / "net", (1 << 18) - 40
    with path.open("wb") as file:
        file.write(pcap([], 101))
        for flow in range(8):
            for n in range(-1, 60):
                length = 1 if n < 0 else size
                ports = struct.pack(">2H", flow, 50_000)
                head = v4(ports + tcp(b"", 100 if n < 0 else 1_000_000 + n * size)[4:], 6)
                head = head[:2] + bytes(2) + head[4:]  # of any length
                file.write(struct.pack("<4I", 0, 0, len(head) + length, 0) + head)
                file.seek(length, os.SEEK_CUR)
        file.truncate(file.tell())
    with memory_below(45):  # of 126 MB
        assert not list(read_capture(path))


def test_frames_of_segments_that_waited_take_bounded_memory(tmp_path: Path) -> None:
    """Segments of 12 MB wait for the first one, and hold 900 000 frames."""
    whole = SHORT * 15_000
    parts = [(1 + n * len(whole), whole) for n in range(1, 60)]
    sent = [tcp(b"", 0, 0x02), *(tcp(part, seq) for seq, part in parts), tcp(whole, 1)]
    path = tmp_path / "net"
    path.write_bytes(pcap([(START_NS, big(each)) for each in sent], 101))
    with memory_below(45):
        assert len(raws(islice(read_capture(path), 100))) == 100


def big(segment: bytes) -> bytes:
    """IP packet above 64 kB, whose length is 0."""
    head = v4(segment[:20], 6)
    return head[:2] + bytes(2) + head[4:] + segment[20:]


def test_segments_above_64_kb_are_read(tmp_path: Path) -> None:
    """Linux offloads them to the network card (BIG TCP)."""
    stream = b"".join(FRAMES * 400)
    cuts = range(0, len(stream), 190_000)
    rows = [(START_NS, big(tcp(stream[at : at + 190_000], 7 + at))) for at in cuts]
    assert raws(events_of(pcap(rows, 101), tmp_path)) == FRAMES * 400


def mavlink_mcap(path: Path, message: bytes, count: int) -> None:
    """MCAP of another program, all in one chunk."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 26, compression=CompressionType.ZSTD)
        writer.start("", "another")
        channel = writer.register_channel("/mavlink", "mavlink", 0)
        for _ in range(count):
            writer.add_message(channel, START_NS, message, START_NS)
        writer.finish()


def test_large_message_of_an_mcap_is_read_in_pieces(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    mavlink_mcap(path, SHORT * 1_200_000, 2)
    with memory_below(110):
        assert len(raws(islice(read_log(path), 100))) == 100


def test_invalid_frames_before_the_first_valid_one_take_bounded_memory(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    mavlink_mcap(path, SHORT[:-1] + b"x", 15_000)
    with memory_below(1.5), pytest.raises(LogError, match="no MAVLink frame in it"):
        read_log(path)


def test_all_flows_share_one_cache_of_senders(tmp_path: Path) -> None:
    """It has 2 MB in each stream of 8192 senders and messages."""
    sent = [pack(heartbeat(Source(1 + n % 250, 1 + n // 250)), 0) for n in range(2000)]
    rows = [
        (START_NS, LINKS[101](v4(udp(b"".join(sent), (1 + flow, 14550))))) for flow in range(20)
    ]
    path = tmp_path / "net"
    path.write_bytes(pcap(rows, 101))
    with memory_below(3 + 400e-6 * len(sent)):
        assert sum(1 for _ in read_capture(path)) == 20 * len(sent)


# --- captured packets --------------------------------------------------------------------------


def sent_over_loopback() -> None:
    """Send half of the frames over UDP and half over TCP, in segments that split frames."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as here,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as there,
    ):
        there.bind(("127.0.0.1", 0))
        for frame in FRAMES[:30]:
            here.sendto(frame, there.getsockname())
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        socket.create_connection(server.getsockname(), timeout=HANG_S) as one,
    ):
        other, _ = server.accept()
        other.settimeout(HANG_S)
        with other:
            stream = b"".join(FRAMES[30:])
            for at in range(0, len(stream), 50):
                one.sendall(stream[at : at + 50])
            one.shutdown(socket.SHUT_WR)
            while other.recv(4096):
                pass


def test_packets_captured_on_loopback_are_read(tmp_path: Path) -> None:
    try:
        tap = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(3))
    except (PermissionError, AttributeError):
        pytest.skip("packets cannot be captured here: that takes rights")
    with tap:
        tap.bind(("lo", 0))
        tap.settimeout(1.0)
        sender = threading.Thread(target=sent_over_loopback)
        sender.start()
        seen: list[tuple[int, bytes]] = []
        sent_until_s = time.monotonic() + 3.0  # others may use the loopback
        with contextlib.suppress(TimeoutError):
            while sender.is_alive() or time.monotonic() < sent_until_s:
                data, (_, _, direction, *_) = tap.recvfrom(65536)
                if direction != socket.PACKET_OUTGOING:  # captured twice: out and in
                    seen.append((START_NS + len(seen) * 1000, data))
        sender.join(HANG_S)
    found = events_of(pcap(seen), tmp_path)
    assert set(raws(found)) >= set(FRAMES)


# --- MCAP files of other programs --------------------------------------------------------------


def foreign_mcap(
    path: Path, encoding: str, topic: str, *, end: bool = True, chunks: bool = True
) -> None:
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD, use_chunking=chunks)
        writer.start("", "another")
        channel = writer.register_channel(topic, encoding, 0)
        other = writer.register_channel("/camera", "jpeg", 0)
        for n, frame in enumerate(FRAMES):
            t_ns = START_NS + n * STEP_NS
            wrapped = frame if encoding == "mavlink" else b"\x0a" + bytes([len(frame)]) + frame
            writer.add_message(channel, t_ns, wrapped, t_ns)
            writer.add_message(other, t_ns, FRAMES[0], t_ns)
        if end:
            writer.finish()


@pytest.mark.parametrize(
    ("encoding", "topic"), [("mavlink", "/uav/raw"), ("protobuf", "/MAVLink/in")]
)
@pytest.mark.parametrize("chunks", [True, False])
def test_foreign_mcap_is_read(encoding: str, topic: str, chunks: bool, tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    foreign_mcap(path, encoding, topic, chunks=chunks)
    assert log_kind(path) == "foreign-mcap"
    found = list(read_log(path))
    assert raws(found) == FRAMES
    assert {event.link for event in found if isinstance(event, Frame)} == {topic}
    assert found[-1].t_ns == START_NS + 59 * STEP_NS


def test_truncated_foreign_mcap_is_read_up_to_the_cut(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    foreign_mcap(path, "mavlink", "/uav/raw", chunks=False)
    path.write_bytes(path.read_bytes()[:4000])
    found = list(read_log(path))
    assert 20 < len(raws(found)) < 60
    assert isinstance(found[-1], Rejection) and found[-1].reason is Reason.GARBAGE


def test_mcap_without_mavlink_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    foreign_mcap(path, "cdr", "/imu")
    with pytest.raises(LogError, match="an MCAP file, but no MAVLink frame in it"):
        read_log(path)


def test_capture_and_onboard_log_merge_into_one_flight(aeroplane: Path, tmp_path: Path) -> None:
    path = tmp_path / "net.pcap"
    first_ns = next(iter(read_log(aeroplane))).t_ns
    path.write_bytes(pcap([(t - START_NS + first_ns, data) for t, data in rows()]))
    found = list(read_flight([path, aeroplane]))
    assert [event.t_ns for event in found] == sorted(event.t_ns for event in found)
    assert len(found) == len(FRAMES) + sum(1 for _ in read_log(aeroplane))
    with path.open("rb") as file:
        assert len(list(packets(file))) == 60
