"""What clients took or left is released at once: no cycle keeps it until a full collection.

Full collections are rare, because their time grows with all that is tracked.
"""

import asyncio
import gc
import json
import weakref
from collections.abc import Iterator
from socket import SO_RCVBUF, SOL_SOCKET
from typing import Any

import pytest
from http_support import Client, connected, ends, get, served, upgrade
from starlette.exceptions import HTTPException
from support import HANG_S, run_async
from websockets.asyncio.client import connect

from companion.server import app, held_bodies, stream, topics
from companion.server.shared_work import SharedWork
from companion.server.stream import Snapshot
from companion.server.topics import Topic


@pytest.fixture(autouse=True)
def uncollected() -> Iterator[None]:
    """No cycle is collected during a test."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


class Watched(Snapshot):
    """A snapshot that ``KEPT`` knows while it is kept."""

    __hash__ = object.__hash__

    def __init__(self, number: int) -> None:
        super().__init__(number)
        KEPT.add(self)


KEPT = weakref.WeakSet[object]()
"""The snapshots and tasks of messages that exist."""


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Streams whose snapshots and tasks are in ``KEPT``."""
    task: Any = stream._task

    def kept(work: Any) -> "asyncio.Task[Any]":
        made: asyncio.Task[Any] = task(work)
        if is_of(made, "Stream._encoded"):
            KEPT.add(made)
        return made

    KEPT.clear()
    monkeypatch.setattr(stream, "Snapshot", Watched)
    monkeypatch.setattr(stream, "_task", kept)


def is_of(task: "asyncio.Task[Any]", name: str) -> bool:
    """Whether a task runs a coroutine of that name."""
    return getattr(task.get_coro(), "__qualname__", "").endswith(name)


def is_sending(task: "asyncio.Task[Any]") -> bool:
    """Whether a task serves a client of a stream."""
    return is_of(task, "Stream._send")


def test_failed_work_is_released_with_its_error() -> None:
    class Answer:
        pass

    async def failed() -> "weakref.ref[Answer]":
        answer = Answer()

        async def work(held: Answer) -> None:
            raise HTTPException(503)

        shared = SharedWork()
        with pytest.raises(HTTPException):
            await shared.run("answer", lambda: work(answer))
        return weakref.ref(answer)

    assert run_async(failed())() is None


def test_refused_messages_release_their_snapshots(
    make_node: Any, serving: Any, monkeypatch: pytest.MonkeyPatch, watched: None
) -> None:
    asked, body = 0, topics.body

    async def refused(*_: object) -> None:
        nonlocal asked
        asked += 1
        raise HTTPException(503)

    async def check() -> None:
        node = make_node()
        async with (
            serving(node) as at,
            connect(f"ws://{at}/v1/stream?topic=beams&rate_hz=100") as websocket,
        ):
            await asyncio.wait_for(websocket.recv(), HANG_S)
            monkeypatch.setattr(topics, "body", refused)
            for number in range(10):
                async with asyncio.timeout(HANG_S):
                    while asked <= number:
                        node.tick()
                        await asyncio.sleep(0.01)
            monkeypatch.setattr(topics, "body", body)
            node.tick()
            await asyncio.wait_for(websocket.recv(), HANG_S)
            async with asyncio.timeout(HANG_S):  # a task may be about to end
                while len(KEPT) > 2:  # the newest snapshot and its message
                    await asyncio.sleep(0.01)

    run_async(check())


def test_messages_of_few_updates_are_made_at_once(
    make_node: Any, serving: Any, monkeypatch: pytest.MonkeyPatch, watched: None
) -> None:
    """On a busy machine 155 snapshots waited to be encoded, each with its update: 140 MB."""
    waiting, most, body = asyncio.Event(), 0, topics.body

    async def slow(topic: Topic, *_: object) -> Any:
        nonlocal most
        most = max(most, sum(isinstance(one, Snapshot) for one in KEPT))
        await waiting.wait()
        raise HTTPException(503)

    async def check() -> None:
        node = make_node()
        async with serving(node) as at:
            monkeypatch.setattr(topics, "body", slow)
            address = f"ws://{at}/v1/stream?topic=beams&rate_hz=100"
            for _ in range(6):
                async with connect(address, close_timeout=1):
                    for _ in range(3):
                        node.tick()
                        await asyncio.sleep(0.02)  # what is refused cannot be awaited
            made = [one for one in asyncio.all_tasks() if is_of(one, "Stream._encoded")]
            assert 0 < len(made) <= stream.VERSIONS_AT_ONCE
            waiting.set()
            monkeypatch.setattr(topics, "body", body)
            async with connect(address) as websocket:  # and it continues
                node.tick()
                await asyncio.wait_for(websocket.recv(), HANG_S)

    run_async(check())
    assert 0 < most <= stream.VERSIONS_AT_ONCE + 1


