"""Links over real sockets on loopback; tests wait for events, never for a time.

Every test runs on both loops: Python's own and the one used in flight.
"""

import asyncio
import contextlib
import gc
import socket
import sys
import time
import tracemalloc
import warnings
from collections.abc import AsyncIterator, Iterator
from itertools import count

import pytest
from link_support import LIMIT_S, LOOPS, Run, frame, port_of, runner, running, until_true
from pymavlink.dialects.v20 import all as dialect

from companion.mavlink.links import kernel_time, tcp, transport, udp
from companion.mavlink.links.endpoints import Upcalls
from companion.mavlink.links.kinds import FRAMES_AT_ONCE
from companion.mavlink.links.peers import PEERS_MAX
from companion.mavlink.links.transport import REFUSED_KINDS, REJECTED_PER_S, Link
from companion.mavlink.links.urls import LinkError, parse_link
from companion.mavlink.trust.fair_share import Account
from companion.mavlink.trust.newcomers import NEW_SAVED
from companion.mavlink.wire.encode import Outgoing, heartbeat, pack, timesync
from companion.mavlink.wire.framing import FALSE_STARTS_SAVED, Splitter
from companion.values import Frame, Reason, Rejection, Severity, Source

OURS = Source(5, 191)


@pytest.fixture(params=LOOPS)
def run(request: pytest.FixtureRequest) -> Run:
    """Return ``run(test())``, on each of the two event loops."""
    return runner(request.param)


