"""Calls from threads executed on the event loop: in order, and in limited batches."""

import asyncio
import time

from support import run_async

from companion.mavlink.links import to_loop
from companion.mavlink.links.to_loop import ToLoop

CALLS = 20
EACH_S = to_loop.SLICE_S / 2


def test_queued_calls_do_not_starve_the_event_loop() -> None:
    """Limited by time, because the cost of a call is unknown."""
    made: list[int] = []
    seen: list[int] = []

    async def test() -> None:
        calls = ToLoop(asyncio.get_running_loop())
        over = asyncio.Event()
        for number in range(CALLS):
            calls.post(lambda number=number: (time.sleep(EACH_S), made.append(number)))
        calls.post(over.set)

        async def beside() -> None:
            while not over.is_set():
                seen.append(len(made))
                await asyncio.sleep(0)

        await asyncio.gather(beside(), over.wait())
        assert calls.handed_over == CALLS + 1

    run_async(test())
    assert made == list(range(CALLS))
    assert len(set(seen)) > CALLS / 5


def test_call_posted_after_draining_is_executed() -> None:
    made: list[str] = []

    async def test() -> None:
        loop = asyncio.get_running_loop()
        calls = ToLoop(loop)
        for text in ("one", "two"):
            done = asyncio.Event()
            calls.post(lambda text=text: made.append(text))
            await asyncio.to_thread(calls.post, done.set)
            await done.wait()
        calls.post(calls.end)
        calls.post(lambda: made.append("never"))
        await asyncio.sleep(0)
        await asyncio.sleep(0)

    run_async(test())
    assert made == ["one", "two"]


def test_queued_bytes_are_bounded() -> None:
    """20 000 samples of 4 MB would be 80 GB."""
    made: list[int] = []

    async def test() -> None:
        calls = ToLoop(asyncio.get_running_loop())
        quarter = to_loop.BYTES_MAX // 4
        for _ in range(2):
            for number in range(6):
                calls.post(lambda number=number: made.append(number), quarter)
            done = asyncio.Event()
            calls.post(done.set)
            await done.wait()
        assert calls.dropped == 4

    run_async(test())
    assert made == [0, 1, 2, 3] * 2


def test_unfinished_call_is_made_again_while_other_work_runs() -> None:
    made: list[int] = []
    seen: set[int] = set()

    async def test() -> None:
        calls = ToLoop(asyncio.get_running_loop())
        over = asyncio.Event()

        def unfinished() -> bool:
            time.sleep(to_loop.SLICE_S)
            made.append(len(made))
            return len(made) < CALLS

        calls.post(unfinished)
        calls.post(over.set)

        async def beside() -> None:
            while not over.is_set():
                seen.add(len(made))
                await asyncio.sleep(0)

        await asyncio.gather(beside(), over.wait())
        assert calls.handed_over == 2

    run_async(test())
    assert len(made) == CALLS
    assert len(seen) > CALLS / 2
