"""Links over real sockets on loopback; what is waited for is an event, never a time."""

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator, Coroutine, Iterator
from itertools import count

import pytest
from pymavlink.dialects.v20 import all as dialect

from companion.mavlink import links
from companion.mavlink.links import PEERS_MAX, Link
from companion.mavlink.urls import LinkError, parse_link
from companion.values import Frame, Reason, Rejection

LIMIT_S = 20.0
"""A test that waits this long has failed."""


def frame(number: int, sysid: int = 1) -> bytes:
    """A report that no other number gives."""
    mav = dialect.MAVLink(None, sysid, 1)
    mav.seq = number % 256
    message = dialect.MAVLink_global_position_int_message(
        number, 473977419, 85455938, 488_000, 25_000, -300, 400, -5, 35_999
    )
    return bytes(message.pack(mav))


def damaged_length(raw: bytes) -> bytes:
    return raw[:1] + b"\xff" + raw[2:]


class Inbox:
    """What a link handed on; ``until`` waits for it to be enough."""

    def __init__(self) -> None:
        self.items: list[Frame | Rejection] = []
        self.batches: list[int] = []
        self._came = asyncio.Event()

    def receive(self, items: list[Frame | Rejection]) -> None:
        self.items += items
        self.batches.append(len(items))
        self._came.set()

    @property
    def raws(self) -> list[bytes]:
        return [item.raw for item in self.items if isinstance(item, Frame)]

    async def until(self, frames: int) -> None:
        while len(self.raws) < frames:
            self._came.clear()
            await self._came.wait()

    async def until_there_is(self, raw: bytes) -> None:
        while raw not in self.raws:
            self._came.clear()
            await self._came.wait()


@contextlib.asynccontextmanager
async def running(url: str) -> AsyncIterator[tuple[Link, Inbox]]:
    """A link that is open and runs, and is cancelled at the end. Its time is 1, 2, 3 …"""
    inbox, clock = Inbox(), count(1)
    link = Link(parse_link(url), inbox.receive, lambda: next(clock))
    link.open()
    task = asyncio.create_task(link.run())
    try:
        yield link, inbox
        assert not task.done()
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
    assert link.status.state == "down"


def run(test: Coroutine[None, None, None]) -> None:
    async def limited() -> None:
        async with asyncio.timeout(LIMIT_S):
            await test

    asyncio.run(limited())


def port_of(link: Link) -> int:
    return parse_link(link.status.url).port


@contextlib.contextmanager
def senders(number: int, family: int = socket.AF_INET) -> Iterator[list[socket.socket]]:
    with contextlib.ExitStack() as stack:
        yield [stack.enter_context(socket.socket(family, socket.SOCK_DGRAM)) for _ in range(number)]


def has_ipv6() -> bool:
    try:
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as probe:
            probe.bind(("::1", 0))
    except OSError:
        return False
    return True


needs_ipv6 = pytest.mark.skipif(not has_ipv6(), reason="there is no IPv6 loopback here")


# --- addresses ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "scheme", "host", "port"),
    [
        ("udpin:0.0.0.0:14550", "udpin", "0.0.0.0", 14550),
        ("tcp:localhost:5760", "tcp", "localhost", 5760),
        ("udpin:[::]:14550", "udpin", "::", 14550),
        ("tcp:[fe80::1%eth0]:5760", "tcp", "fe80::1%eth0", 5760),
        ("udpin:127.0.0.1:0", "udpin", "127.0.0.1", 0),
        ("udpin:127.0.0.1:65535", "udpin", "127.0.0.1", 65535),
    ],
)
def test_an_address_is_read_and_written_alike(text: str, scheme: str, host: str, port: int) -> None:
    url = parse_link(text)
    assert (url.scheme, url.host, url.port) == (scheme, host, port)
    assert str(url) == text


@pytest.mark.parametrize(
    "text",
    [
        "",
        "udpin",
        "udpin:",
        "udpin::14550",
        "udpin:127.0.0.1",
        "udpin:127.0.0.1:",
        "udpin:127.0.0.1:port",
        "udpin:127.0.0.1:-1",
        "udpin:127.0.0.1:65536",
        "udpin:127.0.0.1:1e3",
        "udpin:::1:14550",
        "udpin:[::1]",
        "udpin:[]:14550",
        "udp:127.0.0.1:14550",
        "http://127.0.0.1:80",
        "UDPIN:127.0.0.1:14550",
        "127.0.0.1:14550",
    ],
)
def test_a_bad_address_is_one_line_that_names_it(text: str) -> None:
    with pytest.raises(LinkError) as caught:
        parse_link(text)
    message = str(caught.value)
    assert repr(text) in message and "udpin" in message and "\n" not in message


# --- UDP ----------------------------------------------------------------------------------------


def test_datagrams_become_frames() -> None:
    async def test() -> None:
        async with running("udpin:127.0.0.1:0") as (link, inbox):
            with senders(1) as (sender,):
                to = ("127.0.0.1", port_of(link))
                made = [frame(n) for n in range(40)]
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
            assert times == [1] * 5 + list(range(2, 37))  # a datagram's frames came together
            status = link.status
            assert (status.state, status.frames, status.peers) == ("up", 40, 1)
            assert status.bytes == sum(map(len, made)) and status.lost == {}

    run(test())


@needs_ipv6
def test_datagrams_over_ipv6() -> None:
    async def test() -> None:
        async with running("udpin:[::1]:0") as (link, inbox):
            with senders(2, socket.AF_INET6) as both:
                for n, sender in enumerate(both):
                    sender.sendto(frame(n), ("::1", port_of(link)))
                await inbox.until(2)
            assert sorted(inbox.raws) == sorted([frame(0), frame(1)])
            assert link.status.peers == 2
            assert link.status.url.startswith("udpin:[::1]:")

    run(test())


