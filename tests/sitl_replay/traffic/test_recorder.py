"""tlogs read back by pymavlink, and recordings of real sockets."""

import asyncio
import contextlib
import os
import pty
import re
import socket
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect
from support import HANG_S, free_port, run_async

from companion.mavlink.links.urls import LinkError, LinkUrl, parse_link
from companion.values import Frame, Reason, Source
from sitl_replay.faults.content import msgid_of
from sitl_replay.flight import scenario
from sitl_replay.flight.vehicles import schedule
from sitl_replay.traffic import player, recorder

ENOUGH = 40


def read_by_mavutil(tlog: Path) -> list[tuple[float, bytes]]:
    """Timestamp and frame of every message, read by mavutil."""
    mavutil = pytest.importorskip("pymavlink.mavutil")
    reader = mavutil.mavlink_connection(str(tlog), dialect="ardupilotmega")
    found = []
    while (message := reader.recv_msg()) is not None:
        assert message.get_type() != "BAD_DATA"
        found.append((message._timestamp, bytes(message.get_msgbuf())))
    reader.close()
    return found


@pytest.fixture(scope="module")
def frames() -> list[bytes]:
    made = schedule(scenario.paper(), epoch_ns=1_760_000_000_000_000_000, duration_s=1.0)
    return [sent.raw for sent in made]


def test_mavutil_reads_the_written_tlog(tmp_path: Path, frames: list[bytes]) -> None:
    tlog = tmp_path / "a.tlog"
    start_ns = 1_760_000_000_123_456_789
    with recorder.TlogWriter(tlog) as writer:
        for index, raw in enumerate(frames):
            writer.write(start_ns + index * 1_000_000, raw)
    stamps_s, read = zip(*read_by_mavutil(tlog), strict=True)
    assert list(read) == frames
    assert stamps_s[0] == pytest.approx(start_ns / 1e9, abs=1e-6)
    assert stamps_s[-1] - stamps_s[0] == pytest.approx((len(frames) - 1) / 1e3, abs=2e-6)


def test_a_killed_process_loses_at_most_a_second(tmp_path: Path, frames: list[bytes]) -> None:
    tlog = tmp_path / "a.tlog"
    with recorder.TlogWriter(tlog) as writer:
        for tenth in range(35):
            writer.write(10**18 + tenth * 100_000_000, frames[0])
        on_disk = tlog.stat().st_size / (8 + len(frames[0]))
        assert 35 - 10 <= on_disk < 35


def test_flight_is_recorded_as_sent(tmp_path: Path) -> None:
    tlog = tmp_path / "flight.tlog"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
        sink.bind(("127.0.0.1", 0))
        sink.settimeout(HANG_S)
        url = f"udpout:127.0.0.1:{sink.getsockname()[1]}"
        tally = run_async(player.fly(scenario.paper(), [url], 0.4, seed=2, record=tlog))
        sent = [sink.recv(300) for _ in range(tally.frames)]
    stamps_s, read = zip(*read_by_mavutil(tlog), strict=True)
    assert list(read) == sent
    due_s = [made.t_s for made in schedule(scenario.paper(), seed=2, duration_s=0.4)]
    late_s = [stamp - due for stamp, due in zip(stamps_s, due_s, strict=True)]
    assert max(late_s) - min(late_s) < 3e-6


# Sent until a receiver listens; no scenario contains this message.
KNOCK = dialect.MAVLink_ping_message(1, 2, 3, 4).pack(dialect.MAVLink(None, 9, 9))


async def until(heard: recorder.RecordingTally, count: int) -> None:
    """Wait for the given number of frames, opening packets excluded."""
    async with asyncio.timeout(5.0):
        while heard.frames - heard.messages[dialect.MAVLINK_MSG_ID_PING] < count:
            await asyncio.sleep(0.005)