def test_path_and_stream_of_one_name_share_no_answer(
    make_node: Any, serving: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stream of links took the path's bytes for its body, and the path the stream's."""
    monkeypatch.setattr(topics, "FEW_ITEMS", -1)
    monkeypatch.setattr(app, "FEW_ITEMS", -1)

    async def check() -> None:
        node = make_node()
        async with served(node) as port, connect(address(port)) as websocket:

            async def asks() -> None:
                for _ in range(30):
                    client = await connected(port)
                    client[1].write(get("/v1/links", "Connection: close"))
                    body = await asyncio.wait_for(client[0].read(), HANG_S)
                    assert body.startswith(b"HTTP/1.1 200"), body
                    assert b'"links":[{' in body

            async def hears() -> None:
                for _ in range(30):
                    node.tick()
                    message = json.loads(await asyncio.wait_for(websocket.recv(), HANG_S))
                    assert message["links"]

            await asyncio.gather(asks(), asks(), hears())

    def address(port: int) -> str:
        return f"ws://127.0.0.1:{port}/v1/stream?topic=links&rate_hz=100"

    run_async(check())


def test_stream_keeps_no_message_until_the_next_one(make_node: Any, serving: Any) -> None:
    async def check() -> None:
        async with (
            serving(make_node()) as at,
            connect(f"ws://{at}/v1/stream?topic=beams") as websocket,
        ):
            await asyncio.wait_for(websocket.recv(), HANG_S)
            (sending,) = filter(is_sending, asyncio.all_tasks())
            frame: Any = sending.get_coro().cr_frame  # type: ignore[union-attr]
            async with asyncio.timeout(HANG_S):
                while "message" in frame.f_locals:
                    await asyncio.sleep(0.001)
            assert frame.f_locals["said"]

    run_async(check())


def test_messages_held_for_slow_streams_are_limited_in_all(
    make_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The oldest stream is closed for another one's message, but not for one of its own."""
    monkeypatch.setattr(held_bodies, "BYTES_MAX", 1_500_000)  # two messages have more
    monkeypatch.setattr(topics, "message", lambda *_: "x" * 1_000_000)

    async def slow(port: int, uav: str, node: Any) -> Client:
        client = await connected(port)
        client[1].transport.get_extra_info("socket").setsockopt(SOL_SOCKET, SO_RCVBUF, 2048)
        client[0]._transport.pause_reading()  # type: ignore[attr-defined]
        before = stream_count()
        client[1].write(upgrade(f"topic=beams&uav={uav}"))
        async with asyncio.timeout(HANG_S):
            while stream_count() == before or not held_bodies.HELD.bytes:
                await ticked(node)
        return client

    async def ticked(node: Any) -> None:
        node.tick()
        for _ in range(20):
            await asyncio.sleep(0)

    def stream_count() -> int:
        return sum(map(is_sending, asyncio.all_tasks()))

    async def check() -> None:
        node = make_node()
        async with served(node) as port:
            first = await slow(port, "1:1", node)
            same = await slow(port, "1:1", node)
            assert stream_count() == 2
            second = await slow(port, "2:1", node)
            async with asyncio.timeout(HANG_S):
                while stream_count() > 1:
                    await ticked(node)
            for client in (first, same):
                client[0]._transport.resume_reading()  # type: ignore[attr-defined]
                assert await ends(client)
            second[1].transport.abort()

    run_async(check())
    assert held_bodies.HELD.bytes == 0


def test_small_bodies_are_not_abandoned_for_large_ones() -> None:
    """It would free little: a dashboard of a few UAVs had to reconnect for those of thousands."""
    held, sizes = held_bodies.HeldBodies(), (1000, 12 << 20, 12 << 20)

    async def send(size: int, until: asyncio.Event) -> None:
        with held.hold(bytes(size)):
            await until.wait()

    async def check() -> list[bool]:
        until = asyncio.Event()
        sending = [asyncio.create_task(send(size, until)) for size in sizes]
        await asyncio.wait(sending, timeout=0.1, return_when=asyncio.FIRST_COMPLETED)
        until.set()
        await asyncio.wait(sending)
        return [one.cancelled() for one in sending]

    assert run_async(check()) == [False, True, False]
    assert held.bytes == 0


def test_stream_is_closed_with_a_reason_if_it_reads_again(make_node: Any, serving: Any) -> None:
    async def check() -> None:
        async with serving(make_node()) as at, connect(f"ws://{at}/v1/stream") as websocket:
            await asyncio.wait_for(websocket.recv(), HANG_S)
            (sending,) = filter(is_sending, asyncio.all_tasks())
            sending.cancel()
            await asyncio.wait_for(websocket.wait_closed(), HANG_S)
            assert websocket.close_code == stream.TOO_MANY
            assert "too slowly" in (websocket.close_reason or "")

    run_async(check())
