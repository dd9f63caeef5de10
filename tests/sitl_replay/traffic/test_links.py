"""Endpoints over real sockets and a pseudo-terminal, on both event loops."""

import asyncio
import contextlib
import os
import pty
import socket
from collections.abc import Callable, Coroutine
from typing import Any, cast

import pytest
import uvloop
from support import HANG_S, run_async

from companion.mavlink.links.serial_port import WRITE_BUFFER_BYTES as SERIAL_BUFFER_BYTES
from companion.mavlink.links.tcp import WRITE_BUFFER_BYTES
from companion.mavlink.links.urls import LinkError, LinkUrl, parse_link
from sitl_replay.traffic.links import PEERS_MAX, TrafficLink, open_link

FRAME = bytes(range(1, 41))


@pytest.fixture(params=[asyncio.new_event_loop, uvloop.new_event_loop], ids=["asyncio", "uvloop"])
def run(request: pytest.FixtureRequest) -> Callable[[Coroutine[Any, Any, Any]], Any]:
    """Run a scene to its end on the given event loop, within a time limit."""

    def until_done(scene: Coroutine[Any, Any, Any]) -> Any:
        return run_async(scene, request.param)

    return until_done


Run = Callable[[Coroutine[Any, Any, Any]], Any]


async def until(good: Callable[[], Any]) -> None:
    """Poll until true: data received by the other end cannot be awaited."""
    async with asyncio.timeout(5.0):
        while not good():
            await asyncio.sleep(0.005)


async def received(bound: socket.socket) -> tuple[bytes, Any]:
    """The next datagram of a socket outside the event loop, and its sender."""
    found: list[tuple[bytes, Any]] = []

    def arrived() -> bool:
        with contextlib.suppress(BlockingIOError):
            found.append(bound.recvfrom(300))
        return bool(found)

    await until(arrived)
    return found[0]


class Heard:
    """The data that an endpoint passes on."""

    def __init__(self) -> None:
        self.pieces: list[tuple[object, bytes]] = []

    def __call__(self, peer: object, data: bytes) -> None:
        self.pieces.append((peer, data))

    def octets(self) -> bytes:
        return b"".join(data for _, data in self.pieces)


