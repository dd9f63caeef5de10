"""The player over real sockets on the loopback."""

import asyncio
import contextlib
import os
import pty
import socket
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect
from support import HANG_S, run_async

from companion.mavlink.links.urls import LinkError
from companion.values import Frame, Source
from sitl_replay.faults.asked import Fault, FaultError
from sitl_replay.faults.content import Drift, msgid_of
from sitl_replay.faults.traffic import Senders
from sitl_replay.flight import scenario
from sitl_replay.flight.vehicles import schedule
from sitl_replay.traffic import player


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.bind(("127.0.0.1", 0))
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        bound.settimeout(5.0)
        yield bound


def url_of(bound: socket.socket) -> str:
    return f"udpout:127.0.0.1:{bound.getsockname()[1]}"


def waiting(bound: socket.socket) -> list[bytes]:
    """The frames that have arrived."""
    bound.setblocking(False)
    found = []
    with contextlib.suppress(BlockingIOError):
        while True:
            found.append(bound.recv(300))
    return found


def log_of(stamps_s: list[float]) -> list[Frame]:
    """Frames of the hover scenario with the given timestamps."""
    made = schedule(scenario.hover(1))
    return [
        Frame(
            t_ns=round(t_s * 1e9),
            link="log",
            source=Source(*sent.raw[5:7]),
            msgid=msgid_of(sent.raw),
            raw=sent.raw,
        )
        for t_s, sent in zip(stamps_s, made, strict=False)
    ]


def without_clock(raw: bytes) -> bytes | None:
    """A frame without its time of day."""
    return None if msgid_of(raw) == dialect.MAVLINK_MSG_ID_SYSTEM_TIME else raw


def test_udp_socket_receives_the_flown_frames(receiver: socket.socket) -> None:
    tally = run_async(player.fly(scenario.paper(), [url_of(receiver)], 0.6, seed=5))
    got = waiting(receiver)
    meant = [sent.raw for sent in schedule(scenario.paper(), seed=5, duration_s=0.6)]
    assert list(map(without_clock, got)) == list(map(without_clock, meant))
    assert (tally.frames, tally.octets) == (len(got), sum(map(len, got)))
    assert tally.messages.total() == tally.frames


def test_flight_runs_in_real_time(receiver: socket.socket) -> None:
    tally = run_async(player.fly(scenario.hover(), [url_of(receiver)], 0.5))
    last_s = [sent.t_s for sent in schedule(scenario.hover(), duration_s=0.5)][-1]
    assert tally.duration_s >= last_s
    assert tally.duration_s < last_s + 0.3


def test_every_link_receives_every_frame(receiver: socket.socket) -> None:
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as second:
        try:
            second.bind(("::1", 0))
        except OSError:
            pytest.skip("no IPv6 loopback here")
        urls = [url_of(receiver), f"udpout:[::1]:{second.getsockname()[1]}"]
        tally = run_async(player.fly(scenario.hover(), urls, 0.2))
        assert len(waiting(receiver)) == len(waiting(second)) == tally.frames > 0


def test_refused_udp_peer_is_not_an_error(receiver: socket.socket) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
        gone.bind(("127.0.0.1", 0))
        nobody = url_of(gone)
    tally = run_async(player.fly(scenario.hover(), [nobody, url_of(receiver)], 0.3))
    assert len(waiting(receiver)) == tally.frames > 5
    assert tally.lost == []


def test_udp_resumes_when_the_peer_returns() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first:
        first.bind(("127.0.0.1", 0))
        address = first.getsockname()
    url = f"udpout:127.0.0.1:{address[1]}"

    async def scene() -> bytes:
        tally = player.Tally()
        flight = asyncio.create_task(player.fly(scenario.hover(), [url], tally=tally))
        loop = asyncio.get_running_loop()
        arrived: asyncio.Future[bytes] = loop.create_future()

        class Late(asyncio.DatagramProtocol):
            def datagram_received(self, data: bytes, addr: object) -> None:
                if not arrived.done():
                    arrived.set_result(data)

        while tally.frames < 10:  # most of them refused
            await asyncio.sleep(0.005)
        transport, _ = await loop.create_datagram_endpoint(Late, local_addr=address)
        try:
            return await asyncio.wait_for(arrived, HANG_S)
        finally:
            transport.close()
            flight.cancel()

    assert run_async(scene())[0] == 0xFD


