"""tlogs, read back by pymavlink's own reader, and recordings of real sockets."""

import asyncio
import socket
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.values import Reason
from sitl_replay import player, recorder, scenario
from sitl_replay.links import RECEIVING, LinkError, Url
from sitl_replay.vehicles import schedule

ENOUGH = 40


def read_by_mavutil(tlog: Path) -> list[tuple[float, bytes]]:
    """Stamp and frame of every message: the oracle."""
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


def test_mavutil_reads_what_is_written(tmp_path: Path, frames: list[bytes]) -> None:
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


def test_a_flight_is_recorded_as_it_was_sent(tmp_path: Path) -> None:
    tlog = tmp_path / "flight.tlog"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
        sink.bind(("127.0.0.1", 0))
        url = f"udpout:127.0.0.1:{sink.getsockname()[1]}"
        tally = asyncio.run(player.fly(scenario.paper(), [url], 0.4, seed=2, record=tlog))
        sent = [sink.recv(300) for _ in range(tally.frames)]
    stamps_s, read = zip(*read_by_mavutil(tlog), strict=True)
    assert list(read) == sent
    due_s = [made.t_s for made in schedule(scenario.paper(), seed=2, duration_s=0.4)]
    late_s = [stamp - due for stamp, due in zip(stamps_s, due_s, strict=True)]
    assert max(late_s) - min(late_s) < 3e-6


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


# Sent until somebody listens; no scenario has this message.
KNOCK = dialect.MAVLink_ping_message(1, 2, 3, 4).pack(dialect.MAVLink(None, 9, 9))


async def until(heard: recorder.Heard, count: int) -> None:
    """Wait for so many frames, knocks aside."""
    async with asyncio.timeout(5.0):
        while heard.frames - heard.messages[dialect.MAVLINK_MSG_ID_PING] < count:
            await asyncio.sleep(0.005)


def test_udp_is_recorded_peer_by_peer(tmp_path: Path, frames: list[bytes]) -> None:
    # One peer sends half a frame, then another peer whole ones: those must not suffer.
    tlog = tmp_path / "heard.tlog"
    port = free_port()
    heard = recorder.Heard()

    async def scene() -> None:
        listening = Url.parse(f"udpin:127.0.0.1:{port}", RECEIVING)
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

    asyncio.run(scene())
    read = [raw for _, raw in read_by_mavutil(tlog)]
    assert len(read) == heard.frames == heard.messages.total()
    assert [raw for raw in read if raw != KNOCK] == [*frames[1:ENOUGH], frames[0]]
    assert heard.octets == sum(map(len, read))
    assert not heard.rejected


async def serve(data: bytes) -> tuple[asyncio.Server, Url]:
    async def answer(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(data)
        writer.close()

    server = await asyncio.start_server(answer, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    return server, Url("tcp", "127.0.0.1", port)


def test_tcp_is_recorded_to_its_end(tmp_path: Path, frames: list[bytes]) -> None:
    tlog = tmp_path / "heard.tlog"
    damaged = bytearray(frames[3])
    damaged[12] ^= 0x40

    async def scene() -> recorder.Heard:
        stream = b"".join(frames[:3]) + damaged + b"".join(frames[4:])
        server, url = await serve(stream)
        async with server:
            return await recorder.record(url, tlog)

    heard = asyncio.run(scene())
    assert [raw for _, raw in read_by_mavutil(tlog)] == frames[:3] + frames[4:]
    assert heard.rejected == {Reason.BAD_CRC.value: 1}


def test_frames_behind_a_torn_one_are_kept_at_the_end(tmp_path: Path, frames: list[bytes]) -> None:
    # A header that claims 255 bytes, and two whole frames within what it claims.
    tlog = tmp_path / "heard.tlog"
    claim = bytes([0xFD, 255, 0, 0, 0, 9, 1, 33, 0, 0])

    async def scene() -> None:
        server, url = await serve(claim + frames[0] + frames[1])
        async with server:
            await recorder.record(url, tlog)

    asyncio.run(scene())
    assert [raw for _, raw in read_by_mavutil(tlog)] == frames[:2]


def test_a_peer_that_leaves_before_the_duration_is_an_error(
    tmp_path: Path, frames: list[bytes]
) -> None:
    async def scene() -> None:
        server, url = await serve(frames[0])
        async with server:
            await recorder.record(url, tmp_path / "heard.tlog", 60.0)

    with pytest.raises(LinkError, match=r"closed after .* 1 frames"):
        asyncio.run(scene())


def test_the_duration_ends_a_recording(tmp_path: Path) -> None:
    url = Url("udpin", "127.0.0.1", free_port())
    heard = asyncio.run(recorder.record(url, tmp_path / "silence.tlog", 0.05))
    assert heard.frames == 0
    assert 0.05 <= heard.duration_s < 1.0


def test_a_taken_port_is_told(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as owner:
        owner.bind(("127.0.0.1", 0))
        url = Url("udpin", "127.0.0.1", owner.getsockname()[1])
        with pytest.raises(LinkError, match="Address already in use"):
            asyncio.run(recorder.record(url, tmp_path / "a.tlog"))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_an_error(frames: list[bytes]) -> None:
    # It ends the recording at once, though more could come.
    port = free_port()
    url = Url("udpin", "127.0.0.1", port)

    async def scene() -> None:
        task = asyncio.create_task(recorder.record(url, Path("/dev/full")))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            async with asyncio.timeout(5.0):
                while not task.done():
                    sender.sendto(frames[0], ("127.0.0.1", port))
                    await asyncio.sleep(0.005)
        await task

    with pytest.raises(OSError, match="No space left"):
        asyncio.run(scene())
