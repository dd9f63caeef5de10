"""Budgets of connections: requests, WebSocket frames, unread answers, wrong tokens."""

import asyncio
import contextlib
import os
import socket
import time
from collections.abc import Callable
from functools import partial
from socket import SO_RCVBUF, SOL_SOCKET
from typing import Any

import pytest
import uvicorn
import uvloop
import websockets
from http_support import Client, asked, connected, ends, get, served, upgrade
from starlette.testclient import TestClient
from support import HANG_S, run_async
from uvicorn.server import ServerState

from companion.node import serving
from companion.server import (
    access,
    connections,
    held_bodies,
    request_queue,
    responses,
    stream,
    websocket_connections,
)
from companion.server.app import create_app
from companion.server.request_queue import AT_ONCE, Rank, RequestQueue
from companion.values import Severity
from companion.values.budget import Budget

LOOPS: list[Callable[[], asyncio.AbstractEventLoop] | None] = [None, uvloop.new_event_loop]
PING = b"\x89\x80\0\0\0\0"
TOKEN = "a token of sixteen characters"


UPGRADE = upgrade()


# --- budgets --------------------------------------------------------------------------------------


def test_budget_is_spent_and_regained_with_time() -> None:
    budget = Budget(per_s=2.0, most=3.0)
    assert [budget.spend(1, 5.0) for _ in range(4)] == [True, True, True, False]
    assert not budget.spend(1, 5.4)
    assert budget.spend(1, 5.5)
    assert not budget.spend(1, 5.0)  # a time in the past gives nothing
    assert budget.spend(3, 100.0)
    assert not budget.spend(0.1, 100.0)


async def answered(client: Client) -> bool:
    """Request ``/healthz`` on a connection that stays open; return whether it was answered."""
    reader, writer = client
    writer.write(get("/healthz"))
    with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
        head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HANG_S)
        await reader.readexactly(len(b'{"status":"ok","needs_token":false}'))
        return head.startswith(b"HTTP/1.1 200 OK")
    return False


# --- pipelined requests ---------------------------------------------------------------------------


@pytest.mark.parametrize("loop", LOOPS, ids=["asyncio", "uvloop"])
def test_pipelined_requests_are_answered_in_order(make_node: Any, loop: Any) -> None:
    """Also if all arrive at once, and some are invalid paths."""
    paths = [path for _ in range(100) for path in ("/healthz", "/nowhere", "/v1/uavs", "/readyz")]
    expected = [200, 404, 200, 200] * 100

    async def pipelined() -> list[int]:
        async with served(make_node()) as port:
            reader, writer = await connected(port)
            writer.write(b"".join(map(get, paths)))
            statuses = []
            for _ in paths:
                head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HANG_S)
                size = int(head.lower().partition(b"content-length: ")[2].partition(b"\r")[0])
                await reader.readexactly(size)
                statuses.append(int(head.split()[1]))
            return statuses

    assert run_async(pipelined(), loop) == expected


@pytest.mark.parametrize("loop", LOOPS, ids=["asyncio", "uvloop"])
def test_pipelined_requests_wait_in_the_client(make_node: Any, loop: Any) -> None:
    """A client that reads no answer can send a few requests; the rest is not read."""
    flood = get("/v1/uavs") * 250_000

    async def flooded() -> None:
        async with served(make_node(), TOKEN) as port:
            reader, writer = await connected(port)
            reader._transport.pause_reading()  # type: ignore[attr-defined]
            writer.write(flood)
            for _ in range(50):  # answers to others, while the flood waits
                assert await asked(await connected(port)) == b"HTTP/1.1 200 OK\r\n"
            unsent = writer.transport.get_write_buffer_size()
            assert unsent > 0.5 * len(flood)

    run_async(flooded(), loop)