def test_tcp_peer_receives_the_stream() -> None:
    async def scene() -> tuple[bytes, player.Tally]:
        received = bytearray()
        ended = asyncio.Event()

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write(b"whatever a ground station says")
            received.extend(await reader.read(-1))
            writer.close()
            ended.set()

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        tally = await player.fly(scenario.hover(), [f"tcp:127.0.0.1:{port}"], 0.3)
        await asyncio.wait_for(ended.wait(), HANG_S)
        server.close()
        return bytes(received), tally

    stream, tally = run_async(scene())
    assert len(dialect.MAVLink(None).parse_buffer(stream) or []) == tally.frames > 5
    assert len(stream) == tally.octets


async def closing_server() -> tuple[asyncio.Server, str]:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readexactly(20)
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    return server, f"tcp:127.0.0.1:{server.sockets[0].getsockname()[1]}"


def test_lost_tcp_peer_ends_the_flight() -> None:
    async def scene() -> None:
        server, url = await closing_server()
        async with server:
            with pytest.raises(LinkError, match=url):
                await asyncio.wait_for(player.fly(scenario.hover(), [url]), HANG_S)

    run_async(scene())


def test_other_links_continue_after_a_lost_peer(
    receiver: socket.socket, caplog: pytest.LogCaptureFixture
) -> None:
    async def scene() -> tuple[str, player.Tally]:
        server, url = await closing_server()
        async with server:
            return url, await player.fly(scenario.hover(), [url, url_of(receiver)], 0.8)

    url, tally = run_async(scene())
    assert len(waiting(receiver)) == tally.frames
    assert [text.startswith(url) for text in tally.lost] == [True]
    assert [record.levelname for record in caplog.records] == ["WARNING"]


def test_refused_tcp_peer_error_names_the_url() -> None:
    with socket.socket() as gone:
        gone.bind(("127.0.0.1", 0))
        port = gone.getsockname()[1]
    with pytest.raises(LinkError, match=f"tcp:127.0.0.1:{port}: Connection refused"):
        run_async(player.fly(scenario.hover(), [f"tcp:127.0.0.1:{port}"]))


@pytest.mark.full
def test_tcp_peer_that_does_not_read_does_not_block_playback(receiver: socket.socket) -> None:
    # In real time: frames for this peer are dropped and counted once its buffers are full.
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        url = f"tcp:127.0.0.1:{deaf.getsockname()[1]}"
        frames = log_of([0.0] * 20) * 10_000
        tally = run_async(player.play(frames, [url]))
    assert tally.frames == len(frames)
    assert 0 < tally.dropped < tally.frames


def test_cancelled_flight_closes_its_links_and_log(receiver: socket.socket, tmp_path: Path) -> None:
    tlog = tmp_path / "cut.tlog"
    tally = player.Tally()

    async def scene() -> set[asyncio.Task[object]]:
        flight = asyncio.create_task(
            player.fly(scenario.paper(), [url_of(receiver)], record=tlog, tally=tally)
        )
        loop = asyncio.get_running_loop()
        await loop.sock_recv(receiver, 300)
        flight.cancel()
        with pytest.raises(asyncio.CancelledError):
            await flight
        return asyncio.all_tasks() - {asyncio.current_task()}

    receiver.setblocking(False)
    assert run_async(scene()) == set()
    assert tally.frames >= 1
    assert tlog.stat().st_size == tally.octets + 8 * tally.frames


def test_log_is_played_unchanged(receiver: socket.socket) -> None:
    frames = log_of([0.0, 0.1, 0.15, 0.3])
    tally = run_async(player.play(frames, [url_of(receiver)]))
    assert waiting(receiver) == [frame.raw for frame in frames]
    assert 0.3 <= tally.duration_s < 0.6
    assert tally.clamped == 0


@pytest.mark.parametrize(("speed", "seconds"), [(2.0, 0.15), (None, 0.0)])
def test_playback_speed_scales_the_duration(
    receiver: socket.socket, speed: float | None, seconds: float
) -> None:
    frames = log_of([0.0, 0.1, 0.2, 0.3])
    tally = run_async(player.play(frames, [url_of(receiver)], speed))
    assert len(waiting(receiver)) == 4
    assert seconds <= tally.duration_s < seconds + 0.14