@pytest.fixture
def unstamped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use read times as arrival times, for tests with their own time."""
    monkeypatch.setattr(kernel_time, "stamped", lambda _: False)


def damaged_length(raw: bytes) -> bytes:
    return raw[:1] + b"\xff" + raw[2:]


@contextlib.contextmanager
def senders(number: int, family: int = socket.AF_INET) -> Iterator[list[socket.socket]]:
    with contextlib.ExitStack() as stack:
        made = [
            stack.enter_context(socket.socket(family, socket.SOCK_DGRAM)) for _ in range(number)
        ]
        for one in made:
            one.settimeout(LIMIT_S)
        yield made


def has_ipv6() -> bool:
    try:
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as probe:
            probe.bind(("::1", 0))
    except OSError:
        return False
    return True


needs_ipv6 = pytest.mark.skipif(not has_ipv6(), reason="there is no IPv6 loopback here")


# --- UDP ----------------------------------------------------------------------------------------


def test_datagrams_become_frames(run: Run) -> None:
    async def test() -> None:
        async with running("udpin:127.0.0.1:0", time.monotonic_ns) as (link, inbox):
            with senders(1) as (sender,):
                to = ("127.0.0.1", port_of(link))
                made, begun_ns = [frame(n) for n in range(40)], time.monotonic_ns()
                sender.sendto(b"".join(made[:5]), to)  # many frames in one datagram
                for raw in made[5:]:
                    sender.sendto(raw, to)
                await inbox.until(40)
            assert inbox.raws == made
            assert inbox.batches[0] == 5
            url = f"udpin:127.0.0.1:{port_of(link)}"
            frames = [item for item in inbox.items if isinstance(item, Frame)]
            assert {item.link for item in frames} == {url}
            times = [item.t_ns for item in frames]
            assert len(set(times[:5])) == 1  # frames of one datagram arrived together
            # Not ordered to the millisecond: before kernel stamps start, read times are used.
            assert begun_ns < min(times) and max(times) < time.monotonic_ns()
            status = link.status
            assert (status.state, status.frames, status.peers) == ("up", 40, 1)
            assert status.bytes == sum(map(len, made)) and status.lost == {}

    run(test())


@needs_ipv6
def test_datagrams_over_ipv6_become_frames(run: Run) -> None:
    async def test() -> None:
        async with running("udpin:[::1]:0") as (link, inbox):
            with senders(2, socket.AF_INET6) as both:
                for n, sender in enumerate(both):
                    sender.sendto(frame(n, sysid=1 + n), ("::1", port_of(link)))
                await inbox.until(2)
            assert sorted(inbox.raws) == sorted([frame(0), frame(1, sysid=2)])
            assert link.status.peers == 2
            assert link.status.url.startswith("udpin:[::1]:")

    run(test())


def test_each_peer_has_its_own_splitter(run: Run) -> None:
    """Every frame in halves, interleaved over 100 peers: all are found, and none is lost."""

    async def test() -> None:
        async with running("udpin:127.0.0.1:0") as (link, inbox):
            with senders(100) as peers:
                to = ("127.0.0.1", port_of(link))
                made = [frame(n, sysid=1 + n) for n in range(100)]
                for peer, raw in zip(peers, made, strict=True):
                    peer.sendto(raw[:20], to)
                for peer, raw in zip(peers, made, strict=True):
                    peer.sendto(raw[20:], to)
                await inbox.until(100)
            assert sorted(inbox.raws) == sorted(made)
            assert link.status.peers == 100 and link.status.lost == {}

    run(test())


def test_truncated_datagram_does_not_affect_other_peers(run: Run) -> None:
    async def test() -> None:
        async with running("udpin:127.0.0.1:0") as (link, inbox):
            with senders(2) as (bad, good):
                to = ("127.0.0.1", port_of(link))
                for n in range(30):
                    bad.sendto(frame(n, sysid=9)[: 5 + n], to)
                    good.sendto(frame(n), to)
                await inbox.until(30)
            assert [raw for raw in inbox.raws if raw[5] == 1] == [frame(n) for n in range(30)]

    run(test())


def test_rejected_bytes_are_delivered_and_counted(run: Run) -> None:
    async def test() -> None:
        async with running("udpin:127.0.0.1:0") as (link, inbox):
            raw = frame(1)
            broken = raw[:-1] + bytes([raw[-1] ^ 1])
            with senders(1) as (sender,):
                to = ("127.0.0.1", port_of(link))
                for data in (b"noise", broken, b"", broken + b"more", frame(2)):
                    sender.sendto(data, to)
                await inbox.until(1)
            assert inbox.raws == [frame(2)]
            assert link.status.lost == {"garbage": 9, "bad-crc": 2}
            assert link.status.frames == 1
            lost = [item for item in inbox.items if isinstance(item, Rejection)]
            assert sum(item.count for item in lost if item.reason is Reason.GARBAGE) == 9
            assert {item.source for item in lost} == {link.status.url}

    run(test())


def test_port_scan_uses_bounded_memory() -> None:
    """The most recent peers are kept: a peer that keeps sending is never evicted."""
    inbox: list[Frame | Rejection] = []
    link = Link(url=parse_link("udpin:127.0.0.1:0"), receive=inbox.extend, now_ns=lambda: 0)
    link.take("old", frame(0)[:20])
    link.take("steady", frame(1)[:10])
    for n in range(2 * PEERS_MAX):
        link.take(n, b"\xfd\x09")
        if n == PEERS_MAX // 2:
            link.take("steady", frame(1)[10:20])
        if n == PEERS_MAX + PEERS_MAX // 4:
            link.take("steady", frame(1)[20:])
    link.take("old", frame(0)[20:])
    assert [item.raw for item in inbox if isinstance(item, Frame)] == [frame(1)]
    assert len(link._peers) == PEERS_MAX
    assert link.status.peers == 2 * PEERS_MAX + 3
    assert link.status.lost["garbage"] > 2 * PEERS_MAX  # of evicted peers: their bytes still count


def test_peers_of_a_link_share_one_cache_of_senders() -> None:
    """It has 2 MB for 8192 senders and messages, and a link may have 256 peers."""
    link = Link(url=parse_link("tcpin:127.0.0.1:0"), receive=lambda _: None, now_ns=lambda: 0)
    sent = [pack(heartbeat(Source(1 + n % 250, 1 + n // 250)), 0) for n in range(2000)]
    tracemalloc.start()
    try:
        for peer in range(20):
            for start in range(0, len(sent), 16):
                link.take(peer, b"".join(sent[start : start + 16]))
        assert link.status.frames == 20 * NEW_SAVED  # all are cached, before the others are dropped
        assert tracemalloc.get_traced_memory()[1] < 4e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("scheme", ["udpin", "tcpin"])
def test_port_in_use_is_reported_in_one_line(scheme: str) -> None:
    kind = socket.SOCK_DGRAM if scheme == "udpin" else socket.SOCK_STREAM
    with socket.socket(socket.AF_INET, kind) as taken:
        taken.bind(("127.0.0.1", 0))
        if scheme == "tcpin":
            taken.listen()
        url = f"{scheme}:127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(LinkError) as caught:
            Link(url=parse_link(url), receive=lambda _: None, now_ns=lambda: 0).open()
    assert str(caught.value) == f"{url}: Address already in use"


@pytest.mark.parametrize("scheme", ["udpin", "tcpin"])
def test_foreign_bind_address_is_reported_in_one_line(scheme: str) -> None:
    url = f"{scheme}:192.0.2.1:0"  # TEST-NET-1: an unassigned address
    with pytest.raises(LinkError) as caught:
        Link(url=parse_link(url), receive=lambda _: None, now_ns=lambda: 0).open()
    assert str(caught.value) == f"{url}: Cannot assign requested address"


@pytest.mark.parametrize(
    "url", ["tcp:127.0.0.1:1", "udpout:127.0.0.1:1", "serial:/dev/not-plugged-in:57600"]
)
def test_absent_peer_or_device_does_not_fail_at_start(url: str) -> None:
    Link(url=parse_link(url), receive=lambda _: None, now_ns=lambda: 0).open()


@pytest.mark.parametrize("scheme", ["udpin", "tcpin"])
def test_port_is_released_after_a_link(run: Run, scheme: str) -> None:
    """Also when the link closes a connection: the kernel remembers those for a minute."""

    async def test() -> None:
        url = f"{scheme}:127.0.0.1:0"
        kind = socket.SOCK_DGRAM if scheme == "udpin" else socket.SOCK_STREAM
        for n in range(3):
            with socket.socket(socket.AF_INET, kind) as sender:
                async with running(url) as (link, inbox):
                    sender.connect(("127.0.0.1", port_of(link)))
                    sender.send(frame(n))
                    await inbox.until(1)
                url = link.status.url

    run(test())


# --- TCP ----------------------------------------------------------------------------------------


class Server:
    """A server on loopback that passes on its connections as they arrive."""

    def __init__(self) -> None:
        self.port = 0
        self.connections: asyncio.Queue[asyncio.StreamWriter] = asyncio.Queue()
        self._server: asyncio.Server | None = None

    async def start(self) -> None:
        async def accept(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            self.connections.put_nowait(writer)

        self._server = await asyncio.start_server(accept, "127.0.0.1", self.port)
        self.port = self._server.sockets[0].getsockname()[1]

    async def stop(self) -> None:
        assert self._server is not None
        self._server.close()
        await self._server.wait_closed()


@contextlib.asynccontextmanager
async def serving() -> AsyncIterator[Server]:
    server = Server()
    await server.start()
    try:
        yield server
    finally:
        await server.stop()


async def on_peer_gone(writer: asyncio.StreamWriter) -> None:
    writer.close()
    await writer.wait_closed()


def test_fragmented_stream_becomes_frames(run: Run) -> None:
    async def test() -> None:
        async with serving() as server, running(f"tcp:127.0.0.1:{server.port}") as (link, inbox):
            writer = await server.connections.get()
            made = [frame(n) for n in range(50)]
            stream = b"".join(made)
            for at in range(0, len(stream), 13):
                writer.write(stream[at : at + 13])
                await writer.drain()
            await inbox.until(50)
            assert inbox.raws == made
            status = link.status
            assert (status.state, status.frames, status.lost) == ("up", 50, {})
            await on_peer_gone(writer)

    run(test())


def test_client_reconnects_after_the_server_stops(run: Run) -> None:
    """The server stops listening and returns; half a frame from before does no harm."""

    async def test() -> None:
        async with serving() as server, running(f"tcp:127.0.0.1:{server.port}") as (link, inbox):
            for n in range(3):
                writer = await server.connections.get()
                writer.write(frame(n) + frame(100 + n)[:20])
                await inbox.until(n + 1)
                await server.stop()
                await on_peer_gone(writer)
                await server.start()
            writer = await server.connections.get()
            writer.write(frame(7))
            await inbox.until(4)
            assert inbox.raws == [frame(0), frame(1), frame(2), frame(7)]
            assert link.status.state == "up"
            await on_peer_gone(writer)

    run(test())


def test_link_waits_for_a_server_that_starts_later(run: Run) -> None:
    async def test() -> None:
        server = Server()
        await server.start()
        await server.stop()  # its port is known, and nothing listens there
        async with running(f"tcp:127.0.0.1:{server.port}") as (link, inbox):
            await inbox.until_said(1)
            assert inbox.texts == [f"link {link.url} is down: Connection refused; trying again"]
            assert link.status.state == "connecting"
            await server.start()
            writer = await server.connections.get()
            writer.write(frame(1))
            await inbox.until(1)
            assert link.status.state == "up"
            await on_peer_gone(writer)
            await server.stop()

    run(test())


def test_successful_connection_resets_the_retry_delay(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transport, "RETRY_S", (0.0, 2 * LIMIT_S))

    async def test() -> None:
        async with serving() as server, running(f"tcp:127.0.0.1:{server.port}") as (_, inbox):
            for n in range(4):
                writer = await server.connections.get()
                writer.write(frame(n))
                await inbox.until(n + 1)
                await on_peer_gone(writer)
            await on_peer_gone(await server.connections.get())

    run(test())


def test_retry_delays_increase() -> None:
    assert transport.RETRY_S[0] <= 0.5 and transport.RETRY_S[-1] <= 10
    assert list(transport.RETRY_S) == sorted(transport.RETRY_S)


def test_frames_behind_a_damaged_length_are_found_at_disconnect(run: Run) -> None:
    """A damaged length covers the following frames; they are searched because no more bytes will
    arrive."""

    async def test() -> None:
        async with serving() as server, running(f"tcp:127.0.0.1:{server.port}") as (link, inbox):
            writer = await server.connections.get()
            writer.write(damaged_length(frame(1)) + frame(2) + frame(3))
            await on_peer_gone(writer)
            writer = await server.connections.get()  # it noticed, and has reconnected
            writer.write(frame(4))
            await inbox.until_there_is(frame(4))
            await on_peer_gone(writer)
            assert inbox.raws == [frame(2), frame(3), frame(4)]
            assert link.status.lost

    run(test())


@pytest.mark.parametrize("greeting", [b"", b"HTTP/1.1 400 Bad Request\r\n\r\n"])
def test_immediate_disconnects_are_retried_with_backoff(
    run: Run, monkeypatch: pytest.MonkeyPatch, greeting: bytes
) -> None:
    """Only frames reset the retry delay; however often it accepts, it is one outage."""
    monkeypatch.setattr(transport, "RETRY_S", (0.0, 0.0, 2 * LIMIT_S))

    async def test() -> None:
        async with serving() as server, running(f"tcp:127.0.0.1:{server.port}") as (link, inbox):
            for _ in range(3):
                writer = await server.connections.get()
                writer.write(greeting)
                await on_peer_gone(writer)
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(0.2):
                    await server.connections.get()
            assert link.status.state == "connecting"
            assert inbox.texts == [f"link {link.url} is down: the peer hung up; trying again"]

    run(test())


def test_outage_and_recovery_are_announced_once_each(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transport, "RETRY_S", (0.01,))
    monkeypatch.setattr(transport, "STEADY_S", 0.05)

    async def test() -> None:
        async with serving() as server, running(f"tcp:127.0.0.1:{server.port}") as (link, inbox):
            writer = await server.connections.get()
            await asyncio.sleep(0.1)  # longer than a callback would take
            assert inbox.notices == []
            for outage in range(2):
                await until_true(lambda: link.status.state == "up")
                await server.stop()
                await on_peer_gone(writer)
                await inbox.until_said(1 + 2 * outage)
                assert link.status.state == "connecting"
                await asyncio.sleep(0.05)  # several attempts, all refused
                await server.start()
                writer = await server.connections.get()
                await inbox.until_said(2 + 2 * outage)
            await on_peer_gone(writer)
            down = (Severity.WARNING, f"link {link.url} is down: the peer hung up; trying again")
            back = (Severity.INFO, f"link {link.url} is back")
            said = [(notice.severity, notice.text) for notice in inbox.notices[:4]]
            assert said == [down, back, down, back]
            assert {notice.subject for notice in inbox.notices} == {str(link.url)}

    run(test())


def test_host_name_is_resolved(run: Run) -> None:
    """Any of its addresses may answer: here the first may be ::1, without a listener."""

    async def test() -> None:
        async with serving() as server, running(f"tcp:localhost:{server.port}") as (_, inbox):
            writer = await server.connections.get()
            writer.write(frame(1))
            await inbox.until(1)
            await on_peer_gone(writer)

    run(test())


# --- TCP, listening -----------------------------------------------------------------------------


@contextlib.asynccontextmanager
async def connected(link: Link, family: int = socket.AF_INET) -> AsyncIterator[socket.socket]:
    """Connect to a listening link."""
    host = "127.0.0.1" if family == socket.AF_INET else "::1"
    with socket.socket(family, socket.SOCK_STREAM) as stream:
        stream.setblocking(False)
        await asyncio.get_running_loop().sock_connect(stream, (host, port_of(link)))
        yield stream


@pytest.mark.parametrize("host", ["127.0.0.1", pytest.param("[::1]", marks=needs_ipv6)])
def test_connections_are_served_concurrently(run: Run, host: str) -> None:
    """Interleaved half frames; one connection breaks off in the middle of a frame."""
    family = socket.AF_INET6 if host == "[::1]" else socket.AF_INET

    async def test() -> None:
        async with running(f"tcpin:{host}:0") as (link, inbox):
            assert link.status.url == f"tcpin:{host}:{port_of(link)}"
            await until_true(lambda: link.status.state == "up")
            async with connected(link, family) as a, connected(link, family) as b:
                async with connected(link, family) as broken:
                    second = frame(2, sysid=2)
                    for stream, raw in ((a, frame(1)), (b, second), (broken, frame(3))):
                        stream.send(raw[:20])
                    await until_true(lambda: link.status.bytes == 60)
                await until_true(lambda: bool(link.status.lost))
                a.send(frame(1)[20:])
                await inbox.until(1)
                b.send(second[20:])
                await inbox.until(2)
            assert inbox.raws == [frame(1), second]
            assert (link.status.state, link.status.peers) == ("up", 3)
            assert link.status.lost == {"garbage": 20} and inbox.notices == []

    run(test())


def test_sender_that_reconnects_is_used_from_its_first_frame(run: Run) -> None:
    """Its new connection is another peer, but the known one has left."""

    async def test() -> None:
        async with running("tcpin:127.0.0.1:0") as (link, inbox), connected(link) as other:
            async with connected(link) as first:
                first.send(frame(1))
                await inbox.until(1)
                other.send(frame(2))
                await inbox.until_true(lambda: len(inbox.rejections) == 1)
            await until_true(lambda: link.send(heartbeat(OURS)) == 1)  # it has noticed the end
            async with connected(link) as second:
                second.send(frame(3))
                await inbox.until_true(lambda: len(inbox.items) == 3)
                assert inbox.raws == [frame(1), frame(3)]

    run(test())


def test_number_of_connections_is_bounded(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp, "CONNECTIONS_MAX", 2)

    async def test() -> None:
        loop = asyncio.get_running_loop()
        async with running("tcpin:127.0.0.1:0") as (link, inbox), connected(link) as first:
            async with connected(link) as second:
                first.send(frame(1))
                second.send(frame(2, sysid=2))
                await inbox.until(2)
                async with connected(link) as third:
                    with contextlib.suppress(ConnectionResetError):
                        assert await loop.sock_recv(third, 1) == b""
                assert link.send(heartbeat(OURS)) == 2 and link.status.send_dropped == 0
            await until_true(lambda: link.send(heartbeat(OURS)) == 1)  # it has noticed the end
            async with connected(link) as fourth:
                fourth.send(frame(3, sysid=3))
                await inbox.until(3)

    run(test())


def test_connections_without_frames_keep_nobody_out(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """260 that sent nothing kept a vehicle out that came back, for ever."""
    monkeypatch.setattr(tcp, "CONNECTIONS_MAX", 3)

    async def test() -> None:
        async with running("tcpin:127.0.0.1:0") as (link, inbox), contextlib.AsyncExitStack() as on:
            first = await on.enter_async_context(connected(link))
            first.send(frame(1))
            await inbox.until(1)
            for number in range(6):
                silent = await on.enter_async_context(connected(link))
                silent.send(b"no frame")
                vehicle = await on.enter_async_context(connected(link))
                vehicle.send(frame(2, sysid=2 + number % 2))
                await inbox.until_true(lambda count=number + 2: len(inbox.raws) == count)
                vehicle.close()

    run(test())


# --- UDP, to one peer ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "host", ["127.0.0.1", "localhost", pytest.param("[::1]", marks=needs_ipv6)]
)
def test_udp_client_exchanges_frames_with_its_peer(run: Run, host: str) -> None:
    async def test() -> None:
        infos = socket.getaddrinfo(host.strip("[]"), 0, type=socket.SOCK_DGRAM)
        family, _, _, _, address = infos[0]
        with senders(2, family) as (peer, stranger):
            peer.bind(address)
            async with running(f"udpout:{host}:{peer.getsockname()[1]}") as (link, inbox):
                assert link.send(heartbeat(OURS)) == 0  # no socket yet: it does not wait
                await until_true(lambda: link.status.state == "up")
                assert link.send(heartbeat(OURS)) == 1
                raw, ours = peer.recvfrom(1000)
                (heard,) = Splitter("peer").feed(0, raw)
                assert isinstance(heard, Frame) and heard.source == OURS
                stranger.sendto(frame(1), ours)
                peer.sendto(frame(2), ours)
                await inbox.until(1)
                assert inbox.raws == [frame(2)]
                assert link.send_to(Source(1, 1), heartbeat(OURS))
                peer.recv(1000)
                assert (link.status.sent, link.status.send_dropped) == (2, 0)
                assert link.status.receive_buffer_bytes and inbox.notices == []

    run(test())


def test_refused_datagrams_do_not_take_the_link_down(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel reports a refusal for every datagram; no message of ours is dropped for it, and a
    returning peer finds us at the known port."""
    monkeypatch.setattr(udp, "OVERFLOW_CHECK_S", 0.01)

    async def test() -> None:
        with senders(2) as (before, after):
            before.bind(("127.0.0.1", 0))
            address = before.getsockname()
            async with running(f"udpout:127.0.0.1:{address[1]}") as (link, inbox):
                await until_true(lambda: link.send(heartbeat(OURS)) == 1)
                ours = before.recvfrom(1000)[1]
                before.close()
                for _ in range(20):
                    assert link.send(heartbeat(OURS)) == 1
                    assert link.send(heartbeat(OURS)) == 1
                    await asyncio.sleep(0.002)  # the loop receives the refusal as well
                link.send(heartbeat(OURS))
                after.bind(address)
                assert link.send(heartbeat(OURS)) == 1
                raw, sender = after.recvfrom(1000)
                (heard,) = Splitter("peer").feed(0, raw)
                assert isinstance(heard, Frame) and heard.seq == (link.status.sent - 1) % 256
                assert sender == ours
                after.sendto(frame(1), ours)
                await inbox.until(1)
                assert (link.status.state, inbox.notices) == ("up", [])
                assert link.status.send_dropped == 0

    run(test())


