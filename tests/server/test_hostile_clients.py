"""Hostile clients: no request head, connection, host name or request delays the others."""

import asyncio
import contextlib
import json
import socket
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import websockets
from http_support import REQUEST, asked, connected, ends, served
from starlette.testclient import TestClient
from support import HANG_S, run_async

from companion.beams.array.geometry import Array
from companion.beams.hardware import codebooks
from companion.pipeline import assembly
from companion.server import connections, work_slots
from companion.server.app import create_app
from companion.server.responses import encode
from companion.server.work_slots import WorkSlots
from companion.settings.model import Settings
from companion.values import UserError, UtcNs
from companion.views import beam_state, series
from companion.views.series import SAMPLES, Series

# --- heads, bodies and timeouts -------------------------------------------------------------------


def test_endless_request_head_is_cut_off(make_node: Any) -> None:
    """A client without a token uses no more of the event loop than this."""
    floods = (
        b"GET /" + b"a" * (1 << 25),
        b"GET / HTTP/1.1\r\n" + b"x: y\r\n" * (1 << 22),
        b"GET / HTTP/1.1\r\n" + b"a:\r\n" * (connections.HEADERS_MOST + 1) + b"z" * (1 << 25),
        b"GET / HTTP/1.1\r\nx: " + b"y" * (1 << 25),
        b"GET /?" + b"a&" * (1 << 24),
        b"GET / HTTP/1.1\r\n" + b"z" * (1 << 25),
        b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 99999999\r\n\r\n"
        + b"z" * (1 << 25),
    )

    async def flooded() -> None:
        async with served(make_node(flown=False), "secret") as port:
            for flood in floods:
                client = await connected(port)
                client[1].write(flood)
                assert await ends(client)
                # Bytes still in the kernel at the cut: far fewer than were sent.
                left = client[1].transport.get_write_buffer_size()
                assert left > len(flood) / 2 or client[1].transport.is_closing()
            assert await asked(await connected(port)) == b"HTTP/1.1 200 OK\r\n"

    run_async(flooded())


@pytest.mark.parametrize(
    "half", [b"", b"G", b"GET / HTTP/1.1\r\nHost: ", REQUEST + b"GET /half"], ids=repr
)
def test_unfinished_request_head_times_out(
    make_node: Any, monkeypatch: pytest.MonkeyPatch, half: bytes
) -> None:
    """Slowly trickling bytes do not extend the timeout."""
    monkeypatch.setattr(connections, "HEAD_S", 0.3)

    async def half_sent() -> None:
        async with served(make_node(flown=False)) as port:
            reader, writer = await connected(port)
            writer.write(half)
            ended = asyncio.ensure_future(ends((reader, writer)))
            while not ended.done():
                await asyncio.wait([ended], timeout=0.05)
                if half and not writer.transport.is_closing():
                    writer.write(b"x")

    run_async(half_sent())