@pytest.mark.full
def test_slow_tcp_peer_loses_no_frame_at_full_speed() -> None:
    frames = log_of([0.0] * 20) * 10_000

    async def scene() -> tuple[int, player.Tally]:
        count, stalled_at = 0, -1
        ended = asyncio.Event()
        tally = player.Tally()

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            nonlocal count, stalled_at
            while tally.frames != stalled_at:  # read only once the buffers are full
                stalled_at = tally.frames
                await asyncio.sleep(0.05)
            while data := await reader.read(1 << 16):
                count += len(data)
            writer.close()
            ended.set()

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        url = f"tcp:127.0.0.1:{server.sockets[0].getsockname()[1]}"
        await player.play(frames, [url], None, tally=tally)
        await asyncio.wait_for(ended.wait(), HANG_S)
        server.close()
        assert 0 < stalled_at < len(frames)
        return count, tally

    count, tally = run_async(scene())
    assert tally.dropped == 0
    assert count == tally.octets == sum(len(frame.raw) for frame in frames)


def test_bad_timestamps_are_clamped_and_counted() -> None:
    tally = player.Tally()
    stamps_s = [100.0, 101.0, 41.0, 42.5, 1e9, 1e9 + 5.0, 0.0, 0.25]
    times_s = [t_s for t_s, _ in player.on_timeline(log_of(stamps_s), tally)]
    assert times_s == pytest.approx([0.0, 1.0, 1.0, 2.5, 7.5, 12.5, 12.5, 12.75])
    assert tally.clamped == 3


def test_message_names_include_unknown_ids() -> None:
    assert player.message_name(168) == "WIND"
    assert player.message_name(70_000) == "UNKNOWN_70000"


# --- links that listen, serial links, and faults ------------------------------------------------


async def port_told(caplog: pytest.LogCaptureFixture) -> int:
    """The port of the link that waits for its first peer."""
    async with asyncio.timeout(5.0):
        while not (texts := [r.getMessage() for r in caplog.records if "waiting" in r.msg]):
            await asyncio.sleep(0.005)
    return int(texts[0].split(": ")[0].rpartition(":")[2])