def test_udp_peers_are_recorded_separately(tmp_path: Path, frames: list[bytes]) -> None:
    # One peer sends half a frame, then another sends whole ones, which must not be affected.
    tlog = tmp_path / "heard.tlog"
    port = free_port(socket.SOCK_DGRAM)
    heard = recorder.RecordingTally()

    async def scene() -> None:
        listening = parse_link(f"udpin:127.0.0.1:{port}")
        task = asyncio.create_task(recorder.record(listening, tlog, heard=heard))
        with (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as torn,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sound,
        ):
            while not heard.frames:  # until it listens
                sound.sendto(KNOCK, ("127.0.0.1", port))
                await asyncio.sleep(0.005)
            torn.sendto(frames[0][:20], ("127.0.0.1", port))
            for raw in frames[1:ENOUGH]:
                sound.sendto(raw, ("127.0.0.1", port))
            await until(heard, ENOUGH - 1)
            torn.sendto(frames[0][20:], ("127.0.0.1", port))
            await until(heard, ENOUGH)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    run_async(scene())
    read = [raw for _, raw in read_by_mavutil(tlog)]
    assert len(read) == heard.frames == heard.messages.total()
    assert [raw for raw in read if raw != KNOCK] == [*frames[1:ENOUGH], frames[0]]
    assert heard.octets == sum(map(len, read))
    assert not heard.rejected