def udp(host: str = "127.0.0.1") -> socket.socket:
    """A bound datagram socket; the test is skipped if the host's address family is unavailable."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    bound = socket.socket(family, socket.SOCK_DGRAM)
    try:
        bound.bind((host, 0))
    except OSError:
        bound.close()
        pytest.skip(f"no {host} here")
    bound.setblocking(False)
    return bound


@pytest.mark.parametrize("host", ["127.0.0.1", "[::1]"])
def test_udpout_sends_receives_and_opens_with_an_empty_packet(run: Run, host: str) -> None:
    heard = Heard()

    async def scene(other: socket.socket) -> list[bytes]:
        peer = await open_link(parse_link(f"udpout:{host}:{other.getsockname()[1]}"), heard)
        assert peer.peers()
        peer.send_empty()
        peer.send(FRAME)
        got = []
        for _ in range(2):
            data, address = await received(other)
            got.append(data)
        other.sendto(b"answer", address)
        await until(heard.octets)
        await peer.close()
        return got

    with udp(host.strip("[]")) as other:
        assert run(scene(other)) == [b"", FRAME]
    assert heard.octets() == b"answer"


@pytest.mark.parametrize("host", ["127.0.0.1", "[::1]"])
def test_udpin_sends_to_every_known_peer(run: Run, host: str) -> None:
    heard = Heard()

    async def scene(first: socket.socket, second: socket.socket) -> None:
        endpoint = await open_link(parse_link(f"udpin:{host}:0"), heard)
        assert endpoint.url.port > 0
        address = (host.strip("[]"), endpoint.url.port)
        endpoint.send(b"nobody there")
        assert (endpoint.dropped, bool(endpoint.peers())) == (1, False)
        first.sendto(b"", address)  # an opening packet
        await endpoint.first_peer()
        await endpoint.writable()
        endpoint.send(b"one")
        assert (await received(first))[0] == b"one"
        second.sendto(b"hello", address)
        await until(heard.octets)
        endpoint.send(b"two")
        assert (await received(first))[0] == b"two"
        assert (await received(second))[0] == b"two"
        assert (endpoint.dropped, endpoint.lost) == (1, "")
        await endpoint.close()

    with udp(host.strip("[]")) as first, udp(host.strip("[]")) as second:
        run(scene(first, second))
    assert heard.octets() == b"hello"


def test_udpin_survives_lost_peers_and_bounds_their_number(run: Run) -> None:
    async def scene(first: socket.socket, early: socket.socket, last: socket.socket) -> None:
        heard = Heard()
        endpoint = await open_link(parse_link("udpin:127.0.0.1:0"), heard)
        address = ("127.0.0.1", endpoint.url.port)
        first.sendto(b".", address)
        early.sendto(b".", address)
        with contextlib.ExitStack() as stack:  # all open at once: each has a port of its own
            for _ in range(PEERS_MAX - 2):
                stack.enter_context(udp()).sendto(b".", address)
            await until(lambda: len(heard.octets()) == PEERS_MAX)
        endpoint.send(b"one")  # refused by all but two
        for peer in (first, early):
            assert (await received(peer))[0] == b"one"
        first.sendto(b".", address)
        last.sendto(b".", address)  # one too many: the peer silent for longest is removed
        await until(lambda: len(heard.octets()) == PEERS_MAX + 2)
        endpoint.send(b"two")
        for peer in (first, last):
            assert (await received(peer))[0] == b"two"
        with pytest.raises(BlockingIOError):
            early.recv(300)
        await endpoint.close()

    with udp() as first, udp() as early, udp() as last:
        run(scene(first, early, last))


def test_tcp_receives_and_is_lost_when_the_peer_closes(run: Run) -> None:
    heard = Heard()

    async def scene() -> TrafficLink:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write(await reader.readexactly(len(FRAME)))
            writer.close()

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        async with server:
            port = server.sockets[0].getsockname()[1]
            peer = await open_link(LinkUrl(scheme="tcp", host="127.0.0.1", port=port), heard)
            peer.send(FRAME)
            await until(lambda: peer.lost)
            peer.send(FRAME)
            await peer.writable()  # at once
            await peer.close()
        return peer

    peer = run(scene())
    (one, said), (same, end) = heard.pieces
    assert (one, said, end) == (same, FRAME, b"")
    assert (peer.lost, peer.broken, peer.dropped) == ("the peer hung up", False, 0)


def test_dropped_frames_are_not_buffered(run: Run) -> None:
    async def scene(url: LinkUrl) -> None:
        peer = await open_link(url)
        while peer.dropped < 1000:
            peer.send(bytes(1000))
        (stream,) = peer.peers()
        assert cast(Any, stream)._transport.get_write_buffer_size() <= WRITE_BUFFER_BYTES
        await peer.close()

    with socket.create_server(("127.0.0.1", 0)) as deaf:
        run(scene(LinkUrl(scheme="tcp", host="127.0.0.1", port=deaf.getsockname()[1])))


async def assert_no_frame_lost(link: TrafficLink, far: int, frames: list[bytes]) -> None:
    """Send as fast as the link accepts to a peer that reads slowly; then close the link."""
    os.set_blocking(far, False)
    got = bytearray()

    def read_some() -> int:
        with contextlib.suppress(OSError):  # no data; EIO from a line without its other end
            got.extend(os.read(far, 1 << 16))
        return len(got)

    async def read_slowly() -> None:
        while True:
            read_some()
            await asyncio.sleep(0.001)

    reading = asyncio.ensure_future(read_slowly())
    for raw in frames:
        await link.writable()
        link.send(raw)
    await link.close()
    await until(lambda: read_some() >= len(b"".join(frames)))
    reading.cancel()
    assert (bytes(got), link.dropped, link.lost) == (b"".join(frames), 0, "")


def test_tcp_loses_no_frame_if_the_sender_waits(run: Run) -> None:
    async def scene(server: socket.socket) -> None:
        link = await open_link(
            LinkUrl(scheme="tcp", host="127.0.0.1", port=server.getsockname()[1])
        )
        with server.accept()[0] as far:
            await assert_no_frame_lost(
                link, far.fileno(), [n.to_bytes(4, "big") * 250 for n in range(20_000)]
            )

    with socket.create_server(("127.0.0.1", 0)) as server:
        run(scene(server))


def test_serial_port_loses_no_frame_if_the_sender_waits(run: Run) -> None:
    async def scene(far: int, url: LinkUrl) -> None:
        frames = [n.to_bytes(4, "big") * 10 for n in range(2_000)]
        await assert_no_frame_lost(await open_link(url), far, frames)

    far, url = terminal()
    try:
        run(scene(far, url))
    finally:
        os.close(far)


@pytest.mark.parametrize("host", ["127.0.0.1", "[::1]"])
def test_tcpin_serves_every_peer_from_its_connection_on(run: Run, host: str) -> None:
    async def scene() -> tuple[list[bytes], Heard]:
        heard = Heard()
        server = await open_link(parse_link(f"tcpin:{host}:0"), heard)
        address = (host.strip("[]"), server.url.port)
        server.send(b"nobody there")
        assert (server.dropped, bool(server.peers())) == (1, False)
        first, first_out = await asyncio.open_connection(*address)
        first_out.write(b"hello")
        await server.first_peer()
        server.send(b"one")
        assert await first.readexactly(3) == b"one"
        second, second_out = await asyncio.open_connection(*address)
        second_out.write(b"hi")
        await until(lambda: len(heard.octets()) == 7)
        server.send(b"two")
        assert await first.readexactly(3) == await second.readexactly(3) == b"two"
        first_out.close()
        await until(lambda: any(data == b"" for _, data in heard.pieces))
        server.send(b"three")
        rest = [await second.readexactly(5)]
        second_out.close()
        await until(lambda: not server.peers())
        server.send(b"nobody there")
        assert (server.dropped, server.lost, server.broken) == (2, "", False)
        third, third_out = await asyncio.open_connection(*address)
        await server.writable()  # waits for first_peer
        server.send(b"four")
        await server.close()
        rest.append(await third.read())
        third_out.close()
        with pytest.raises(OSError):
            await asyncio.open_connection(*address)
        return rest, heard

    if ":" in host:
        udp("::1").close()
    rest, heard = run(scene())
    assert rest == [b"three", b"four"]
    assert len({peer for peer, _ in heard.pieces}) == 3


def test_tcp_client_that_does_not_read_delays_no_other(run: Run) -> None:
    async def scene() -> tuple[int, int]:
        server = await open_link(parse_link("tcpin:127.0.0.1:0"))
        address = ("127.0.0.1", server.url.port)
        with socket.create_connection(address):  # never reads
            reader, writer = await asyncio.open_connection(*address)
            await until(lambda: len(server.peers()) == 2)
            sent = 0
            while server.dropped < 100:
                server.send(bytes(1000))
                sent += 1000
                assert await reader.readexactly(1000) == bytes(1000)
            writer.close()
            await until(lambda: len(server.peers()) == 1)
            dropped = server.dropped
            await server.close()
        assert server.dropped >= dropped  # the count persists after the connection
        return sent, dropped

    sent, dropped = run(scene())
    assert sent > 100_000
    assert dropped == 100


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("serial:/nowhere/tty:57600", "No such file or directory"),
        ("serial:/dev/null:57600", "Inappropriate ioctl"),
        ("tcp:127.0.0.1:1", "Connection refused"),
        ("udpin:192.0.2.1:14550", "Cannot assign requested address"),
        ("tcpin:192.0.2.1:5760", "Cannot assign requested address"),
    ],
)
def test_link_open_error_names_the_url(run: Run, text: str, complaint: str) -> None:
    with pytest.raises(LinkError, match=complaint) as caught:
        run(open_link(parse_link(text)))
    assert str(caught.value).startswith(f"{text}: ")


def terminal() -> tuple[int, LinkUrl]:
    """The far end of a serial line, and the link to the near end."""
    far, near = pty.openpty()
    url = parse_link(f"serial:{os.ttyname(near)}:921600")
    os.close(near)  # pyserial opens it again
    os.set_blocking(far, False)
    return far, url


def test_serial_sends_and_receives_every_byte_value(run: Run) -> None:
    async def scene(far: int, url: LinkUrl) -> bytes:
        heard = Heard()
        port = await open_link(url, heard)
        os.write(far, bytes(range(256)))
        await until(lambda: len(heard.octets()) == 256)
        assert heard.octets() == bytes(range(256))
        port.send(bytes(range(256)))
        await port.close()
        assert heard.pieces[-1] == (None, b"")
        return os.read(far, 1000)

    far, url = terminal()
    try:
        assert run(scene(far, url)) == bytes(range(256))
    finally:
        os.close(far)


def test_slow_serial_port_drops_whole_frames(run: Run) -> None:
    async def scene(far: int, url: LinkUrl) -> None:
        port = await open_link(url)
        sent = 0
        while not port.dropped:
            port.send(FRAME)
            sent += 1
        sent -= 1
        unsent = cast(Any, port._endpoint)._unsent
        assert SERIAL_BUFFER_BYTES - len(FRAME) < len(unsent) <= SERIAL_BUFFER_BYTES
        got = bytearray()

        def read_some() -> bool:
            """Whether there is no data to read: a line without its other end returns EIO."""
            try:
                got.extend(os.read(far, 1000))
            except OSError:
                return True
            return False

        await until(lambda: read_some() and len(got) == sent * len(FRAME))
        await asyncio.wait_for(port.writable(), HANG_S)
        while not unsent:
            port.send(FRAME)
            sent += 1
        closing = asyncio.ensure_future(port.close())  # with some data still queued here
        await until(lambda: read_some() and closing.done())
        assert bytes(got) == FRAME * sent

    far, url = terminal()
    try:
        run(scene(far, url))
    finally:
        os.close(far)


def test_unplugged_serial_port_is_lost(run: Run) -> None:
    heard = Heard()

    async def scene(far: int, url: LinkUrl) -> TrafficLink:
        port = await open_link(url, heard)
        os.close(far)
        await until(lambda: port.lost)
        port.send(FRAME)
        await port.close()
        return port

    port = run(scene(*terminal()))
    assert port.broken
    assert port.lost
    assert heard.pieces == [(None, b"")]


def test_serial_port_is_opened_exclusively(run: Run) -> None:
    async def scene(url: LinkUrl) -> None:
        port = await open_link(url)
        with pytest.raises(LinkError, match=r"^serial:.*: "):
            await open_link(url)
        await port.close()
        await (await open_link(url)).close()

    far, url = terminal()
    try:
        run(scene(url))
    finally:
        os.close(far)