def test_tcp_server_waits_for_its_first_peer_and_survives_it(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def scene() -> tuple[bytes, bytes, player.Tally]:
        tally = player.Tally()
        url = "tcpin:127.0.0.1:0"
        flight = asyncio.create_task(player.play(log_of([0.0, 0.5, 1.0]), [url], tally=tally))
        port = await port_told(caplog)
        assert tally.frames == 0
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        first = await reader.readexactly(len(log_of([0.0])[0].raw))
        writer.close()
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        rest = await reader.read()
        await flight
        writer.close()
        return first, rest, tally

    first, rest, tally = run_async(scene())
    frames = log_of([0.0, 0.5, 1.0])
    assert first + rest == b"".join(frame.raw for frame in frames)
    assert (tally.frames, tally.lost) == (3, [])
    assert 1.0 <= tally.duration_s < 1.4
    assert [record.levelname for record in caplog.records] == ["WARNING"]


def test_frames_are_dropped_without_connected_peers(caplog: pytest.LogCaptureFixture) -> None:
    async def scene() -> player.Tally:
        flight = asyncio.create_task(
            player.play(log_of([0.0, 0.4, 0.5, 0.6]), ["tcpin:127.0.0.1:0"])
        )
        port = await port_told(caplog)
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        await reader.readexactly(20)
        writer.close()
        return await flight

    tally = run_async(scene())
    assert (tally.frames, tally.dropped, tally.lost) == (4, 3, [])


def test_udp_server_sends_to_peers_that_sent_a_packet(
    receiver: socket.socket, caplog: pytest.LogCaptureFixture
) -> None:
    async def scene() -> None:
        flight = asyncio.create_task(player.play(log_of([0.0, 0.1, 0.2]), ["udpin:127.0.0.1:0"]))
        receiver.sendto(b"", ("127.0.0.1", await port_told(caplog)))
        await flight

    run_async(scene())
    assert waiting(receiver) == [frame.raw for frame in log_of([0.0, 0.1, 0.2])]


def test_serial_port_receives_the_stream() -> None:
    far, near = pty.openpty()
    url = f"serial:{os.ttyname(near)}:57600"
    os.close(near)
    try:
        tally = run_async(player.play(log_of([0.0, 0.05, 0.1]), [url]))
        sent, got = b"".join(frame.raw for frame in log_of([0.0, 0.05, 0.1])), b""
        while len(got) < len(sent):  # a terminal returns what it has
            got += os.read(far, 4096)
        assert got == sent
    finally:
        os.close(far)
    assert (tally.frames, tally.dropped) == (3, 0)


def faults(*texts: str) -> list[Fault]:
    return [Fault.parse(text) for text in texts]


def test_faults_apply_to_each_link_independently(receiver: socket.socket) -> None:
    frames = log_of([0.01 * number for number in range(60)])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as second:
        second.bind(("127.0.0.1", 0))
        urls = [url_of(receiver), url_of(second)]
        asked = faults("loss=0.4", "drift=24000", "delay=0.2")
        tallies = [run_async(player.play(frames, urls, faults=asked, seed=3)) for _ in range(2)]
        got = [waiting(one) for one in (receiver, second)]
    halves = [(one[: len(one) // 2], one[len(one) // 2 :]) for one in got]
    assert all(first == again for first, again in halves)  # the same seed
    assert set(halves[0][0]) != set(halves[1][0])
    drift = Drift(24_000.0)
    meant = {drift(0.0, frame.raw) for frame in frames}
    assert {*halves[0][0], *halves[1][0]} <= meant
    for tally in tallies:
        assert tally.frames == len(frames)
        assert tally.faults["loss"] == 2 * len(frames) - len(got[0]) // 2 - len(got[1]) // 2
        assert tally.faults["delay"] == 2 * len(frames) - tally.faults["loss"]
        assert 0.75 <= tally.duration_s < 1.2  # delayed frames are awaited


def test_delayed_frames_arrive_late_in_real_time(receiver: socket.socket) -> None:
    async def scene() -> list[float]:
        loop = asyncio.get_running_loop()
        start_s = loop.time()
        arrivals_s: list[float] = []
        frames = log_of([0.0, 0.1, 0.5])
        flight = asyncio.create_task(
            player.play(frames, [url_of(receiver)], faults=faults("delay=0.3"))
        )
        for _ in frames:
            await loop.sock_recv(receiver, 300)
            arrivals_s.append(loop.time() - start_s)
        await flight
        return arrivals_s

    receiver.setblocking(False)
    arrivals_s = run_async(scene())
    assert arrivals_s == pytest.approx([0.3, 0.4, 0.8], abs=0.09)
    assert min(arrivals_s) >= 0.3


def test_fault_delays_scale_with_playback_speed(receiver: socket.socket) -> None:
    frames = log_of([0.0, 1.0, 2.0])
    asked = faults("delay=2")
    tally = run_async(player.play(frames, [url_of(receiver)], 10.0, faults=asked))
    assert 0.4 <= tally.duration_s < 0.6
    tally = run_async(player.play(frames, [url_of(receiver)], None, faults=asked))
    assert tally.duration_s < 0.2
    assert len(waiting(receiver)) == 6


def test_flight_log_holds_the_frames_as_sent(receiver: socket.socket, tmp_path: Path) -> None:
    tlog = tmp_path / "a.tlog"
    asked = faults("loss=1", "reboot=0.2")
    tally = run_async(
        player.fly(scenario.hover(), [url_of(receiver)], 0.5, record=tlog, faults=asked)
    )
    assert waiting(receiver) == []
    assert tally.faults["loss"] == tally.frames > 10
    assert tally.faults["reboot"] > 3
    data, raws = tlog.read_bytes(), []
    while data:
        raws.append(data[8 : 20 + data[9]])
        data = data[20 + data[9] :]
    assert len(raws) == tally.frames
    meant = schedule(scenario.hover(), duration_s=0.5)
    senders = Senders(asked, 0, Counter())
    sent = [senders.altered(one.t_s, one.raw) for one in meant]
    assert list(map(without_clock, raws)) == list(map(without_clock, sent))


def test_conflicting_faults_open_no_link(tmp_path: Path) -> None:
    with pytest.raises(FaultError, match="loss is given 2 times"):
        run_async(
            player.fly(scenario.hover(), ["tcp:127.0.0.1:1"], faults=faults("loss=1", "loss=0.5"))
        )