# --- losses in the kernel -----------------------------------------------------------------------


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux counts what a socket lost")
def test_overflowed_datagrams_are_counted_exactly(run: Run) -> None:
    """Sent while nothing is read, far beyond the buffer: every lost datagram is counted."""

    async def test() -> None:
        made = [frame(n) for n in range(256)]
        async with running("udpin:127.0.0.1:0") as (link, inbox):
            await until_true(lambda: link.status.state == "up")
            with senders(1) as (sender,):
                sender.connect(("127.0.0.1", port_of(link)))
                sent = 14_000
                for n in range(sent):
                    sender.send(made[n % 256])
            status = link.status
            await until_true(lambda: status.frames + (status.overflowed or 0) == sent)
            assert status.overflowed and status.frames
            assert status.lost == {"socket-overflow": status.overflowed}
            assert {item.reason for item in inbox.rejections} == {Reason.SOCKET_OVERFLOW}
            assert sum(item.count for item in inbox.rejections) == status.overflowed
            assert {item.source for item in inbox.rejections} == {status.url}

    run(test())


def test_receive_buffer_size_is_set_and_reported(run: Run) -> None:
    async def test() -> None:
        with senders(1) as (stock,):
            usual = stock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        async with running("udpin:127.0.0.1:0") as (link, _):
            granted = (
                link.status.receive_buffer_bytes
            )  # before it runs: a burst may be queued there
            await until_true(lambda: link.status.state == "up")
            assert granted is not None and usual < granted <= 2 * udp.RECEIVE_BUFFER_BYTES
        async with running("tcpin:127.0.0.1:0") as (link, _):
            await until_true(lambda: link.status.state == "up")
            assert link.status.receive_buffer_bytes is None and link.status.overflowed is None

    run(test())


