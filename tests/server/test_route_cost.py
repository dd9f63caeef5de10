"""Every route and every topic of the stream with 2000 UAVs and eight clients: none holds the loop.

Measured is the processor time of the event loop's thread in each callback, which neither other
threads nor other processes add to. It is compared with that of the same route with a few UAVs, and
with the time of an answer about ``UNIT_UAVS``: many UAVs may add three times that.
"""

import asyncio
import gc
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from crowd import heartbeat, ids, report
from http_support import served
from load_sender import GLOBAL_POSITION_INT, HEARTBEAT
from support import HANG_S, run_async
from websockets.asyncio.client import connect

from companion.mavlink.links.status import ComponentStatus, LinkStatus
from companion.server import large_answers, work_slots
from companion.server.app import create_app
from companion.server.giving_way import NEVER
from companion.server.observation_routes import PATH as OBSERVATIONS
from companion.server.topics import Topic
from companion.values import Frame, Source
from companion.views import uav_state
from companion.views.series import EVERY_NS, SAMPLES

from .conftest import StandIn, settings

UAVS = 2000
UNIT_UAVS = 24
CLIENTS = 8
ROUNDS = 5
RECORDED = "companion-20261120T130000Z.mcap"
ACCESSORIES = (*range(100, 106), 154, *range(171, 176), *range(191, 195))
"""Components beside the autopilots of a system: cameras, gimbals, onboard computers."""
FILLED = {
    "/v1/uavs/{uav}": "/v1/uavs/10:1",
    "/v1/pattern": "/v1/pattern?uav=10:1",  # of all beams at once it is refused
    "/v1/recordings/{name}": f"/v1/recordings/{RECORDED}",
    "/v1/recordings/{name}/history": f"/v1/recordings/{RECORDED}/history",
    "/v1/mavlink/vehicles/{sys}/components/{comp}/messages": (
        "/v1/mavlink/vehicles/10/components/1/messages"
    ),
    "/v1/mavlink/vehicles/{sys}/components/{comp}/messages/{name}": (
        "/v1/mavlink/vehicles/10/components/1/messages/GLOBAL_POSITION_INT"
    ),
}
"""Paths that are asked for, where those of the document are not."""
STATUSES = {
    "/v1/map/tiles": {404},  # there is no map
    "/v1/recordings/{name}/history": {202, 409},  # being read; the file is no recording
}