def test_each_peer_has_its_own_splitter() -> None:
    """Every frame in halves, those of 100 peers by turns: all are found, and nothing is lost."""

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


def test_a_truncated_datagram_harms_no_other_peer() -> None:
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


def test_what_is_lost_is_handed_on_and_counted() -> None:
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


def test_a_port_scan_does_not_fill_the_memory() -> None:
    """The peers heard last are kept: one that keeps sending is never forgotten."""
    inbox: list[Frame | Rejection] = []
    link = Link(parse_link("udpin:127.0.0.1:0"), inbox.extend, lambda: 0)
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
    assert len(link._splitters) == PEERS_MAX
    assert link.status.peers == 2 * PEERS_MAX + 3


def test_a_port_in_use_is_one_line() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        url = f"udpin:127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(LinkError) as caught:
            Link(parse_link(url), lambda _: None, lambda: 0).open()
    message = str(caught.value)
    assert message.startswith(f"{url}: ") and "in use" in message and "\n" not in message


def test_an_address_of_another_machine_is_one_line() -> None:
    url = "udpin:192.0.2.1:0"  # TEST-NET-1: nobody's address
    with pytest.raises(LinkError) as caught:
        Link(parse_link(url), lambda _: None, lambda: 0).open()
    assert str(caught.value).startswith(f"{url}: ") and "\n" not in str(caught.value)


@pytest.mark.parametrize("scheme", ["udpin", "tcp"])
@pytest.mark.parametrize("host", ["a..b", "é" * 70, "a" * 64], ids=["empty", "accents", "long"])
def test_what_can_be_no_hosts_name_is_refused_at_the_start(scheme: str, host: str) -> None:
    """A label has 1 to 63 letters: no retry will ever help, so ``run`` is never reached."""
    with pytest.raises(LinkError) as caught:
        Link(parse_link(f"{scheme}:{host}:0"), lambda _: None, lambda: 0).open()
    assert host in str(caught.value) and "\n" not in str(caught.value)


def test_the_port_is_free_again_after_a_link() -> None:
    async def test() -> None:
        url = "udpin:127.0.0.1:0"
        for n in range(3):
            async with running(url) as (link, inbox):
                with senders(1) as (sender,):
                    sender.sendto(frame(n), ("127.0.0.1", port_of(link)))
                    await inbox.until(1)
                url = link.status.url

    run(test())


# --- TCP ----------------------------------------------------------------------------------------


class Server:
    """A server on loopback that hands over its connections as they come."""

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


async def hang_up(writer: asyncio.StreamWriter) -> None:
    writer.close()
    await writer.wait_closed()


def test_a_stream_in_pieces() -> None:
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
            await hang_up(writer)

    run(test())


def test_it_connects_again_when_the_server_goes_away() -> None:
    """The server stops listening and comes back; half a frame of before spoils nothing."""

    async def test() -> None:
        async with serving() as server, running(f"tcp:127.0.0.1:{server.port}") as (link, inbox):
            for n in range(3):
                writer = await server.connections.get()
                writer.write(frame(n) + frame(100 + n)[:20])
                await inbox.until(n + 1)
                await server.stop()
                await hang_up(writer)
                await server.start()
            writer = await server.connections.get()
            writer.write(frame(7))
            await inbox.until(4)
            assert inbox.raws == [frame(0), frame(1), frame(2), frame(7)]
            assert link.status.state == "up"
            await hang_up(writer)

    run(test())


def test_a_link_may_be_there_before_its_server(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = asyncio.Event()
    connect = asyncio.open_connection

    async def watched(host: str, port: int) -> object:
        try:
            return await connect(host, port)
        except OSError:
            tried.set()
            raise

    monkeypatch.setattr(asyncio, "open_connection", watched)

    async def test() -> None:
        server = Server()
        await server.start()
        await server.stop()  # its port is known now, and nobody listens there
        async with running(f"tcp:127.0.0.1:{server.port}") as (link, inbox):
            await tried.wait()
            await server.start()
            writer = await server.connections.get()
            writer.write(frame(1))
            await inbox.until(1)
            assert link.status.state == "up"
            await hang_up(writer)
            await server.stop()

    run(test())


def test_after_a_connection_the_first_retry_is_quick_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(links, "RETRY_S", (0.0, 2 * LIMIT_S))

    async def test() -> None:
        async with serving() as server, running(f"tcp:127.0.0.1:{server.port}") as (_, inbox):
            for n in range(4):
                writer = await server.connections.get()
                writer.write(frame(n))
                await inbox.until(n + 1)
                await hang_up(writer)
            await hang_up(await server.connections.get())

    run(test())


def test_retries_become_rare() -> None:
    assert links.RETRY_S[0] <= 0.5 and links.RETRY_S[-1] <= 10
    assert list(links.RETRY_S) == sorted(links.RETRY_S)


def test_good_frames_in_an_unfinished_claim_are_found_when_the_peer_hangs_up() -> None:
    """A damaged length claims what follows; no more bytes will come, so it is looked through."""

    async def test() -> None:
        async with serving() as server, running(f"tcp:127.0.0.1:{server.port}") as (link, inbox):
            writer = await server.connections.get()
            writer.write(damaged_length(frame(1)) + frame(2) + frame(3))
            await hang_up(writer)
            writer = await server.connections.get()  # it noticed, and is here again
            writer.write(frame(4))
            await inbox.until_there_is(frame(4))
            await hang_up(writer)
            assert inbox.raws == [frame(2), frame(3), frame(4)]
            assert link.status.lost

    run(test())