@pytest.mark.skipif(sys.platform != "linux", reason="it is Linux that knows")
def test_overflow_count_is_unknown_where_unsupported() -> None:
    """For a closed socket the number of lost datagrams is unknown."""
    with socket.socket(type=socket.SOCK_DGRAM) as sock:
        assert udp.dropped_by_system(sock) == 0
    assert udp.dropped_by_system(sock) is None


# --- counts -------------------------------------------------------------------------------------


def test_received_frames_are_counted_per_component(run: Run) -> None:
    async def test() -> None:
        async with running("udpin:127.0.0.1:0") as (link, inbox):
            assert link.status.heard_ns is None and link.status.components == {}
            with senders(2) as (a, b):
                to = ("127.0.0.1", port_of(link))
                for n in (1, 2, 6, 6, 4):
                    a.sendto(frame(n), to)
                b.sendto(frame(1, sysid=2, version=1) + frame(4, sysid=2, version=1), to)
                await inbox.until(7)
            status = link.status
            assert (status.gaps, status.repeats, status.late) == (3 + 2, 1, 1)
            one, two = status.components[Source(1, 1)], status.components[Source(2, 1)]
            assert (one.frames, one.gaps, one.mavlink) == (5, 3, 2)
            assert (two.frames, two.gaps, two.mavlink) == (2, 2, 1)
            times = {f.source: f.t_ns for f in inbox.frames}
            assert (one.heard_ns, two.heard_ns) == (times[Source(1, 1)], times[Source(2, 1)])
            assert status.heard_ns == inbox.frames[-1].t_ns

    run(test())


# --- sending ------------------------------------------------------------------------------------