def test_idle_connections_do_not_block_new_ones(
    make_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The longest idle connection is closed."""
    monkeypatch.setattr(connections, "most_connections", lambda: 20)

    async def crowded() -> None:
        async with served(make_node()) as port:
            idle = [await connected(port) for _ in range(60)]
            assert await asked(await connected(port)) == b"HTTP/1.1 200 OK\r\n"
            gone = [asyncio.ensure_future(ends(client)) for client in idle]
            await asyncio.wait(gone[:40], timeout=HANG_S)
            assert all(one.done() for one in gone[:40])
            assert not any(one.done() for one in gone[42:])
            for task in gone:
                task.cancel()

    run_async(crowded())


# --- host names -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1:8080", 200), ("localhost:8080", 200), ("LocalHost", 200), ("[::1]:8080", 200),
        ("192.168.1.7:8080", 200), (f"{socket.gethostname()}:8080", 200), ("mast.example", 200),
        ("Mast.Example.:443", 200), ("evil.example", 421), ("evil.example:8080", 421),
        ("127.0.0.1.evil.example", 421), ("localhost.evil.example", 421), ("", 421), ("[", 421),
        ("127.0.0.1@evil.example", 421), ("[::1].evil.example", 421),
    ],
)  # fmt: skip
def test_only_known_host_names_are_answered(make_node: Any, host: str, status: int) -> None:
    """A page whose name resolves to this machine (DNS rebinding) sends its own name in Host."""
    node = make_node(flown=False, server={"hosts": ["Mast.example"]})
    with TestClient(create_app(node)) as client:
        assert client.get("/v1/uavs", headers={"host": host}).status_code == status


def test_stream_under_an_unknown_host_name_is_rejected(make_node: Any) -> None:
    async def streamed() -> None:
        async with served(make_node()) as port:
            address = f"ws://127.0.0.1:{port}/v1/stream"
            evil = f"evil.example:{port}"
            origin = websockets.Origin(f"http://{evil}")
            with pytest.raises(websockets.InvalidStatus, match="HTTP 403"):
                async with websockets.connect(
                    f"ws://{evil}/v1/stream", host="127.0.0.1", port=port, origin=origin
                ):
                    pass
            async with websockets.connect(address) as stream:
                assert await asyncio.wait_for(stream.recv(), HANG_S)

    run_async(streamed())


def test_stream_limit_leaves_connections_for_requests(
    make_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.server.stream.CLIENTS_MAX", 1)

    async def streamed() -> None:
        async with served(make_node()) as port:
            address = f"ws://127.0.0.1:{port}/v1/stream"
            async with websockets.connect(address) as one, websockets.connect(address) as other:
                assert await asyncio.wait_for(one.recv(), HANG_S)
                with pytest.raises(websockets.ConnectionClosed, match="too many streams are open"):
                    await asyncio.wait_for(other.recv(), HANG_S)
            async with websockets.connect(address) as again:
                assert await asyncio.wait_for(again.recv(), HANG_S)

    run_async(streamed())


@pytest.mark.parametrize("scheme", ["Bearer", "bearer", "BEARER"])
def test_bearer_scheme_is_case_insensitive(make_node: Any, scheme: str) -> None:
    client = TestClient(create_app(make_node(flown=False), "S3cret"), "http://localhost")
    good = client.get("/v1/uavs", headers={"authorization": f"{scheme} S3cret"})
    wrong = client.get("/v1/uavs", headers={"authorization": f"{scheme} s3CRET"})
    other = client.get("/v1/uavs", headers={"authorization": "Basic S3cret"})
    assert [good.status_code, wrong.status_code, other.status_code] == [200, 401, 401]


def test_host_name_is_checked_before_the_token(make_node: Any) -> None:
    client = TestClient(create_app(make_node(flown=False), "secret"), "http://evil.example")
    assert client.get("/v1/uavs").status_code == 421


# --- requests -------------------------------------------------------------------------------------


def test_excess_work_is_rejected_with_503(make_node: Any) -> None:
    async def crowd() -> list[str]:
        work_slots, begun, free = WorkSlots(at_once=2, waiting=3), [], asyncio.Event()
        loop = asyncio.get_running_loop()

        def work() -> str:
            begun.append(None)
            asyncio.run_coroutine_threadsafe(free.wait(), loop).result(HANG_S)
            assert len(begun) <= 2 or free.is_set()
            return "done"

        tasks = [asyncio.create_task(work_slots.run(work)) for _ in range(9)]
        refused = [task async for task in _first(tasks, 4)]
        free.set()
        rest = await asyncio.gather(*(task for task in tasks if task not in refused))
        assert await work_slots.run(lambda: "again") == "again"
        return [*(str(task.exception()) for task in refused), *rest]

    told = run_async(crowd())
    assert told == ["503: too many requests at once"] * 4 + ["done"] * 5


async def _first(tasks: list["asyncio.Task[str]"], many: int) -> AsyncIterator["asyncio.Task[str]"]:
    waiting: set[asyncio.Task[str]] = set(tasks)
    found = 0
    while found < many:
        done, waiting = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            found += 1
            yield task


def test_oversized_pattern_request_is_rejected(
    make_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = make_node()
    node.tick(0.0)
    with TestClient(create_app(node), "http://localhost") as client:
        assert client.get("/v1/pattern?points=3601").status_code == 200
        monkeypatch.setattr("companion.server.beam_routes.ANGLES_MAX", 14_000)
        told = client.get("/v1/pattern?points=3600")
        assert told.status_code == 422
        assert (
            told.json()["title"] == "too large: 4 beams at 3600 angles; give uav, or fewer points"
        )
        assert client.get("/v1/pattern?points=3601&uav=1:1").status_code == 200


def test_codebook_work_is_bounded(
    make_node: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """For any number of elements and stored beams; counted in products, not in seconds."""
    node = make_node(array={"kind": "ura", "rows": 16, "columns": 16}, codebook={"kind": "dft"})
    node.tick(0.0)
    work = list[int]()
    best, contest = codebooks._best, codebooks._possible_beams

    def counted_best(codebook: Any, array: Any, unit: Any) -> Any:
        work.append(codebook.weights.size * len(unit))
        return best(codebook, array, unit)

    def counted_contest(cones: Any, boxes: Any, weights: Any) -> Any:
        work.append(weights.size * len(boxes.cone))
        return contest(cones, boxes, weights)

    monkeypatch.setattr(codebooks, "_best", counted_best)
    monkeypatch.setattr(codebooks, "_possible_beams", counted_contest)
    told = _codebook_answers(node)
    spent = sum(work)
    monkeypatch.setattr(codebooks, "TERMS_MAX", 2**20)
    monkeypatch.setattr(codebooks, "FIRST_TERMS_MAX", 2**22)
    monkeypatch.setattr(beam_state, "RESPONSES_MAX", 2**20)
    work.clear()
    less = _codebook_answers(node)
    assert sum(work) < spent / 4
    for wide, narrow in zip(less, told, strict=True):
        assert wide["best"] == narrow["best"]
        assert set(wide["candidates"]) >= set(narrow["candidates"])  # still proven


def _codebook_answers(node: Any) -> list[dict[str, Any]]:
    update = node.pipeline.last_update
    shown = beam_state.beams(node.pipeline, node.equipment, update, age_s=0.0, lead_ms=0.0)
    return [beam["codebook"] for beam in shown["beams"]]


def test_oversized_codebook_is_rejected() -> None:
    def array(side: int) -> Array:
        return assembly.array(
            Settings().override(array={"kind": "ura", "rows": side, "columns": side})
        )

    with pytest.raises(UserError, match="16777216 weights, allowed: at most 4194304"):
        codebooks.dft(array(64))
    assert codebooks.dft(array(32), 2).size == 4096


def test_history_is_limited_to_five_minutes(make_node: Any) -> None:
    node = make_node()
    kept = Series()
    for _ in range(SAMPLES + 50):
        node.tick(1.0)
        kept.add(node.pipeline)
    samples = kept.samples()
    newest_ns = node.pipeline.last_update.t_ns
    assert [t_ns for t_ns, _ in samples] == [
        newest_ns - (SAMPLES - 1 - i) * 1_000_000_000 for i in range(SAMPLES)
    ]
    said = encode(series.show(samples, newest_ns, UtcNs))
    node.tick(1.0)
    kept.add(node.pipeline)  # the snapshot for another thread is unchanged
    assert said == encode(series.show(samples, newest_ns, UtcNs))
    shown = json.loads(said)
    assert len(shown["at"]) == SAMPLES == 300
    columns = [column for uav in shown["uavs"].values() for column in uav.values()]
    assert columns and all(len(column) == SAMPLES for column in columns)
    values = [value for column in columns for value in column if isinstance(value, float)]
    assert values and np.isfinite(values).all()


def test_history_of_many_uavs_is_limited_to_those_with_beams_first(
    make_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(series, "UAVS_MAX", 2)
    node = make_node()
    node.tick()
    update = node.pipeline.last_update
    kept, (*rest, last) = Series(), update.beams.beams
    assert len(rest) >= 2
    monkeypatch.setattr(
        node.pipeline, "last_update", replace(update, beams=replace(update.beams, beams=(last,)))
    )
    kept.add(node.pipeline)
    ((_, sample),) = kept.samples()
    assert len(sample.uavs) == 2 and next(iter(sample.uavs)) == last.uav
    assert len(sample.positions_ned_m) == 3
    positions = {one.uav: one.position_ned_m for one in update.tracks}
    assert sample.positions_ned_m[0] == pytest.approx(positions[last.uav])
    monkeypatch.undo()
    node.tick(1.0)
    kept.add(node.pipeline)
    shown = series.show(kept.samples(), 0, UtcNs, most=3)
    assert len(shown["uavs"]) == 3 and set(sample.uavs) < set(shown["uavs"])


def test_history_is_made_once_for_each_sample(
    make_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, show = [], series.show

    def counted(*given: Any, **named: Any) -> Any:
        made.append(None)
        return show(*given, **named)

    monkeypatch.setattr("companion.views.series.show", counted)
    node = make_node()
    node.series.add(node.pipeline)
    with TestClient(create_app(node)) as client:
        first = client.get("/v1/history").json()
        assert client.get("/v1/history").json() == first and len(made) == 1
        assert client.get("/v1/history?rounded=true").json() != first and len(made) == 2
        node.tick(1.0)
        node.series.add(node.pipeline)
        assert len(client.get("/v1/history").json()["at"]) == len(first["at"]) + 1


def test_slot_rests_after_long_work_only() -> None:
    """Else threads that compute take the interpreter from the links all the time."""

    async def ask(work_s: float, *, is_shared: bool = False, is_overloaded: bool = False) -> float:
        loop = asyncio.get_running_loop()
        slots, ended_s, begun_s = work_slots.WorkSlots(at_once=1), list[float](), list[float]()

        def work() -> None:
            begun_s.append(loop.time())
            time.sleep(work_s)
            ended_s.append(loop.time())

        slots.is_overloaded = lambda: is_overloaded
        await slots.run(work, is_shared=is_shared)
        async with slots.slot(is_long=not is_shared, is_shared=is_shared):
            begun_s.append(loop.time())
        assert slots.running == 0
        return begun_s[1] - ended_s[0]

    long_s = work_slots.RESTS_FROM_S * 2
    assert run_async(ask(long_s)) >= work_slots.REST * long_s * 0.99
    assert run_async(ask(long_s, is_shared=True)) >= work_slots.REST_SHARED * long_s * 0.99
    rest_s = run_async(ask(long_s, is_shared=True, is_overloaded=True))
    assert rest_s >= work_slots.REST * long_s * 0.99
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(work_slots, "REST_MAX_S", 0.0)
        assert run_async(ask(long_s, is_overloaded=True)) >= work_slots.REST * long_s * 0.99
        patch.setattr(work_slots, "REST", 1e6)
        patch.setattr(work_slots, "REST_MAX_S", 2 * long_s)
        assert run_async(ask(long_s)) < HANG_S
        patch.setattr(work_slots, "RESTS_FROM_S", HANG_S)
        assert run_async(ask(0.0)) < HANG_S


def test_slot_that_rests_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither with the event loop of its work, nor with a request that stops waiting for it."""
    monkeypatch.setattr(work_slots, "RESTS_FROM_S", 0.0)
    monkeypatch.setattr(work_slots, "REST", 1e6)
    monkeypatch.setattr(work_slots, "REST_MAX_S", 0.3)
    slots = work_slots.WorkSlots(at_once=1)

    async def impatient() -> None:
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(slots.run(lambda: None), 0.01)

    begun_s = time.monotonic()
    run_async(slots.run(lambda: None))
    run_async(impatient())
    run_async(asyncio.wait_for(slots.run(lambda: None), HANG_S))
    assert time.monotonic() - begun_s > 0.3  # the rest begins with the end of the first work


def test_history_is_built_off_the_event_loop(
    make_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    import threading

    seen = list[str]()

    def told(*_: object, **__: object) -> dict[str, Any]:
        seen.append(threading.current_thread().name)
        return {}

    monkeypatch.setattr("companion.views.series.show", told)

    async def ask() -> None:
        async with served(make_node()) as port:
            request = b"GET /v1/history HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
            assert await asked(await connected(port), request) == b"HTTP/1.1 200 OK\r\n"

    run_async(ask())
    assert seen and threading.current_thread().name not in seen
