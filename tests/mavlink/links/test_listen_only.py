"""Receive-only links over real sockets: web server responses, multicast groups, silent peers.

Every test runs on both loops.
"""

import asyncio
import contextlib
import json
import shutil
import socket
import ssl
import subprocess
import threading
from collections.abc import AsyncIterator, Callable
from datetime import UTC, datetime
from functools import partial
from itertools import count
from pathlib import Path
from typing import cast

import pytest
from link_support import LIMIT_S, LOOPS, Run, port_of, runner, running, until_true
from support import HANG_S

from companion.mavlink.links import http_poll, transport
from companion.mavlink.wire.encode import heartbeat
from companion.values import Reason, Source

AIRCRAFT = {"hex": "a2fcf2", "lat": 47.1, "lon": -122.3, "alt_geom": 5650, "seen_pos": 0.1}
DOCUMENT = b'{"now": %.1f, "aircraft": [' + json.dumps(AIRCRAFT).encode() + b"]}"
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
    """Run a server with a fixed response, but for the number of the request in a document.

    Yields its URL and the received requests.
    """
    asked: list[bytes] = []
    stop = asyncio.Event()

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError, EOFError):
            asked.append(await reader.readuntil(b"\r\n\r\n"))
            for piece in pieces:
                writer.write(piece % len(asked) if b"%" in piece else piece)
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