class Mailbox:
    """A real UDP peer: its own socket, and pymavlink's parser for received data."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        self.socket = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)

    def got(self) -> list[tuple[int, int, str]]:
        """Return version, sequence number and type of everything received."""
        parser, found = dialect.MAVLink(None), []
        with contextlib.suppress(BlockingIOError):
            while data := self.socket.recv(1000):
                for message in parser.parse_buffer(data) or []:
                    version = 2 if message.get_msgbuf()[0] == 0xFD else 1
                    found.append((version, message.get_seq(), message.get_type()))
        return found


@pytest.mark.usefixtures("unstamped")
def test_messages_go_to_every_recently_received_peer(run: Run) -> None:
    """Each with its own sequence numbers and in its own MAVLink version."""

    async def test() -> None:
        now = [0]
        with contextlib.ExitStack() as stack:
            old, new, v1, both, noise = (Mailbox(stack) for _ in range(5))
            async with running("udpin:127.0.0.1:0", lambda: now[0]) as (link, inbox):
                to = ("127.0.0.1", port_of(link))
                assert link.send(heartbeat(OURS)) == 0
                old.socket.sendto(frame(0), to)
                await inbox.until(1)
                assert link.send(heartbeat(OURS)) == 1
                now[0] = 1
                new.socket.sendto(frame(0, sysid=2), to)
                v1.socket.sendto(frame(0, sysid=3, version=1), to)
                both.socket.sendto(frame(0, sysid=4, version=1) + frame(1, sysid=4), to)
                noise.socket.sendto(b"\xfe\x00noise", to)
                await inbox.until(5)
                assert link.send(heartbeat(OURS)) == 4
                now[0] = int(transport.PEER_ACTIVE_S * 1e9) + 1
                assert link.send(timesync(OURS, 7)) == 3
                assert old.got() == [(2, 0, "HEARTBEAT"), (2, 1, "HEARTBEAT")]
                assert new.got() == [(2, 0, "HEARTBEAT"), (2, 1, "TIMESYNC")]
                assert v1.got() == [(1, 0, "HEARTBEAT"), (1, 1, "TIMESYNC")]
                assert both.got() == [(2, 0, "HEARTBEAT"), (2, 1, "TIMESYNC")]
                assert noise.got() == []
                assert (link.status.sent, link.status.send_dropped) == (8, 0)

    run(test())


def test_reply_goes_to_the_peer_last_received_from(run: Run) -> None:
    """Messages other than positions: a stranger's positions would not count."""

    async def test() -> None:
        with contextlib.ExitStack() as stack:
            a, b = Mailbox(stack), Mailbox(stack)
            async with running("udpin:127.0.0.1:0") as (link, inbox):
                to, one = ("127.0.0.1", port_of(link)), Source(1, 1)
                assert not link.send_to(one, heartbeat(OURS))
                for n, peer in enumerate((a, b, a)):
                    peer.socket.sendto(pack(heartbeat(one), n), to)
                    await inbox.until(n + 1)
                    assert link.send_to(one, heartbeat(OURS))
                    assert not link.send_to(Source(1, 2), heartbeat(OURS))
                assert [seq for _, seq, _ in a.got()] == [0, 1]
                assert [seq for _, seq, _ in b.got()] == [0]

    run(test())


def test_reply_does_not_go_to_a_stranger(run: Run) -> None:
    async def test() -> None:
        with contextlib.ExitStack() as stack:
            known, stranger = Mailbox(stack), Mailbox(stack)
            async with running("udpin:127.0.0.1:0") as (link, inbox):
                to = ("127.0.0.1", port_of(link))
                for n, peer in enumerate((known, stranger)):
                    peer.socket.sendto(frame(n), to)
                    await until_true(lambda n=n: len(inbox.items) == n + 1)
                assert link.send_to(Source(1, 1), heartbeat(OURS))
                assert (len(known.got()), len(stranger.got())) == (1, 0)
                assert (link.status.frames, link.status.lost) == (2, {})

    run(test())


def test_messages_go_to_every_connection_and_replies_to_their_own(run: Run) -> None:
    async def test() -> None:
        loop = asyncio.get_running_loop()
        async with running("tcpin:127.0.0.1:0") as (link, inbox), connected(link) as silent:
            async with connected(link) as other:
                other.send(frame(0))
                await inbox.until(1)
                await until_true(lambda: link.status.peers == 2 or link.send(heartbeat(OURS)) == 2)
                assert link.send_to(Source(1, 1), timesync(OURS, 1))
            await until_true(lambda: not link.send_to(Source(1, 1), heartbeat(OURS)))
            silent_heard = Splitter("s").feed(0, await loop.sock_recv(silent, 1000))
            assert {f.msgid for f in silent_heard if isinstance(f, Frame)} == {0}

    run(test())


def test_blocked_connection_drops_messages_without_blocking(run: Run) -> None:
    """Its buffer is bounded; when it reads again, it receives whole frames only."""

    async def test() -> None:
        loop = asyncio.get_running_loop()
        async with running("tcpin:127.0.0.1:0") as (link, inbox), connected(link) as peer:
            peer.send(frame(0))
            await inbox.until(1)
            message = Outgoing(OURS, 11030, bytes(range(1, 45)))  # any id, at full length
            for _ in range(2000):
                for _ in range(1000):
                    link.send(message)
                if link.status.send_dropped > 5000:
                    break
                await asyncio.sleep(0)
            status = link.status
            assert status.send_dropped > 5000 and status.state == "up"
            splitter, frames = Splitter("peer"), 0
            while frames < status.sent:
                found = splitter.feed(0, await loop.sock_recv(peer, 1 << 16))
                assert all(isinstance(item, Frame) for item in found)
                frames += len(found)
            assert link.send(heartbeat(OURS)) == 1
            while not any(
                isinstance(item, Frame) and item.msgid == 0
                for item in splitter.feed(0, await loop.sock_recv(peer, 1 << 16))
            ):
                pass

    run(test())


def test_unreachable_peer_does_not_affect_others(run: Run) -> None:
    async def test() -> None:
        with contextlib.ExitStack() as stack:
            peer = Mailbox(stack)
            async with running("udpin:127.0.0.1:0") as (link, inbox):
                link.take(("127.0.0.1", 0), frame(1, sysid=2))  # port 0 is not a valid destination
                peer.socket.sendto(frame(1), ("127.0.0.1", port_of(link)))
                await inbox.until(2)
                assert link.send(heartbeat(OURS)) == 1
                assert not link.send_to(Source(2, 1), heartbeat(OURS))
                assert (link.status.sent, link.status.send_dropped) == (1, 2)
                assert len(peer.got()) == 1

    run(test())


# --- guard --------------------------------------------------------------------------------------


class OddOnly:
    """Rejects every even system id, and signs with its own tail."""

    def __init__(self) -> None:
        self.asked: list[Frame] = []

    def refusal(self, frame: Frame) -> Reason | None:
        self.asked.append(frame)
        return None if frame.source.sysid % 2 else Reason.BAD_SIGNATURE

    def sign(self, raw: bytes, now_ns: int) -> bytes:
        return raw + b"signed at %d" % now_ns


