"""Receive-only links over real sockets: web server responses, multicast groups, silent peers.

Every test runs on both loops.
"""

import asyncio
import contextlib
import json
import socket
from collections.abc import AsyncIterator

import pytest
from link_support import LIMIT_S, LOOPS, Run, port_of, runner, running

from companion.mavlink.links import http_poll
from companion.mavlink.wire.encode import heartbeat
from companion.values import Reason, Source

AIRCRAFT = {"hex": "a2fcf2", "lat": 47.1, "lon": -122.3, "alt_geom": 5650, "seen_pos": 0.1}
DOCUMENT = json.dumps({"now": 100.0, "aircraft": [AIRCRAFT]}).encode()
EVENT = (
    b'<event uid="A" type="a-f-A" time="2026-11-22T10:00:00Z" how="m-g">'
    b'<point lat="51.4" lon="-0.1" hae="120" ce="4" le="9"/></event>'
)


@pytest.fixture(params=LOOPS)
def run(request: pytest.FixtureRequest) -> Run:
    """Return ``run(test())``, on each of the two event loops."""
    return runner(request.param)


@contextlib.asynccontextmanager
async def answering(*pieces: bytes, hangs: bool = False) -> AsyncIterator[tuple[str, list[bytes]]]:
    """Run a server with a fixed response; yields its URL and the received requests."""
    asked: list[bytes] = []
    stop = asyncio.Event()

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError, EOFError):
            asked.append(await reader.readuntil(b"\r\n\r\n"))
            for piece in pieces:
                writer.write(piece)
                await writer.drain()
            if hangs:
                await stop.wait()
        writer.close()

    server = await asyncio.start_server(answer, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    try:
        yield f"readsb:http://127.0.0.1:{port}/data/aircraft.json?a=b", asked
    finally:
        stop.set()
        server.close()


@pytest.mark.parametrize("status", [b"HTTP/1.0 200 OK\r\n", b"HTTP/1.1 200 fine\r\nA: b\r\n"])
def test_http_document_becomes_frames(run: Run, status: bytes) -> None:
    async def test() -> None:
        pieces = (status, b"\r\n", DOCUMENT[:20], DOCUMENT[20:])
        async with answering(*pieces) as (url, asked), running(url) as (link, inbox):
            await inbox.until(1)
            assert (link.status.state, link.status.frames) == ("up", 1)
        (first, *_) = asked
        assert first.startswith(b"GET /data/aircraft.json?a=b HTTP/1.0\r\nHost: 127.0.0.1:")

    run(test())


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        ((b"HTTP/1.1 302 Found\r\nLocation: http://127.0.0.1/\r\n\r\n",), "answers 302"),
        ((b"SSH-2.0-OpenSSH_9.2\r\n\r\n",), "malformed HTTP"), ((b"",), "malformed HTTP"),
        ((b"HTTP/1.1 200 OK\r\n",), "malformed HTTP"), ((b"A" * 100_000,), "malformed HTTP"),
        ((b"HTTP/1.1\r\n\r\n",), "malformed HTTP"),
        ((b"HTTP/1.1 200 OK\r\n\r\n", *[b" " * (1 << 20)] * 17), "body exceeds"),
    ],
)  # fmt: skip
def test_invalid_http_response_takes_the_link_down(
    run: Run, answer: tuple[bytes, ...], why: str
) -> None:
    async def test() -> None:
        async with answering(*answer) as (url, _), running(url) as (link, inbox):
            await inbox.until_said(1)
            assert why in inbox.texts[0]
            assert link.status.bytes == 0

    run(test())


def test_endless_http_response_times_out(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_poll, "ANSWER_S", 0.1)

    async def test() -> None:
        head = b"HTTP/1.0 200 OK\r\n\r\n"
        async with answering(head, DOCUMENT, hangs=True) as (url, _), running(url) as (_, inbox):
            await inbox.until_said(1)
            assert "timed out" in inbox.texts[0]
            assert not inbox.items

    run(test())


def test_invalid_document_is_counted(run: Run) -> None:
    async def test() -> None:
        answer = b"HTTP/1.0 200 OK\r\n\r\n<html>"
        async with answering(answer) as (url, _), running(url) as (link, inbox):
            await inbox.until_true(lambda: bool(inbox.items))
            assert link.status.lost == {Reason.GARBAGE: 6}

    run(test())


@pytest.mark.parametrize("url", ["cot:udp:127.0.0.1:0", "rid:udp:127.0.0.1:0"])
def test_listen_only_peer_receives_nothing(run: Run, url: str) -> None:
    async def test() -> None:
        async with running(url) as (link, inbox):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                sender.connect(("127.0.0.1", port_of(link)))
                sender.send(EVENT if url.startswith("cot") else b"noise\n")
                await inbox.until_true(lambda: bool(inbox.items))
                assert link.send(heartbeat(Source(5, 191))) == 0
                sender.settimeout(0)
                with pytest.raises(BlockingIOError):
                    sender.recv(100)

    run(test())


def test_multicast_group_is_joined_and_shared(run: Run) -> None:
    """As ATAK sends it: to every listener of the group."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
        sender.settimeout(LIMIT_S)
        try:
            sender.sendto(b"", ("239.2.3.1", 9))
        except OSError:
            pytest.skip("no route leads to a group from here")

        async def test() -> None:
            url = "cot:udp:239.2.3.1:26969"
            async with running(url) as (_, first), running(url) as (_, second):
                sender.sendto(EVENT, ("239.2.3.1", 26969))
                await first.until(1)
                await second.until(1)

        run(test())