async def serve(data: bytes) -> tuple[asyncio.Server, LinkUrl]:
    async def answer(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(data)
        writer.close()

    server = await asyncio.start_server(answer, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    return server, LinkUrl(scheme="tcp", host="127.0.0.1", port=port)


def test_tcp_stream_is_recorded_to_its_end(tmp_path: Path, frames: list[bytes]) -> None:
    tlog = tmp_path / "heard.tlog"
    damaged = bytearray(frames[3])
    damaged[12] ^= 0x40

    async def scene() -> recorder.RecordingTally:
        stream = b"".join(frames[:3]) + damaged + b"".join(frames[4:])
        server, url = await serve(stream)
        async with server:
            return await recorder.record(url, tlog)

    heard = run_async(scene())
    assert [raw for _, raw in read_by_mavutil(tlog)] == frames[:3] + frames[4:]
    assert heard.rejected == {Reason.BAD_CRC.value: 1}


def test_frames_after_a_truncated_frame_are_recorded(tmp_path: Path, frames: list[bytes]) -> None:
    # A header that claims 255 bytes, and two whole frames within these bytes.
    tlog = tmp_path / "heard.tlog"
    claim = bytes([0xFD, 255, 0, 0, 0, 9, 1, 33, 0, 0])

    async def scene() -> None:
        server, url = await serve(claim + frames[0] + frames[1])
        async with server:
            await recorder.record(url, tlog)

    run_async(scene())
    assert [raw for _, raw in read_by_mavutil(tlog)] == frames[:2]


def test_peer_closing_before_the_duration_is_an_error(tmp_path: Path, frames: list[bytes]) -> None:
    async def scene() -> None:
        server, url = await serve(frames[0])
        async with server:
            await recorder.record(url, tmp_path / "heard.tlog", 60.0)

    with pytest.raises(LinkError, match=r"closed after .* 1 frames"):
        run_async(scene())


def test_duration_ends_a_recording(tmp_path: Path) -> None:
    url = LinkUrl(scheme="udpin", host="127.0.0.1", port=free_port(socket.SOCK_DGRAM))
    heard = run_async(recorder.record(url, tmp_path / "silence.tlog", 0.05))
    assert heard.frames == 0
    assert 0.05 <= heard.duration_s < 1.0


def test_port_in_use_is_an_error(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as owner:
        owner.bind(("127.0.0.1", 0))
        url = LinkUrl(scheme="udpin", host="127.0.0.1", port=owner.getsockname()[1])
        with pytest.raises(LinkError, match="Address already in use"):
            run_async(recorder.record(url, tmp_path / "a.tlog"))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_an_error(frames: list[bytes]) -> None:
    # The error ends the recording at once, though more data could arrive.
    port = free_port(socket.SOCK_DGRAM)
    url = LinkUrl(scheme="udpin", host="127.0.0.1", port=port)

    async def scene() -> None:
        task = asyncio.create_task(recorder.record(url, Path("/dev/full")))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            async with asyncio.timeout(5.0):
                while not task.done():
                    sender.sendto(frames[0], ("127.0.0.1", port))
                    await asyncio.sleep(0.005)
        await task

    with pytest.raises(OSError, match="No space left"):
        run_async(scene())


# --- every kind of link, and what others read ---------------------------------------------------


async def waited_for(
    heard: recorder.RecordingTally, frames: int, task: "asyncio.Task[object]"
) -> None:
    """Wait for the given number of frames, then end the recording as a signal does."""
    async with asyncio.timeout(5.0):
        while heard.frames < frames:
            assert not task.done(), task.exception()
            await asyncio.sleep(0.005)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task


@pytest.mark.parametrize("host", ["127.0.0.1", "[::1]"])
@pytest.mark.parametrize("pair", ["udpin udpout", "udpout udpin", "tcp tcpin", "tcpin tcp"])
def test_frames_played_over_any_link_are_recorded(
    tmp_path: Path, frames: list[bytes], pair: str, host: str, caplog: pytest.LogCaptureFixture
) -> None:
    """The recorder at one end and the player at the other; either may be the listener."""
    tlog = tmp_path / "heard.tlog"
    heard, listening = recorder.RecordingTally(), pair.split()
    log = [
        Frame(t_ns=10**18, link="", source=Source(1, 1), msgid=0, raw=raw)
        for raw in frames[:ENOUGH]
    ]

    async def told() -> int:
        async with asyncio.timeout(5.0):
            while not caplog.records:
                await asyncio.sleep(0.005)
        return int(re.findall(r":(\d+)(?:$|: )", caplog.records[0].getMessage())[0])

    async def scene() -> None:
        mine, theirs = (f"{scheme}:{host}" for scheme in listening)
        if mine.startswith(("udpin", "tcpin")):
            task = asyncio.create_task(recorder.record(parse_link(f"{mine}:0"), tlog, heard=heard))
            playing = asyncio.create_task(player.play(log, [f"{theirs}:{await told()}"]))
        else:
            playing = asyncio.create_task(player.play(log, [f"{theirs}:0"]))
            url = parse_link(f"{mine}:{await told()}")
            task = asyncio.create_task(recorder.record(url, tlog, heard=heard))
        await playing
        if pair == "tcp tcpin":  # the player has closed the connection: that is the end
            await asyncio.wait_for(task, HANG_S)
        else:
            await waited_for(heard, ENOUGH, task)

    if ":" in host and not has_ipv6():
        pytest.skip("no IPv6 loopback here")
    run_async(scene())
    read = read_by_mavutil(tlog)
    assert [raw for _, raw in read] == frames[:ENOUGH]
    assert [stamp for stamp, _ in read] == sorted(stamp for stamp, _ in read)
    assert abs(read[0][0] - time.time()) < 60.0


def test_frames_played_over_zenoh_are_recorded(tmp_path: Path, frames: list[bytes]) -> None:
    pytest.importorskip("zenoh")
    tlog, heard = tmp_path / "heard.tlog", recorder.RecordingTally()
    log = [
        Frame(t_ns=10**18, link="", source=Source(1, 1), msgid=0, raw=raw)
        for raw in frames[:ENOUGH]
    ]

    async def scene() -> None:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        hub = f"zenoh:site/raw?as=hub&listen={endpoint}"
        playing = asyncio.create_task(player.play(log, [hub]))
        url = parse_link(f"zenoh:site/raw?connect={endpoint}")
        task = asyncio.create_task(recorder.record(url, tlog, heard=heard))
        await playing
        with pytest.raises(LinkError, match="router is gone"):
            await asyncio.wait_for(task, HANG_S)

    run_async(scene())
    assert [raw for _, raw in read_by_mavutil(tlog)] == frames[:ENOUGH]


def has_ipv6() -> bool:
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("::1", 0))
        except OSError:
            return False
    return True


def test_serial_port_is_recorded_until_unplugged(tmp_path: Path, frames: list[bytes]) -> None:
    tlog = tmp_path / "heard.tlog"
    far, near = pty.openpty()
    url = parse_link(f"serial:{os.ttyname(near)}:57600")
    heard = recorder.RecordingTally()

    async def scene() -> None:
        task = asyncio.create_task(recorder.record(url, tlog, heard=heard))
        sent = b"".join(frames[:3])
        async with asyncio.timeout(5.0):
            while heard.frames < 1:  # bytes received before the port is set up are discarded
                os.write(far, KNOCK)
                await asyncio.sleep(0.02)
            for at in range(0, len(sent), 7):
                os.write(far, sent[at : at + 7])
                await asyncio.sleep(0)
            while heard.octets < len(sent) or heard.messages.total() < 4:
                await asyncio.sleep(0.005)
        os.close(near)
        os.close(far)
        with pytest.raises(LinkError, match=f"^{url}: "):
            await asyncio.wait_for(task, HANG_S)

    run_async(scene())
    assert [raw for _, raw in read_by_mavutil(tlog) if raw != KNOCK] == frames[:3]


def test_recorder_sends_only_its_opening_packet(tmp_path: Path, frames: list[bytes]) -> None:
    heard = recorder.RecordingTally()

    async def scene(vehicle: socket.socket) -> list[bytes]:
        url = parse_link(f"udpout:127.0.0.1:{vehicle.getsockname()[1]}")
        task = asyncio.create_task(recorder.record(url, tmp_path / "a.tlog", heard=heard))
        got: list[bytes] = []
        async with asyncio.timeout(8.0):
            while len(got) < 2:  # a second apart, until it receives data
                with contextlib.suppress(BlockingIOError):
                    data, address = vehicle.recvfrom(300)
                    got.append(data)
                await asyncio.sleep(0.005)
        vehicle.sendto(frames[0], address)
        await asyncio.sleep(1.2)  # no third packet arrives: nothing to wait for
        with contextlib.suppress(BlockingIOError):
            got.append(vehicle.recv(300))
        await waited_for(heard, 1, task)
        return got

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.bind(("127.0.0.1", 0))
        vehicle.setblocking(False)
        assert run_async(scene(vehicle)) == [b"", b""]


def test_received_frames_are_on_disk_when_traffic_stops(
    tmp_path: Path, frames: list[bytes]
) -> None:
    """A killed process loses at most a second, not everything since the last flush."""
    tlog, port = tmp_path / "a.tlog", free_port(socket.SOCK_DGRAM)
    heard = recorder.RecordingTally()

    async def scene() -> None:
        url = LinkUrl(scheme="udpin", host="127.0.0.1", port=port)
        task = asyncio.create_task(recorder.record(url, tlog, heard=heard))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            async with asyncio.timeout(5.0):
                while heard.frames < 3:
                    sender.sendto(frames[0], ("127.0.0.1", port))
                    await asyncio.sleep(0.005)
                while tlog.stat().st_size < heard.octets + 8 * heard.frames:
                    await asyncio.sleep(0.02)
        await waited_for(heard, 3, task)

    run_async(scene())


def test_disconnecting_client_does_not_end_a_server_recording(
    tmp_path: Path, frames: list[bytes], caplog: pytest.LogCaptureFixture
) -> None:
    tlog = tmp_path / "a.tlog"
    heard = recorder.RecordingTally()
    claim = bytes([0xFD, 255, 0, 0, 0, 9, 1, 33, 0, 0])  # hides the frames after it

    async def scene() -> None:
        url = parse_link("tcpin:127.0.0.1:0")
        task = asyncio.create_task(recorder.record(url, tlog, heard=heard))
        while not caplog.records:
            await asyncio.sleep(0.005)
        port = int(caplog.records[0].getMessage().rpartition(":")[2])
        for number, data in enumerate((claim + frames[0], frames[1])):
            _, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(data)
            writer.close()
            await writer.wait_closed()
            async with asyncio.timeout(5.0):
                while heard.frames <= number:
                    await asyncio.sleep(0.005)
        await waited_for(heard, 2, task)

    run_async(scene())
    assert [raw for _, raw in read_by_mavutil(tlog)] == frames[:2]


def test_mavlogdump_reads_the_recording(tmp_path: Path) -> None:
    tlog = tmp_path / "flight.tlog"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
        sink.bind(("127.0.0.1", 0))
        port = sink.getsockname()[1]
        run_async(
            player.fly(scenario.paper(), [f"udpout:127.0.0.1:{port}"], 0.6, seed=2, record=tlog)
        )
    meant = Counter(
        player.message_name(msgid_of(made.raw))
        for made in schedule(scenario.paper(), seed=2, duration_s=0.6)
    )
    mavlogdump = Path(sys.executable).with_name("mavlogdump.py")
    if not mavlogdump.exists():
        pytest.skip("mavlogdump.py is not installed")
    done = subprocess.run(
        [sys.executable, mavlogdump, tlog],
        capture_output=True,
        text=True,
        check=True,
        timeout=HANG_S,
    )
    lines = [re.match(r"\d{4}-\d\d-\d\d \S+: (\w+) {", line) for line in done.stdout.splitlines()]
    found = Counter(line[1] for line in lines if line)
    assert found == meant
    assert len(found) >= 4