@pytest.mark.usefixtures("unstamped")
def test_frame_rejected_by_the_guard_has_no_other_effect(run: Run) -> None:
    async def test() -> None:
        guard, now = OddOnly(), 1234
        with contextlib.ExitStack() as stack:
            peer, forger = Mailbox(stack), Mailbox(stack)
            async with running("udpin:127.0.0.1:0", lambda: now, guard) as (link, inbox):
                to = ("127.0.0.1", port_of(link))
                mixed = [frame(1), frame(9, sysid=2), frame(2)]
                peer.socket.sendto(b"".join([*mixed, b"x"]), to)
                forger.socket.sendto(frame(3, sysid=4), to)
                await inbox.until_true(lambda: len(inbox.rejections) == 3)
                assert inbox.raws == [frame(1), frame(2)]
                assert [item.raw for item in guard.asked] == [*mixed, frame(3, sysid=4)]
                first = inbox.items[1]
                assert first == Rejection(
                    t_ns=now, source="2:1", reason=Reason.BAD_SIGNATURE, count=1, msgid=33
                )
                status = link.status
                assert status.lost == {"bad-signature": 2, "garbage": 1}
                assert (status.frames, status.gaps) == (2, 0)
                assert set(status.components) == {Source(1, 1)}
                assert link.send(heartbeat(OURS)) == 1  # an unauthenticated peer is not active
                assert not link.send_to(Source(4, 1), heartbeat(OURS))
                assert peer.socket.recv(1000).endswith(b"signed at 1234")
                assert forger.got() == []

    run(test())


def test_guarded_link_sends_mavlink_2(run: Run) -> None:
    async def test() -> None:
        with contextlib.ExitStack() as stack:
            peer = Mailbox(stack)
            async with running("udpin:127.0.0.1:0", guard=OddOnly()) as (link, inbox):
                peer.socket.sendto(frame(1, version=1), ("127.0.0.1", port_of(link)))
                await inbox.until(1)
                assert link.send(heartbeat(OURS)) == 1
                assert peer.socket.recv(1000)[0] == 0xFD

    run(test())


# --- shutdown, several links, and defects -------------------------------------------------------


@pytest.mark.parametrize("scheme", ["tcp", "tcpin"])
def test_incomplete_frame_is_rejected_before_the_link_stops(run: Run, scheme: str) -> None:
    """Afterwards it must report nothing more (``running`` checks that)."""

    async def test() -> None:
        async with serving() as server:
            away = f"tcp:127.0.0.1:{server.port}"
            url = away if scheme == "tcp" else "tcpin:127.0.0.1:0"
            with contextlib.ExitStack() as stack:
                async with running(url) as (link, inbox):
                    if scheme == "tcp":
                        writer = await server.connections.get()
                        writer.write(frame(1)[:20])
                    else:
                        sender = stack.enter_context(socket.socket())
                        sender.connect(("127.0.0.1", port_of(link)))
                        sender.send(frame(1)[:20])
                    await until_true(lambda: link.status.bytes == 20)
                    assert inbox.items == []
                assert [item.count for item in inbox.rejections] == [20]
            if scheme == "tcp":
                await on_peer_gone(writer)

    run(test())


@pytest.mark.parametrize("turns", range(1, 7))
@pytest.mark.parametrize("scheme", ["udpin", "tcpin", "udpout", "tcp"])
def test_link_cancelled_while_opening_leaves_nothing_open(
    run: Run, scheme: str, turns: int
) -> None:
    """Cancelled after so many loop iterations. Python or uvloop warns of anything left open; as an
    error it would block uvloop's close, so warnings are only collected."""

    async def test() -> None:
        with socket.create_server(("127.0.0.1", 0)) as server:
            port = 0 if scheme.endswith("in") else server.getsockname()[1]
            link = Link(
                url=parse_link(f"{scheme}:127.0.0.1:{port}"),
                receive=lambda _: None,
                now_ns=lambda: 0,
            )
            link.open()
            task = asyncio.create_task(link.run())
            for _ in range(turns):
                await asyncio.sleep(0)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        run(test())
        gc.collect()
    assert [str(one.message) for one in said] == []


@pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning")
@pytest.mark.parametrize("turns", range(7))
def test_connection_during_shutdown_is_closed(run: Run, turns: int) -> None:
    """However far the loop had come with the connection when the link was stopped."""

    async def test() -> None:
        async with running("tcpin:127.0.0.1:0") as (link, _):
            await until_true(lambda: link.status.state == "up")
            visitor = socket.create_connection(("127.0.0.1", port_of(link)))
            for _ in range(turns):
                await asyncio.sleep(0)
        gc.collect()  # asyncio hands over connections accepted while its server closes
        with visitor:
            visitor.setblocking(False)
            with contextlib.suppress(ConnectionResetError):
                assert await asyncio.get_running_loop().sock_recv(visitor, 1) == b""

    run(test())


def test_several_links_run_concurrently(run: Run) -> None:
    async def test() -> None:
        async with (
            running("udpin:127.0.0.1:0") as (udp_in, heard_udp),
            running("tcpin:127.0.0.1:0") as (tcp_in, heard_tcp),
            running(f"udpout:127.0.0.1:{port_of(udp_in)}") as (udp_out, answered_udp),
            running(f"tcp:127.0.0.1:{port_of(tcp_in)}") as (tcp_out, answered_tcp),
        ):
            for link, heard in ((udp_out, heard_udp), (tcp_out, heard_tcp)):
                await until_true(lambda link=link: link.send(heartbeat(OURS)) == 1)
                await heard.until(1)
                assert heard.frames[0].source == OURS
            for link, heard in ((udp_in, answered_udp), (tcp_in, answered_tcp)):
                assert link.send(heartbeat(Source(1, 1))) == 1
                await heard.until(1)
                assert heard.frames[0].source == Source(1, 1)

    run(test())


class FaultError(Exception):
    """A program defect."""