def test_receiver_beyond_its_share_of_the_time_is_skipped_and_counted(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All peers of a link share the time, whichever port they use, and its work is charged."""
    monkeypatch.setattr(transport, "RECEIVER_SAVED_S", 0.0)
    clock = Seconds(1_000_000_000)

    async def test() -> None:
        async with running("cot:udp:127.0.0.1:0", now_ns=clock.now_ns) as (link, inbox):
            await until_true(lambda: link.status.state == "up")
            link._newcomers.adapts_ns = 1 << 62  # the work is not taken into account meanwhile
            link.take(("127.0.0.1", 1), 8 * EVENT)
            assert len(inbox.frames) == 8
            charged = [work.seconds for work in link._newcomers._work.values()]
            assert sum(charged) == pytest.approx(link._newcomers.worked_s)
            assert link._newcomers.worked_s > 0.9 * -link._receiver_s.left > 0.0
            for port in range(2, 30):
                link.take(("127.0.0.1", port), EVENT)
            assert len(inbox.frames) == 8
            (skipped,) = inbox.rejections
            assert (skipped.reason, skipped.count) == (Reason.TOO_FREQUENT, 1)
            clock.t_ns += 60_000_000_000
            link.take(("127.0.0.1", 40), EVENT)
            assert len(inbox.frames) == 9
            assert sum(one.count for one in inbox.rejections) == 28
            assert link.status.lost == {Reason.TOO_FREQUENT: 28}

    run(test())


def test_receivers_share_a_budget(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Six servers of large documents, each within its share: no beams in 6 of 9 looks."""
    monkeypatch.setattr(transport, "RECEIVERS_SAVED_S", 0.0)
    budget = transport.receivers_budget()
    clock = Seconds(1_000_000_000)

    async def test() -> None:
        shared = partial(running, "cot:udp:127.0.0.1:0", now_ns=clock.now_ns, receivers_s=budget)
        async with shared() as (one, first), shared() as (other, second):
            for link in (one, other):
                await until_true(lambda link=link: link.status.state == "up")
                link._newcomers.adapts_ns = 1 << 62
            one.take(("127.0.0.1", 1), 8 * EVENT)
            other.take(("127.0.0.1", 1), EVENT)
            assert (len(first.frames), len(second.frames)) == (8, 0)
            assert other.status.lost == {Reason.TOO_FREQUENT: 1}
            clock.t_ns += 60_000_000_000
            other.take(("127.0.0.1", 1), EVENT)
            assert len(second.frames) == 1

    run(test())


def test_datagram_beyond_the_share_is_dropped_whole(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its garbage cost as much as its messages: 64 kB of it 0.7 s."""
    monkeypatch.setattr(transport, "RECEIVER_SAVED_S", 0.0)
    clock = Seconds(1_000_000_000)

    async def test() -> None:
        async with running("cot:udp:127.0.0.1:0", now_ns=clock.now_ns) as (link, inbox):
            await until_true(lambda: link.status.state == "up")
            assert link.take(("127.0.0.1", 1), 20 * EVENT)
            assert not link.take(("127.0.0.1", 1), b"")  # the rest is dropped
            assert not link.take(("127.0.0.1", 2), b"\xbf" * 60_000)
            clock.t_ns += 60_000_000_000
            link.take(("127.0.0.1", 1), EVENT)  # whose half-read datagram left nothing
            assert 8 < len(inbox.frames) < 20
            assert link.status.lost == {Reason.TOO_FREQUENT: 2}

    run(test())


@pytest.mark.parametrize("status", [b"HTTP/1.0 200 OK\r\n", b"HTTP/1.1 200 fine\r\nA: b\r\n"])
def test_http_document_becomes_frames(run: Run, status: bytes) -> None:
    async def test() -> None:
        pieces = (status, b"\r\n", DOCUMENT[:20], DOCUMENT[20:])
        async with answering(*pieces) as (url, asked), running(url) as (link, inbox):
            await inbox.until(1)
            assert (link.status.state, link.status.frames) == ("up", 1)
            assert link.status.lost == {Reason.UNPLACED_STAMP: 1}  # the first document
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
        async with (
            answering(head, DOCUMENT % 1, hangs=True) as (url, _),
            running(url) as (_, inbox),
        ):
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


# --- servers that send bytes, but no message ------------------------------------------------------


class Seconds:
    """A clock that the test sets."""

    def __init__(self, t_ns: int = 1) -> None:
        self.t_ns = t_ns

    def now_ns(self) -> int:
        return self.t_ns


@contextlib.asynccontextmanager
async def connections(scheme: str) -> AsyncIterator[tuple[str, asyncio.Queue[asyncio.Transport]]]:
    """Run a server; yields its link and the connections that it accepts."""
    accepted: asyncio.Queue[asyncio.Transport] = asyncio.Queue()
    opened: list[asyncio.Transport] = []

    class Accepted(asyncio.Protocol):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            opened.append(cast(asyncio.Transport, transport))
            accepted.put_nowait(opened[-1])

    server = await asyncio.get_running_loop().create_server(Accepted, "127.0.0.1", 0)
    try:
        yield f"{scheme}:127.0.0.1:{server.sockets[0].getsockname()[1]}", accepted
    finally:
        server.close()
        for transport in opened:
            transport.abort()


SBS = b"MSG,3,1,1,4006B3,1,,,,,,38000,,,51.4,-0.1,,,0,0,0,0\n"
BEAST = b"\x1a3" + bytes(6) + b"\x80" + bytes.fromhex("8D4840D6202CC371C32CE0576098")
RID = b'{"mac": "01:02", "uav id": "X"}\n'
SENT = {"sbs": SBS, "readsb": BEAST, "rid": RID, "cot:tcp": EVENT}


@pytest.mark.parametrize("scheme", SENT)
def test_server_that_drips_bytes_is_announced_once_and_reconnected(
    run: Run, monkeypatch: pytest.MonkeyPatch, scheme: str
) -> None:
    monkeypatch.setattr(transport, "RETRY_S", (0.001,))
    monkeypatch.setattr(transport, "STEADY_S", 2.0)  # longer than until the first byte
    clock = Seconds()

    async def drip(link: transport.Link, connection: asyncio.Transport) -> None:
        """A byte a second of one message, until the link hangs up."""
        for at in range(transport.UNFINISHED_S + 2):
            before = link.status.bytes
            connection.write(SENT[scheme][at : at + 1])
            await until_true(lambda before=before: link.status.bytes > before)
            clock.t_ns += 1_000_000_000

    async def test() -> None:
        async with (
            connections(scheme) as (url, accepted),
            running(url, clock.now_ns) as (link, inbox),
        ):
            for _ in range(2):
                await drip(link, await accepted.get())
            why = "no complete message in 10 s of data"
            connection = await accepted.get()
            assert inbox.texts == [f"link {url} is down: {why}; trying again"]
            assert sum(one.count for one in inbox.rejections) == 2 * 12
            connection.write(SENT[scheme])
            await inbox.until_said(2)
            assert inbox.texts[1] == f"link {url} is back"
            assert link.status.frames == 1

    run(test())


@pytest.mark.parametrize(
    "piece",
    [b"x" * 4000, b"<event " * 500, b"\xbf" * 4000, b"[" * 4000],
    ids=["text", "events", "lengths", "lists"],
)
@pytest.mark.parametrize("scheme", SENT)
def test_server_of_another_protocol_is_announced_and_counted(
    run: Run, monkeypatch: pytest.MonkeyPatch, scheme: str, piece: bytes
) -> None:
    """Data without an end of line or message; the memory for them is bounded."""
    monkeypatch.setattr(transport, "RETRY_S", (0.001,))
    clock = Seconds()

    async def test() -> None:
        async with (
            connections(scheme) as (url, accepted),
            running(url, clock.now_ns) as (link, inbox),
        ):
            connection = await accepted.get()
            for second in range(transport.UNFINISHED_S + 2):
                connection.write(piece)
                total = (second + 1) * len(piece)
                peers = link._peers._peers
                await until_true(
                    lambda total=total, peers=peers: (
                        link.status.bytes >= total
                        and not any(peer.splitter.has_more for peer in peers.values())
                    )
                )
                for peer in link._peers._peers.values():
                    assert len(peer.splitter._pending) <= 32_768  # type: ignore[attr-defined]
                clock.t_ns += 1_000_000_000
            await inbox.until_said(1)
            assert "no complete message in 10 s of data" in inbox.texts[0]
            await accepted.get()
            # White space between events is no garbage, and pieces may end in it.
            garbage = link.status.lost[Reason.GARBAGE]
            assert garbage == pytest.approx(12 * len(piece), rel=1e-3)

    run(test())


@pytest.mark.parametrize("scheme", SENT)
def test_slow_but_complete_messages_keep_the_connection(run: Run, scheme: str) -> None:
    """A quiet receiver, whose reads end within a message."""
    clock = Seconds()

    async def test() -> None:
        async with (
            connections(scheme) as (url, accepted),
            running(url, clock.now_ns) as (link, inbox),
        ):
            connection = await accepted.get()
            for n in range(1, 5):
                before = link.status.bytes
                connection.write(SENT[scheme][:9])
                await until_true(lambda before=before: link.status.bytes >= before + 9)
                clock.t_ns += 9_000_000_000
                connection.write(SENT[scheme][9:])
                await inbox.until(n)
                clock.t_ns += 3_600_000_000_000
            assert inbox.texts == [] and link.status.lost == {}

    run(test())


@pytest.fixture
def without_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make links poll, and retry, at once."""
    monkeypatch.setattr(http_poll, "PERIOD_S", 0.001)
    monkeypatch.setattr(transport, "RETRY_S", (0.001,))


@pytest.mark.usefixtures("without_pauses")
def test_web_server_without_valid_documents_is_announced(run: Run) -> None:
    clock = count(1, 1_000_000_000)

    async def test() -> None:
        answer = b"HTTP/1.0 200 OK\r\n\r\n<html>"
        async with answering(answer) as (url, _), running(url, lambda: next(clock)) as (_, inbox):
            await inbox.until_said(1)
            assert "no complete message in 10 s of data" in inbox.texts[0]
            seen = len(inbox.items)
            await inbox.until_true(lambda: len(inbox.items) > seen + 3)  # it is still polled
            assert len(inbox.texts) == 1

    run(test())


@contextlib.asynccontextmanager
async def polled(
    document: Callable[[], bytes], secure: ssl.SSLContext | None = None
) -> AsyncIterator[str]:
    """Run a server of a document; yields its URL."""

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError, EOFError):
            await reader.readuntil(b"\r\n\r\n")
            writer.write(b"HTTP/1.0 200 OK\r\n\r\n" + document())
            await writer.drain()
        writer.close()

    way = "http" if secure is None else "https"
    async with await asyncio.start_server(answer, "127.0.0.1", 0, ssl=secure) as server:
        yield f"readsb:{way}://127.0.0.1:{server.sockets[0].getsockname()[1]}/aircraft.json"


@pytest.mark.usefixtures("without_pauses")
@pytest.mark.parametrize("is_trusted", [False, True])
def test_certificates_are_checked_and_read_once(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, is_trusted: bool
) -> None:
    """Each request read those of the system on the event loop, for 40 ms."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not here")
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    made = f"openssl req -x509 -newkey rsa:2048 -nodes -keyout {key} -out {certificate} -days 2"
    names = ["-subj", "/CN=receiver", "-addext", "subjectAltName=IP:127.0.0.1"]
    subprocess.run([*made.split(), *names], check=True, capture_output=True, timeout=HANG_S)
    secure = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    secure.load_cert_chain(certificate, key)
    if is_trusted:
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    made_on, make = list[str](), ssl.create_default_context

    def create_default_context() -> ssl.SSLContext:
        made_on.append(threading.current_thread().name)
        return make()

    monkeypatch.setattr(http_poll.ssl, "create_default_context", create_default_context)
    http_poll._context.cache_clear()  # it is shared by all links
    numbers = count(100)

    async def test() -> None:
        document = polled(lambda: DOCUMENT % next(numbers), secure)
        async with document as url, running(url) as (link, inbox), running(url):
            if is_trusted:
                await inbox.until(5)
                assert not inbox.texts
            else:
                await inbox.until_said(1)
                assert "its certificate is not valid: self-signed" in inbox.texts[0]
                assert link.status.frames == 0

    run(test())
    assert made_on == ["background"]
    http_poll._context.cache_clear()


@pytest.mark.usefixtures("without_pauses")
def test_receiver_that_stopped_is_announced(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its web server continues; and the receiver is back."""
    monkeypatch.setattr(http_poll, "UNCHANGED_S", 0.02)
    monkeypatch.setattr(transport, "STEADY_S", 0.0)

    async def test() -> None:
        body = [DOCUMENT % 100]
        async with polled(lambda: body[0]) as url, running(url) as (link, inbox):
            await inbox.until_said(1)
            assert "the document has not changed for 0 s" in inbox.texts[0]
            assert not inbox.frames and link.status.state != "up"
            before = link.status.bytes
            await until_true(lambda: link.status.bytes > before + 5 * len(body[0]))
            assert link.status.state != "up" and len(inbox.texts) == 1
            body[0] = DOCUMENT % 101
            await inbox.until(1)
            await inbox.until_said(2)
            assert inbox.texts[1].endswith("is back")

    run(test())


def sbs_line(at_s: int) -> bytes:
    """Return a line that was received and written at a time of its server."""
    at = datetime.fromtimestamp(at_s, UTC).strftime("%Y/%m/%d,%H:%M:%S.000")
    return f"MSG,3,1,1,4006B3,1,{at},{at},,38000,250,90,51.4,-0.1,64,,0,0,0,0\n".encode()


def test_server_whose_lines_become_too_late_is_connected_again(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its clock may have been set back, too: a notice tells both."""
    monkeypatch.setattr(transport, "RETRY_S", (0.001,))
    clock = Seconds(0)

    async def test() -> None:
        async with (
            connections("sbs") as (url, accepted),
            running(url, clock.now_ns) as (link, inbox),
        ):
            connection = await accepted.get()
            for second in range(20):
                clock.t_ns = second * 1_000_000_000
                before = link.status.bytes
                connection.write(sbs_line(1000 + second - (60 if second >= 10 else 0)))
                await until_true(lambda: link.status.bytes > before or inbox.texts)  # noqa: B023
                if inbox.texts:
                    break
            assert (
                "lines are over 10 s later than before, or its clock was set back"
                in (inbox.texts[0])
            )
            assert len(inbox.frames) == 10
            again = await accepted.get()
            again.write(sbs_line(1000))
            await inbox.until(11)

    run(test())


@pytest.mark.usefixtures("without_pauses")
def test_documents_that_become_too_late_are_announced(run: Run) -> None:
    """The next ones are used: the clock of their server may have been set back."""
    clock = Seconds(0)

    async def test() -> None:
        served = count()

        def document() -> bytes:
            number = next(served)
            clock.t_ns = number * 1_000_000_000
            return DOCUMENT % (1000 + number - (60 if number >= 10 else 0))

        async with polled(document) as url, running(url, clock.now_ns) as (_, inbox):
            await inbox.until_said(1)
            assert "documents are over 10 s later than before" in inbox.texts[0]
            seen = len(inbox.frames)
            assert seen >= 9  # all before, but the first
            await inbox.until(seen + 3)

    run(test())


@pytest.mark.parametrize(
    "drip",
    [
        b"HTTP/1.0 200 OK\r\nA: " + b"b" * 1000, b"HTTP/1.0 200 OK\r\n\r\n" + b" " * 1000,
        b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n" + b"1\r\n \r\n" * 200,
    ],
    ids=["header", "body", "chunks"],
)  # fmt: skip
def test_http_answer_that_drips_times_out(
    run: Run, monkeypatch: pytest.MonkeyPatch, drip: bytes
) -> None:
    """Each byte arrives in time, the whole answer does not."""
    monkeypatch.setattr(http_poll, "ANSWER_S", 0.2)
    monkeypatch.setattr(transport, "RETRY_S", (0.001,))

    async def test() -> None:
        async with (
            connections("readsb") as (address, accepted),
            running(address.replace(":", ":http://", 1) + "/a") as (link, inbox),
        ):
            connection, dripped = await accepted.get(), 0
            while not connection.is_closing() and not inbox.texts:
                connection.write(drip[dripped : dripped + 1])
                dripped += 1
                await asyncio.sleep(0.01)
            await inbox.until_said(1)
            assert "timed out" in inbox.texts[0]
            assert link.status.bytes == 0 and 1 < dripped < 500
            await accepted.get()  # tried again

    run(test())