@pytest.fixture(autouse=True)
def _without_rests(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rests between two answers of a slot take no time of the event loop, but most of a minute."""
    monkeypatch.setattr(work_slots, "REST_MAX_S", 0.0)


def document_paths() -> list[str]:
    """Return the paths of the OpenAPI document; all are read with GET."""
    app: Any = create_app(StandIn(settings(), flown=False))
    while not hasattr(app, "openapi"):
        app = app._app
    paths = app.openapi()["paths"]
    other = {path for path, operations in paths.items() if list(operations) != ["get"]}
    assert other == {OBSERVATIONS}  # its slices of time have a test of their own
    return [path for path in paths if path not in other]


def filled(path: str) -> str:
    """Return a path with its parameters."""
    found = FILLED.get(path, path)
    assert "{" not in found, f"{path}: give its parameters in FILLED"
    return found


def crowded(uavs: int, directory: Path) -> StandIn:
    """Return a node with so many UAVs, each of them in every answer that there is."""
    node = StandIn(settings(recording={"directory": str(directory)}, tracks={"most": UAVS}))
    link = "udpin:127.0.0.1:14550"
    heard = dict[Source, ComponentStatus]()
    for number in range(3):
        node.advance(0.1)
        for index in range(uavs):
            source = Source(*ids(index))
            for compid in (source.compid, *ACCESSORIES):
                heard[Source(source.sysid, compid)] = ComponentStatus(
                    frames=7, gaps=1, heard_ns=node.now_ns(), mavlink=2
                )
            raws = [(GLOBAL_POSITION_INT, report(index, number, 100_000 + 100 * number))]
            raws += [(HEARTBEAT, heartbeat(index, 0))] if number == 0 else []
            for msgid, raw in raws:
                frame = Frame(t_ns=node.now_ns(), link=link, source=source, msgid=msgid, raw=raw)
                node.last_messages.add(frame)
                node.pipeline.step(frame)
    links = [LinkStatus(url=link, state="up", heard_ns=node.now_ns(), components=heard)]
    node.links = lambda: links  # type: ignore[method-assign]
    for number in range(200):
        node.say(f"notice {number}")
    node.tick()
    sampled = SimpleNamespace(health=node.pipeline.health, local=node.pipeline.local)
    update = node.pipeline.last_update
    assert update is not None
    for number in range(SAMPLES):
        sampled.last_update = replace(update, t_ns=update.t_ns + number * EVERY_NS)
        node.series.add(sampled)  # type: ignore[arg-type]
    return node


class Held:
    """Processor time of each callback of one thread's event loop, while the block runs."""

    def __init__(self, thread: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
        self.took_s: list[float] = []
        self._thread, self._patch = thread, monkeypatch

    def __enter__(self) -> "Held":
        run, thread, took_s = asyncio.Handle._run, self._thread, self.took_s  # type: ignore[attr-defined]

        def timed(handle: asyncio.Handle) -> None:
            if threading.get_ident() != thread:
                run(handle)
                return
            begun_s = time.thread_time()
            run(handle)
            took_s.append(time.thread_time() - begun_s)

        self._patch.setattr(asyncio.Handle, "_run", timed)
        return self

    def __exit__(self, *_: object) -> None:
        self._patch.undo()


class Serving:
    """A node served by an event loop on a thread of its own."""

    def __init__(self, node: StandIn) -> None:
        self.node, self.port = node, 0
        self._ready = threading.Event()
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()
        assert self._ready.wait(HANG_S)

    def _run(self) -> None:
        with asyncio.Runner() as runner:
            runner.run(self._serve())

    async def _serve(self) -> None:
        self._loop, self._until = asyncio.get_running_loop(), asyncio.Event()
        async with served(self.node) as port:
            self.port = port
            self._ready.set()
            await self._until.wait()

    def call(self, function: Callable[[], object]) -> None:
        """Call a function on the event loop."""
        self._loop.call_soon_threadsafe(function)

    def stop(self) -> None:
        """Stop serving."""
        self.call(self._until.set)
        self.thread.join(HANG_S)


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Serving, Serving]]:
    """Serve two nodes, with a few UAVs and with ``UAVS``; no garbage is collected meanwhile."""
    directory = tmp_path_factory.mktemp("recordings")
    (directory / RECORDED).write_bytes(bytes(1 << 20))
    few, many = Serving(crowded(4, directory)), Serving(crowded(UAVS, directory))
    gc.collect()
    gc.disable()
    yield few, many
    gc.enable()
    few.stop()
    many.stop()