@pytest.mark.parametrize("scheme", ["udpin", "tcpin", "udpout", "tcp"])
def test_program_error_is_raised_by_run(run: Run, scheme: str) -> None:
    """``run`` raises what ``receive`` raises, whatever the loop would do with it."""

    def receive(_: list[Frame | Rejection]) -> None:
        raise FaultError

    async def test() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _loop, _context: None)
        with socket.socket() as server, socket.socket(type=socket.SOCK_DGRAM) as datagrams:
            server.bind(("127.0.0.1", 0))
            server.listen()
            datagrams.bind(("127.0.0.1", 0))
            server.settimeout(LIMIT_S)
            datagrams.settimeout(LIMIT_S)
            there = datagrams if scheme == "udpout" else server
            port = 0 if scheme.endswith("in") else there.getsockname()[1]
            link = Link(
                url=parse_link(f"{scheme}:127.0.0.1:{port}"), receive=receive, now_ns=lambda: 0
            )
            link.open()
            task = asyncio.create_task(link.run())
            await until_true(lambda: link.status.state == "up")
            with contextlib.ExitStack() as stack:
                if scheme == "tcp":
                    peer = stack.enter_context(server.accept()[0])
                elif scheme == "udpout":
                    peer = datagrams
                    assert link.send(heartbeat(OURS)) == 1
                    peer.connect(peer.recvfrom(1000)[1])
                else:
                    kind = socket.SOCK_DGRAM if scheme == "udpin" else socket.SOCK_STREAM
                    peer = stack.enter_context(socket.socket(type=kind))
                    peer.connect(("127.0.0.1", port_of(link)))
                peer.send(frame(1))
                with pytest.raises(FaultError):
                    await task
            assert link.status.state == "down"

    run(test())


@pytest.mark.parametrize("scheme", ["udpin", "tcpin"])
def test_link_can_be_run_again_on_its_port(run: Run, scheme: str) -> None:
    async def test() -> None:
        came: list[Frame | Rejection] = []
        link = Link(url=parse_link(f"{scheme}:127.0.0.1:0"), receive=came.extend, now_ns=lambda: 0)
        link.open()
        port, kind = port_of(link), {"udpin": socket.SOCK_DGRAM, "tcpin": socket.SOCK_STREAM}
        for n in range(3):
            task = asyncio.create_task(link.run())
            await until_true(lambda: link.status.state == "up")
            with socket.socket(type=kind[scheme]) as sender:
                sender.connect(("127.0.0.1", port))
                sender.send(frame(n))
                await until_true(lambda n=n: len(came) == n + 1)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task

    run(test())


def test_flood_over_a_connection_is_processed_in_pieces(run: Run) -> None:
    """Other work runs in between, and no frame is lost."""

    async def test() -> None:
        async with running("tcpin:127.0.0.1:0") as (link, inbox), connected(link) as peer:
            raws = [frame(n, seq=n % 256) for n in range(5000)]
            await asyncio.get_running_loop().sock_sendall(peer, b"".join(raws))
            await inbox.until(len(raws))
            assert inbox.raws == raws
            assert max(inbox.batches) <= tcp.PIECE_BYTES / len(raws[0]) + 1

    run(test())


def test_connections_are_processed_in_turn_a_piece_at_a_time(run: Run) -> None:
    """Many flooding connections take no more time of an iteration than one, and end in order."""

    async def test() -> None:
        async with running("tcpin:127.0.0.1:0") as (link, inbox), contextlib.AsyncExitStack() as on:
            flood = [
                b"".join(frame(n, sysid, seq=n % 256) for n in range(2000)) for sysid in range(1, 6)
            ]
            loop, grown = asyncio.get_running_loop(), list[tuple[int, int]]()
            for raws in flood:
                peer = await on.enter_async_context(connected(link))
                await loop.sock_sendall(peer, raws)
                peer.shutdown(socket.SHUT_WR)
            while len(inbox.frames) < len(flood) * 2000:  # nothing of a closed one is lost
                before = link.status.bytes, len(inbox.frames)
                await asyncio.sleep(0)  # one iteration
                grown.append((link.status.bytes - before[0], len(inbox.frames) - before[1]))
            read, processed = (max(numbers) for numbers in zip(*grown, strict=True))
            assert 0 < read <= tcp.PIECE_BYTES
            assert 0 < processed <= FRAMES_AT_ONCE

    run(test())


def test_work_is_charged_to_the_sender_of_each_frame(run: Run) -> None:
    """A router passes on several senders, and garbage may come first."""

    async def test() -> None:
        async with running("udpin:127.0.0.1:0") as (link, _):
            await until_true(lambda: link.status.state == "up")
            link._newcomers.adapts_ns = 1 << 62  # the work is not taken into account meanwhile
            frames = [frame(number, sysid=7) for number in range(2, 41)]
            key = ("127.0.0.1", 9)
            has_more = link.take(key, b"\xfd\x09garbage" + frame(1) + b"".join(frames))
            while has_more:
                has_more = link.take(key, b"")
            charged = {one: work.seconds for one, work in link._newcomers._work.items()}
            assert charged[Account(Source(7, 1))] > 10 * charged[Account(Source(1, 1))]
            assert sum(charged.values()) == pytest.approx(link._newcomers.worked_s, rel=0.1)
            frames = [work.frames for work in link._newcomers._work.values()]
            assert sorted(frames) == [1, 39]

    run(test())


