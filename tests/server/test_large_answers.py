"""Answers about many UAVs: the same as about a few, shared, off the event loop."""

import asyncio
import json
import threading
from typing import Any

import pytest
from http_support import served
from hypothesis import given
from hypothesis import strategies as st
from starlette.exceptions import HTTPException
from starlette.testclient import TestClient
from support import HANG_S
from websockets.asyncio.client import connect

from companion.server import giving_way, large_answers
from companion.server.app import create_app
from companion.server.giving_way import NEVER, PAUSES_MAX, GivingWay
from companion.server.large_answers import LargeAnswers
from companion.server.responses import PIECE_BYTES, encode, encode_in_parts
from companion.server.shared_work import SharedWork
from companion.server.websocket_connections import FRAGMENT_CHARS
from companion.server.work_slots import WorkSlots

pytestmark = pytest.mark.anyio

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


@given(VALUES, st.integers(0, 4))
def test_json_in_parts_is_the_same(value: Any, depth: int) -> None:
    assert encode_in_parts(value, NEVER, depth) == encode(value)


@pytest.mark.parametrize("path", ["/v1/uavs", "/v1/design", "/v1/links", "/v1/fleet", "/metrics"])
def test_many_uavs_are_answered_as_a_few(
    shared_node: Any, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    client = TestClient(create_app(shared_node))
    few = client.get(path).content
    monkeypatch.setattr(large_answers, "FEW_UAVS", 0)
    monkeypatch.setattr("companion.server.app.FEW_ITEMS", -1)
    many = client.get(path).content
    if path == "/metrics":  # those of the process change
        few, many = few.partition(b"process_")[0], many.partition(b"process_")[0]
    assert many == few
    assert len(few) > 100


def test_long_bodies_are_sent_whole(make_node: Any) -> None:
    node = make_node()
    for number in range(2000):
        node.say(f"{number} " + "ä" * 50)
    client = TestClient(create_app(node), headers={"accept-encoding": "identity"})
    answer = client.get("/v1/events")
    assert len(answer.content) > 2 * PIECE_BYTES
    assert int(answer.headers["content-length"]) == len(answer.content)
    assert len(answer.json()["events"]) == len(node.notices)
    assert client.head("/v1/events").headers["content-length"] == str(len(answer.content))


async def test_long_messages_arrive_whole(make_node: Any) -> None:
    node = make_node()
    for number in range(2000):
        node.say(f"{number} " + "ä" * 50)
    async with served(node) as port:
        address = f"ws://127.0.0.1:{port}/v1/stream?topic=events"
        async with connect(address, max_size=None) as websocket:
            text = str(await asyncio.wait_for(websocket.recv(), HANG_S))
    assert len(text) > 2 * FRAGMENT_CHARS
    assert len(json.loads(text)["events"]) == len(node.notices)


@pytest.fixture
def large(shared_node: Any, monkeypatch: pytest.MonkeyPatch) -> LargeAnswers:
    monkeypatch.setattr(large_answers, "FEW_UAVS", 0)
    return LargeAnswers(shared_node, WorkSlots())


async def test_eight_clients_share_two_computations(large: LargeAnswers) -> None:
    """The first one begins at once; all who ask while it runs share the next one."""
    threads = list[threading.Thread]()

    def prepare(_overview: Any) -> Any:
        return lambda _way: threads.append(threading.current_thread())

    first = asyncio.create_task(large.of_uavs("answer", prepare))
    await asyncio.sleep(0)
    await asyncio.gather(first, *(large.of_uavs("answer", prepare) for _ in range(7)))
    assert len(threads) == 2
    assert threading.current_thread() not in threads


async def test_excess_answers_are_refused_before_any_work(
    shared_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(large_answers, "FEW_UAVS", 0)
    large = LargeAnswers(shared_node, WorkSlots(0, 0))
    with pytest.raises(HTTPException) as refused:
        await large.of_uavs("answer", lambda _: pytest.fail("prepared"))
    assert refused.value.status_code == 503
    assert refused.value.headers == {"retry-after": "1"}


async def test_stream_continues_after_a_refusal(
    make_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A message that finds the work slots full is left out; the next one is sent."""
    monkeypatch.setattr(large_answers, "FEW_UAVS", 0)
    node, slots, refused = make_node(), WorkSlots(), asyncio.Event()
    refuse_if_full = slots.refuse_if_full

    def full(**_: bool) -> None:
        refused.set()
        raise HTTPException(503)

    monkeypatch.setattr(slots, "refuse_if_full", full)
    monkeypatch.setattr("companion.node.serving.WorkSlots", lambda: slots)
    async with served(node) as port:
        address = f"ws://127.0.0.1:{port}/v1/stream?topic=uavs&rate_hz=100"
        async with connect(address, max_size=None) as websocket:
            await asyncio.wait_for(refused.wait(), HANG_S)
            monkeypatch.setattr(slots, "refuse_if_full", refuse_if_full)
            receiving = asyncio.create_task(websocket.recv())
            while not receiving.done():
                node.tick()
                await asyncio.wait([receiving], timeout=0.02)
            assert json.loads(receiving.result())["topic"] == "uavs"


async def test_overview_is_read_again_after_a_change_of_the_local_frame(
    large: LargeAnswers, shared_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    center, frames = shared_node.pipeline.center, [shared_node.pipeline.local]
    read = large_answers.uav_state.known_uavs
    calls = 0

    def reanchored(*args: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == 1:
            monkeypatch.setattr(center, "local", object())
        else:
            monkeypatch.setattr(center, "local", frames[0])
        return read(*args)

    monkeypatch.setattr(large_answers.uav_state, "known_uavs", reanchored)
    overview = await large.of_uavs("answer", lambda overview: lambda _: overview)
    assert overview.local is frames[0]
    assert calls > 1


async def test_work_begins_after_the_call_that_gets_it() -> None:
    shared, may_end, begun = SharedWork(), asyncio.Event(), list[int]()

    async def work() -> int:
        begun.append(len(begun))
        number = begun[-1]
        await may_end.wait()
        return number

    first = asyncio.create_task(shared.run("work", work))
    await asyncio.sleep(0.01)
    later = [asyncio.create_task(shared.run("work", work)) for _ in range(5)]
    other = asyncio.create_task(shared.run("other", work))
    await asyncio.sleep(0.01)
    assert len(begun) == 2  # the first, and the one of another kind
    later[0].cancel()
    may_end.set()
    assert await asyncio.wait_for(first, HANG_S) == 0
    assert await asyncio.wait_for(other, HANG_S) == 1
    assert await asyncio.wait_for(asyncio.gather(*later[1:]), HANG_S) == [2] * 4
    assert await asyncio.wait_for(shared.run("work", work), HANG_S) == 3


async def test_error_reaches_all_who_share_work_and_no_one_later() -> None:
    shared, fails = SharedWork(), True

    async def work() -> str:
        await asyncio.sleep(0)
        if fails:
            raise ValueError("not so")
        return "made"

    found = await asyncio.gather(
        *(shared.run("work", work) for _ in range(3)), return_exceptions=True
    )
    assert [str(one) for one in found] == ["not so"] * 3
    fails = False
    assert await shared.run("work", work) == "made"


def test_thread_pauses_while_beams_are_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    busy, slept = [True] * 3 + [False], list[float]()
    monkeypatch.setattr(giving_way.time, "sleep", slept.append)
    monkeypatch.setattr(giving_way, "TURN_S", HANG_S)
    way = GivingWay(lambda: busy.pop(0) if len(busy) > 1 else busy[0])
    assert list(way.between("ab")) == ["a", "b"]
    assert slept == [giving_way.TURN_PAUSE_S] + [giving_way.PAUSE_S] * 3
    slept.clear()
    GivingWay(lambda: True).pause()  # beams that never end stop no answer
    assert slept.count(giving_way.PAUSE_S) == PAUSES_MAX


@pytest.mark.parametrize(("is_overloaded", "longer"), [(False, 1), (True, giving_way.OVERLOADED)])
def test_answer_is_computed_in_turns(
    monkeypatch: pytest.MonkeyPatch, is_overloaded: bool, longer: int
) -> None:
    """A thread pauses after each turn, for the event loop; longer while the links are late."""
    slept, now_s = list[float](), [0.0]
    monkeypatch.setattr(giving_way.time, "sleep", slept.append)
    monkeypatch.setattr(giving_way.time, "thread_time", lambda: now_s[0])
    way = GivingWay(lambda: False, is_overloaded=is_overloaded)
    for _ in way.between(range(100)):
        now_s[0] += giving_way.TURN_S / 10
    assert slept == [giving_way.TURN_PAUSE_S * longer] * 10