def test_few_requests_are_parsed_ahead(make_node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    waiting = list[int]()
    answer = connections.BoundedProtocol.on_response_complete

    def noted(self: Any) -> None:
        waiting.append(len(self.pipeline))
        answer(self)

    monkeypatch.setattr(connections.BoundedProtocol, "on_response_complete", noted)

    async def flooded() -> None:
        async with served(make_node(flown=False)) as port:
            reader, writer = await connected(port)
            writer.write(b"GET /healthz HTTP/1.1\r\n\r\n" * 3000)
            while len(waiting) < 1000:
                await asyncio.wait_for(reader.read(1 << 16), HANG_S)

    run_async(flooded())
    assert max(waiting) <= 15


def test_request_framing_without_end_is_cut_off(make_node: Any) -> None:
    """Extensions of chunks are neither head nor body."""
    head = b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\n1;"

    async def flooded() -> None:
        async with served(make_node(flown=False), TOKEN) as port:
            client = await connected(port)
            client[1].write(head + b"a" * (1 << 24))
            assert await ends(client)
            assert client[1].transport.get_write_buffer_size() > 1 << 23 or (
                client[1].transport.is_closing()
            )

    run_async(flooded())


def test_body_of_tiny_chunks_is_cut_off(make_node: Any) -> None:
    head = b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\n"

    async def flooded() -> None:
        async with served(make_node(flown=False), TOKEN) as port:
            client = await connected(port)
            client[1].write(head + b"1\r\na\r\n" * (1 << 21))
            assert await ends(client)
            assert client[1].transport.get_write_buffer_size() > 1 << 22 or (
                client[1].transport.is_closing()
            )
            whole = b"100\r\n" + b"a" * 256 + b"\r\n"
            allowed = head + whole * 16 + b"0\r\n\r\n"
            answer = await asked(await connected(port), allowed)
            assert answer == b"HTTP/1.1 405 Method Not Allowed\r\n"

    run_async(flooded())


def test_requests_over_a_budget_wait_for_others_and_for_threads() -> None:
    async def queued() -> None:
        busy = True
        queue = RequestQueue(lambda: busy)
        started = list[str]()
        done = asyncio.Event()

        def start(name: str) -> Callable[[], None]:
            def run() -> None:
                started.append(name)
                if len(started) == 30:
                    done.set()

            return run

        iteration = [0]

        def count() -> None:
            iteration[0] += 1
            if not done.is_set():
                asyncio.get_running_loop().call_soon(count)

        count()
        for _ in range(10):
            queue.add(start("late"), within_budget=False)
        for _ in range(17):
            queue.add(start("prompt"), within_budget=True)
        for _ in range(2):
            queue.add(start("beams"), within_budget=True, rank=Rank.BEAMS)
        queue.add(start("health"), within_budget=True, rank=Rank.HEALTH)
        await asyncio.sleep(0)
        while len(started) < 22:  # one at a time while threads compute
            await asyncio.sleep(0)
        assert len(started) == 22
        assert started[:20] == ["health"] + ["beams"] * 2 + ["prompt"] * 17
        assert iteration[0] >= 20 / AT_ONCE
        busy = False
        await done.wait()
        assert started[20:] == ["late"] * 10

    run_async(queued())


def test_oldest_request_is_started_first_beyond_the_budget_of_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Requests that many programs repeat must not keep all others waiting."""
    monkeypatch.setattr(request_queue, "REQUESTS_SAVED", 3.0)
    monkeypatch.setattr(request_queue, "REQUESTS_PER_S", 0.0)

    async def queued() -> None:
        queue, started = RequestQueue(lambda: False), list[str]()
        for n in range(3):
            queue.add(partial(started.append, f"other {n}"), within_budget=True)
            queue.add(partial(started.append, f"late {n}"), within_budget=False)
            for m in range(2):
                health = partial(started.append, f"health {2 * n + m}")
                queue.add(health, within_budget=True, rank=Rank.HEALTH)
        while len(started) < 12:
            await asyncio.sleep(0)
        assert started == [
            "health 0", "health 1", "health 2", "other 0", "late 0", "other 1", "late 1",
            "health 3", "other 2", "late 2", "health 4", "health 5",
        ]  # fmt: skip

    run_async(queued())


def test_iteration_after_a_long_one_starts_a_single_request(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(request_queue, "LONG_S", 0.05)

    async def queued() -> None:
        queue, started, at_once = RequestQueue(lambda: False), list[int](), list[int]()

        def start(number: int) -> None:
            started.append(number)
            if number == 7:
                time.sleep(0.06)

        for number in range(16):
            queue.add(partial(start, number), within_budget=True)
        while len(started) < 16:
            before = len(started)
            await asyncio.sleep(0)
            at_once.append(len(started) - before)
        assert 1 in [count for count in at_once if count]

    run_async(queued())


@pytest.mark.parametrize("loop", LOOPS, ids=["asyncio", "uvloop"])
def test_health_is_answered_before_requests_over_connections_that_wait(
    make_node: Any, loop: Any
) -> None:
    """Each client opens a connection for a request: the monitor's is accepted after theirs."""

    def asking(port: int, path: str) -> socket.socket:
        client = socket.create_connection(("127.0.0.1", port), HANG_S)
        client.sendall(get(path))
        client.setblocking(False)
        return client

    async def burst() -> None:
        async with served(make_node(flown=False)) as port:
            paths = ["/v1/status"] * 100 + ["/healthz"]
            with contextlib.ExitStack() as opened:
                clients = [opened.enter_context(asking(port, path)) for path in paths]
                answered = list[int]()

                async def answer(number: int) -> None:
                    await asyncio.get_running_loop().sock_recv(clients[number], 64)
                    answered.append(number)

                waiting = asyncio.gather(*(answer(number) for number in range(len(paths))))
                await asyncio.wait_for(waiting, HANG_S)
            assert answered.index(100) < 60

    run_async(burst(), loop)


def test_streams_are_opened_at_a_limited_rate_unless_their_clients_have_left() -> None:
    async def opened() -> None:
        loop, queue, done = asyncio.get_running_loop(), RequestQueue(lambda: False), asyncio.Event()
        started, saved = list[tuple[int, float]](), round(request_queue.STREAMS_SAVED)
        begun_s = loop.time()

        def start(number: int) -> None:
            started.append((number, loop.time() - begun_s))
            if number == saved + 9:
                done.set()

        for number in range(saved + 10):
            queue.add_stream(partial(start, number), lambda number=number: number != saved + 3)
        assert len(started) == saved
        await asyncio.wait_for(done.wait(), HANG_S)
        assert [number for number, _ in started if number >= saved] == [
            number for number in range(saved, saved + 10) if number != saved + 3
        ]
        assert started[-1][1] >= 8 / request_queue.STREAMS_PER_S

    run_async(opened())


def test_new_clients_replace_those_that_do_not_read(
    make_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The connections of a flood make room, also while all of them wait for answers."""
    monkeypatch.setattr(connections, "most_connections", lambda: 20)
    flood = get("/openapi.json") * 2000

    async def crowded() -> None:
        async with served(make_node()) as port:
            kept = await connected(port)
            for _ in range(40):
                reader, writer = await connected(port)
                reader._transport.pause_reading()  # type: ignore[attr-defined]
                writer.write(flood)
                assert await asked(await connected(port)) == b"HTTP/1.1 200 OK\r\n"
                assert await answered(kept)

    run_async(crowded())


def test_requests_are_not_replaced_by_clients_that_wait_for_a_stream(
    make_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of those the newest is: the first of them keeps its place."""
    monkeypatch.setattr(connections, "most_connections", lambda: 20)
    monkeypatch.setattr(connections, "SETTLED_S", HANG_S)
    monkeypatch.setattr(request_queue.RequestQueue, "add_stream", lambda *_: None)

    async def crowded() -> None:
        async with served(make_node()) as port:
            kept = await connected(port)
            waiting = []
            for _ in range(30):
                waiting.append(await connected(port))
                waiting[-1][1].write(UPGRADE)
            assert await asked(kept) == b"HTTP/1.1 200 OK\r\n"
            assert await ends(waiting[-2])
            assert not waiting[0][0].at_eof()

    run_async(crowded())


def test_client_that_takes_nothing_of_an_answer_is_disconnected(
    make_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "STALL_TIMEOUT_S", 0.3)

    async def stalled() -> None:
        async with served(make_node()) as port:
            reader, writer = await connected(port)
            reader._transport.pause_reading()  # type: ignore[attr-defined]
            writer.write(get("/openapi.json") * 200)
            with contextlib.suppress(ConnectionError):
                while not writer.transport.is_closing():
                    writer.write(b"x")
                    await asyncio.wait_for(writer.drain(), HANG_S)
                    await asyncio.sleep(0.05)  # between two attempts to send

    run_async(stalled())


@pytest.mark.parametrize(("other", "expected"), [("gzip", "closed"), ("identity", "open")])
def test_bodies_held_for_slow_clients_are_limited_in_all(
    make_node: Any, monkeypatch: pytest.MonkeyPatch, other: str, expected: str
) -> None:
    """The oldest answer is abandoned for another body, but not for another client of its own."""
    monkeypatch.setattr(held_bodies, "BYTES_MAX", 50_000)  # one body has more
    monkeypatch.setattr(responses, "PIECE_BYTES", 4096)
    monkeypatch.setattr(connections, "BUFFER_BYTES", 4096)

    async def asked_twice() -> str:
        async with served(make_node()) as port:
            slow, quick = await connected(port), await connected(port)
            slow[1].transport.get_extra_info("socket").setsockopt(SOL_SOCKET, SO_RCVBUF, 2048)
            slow[0]._transport.pause_reading()  # type: ignore[attr-defined]
            slow[1].write(get("/openapi.json"))
            while not held_bodies.HELD.bytes:
                await asyncio.sleep(0.001)
            quick[1].write(get("/openapi.json", f"Accept-Encoding: {other}", "Connection: close"))
            assert (await asyncio.wait_for(quick[0].read(), HANG_S)).startswith(b"HTTP/1.1 200 OK")
            slow[0]._transport.resume_reading()  # type: ignore[attr-defined]
            head = await asyncio.wait_for(slow[0].readuntil(b"\r\n\r\n"), HANG_S)
            size = int(head.lower().partition(b"content-length: ")[2].partition(b"\r")[0])
            assert size > 50_000
            try:
                await asyncio.wait_for(slow[0].readexactly(size), HANG_S)
            except (asyncio.IncompleteReadError, ConnectionError):
                return "closed"
            return "open"

    assert run_async(asked_twice()) == expected
    assert held_bodies.HELD.bytes == 0


# --- WebSockets -----------------------------------------------------------------------------------


@pytest.mark.parametrize("loop", LOOPS, ids=["asyncio", "uvloop"])
@pytest.mark.parametrize(("token", "refused"), [(None, False), (TOKEN, True)])
def test_flood_of_pings_closes_the_websocket(
    make_node: Any, token: str | None, refused: bool, loop: Any
) -> None:
    """After a refusal (4401) too."""
    flood = PING * 100_000
    code = 4401 if refused else websocket_connections.TOO_MUCH

    async def flooded() -> bytes:
        async with served(make_node(), token) as port:
            reader, writer = await connected(port)
            writer.write(UPGRADE)
            assert (await asyncio.wait_for(reader.readline(), HANG_S)).startswith(b"HTTP/1.1 101")
            writer.write(flood)
            said = b""
            with contextlib.suppress(ConnectionError):
                while piece := await asyncio.wait_for(reader.read(1 << 16), HANG_S):
                    said += piece
            return said

    said = run_async(flooded(), loop)
    pongs = said.count(b"\x8a\0")
    assert pongs < websocket_connections.BYTES_SAVED
    # The end of the connection may overtake the close frame.
    assert code.to_bytes(2, "big") in said or pongs == 0


@pytest.mark.parametrize("loop", LOOPS, ids=["asyncio", "uvloop"])
@pytest.mark.parametrize(
    "more",
    [
        b"Content-Length: 5\r\n",
        b"Content-Length: 0\r\n",
        b"Transfer-Encoding: chunked\r\n",
        b"X: " + b"x" * 8200 + b"\r\n",
        b"X: y\r\n" * 120,
    ],
    ids=["body", "empty body", "chunks", "long line", "many lines"],
)
def test_handshake_that_is_none_leaves_no_connection(
    make_node: Any, more: bytes, loop: Any
) -> None:
    """The library behind it says nothing about a head that it does not accept."""

    async def ended() -> None:
        async with served(make_node()) as port:
            reader, writer = await connected(port)
            writer.write(UPGRADE[:-2] + more + b"\r\n")
            status = await asyncio.wait_for(reader.readline(), HANG_S)
            assert status.startswith((b"HTTP/1.1 4", b"HTTP/1.1 101"))
            if b"101" in status:
                return
            with contextlib.suppress(ConnectionError):
                await asyncio.wait_for(reader.read(), HANG_S)

    run_async(ended(), loop)


def answering(
    app: Any, made: list[websocket_connections.BoundedWebSocket]
) -> websocket_connections.BoundedWebSocket:
    """Return a connection whose handshake this application answers, also in the list."""
    config = uvicorn.Config(app, interface="asgi3", log_config=None)
    made.append(
        websocket_connections.BoundedWebSocket(
            config=config, server_state=ServerState(), app_state={}
        )
    )
    return made[-1]


async def asking(
    app: Any, made: list[websocket_connections.BoundedWebSocket]
) -> tuple[asyncio.Server, asyncio.StreamReader, asyncio.StreamWriter]:
    """Serve an application, and ask it for a WebSocket."""
    loop = asyncio.get_running_loop()
    server = await loop.create_server(lambda: answering(app, made), "127.0.0.1", 0)
    reader, writer = await asyncio.open_connection("127.0.0.1", server.sockets[0].getsockname()[1])
    writer.write(UPGRADE)
    return server, reader, writer


@pytest.mark.parametrize(
    "answers", [(), ("websocket.close",), ("websocket.accept", "websocket.close")]
)
def test_handshake_that_waits_at_the_end_of_the_service_is_answered_once(
    answers: tuple[str, ...], caplog: pytest.LogCaptureFixture
) -> None:
    """Its request fails or is answered afterwards: websockets refuses to answer again."""
    over = asyncio.Event()

    async def unanswered(scope: Any, receive: Any, send: Any) -> None:
        await over.wait()
        for answer in answers:
            await send({"type": answer})

    made = list[websocket_connections.BoundedWebSocket]()

    async def ended() -> bytes:
        server, reader, writer = await asking(unanswered, made)
        while not (made and made[0].handshake_initiated):
            await asyncio.sleep(0)
        made[0].shutdown()
        over.set()
        await asyncio.gather(*made[0].tasks)
        server.close()
        received = await reader.read()
        writer.close()
        return received

    assert run_async(ended()).count(b"HTTP/1.1 500") == 1
    assert not [one for one in caplog.records if one.exc_info]


def test_message_at_the_end_of_the_service_is_refused_without_an_error() -> None:
    """The service has sent its close frame; a second one is an error of websockets."""
    made = list[websocket_connections.BoundedWebSocket]()

    async def accepts(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "websocket.accept"})
        await receive()
        await receive()

    async def ended() -> None:
        server, reader, writer = await asking(accepts, made)
        assert b"101" in await reader.readline()
        made[0].shutdown()
        made[0]._refuse(websocket_connections.UNSUPPORTED)
        server.close()
        await reader.read()
        writer.close()

    run_async(ended())


SAID: dict[str, bytes] = {  # masked frames of a client that has nothing to say
    "no UTF-8": b"\x81\x81\0\0\0\0\xff",
    "fragments of no UTF-8": b"\x01\x81\0\0\0\0\xc3\x80\x81\0\0\0\0(",
    "text": b"\x81\x82\0\0\0\0hi",
    "continuation": b"\x80\x81\0\0\0\0x",
    "ping in fragments": b"\x09\x81\0\0\0\0x",
    "reserved bits": b"\xc1\x81\0\0\0\0x",
}


@pytest.mark.parametrize("said", SAID.values(), ids=SAID)
def test_frames_that_the_stream_does_not_accept_write_nothing_to_the_log(
    make_node: Any, capfd: pytest.CaptureFixture[str], said: bytes
) -> None:
    """A traceback for each could fill a disk."""

    async def talks() -> None:
        async with served(make_node()) as port:
            client = await connected(port)
            client[1].write(UPGRADE)
            await client[0].readuntil(b"\r\n\r\n")
            client[1].write(said)
            assert await ends(client)

    run_async(talks())
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("said", SAID.values(), ids=SAID)
def test_client_that_does_not_wait_for_the_answer_is_disconnected(
    said: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    """The answer to a wrong token comes late."""
    over = asyncio.Event()

    async def late(scope: Any, receive: Any, send: Any) -> None:
        await over.wait()
        await send({"type": "websocket.close"})

    made = list[websocket_connections.BoundedWebSocket]()

    async def talks() -> None:
        loop = asyncio.get_running_loop()
        server = await loop.create_server(lambda: answering(late, made), "127.0.0.1", 0)
        client = await asyncio.open_connection(*server.sockets[0].getsockname())
        client[1].write(UPGRADE)
        while not (made and made[0].handshake_initiated):
            await asyncio.sleep(0)
        client[1].write(said)
        assert await ends(client)
        over.set()
        await asyncio.gather(*made[0].tasks)
        server.close()
        client[1].close()

    run_async(talks())
    assert [one.getMessage() for one in caplog.records if one.levelname != "INFO"] == []


def test_message_of_a_client_closes_its_stream(make_node: Any) -> None:
    async def talks() -> None:
        async with (
            served(make_node()) as port,
            websockets.connect(f"ws://127.0.0.1:{port}/v1/stream") as talking,
        ):
            await talking.send("subscribe")
            await asyncio.wait_for(talking.wait_closed(), HANG_S)
            assert talking.close_code == websocket_connections.UNSUPPORTED

    run_async(talks())


def test_message_to_a_client_closed_while_it_did_not_read_is_no_error() -> None:
    async def closed() -> None:
        held = websocket_connections.BoundedWebSocket.__new__(
            websocket_connections.BoundedWebSocket
        )
        held.writable = asyncio.Event()
        held.handshake_complete, held.close_sent, held.disconnected = True, False, False
        held.initial_response = None
        sending = asyncio.create_task(held.send({"type": "websocket.send", "text": "{}"}))
        await asyncio.sleep(0)
        held.close_sent = True  # the client sent too much
        held.writable.set()
        with pytest.raises(websocket_connections.ClientDisconnected):
            await sending

    run_async(closed())


def test_malformed_requests_write_nothing_to_the_log(
    make_node: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    """A line for each could fill a disk."""

    async def flooded() -> None:
        async with served(make_node()) as port:
            for _ in range(5):
                _, writer = await connected(port)
                writer.write(b"no request at all\r\n\r\n")
                reader, writer = await connected(port)
                writer.write(b"\r\n" * 9000)
                assert (await reader.readline()).startswith(b"HTTP/1.1 400")
            assert await asked(await connected(port)) == b"HTTP/1.1 200 OK\r\n"

    run_async(flooded())
    assert capfd.readouterr().err == ""


def test_client_that_answers_no_ping_is_disconnected(
    make_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A client that reads stays."""
    monkeypatch.setattr(serving, "PING_S", 0.1)
    monkeypatch.setattr(serving, "PONG_S", 0.3)

    async def silent() -> None:
        async with (
            served(make_node()) as port,
            websockets.connect(f"ws://127.0.0.1:{port}/v1/stream") as reading,
        ):
            for _ in range(2):
                await asyncio.wait_for(reading.recv(), HANG_S)
            mute = await connected(port)
            mute[1].write(UPGRADE)
            assert await ends(mute)
            await asyncio.wait_for(await reading.ping(), HANG_S)

    run_async(silent())


def test_stream_of_a_silent_client_makes_room(
    make_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "CLIENTS_MAX", 2)
    monkeypatch.setattr(stream, "QUIET_S", 0.5)
    monkeypatch.setattr(serving, "PING_S", 0.1)
    monkeypatch.setattr(serving, "PONG_S", 1e6)

    async def crowded() -> None:
        async with served(make_node()) as port:
            address = f"ws://127.0.0.1:{port}/v1/stream"
            mute = await connected(port)
            mute[1].write(UPGRADE)
            assert (await asyncio.wait_for(mute[0].readline(), HANG_S)).startswith(b"HTTP/1.1 101")
            async with websockets.connect(address) as reading:
                assert await asyncio.wait_for(reading.recv(), HANG_S)
                while True:  # until the silent client has been silent for long enough
                    with contextlib.suppress(websockets.ConnectionClosed):
                        async with websockets.connect(address) as newcomer:
                            assert await asyncio.wait_for(newcomer.recv(), HANG_S)
                            break
                assert await ends(mute)
                await asyncio.wait_for(await reading.ping(), HANG_S)

    run_async(crowded())


# --- tokens ---------------------------------------------------------------------------------------


def test_wrong_tokens_are_counted_told_and_answered_late(
    make_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    delays = list[float]()

    async def noted(delay_s: float) -> None:
        delays.append(delay_s)

    monkeypatch.setattr(access.asyncio, "sleep", noted)
    node = make_node(flown=False)
    client = TestClient(create_app(node, TOKEN), "http://localhost")
    wrong = {"authorization": "Bearer " + "x" * 16}
    for _ in range(15):
        assert client.get("/v1/uavs", headers=wrong).status_code == 401
    assert delays[:10] == [0.0] * 10
    assert delays[10:] == [access.WRONG_DELAY_S] * 5
    told = [notice for notice in node.notices if notice.subject == "http"]
    assert [(one.severity, one.text) for one in told] == [
        (Severity.WARNING, "testclient sends wrong tokens; 11 have been rejected since the start")
    ]
    right = {"authorization": f"Bearer {TOKEN}"}
    assert client.get("/v1/uavs", headers=right).status_code == 200
    assert client.get("/v1/uavs").status_code == 401  # no token is no wrong token
    assert len(delays) == 15
    assert "companion_wrong_tokens_total 15.0" in client.get("/metrics", headers=right).text


def test_addresses_of_wrong_tokens_are_bounded(make_node: Any) -> None:
    wrong = access.WrongTokens(make_node(flown=False))
    for number in range(access.ADDRESSES_MAX + 10):
        wrong.delay_s(f"10.0.{number // 256}.{number % 256}", 1.0)
    assert len(wrong._budgets) == access.ADDRESSES_MAX
    assert wrong.count == access.ADDRESSES_MAX + 10


def test_wrong_tokens_of_many_addresses_are_limited_together(make_node: Any) -> None:
    """Whoever has many addresses must not have ten prompt answers for each of them."""
    wrong = access.WrongTokens(make_node(flown=False))
    delays = [wrong.delay_s(f"2001:db8::{number:x}", number / 1000) for number in range(5000)]
    prompt = delays.count(0.0)
    assert access.WRONG_ALL_MAX <= prompt <= access.WRONG_ALL_MAX + 5 * access.WRONG_ALL_PER_S
    assert wrong.delay_s("192.0.2.1", 60.0) == 0.0  # after a minute some are prompt again


def test_health_is_answered_before_a_burst_of_other_requests(make_node: Any) -> None:
    """Its monitor must not take a service for dead that answers hundreds of others first."""

    async def burst() -> None:
        async with served(make_node(flown=False)) as port:
            clients = [await connected(port) for _ in range(60)]
            asks = [b"GET /v1/status HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"] * 59
            asks.append(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            answered = list[int]()

            async def answer(number: int) -> None:
                await clients[number][0].readline()
                answered.append(number)

            for (_, writer), ask in zip(clients, asks, strict=True):
                writer.write(ask)
            await asyncio.gather(*(answer(number) for number in range(60)))
            assert answered.index(59) < 30

    run_async(burst())


def test_page_files_are_cached_by_etag(make_node: Any) -> None:
    client = TestClient(create_app(make_node(flown=False)), "http://localhost")
    page = client.get("/")
    assert page.text.startswith("<!doctype html>")
    assert page.content == client.get("/index.html").content
    again = client.get("/", headers={"if-none-match": page.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert client.post("/main.js").status_code == 405
    assert client.get("/vendor").status_code == 404
    assert client.get("/../pyproject.toml").status_code == 404
    assert os.sep == "/" and client.get("/main.js").headers["content-type"].startswith("text/java")