def test_waits_for_the_interpreter_do_not_end_a_batch_of_datagrams(
    run: Run, unstamped: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Threads that compute make each call to the system wait: few datagrams were read."""
    iterations, waited_s = 0, count()
    monkeypatch.setattr(time, "thread_time", lambda: 0.0)

    async def test() -> None:
        nonlocal iterations
        async with running("udpin:127.0.0.1:0", now_ns=lambda: iterations) as (link, inbox):
            await until_true(lambda: link.status.state == "up")
            monkeypatch.setattr(udp.time, "monotonic", lambda: next(waited_s))
            with senders(1) as (sender,):
                for number in range(10):
                    sender.sendto(frame(number), ("127.0.0.1", port_of(link)))
            while len(inbox.frames) < 10:
                iterations += 1
                await asyncio.sleep(0)
            assert len({one.t_ns for one in inbox.frames}) == 1
            monkeypatch.undo()

    run(test())


def test_large_datagram_is_processed_a_few_frames_at_a_time(run: Run) -> None:
    """It may hold a thousand frames; other work runs in between."""

    async def test() -> None:
        async with running("udpin:127.0.0.1:0") as (link, inbox):
            await until_true(lambda: link.status.state == "up")
            grown = list[int]()
            frames = [frame(number, sysid=7, seq=number % 256) for number in range(1200)]
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                sender.connect(("127.0.0.1", int(link.status.url.rpartition(":")[2])))
                sender.send(b"".join(frames))
                while len(inbox.frames) < len(frames):
                    before = len(inbox.frames)
                    await asyncio.sleep(0)  # one iteration
                    grown.append(len(inbox.frames) - before)
            assert [one.raw for one in inbox.frames] == frames
            assert sum(count > 0 for count in grown) > 1  # not all of them in one iteration

    run(test())


def test_datagrams_behind_a_large_one_keep_their_arrival_and_order(run: Run) -> None:
    """A frame that seems to arrive before it was sent makes a clock and a bound wrong."""

    async def test() -> None:
        unread = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        async with running("udpin:127.0.0.1:0", now_ns=time.monotonic_ns) as (link, inbox):
            upcalls = Upcalls(
                up=lambda: None,
                take=link.take,
                stale=lambda *_: None,
                on_peer_gone=lambda _: None,
                overflow=lambda _: None,
            )
            datagrams = udp._Datagrams(
                sock=unread, status=link.status, upcalls=upcalls, connected=False
            )
            large = b"".join(frame(number, sysid=7) for number in range(100))
            datagrams._process("a", large, 900_000_000)
            datagrams._process("a", frame(100, sysid=7), 500_000_000)
            datagrams._process("a", frame(101, sysid=7), 100_000_000)
            datagrams._process("b", frame(5, sysid=9), 0)  # another peer does not wait
            assert inbox.frames[-1].source == Source(9, 1)
            now_ns = time.monotonic_ns()
            await inbox.until(103)
            of_a = [one for one in inbox.frames if one.source == Source(7, 1)]
            assert [one.raw for one in of_a] == [frame(number, sysid=7) for number in range(102)]
            ages_s = [round((now_ns - one.t_ns) * 1e-9, 1) for one in of_a]
            assert ages_s == [0.9] * 100 + [0.5, 0.1]
        unread.close()

    run(test())


def test_peer_with_too_much_waiting_is_not_read(run: Run) -> None:
    async def test() -> None:
        async with running("udpin:127.0.0.1:0") as (link, inbox):
            await until_true(lambda: link.status.state == "up")
            large = b"".join(frame(number, sysid=7) for number in range(1500))
            most = 1 + udp.WAITING_MAX_BYTES // len(large)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                sender.connect(("127.0.0.1", port_of(link)))
                for _ in range(most + 5):
                    sender.send(large)
                await inbox.until_true(lambda: bool(inbox.rejections))
            assert inbox.rejections[0].reason is Reason.SOCKET_OVERFLOW
            assert len(inbox.frames) >= 1500

    run(test())


def test_peers_of_a_link_share_its_budget_of_false_starts(run: Run) -> None:
    """Whoever has many ports must not have a budget for each."""

    async def test() -> None:
        async with running("udpin:127.0.0.1:0") as (link, inbox):
            await until_true(lambda: link.status.state == "up")
            flood = b"\xfe\x01" * 700
            for port in range(40):
                link.take(("127.0.0.1", 1000 + port), flood)
            failed = sum(one.count for one in inbox.rejections if one.reason is Reason.BAD_CRC)
            assert 0 < failed < FALSE_STARTS_SAVED
            (garbage,) = [one for one in inbox.items[-1:] if isinstance(one, Rejection)]
            assert (garbage.reason, garbage.count) == (Reason.GARBAGE, len(flood) - 9)

    run(test())


def test_work_on_garbage_is_not_charged_to_senders(run: Run) -> None:
    """Otherwise a flood of random bytes would have frames of honest senders dropped."""

    async def test() -> None:
        async with running("udpin:127.0.0.1:0") as (link, _):
            await until_true(lambda: link.status.state == "up")
            link._newcomers.adapts_ns = 1 << 62  # the work is not taken into account meanwhile
            link.take(("127.0.0.1", 9), b"\xfd\x09garbage" * 400)
            assert link._newcomers.worked_s == 0.0
            link.take(("127.0.0.1", 9), frame(1))
            assert link._newcomers.worked_s > 0.0

    run(test())


def test_frames_that_are_dropped_are_counted_by_vehicle(run: Run) -> None:
    """So that a vehicle is not called silent; invented ones are counted together."""

    async def test() -> None:
        async with running("udpin:127.0.0.1:0") as (link, inbox):
            await until_true(lambda: link.status.state == "up")
            link._newcomers.adapts_ns = 1 << 62
            for sysid in range(1, 100):
                link.take(("127.0.0.1", 9), frame(1, sysid=sysid))
            link._newcomers._served_below = 50
            link._newcomers.generation += 1
            link._refused_ns = link._now_ns()
            for sysid in range(1, 100):
                link.take(("127.0.0.1", 9), frame(2, sysid=sysid, seq=1))
            assert not inbox.rejections
            link._refused_ns = -(1 << 62)
            link.take(("127.0.0.1", 9), frame(3, sysid=60, seq=2))
            assert len(inbox.frames) == 99 + 50
            counts = {one.source: one.count for one in inbox.rejections}
            assert {one.reason for one in inbox.rejections} == {Reason.NEWCOMER}
            apart = {f"{sysid}:1": 1 + (sysid == 60) for sysid in range(51, 51 + REFUSED_KINDS)}
            assert counts == {**apart, link.status.url: 49 - REFUSED_KINDS}
            assert link.status.lost[Reason.NEWCOMER] == 50
            frames = {one.source.sysid: it.frames for one, it in link._newcomers._work.items()}
            assert frames == {sysid: 2 if sysid <= 50 else 1 for sysid in range(1, 100)}
            # They are no gaps of the radio.
            link._newcomers._served_below = None
            link._newcomers.generation += 1
            for sysid in range(1, 100):
                link.take(("127.0.0.1", 9), frame(9, sysid=sysid, seq=9))
            gaps = {one.sysid: counts.gaps for one, counts in link.status.components.items()}
            assert gaps == {sysid: 7 if sysid <= 50 else 0 for sysid in range(1, 100)}

    run(test())


def test_flood_of_damaged_frames_is_passed_on_as_counts(run: Run) -> None:
    """One by one they would take as much time as frames, of senders that nothing can limit."""
    damaged = frame(1)[:-1] + b"\0"

    async def test() -> None:
        async with running("udpin:127.0.0.1:0") as (link, inbox):
            await until_true(lambda: link.status.state == "up")
            link._refused_ns, link._rejections.per_s = link._now_ns(), 0.0
            for port in range(1000):
                link.take(("127.0.0.1", 1000 + port % 20), damaged)
            passed_on = len(inbox.rejections)
            assert passed_on == REJECTED_PER_S
            assert link.status.lost[Reason.BAD_CRC] == 1000
            link._refused_ns = -(1 << 62)
            link.take(("127.0.0.1", 9), frame(1))
            assert sum(one.count for one in inbox.rejections) == 1000
            assert len(inbox.rejections) == passed_on + 1
            assert len(inbox.frames) == 1

    run(test())


def test_dropped_frames_of_a_limited_sender_are_not_charged_to_it(run: Run) -> None:
    """They are cheap: the mean time of a frame would be too small, and the flood be released."""

    async def test() -> None:
        async with running("udpin:127.0.0.1:0") as (link, inbox):
            await until_true(lambda: link.status.state == "up")
            link._newcomers.adapts_ns = 1 << 62
            account = Account(Source(1, 1))
            link._newcomers._shares.watch(account, link._now_ns(), is_new=False)
            frames = [frame(number % 250, seq=number % 256) for number in range(1000)]
            has_more = link.take(("127.0.0.1", 9), b"".join(frames))
            while has_more:
                has_more = link.take(("127.0.0.1", 9), b"")
            assert 0 < len(inbox.frames) < 1000
            assert link._newcomers._work[account].frames == len(inbox.frames)

    run(test())