async def ask(port: int, path: str) -> int:
    """Return the status of an answer, which is read to the end."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n".encode())
    head = await reader.readline()
    while await reader.read(1 << 20):
        pass
    writer.close()
    return int(head.split()[1])


def held_by_route(
    serving: Serving,
    path: str,
    statuses: set[int],
    monkeypatch: pytest.MonkeyPatch,
    rounds: int = ROUNDS,
) -> float:
    """Return the longest callback while eight clients ask for a path: the least of all rounds.

    What the route does itself is in each round; what a busy machine adds is not.
    """
    longest_s = []

    async def all_ask() -> list[int]:
        return await asyncio.gather(*(ask(serving.port, path) for _ in range(CLIENTS)))

    for number in range(rounds):
        # Another moment than in the last round, but the same flight in all.
        serving.node.advance(-0.02 if number % 2 else 0.02)
        with Held(serving.thread.ident, monkeypatch) as held:
            assert set(run_async(all_ask())) <= statuses, path
            time.sleep(0.002)  # the last callback may still run
        longest_s.append(max(held.took_s))
    return min(longest_s)


def held_by_topic(serving: Serving, topic: Topic, monkeypatch: pytest.MonkeyPatch) -> float:
    """Return the longest callback while eight clients get a topic: the least of all updates."""
    address = f"ws://127.0.0.1:{serving.port}/v1/stream?topic={topic}&rate_hz=100"
    longest_s = []

    async def attend() -> None:
        clients = [await connect(address, max_size=None, compression=None) for _ in range(CLIENTS)]
        await asyncio.gather(*(one.recv() for one in clients))
        for number in range(ROUNDS):
            await asyncio.sleep(0.02)  # longer than the time between two messages
            with Held(serving.thread.ident, monkeypatch) as held:
                serving.call(lambda number=number: serving.node.pretend_update(f"update {number}"))
                await asyncio.gather(*(one.recv() for one in clients))
                await asyncio.sleep(0.002)
            longest_s.append(max(held.took_s))
        for one in clients:
            await one.close()

    run_async(attend())
    return min(longest_s)


def answer_s(node: StandIn) -> float:
    """Return how long an answer about ``UNIT_UAVS`` UAVs takes."""
    names, took_s = node.pipeline.tracker.uavs[:UNIT_UAVS], []
    for _ in range(ROUNDS):
        begun_s = time.thread_time()
        known = uav_state.known_uavs(node.pipeline, names)
        overview = uav_state.overview(node, known, node.now_ns())
        large_answers._parts(overview, node.pipeline.utc_ns, NEVER)
        took_s.append(time.thread_time() - begun_s)
    return min(took_s)


def too_long(few_s: float, many_s: float, node: StandIn) -> str | None:
    """Return by how much the event loop is held longer than it may be; None if it is not."""
    limit_s = few_s + 3 * answer_s(node)
    return f"{many_s * 1e3:.1f} ms, limit {limit_s * 1e3:.1f} ms" if many_s > limit_s else None


def offenders(
    both: tuple[Serving, Serving], held: Callable[[Serving, Any], float], names: list[Any]
) -> dict[str, str]:
    """Return what holds the event loop longer with many UAVs than it may, twice in a row."""
    few, many = both
    found = dict[str, str]()
    for name in names:
        for _ in range(2):
            wrong = too_long(held(few, name), held(many, name), many.node)
            if wrong is None:
                break
        else:
            found[name] = wrong or ""
    return found


def test_no_route_holds_the_event_loop(
    both: tuple[Serving, Serving], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert len(both[1].node.pipeline.tracker) >= UAVS

    def held(serving: Serving, path: str) -> float:
        return held_by_route(serving, filled(path), STATUSES.get(path, {200}), monkeypatch)

    assert offenders(both, held, document_paths()) == {}


def test_no_topic_holds_the_event_loop(
    both: tuple[Serving, Serving], monkeypatch: pytest.MonkeyPatch
) -> None:
    def held(serving: Serving, topic: Topic) -> float:
        return held_by_topic(serving, topic, monkeypatch)

    assert offenders(both, held, list(Topic)) == {}


def test_routes_on_the_event_loop_are_found(
    both: tuple[Serving, Serving], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Answers about all UAVs are put back on the event loop: each of these routes is found."""
    routes = ["/v1/uavs", "/v1/design", "/metrics", "/v1/links"]
    with pytest.MonkeyPatch.context() as back:
        back.setattr(large_answers, "FEW_UAVS", 10 * UAVS)
        back.setattr("companion.server.app.FEW_ITEMS", 10 * UAVS)

        def held(serving: Serving, path: str) -> float:
            return held_by_route(serving, path, {200}, monkeypatch, rounds=1)

        assert list(offenders(both, held, routes)) == routes


def test_unknown_path_parameters_are_reported() -> None:
    with pytest.raises(AssertionError, match=r"/v1/new/\{thing\}: give its parameters in FILLED"):
        filled("/v1/new/{thing}")
