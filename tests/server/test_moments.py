"""Requests for the same moment share one computation; no response is outdated."""

import asyncio
import threading
from collections.abc import Callable
from typing import Any

import pytest
from starlette.exceptions import HTTPException

from companion.server.moments import EVERY_NS, Moments
from companion.server.work_slots import WorkSlots
from companion.values import Update

pytestmark = pytest.mark.anyio


@pytest.fixture
def moments(shared_node: Any, monkeypatch: pytest.MonkeyPatch) -> Moments:
    shared_node.looks = []
    prepare_update = shared_node.pipeline.prepare_update

    def counted(now_ns: int, lead_s: float = 0.0) -> Callable[[], Update]:
        made = prepare_update(now_ns, lead_s)

        def counted_too() -> Update:
            shared_node.looks.append(threading.current_thread())
            found: Update = made()
            return found

        return counted_too

    monkeypatch.setattr(shared_node.pipeline, "prepare_update", counted)
    return Moments(shared_node, WorkSlots())


async def test_concurrent_requests_share_one_response(moments: Moments, shared_node: Any) -> None:
    made: list[int] = []

    def make(update: Update) -> int:
        made.append(update.beams.valid_at_ns)
        return update.beams.valid_at_ns

    found = await asyncio.gather(*(moments.made(20.0, "npy", make) for _ in range(50)))
    assert len(made) == len(shared_node.looks) == 1
    delay_ns, now_ns = 10_000_000, shared_node.now_ns()
    assert set(found) == set(made)
    assert 0 <= made[0] - delay_ns - now_ns - 20_000_000 < EVERY_NS
    await moments.made(20.0, "json", make)
    assert (len(made), len(shared_node.looks)) == (2, 1)  # other values of the same beams
    await moments.made(30.0, "npy", make)
    assert (len(made), len(shared_node.looks)) == (3, 2)


async def test_next_period_is_computed_again(
    moments: Moments, shared_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = await moments.made(0.0, "beams", lambda update: update)
    assert await moments.made(0.0, "others", lambda update: update) is first
    later_ns = shared_node.now_ns() + EVERY_NS
    monkeypatch.setattr(shared_node, "now_ns", lambda: later_ns)
    second = await moments.made(0.0, "beams", lambda update: update)
    assert second.beams.valid_at_ns - first.beams.valid_at_ns == EVERY_NS


async def test_beams_are_computed_off_the_event_loop(moments: Moments, shared_node: Any) -> None:
    """For any number of leads: the computations are queued."""
    await asyncio.gather(*(moments.made(lead, "npy", lambda update: update) for lead in range(20)))
    assert len(shared_node.looks) == 20
    assert threading.current_thread() not in shared_node.looks


async def test_rejected_request_costs_no_prediction(
    shared_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_node.pipeline, "prepare_update", lambda *_: pytest.fail("predicted"))
    with pytest.raises(HTTPException) as refused:
        await Moments(shared_node, WorkSlots(0, 0)).made(0.0, "npy", lambda update: update)
    assert refused.value.status_code == 503


async def test_usual_answer_does_not_wait_for_others(shared_node: Any) -> None:
    full = Moments(shared_node, WorkSlots(0, 0))
    found = await full.made(0.0, "beams", lambda update: update, is_usual=True)
    assert isinstance(found, Update)
    for lead_ms, is_usual in ((1.0, True), (0.0, False)):
        with pytest.raises(HTTPException, match="too many requests"):
            await full.made(lead_ms, "other", lambda update: update, is_usual=is_usual)


async def test_requests_that_wait_for_a_slot_share_one_answer_of_a_later_moment(
    moments: Moments, shared_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else each moment queued work of its own, and answers came ever later."""
    begun, go_on, made = asyncio.Event(), threading.Event(), []
    loop, now_ns = asyncio.get_running_loop(), shared_node.now_ns()
    monkeypatch.setattr(shared_node, "now_ns", lambda: now_ns)

    def make(update: Update) -> int:
        made.append(update.beams.valid_at_ns)
        loop.call_soon_threadsafe(begun.set)
        assert go_on.wait(60)
        return update.beams.valid_at_ns

    asked = [asyncio.create_task(moments.made(0.0, "beams", make, is_usual=True))]
    await asyncio.wait_for(begun.wait(), 60)
    for _ in range(5):
        now_ns += EVERY_NS
        asked.append(asyncio.create_task(moments.made(0.0, "beams", make, is_usual=True)))
        await asyncio.sleep(0)
    go_on.set()
    first, *rest = await asyncio.gather(*asked)
    assert made == [first, first + 5 * EVERY_NS] and set(rest) == {first + 5 * EVERY_NS}


async def test_cancelled_request_does_not_cancel_shared_work(moments: Moments) -> None:
    begun, go_on = asyncio.Event(), threading.Event()
    loop = asyncio.get_running_loop()

    def make(_update: Update) -> str:
        loop.call_soon_threadsafe(begun.set)
        assert go_on.wait(60)
        return "made"

    leaves = asyncio.create_task(moments.made(0.0, "npy", make))
    await asyncio.wait_for(begun.wait(), 60)
    stays = asyncio.create_task(moments.made(0.0, "npy", make))
    await asyncio.sleep(0)
    leaves.cancel()
    go_on.set()
    assert await asyncio.wait_for(stays, 60) == "made"
    assert leaves.cancelled() or leaves.cancelling()


async def test_error_reaches_every_waiting_request(moments: Moments) -> None:
    def make(_update: Update) -> None:
        raise ValueError("not so")

    for _ in range(2):
        with pytest.raises(ValueError, match="not so"):
            await moments.made(0.0, "npy", make)
