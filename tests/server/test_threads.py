"""Threads for answers: results and errors reach the caller, and none outlives the service."""

import asyncio
import subprocess
import sys
import threading

import pytest
from support import HANG_S, run_async

from companion.server.threads import Threads, in_thread

SLEEPER = """
import asyncio, time
from companion.server.threads import in_file_thread, in_thread

async def main():
    begun = asyncio.Event()
    loop = asyncio.get_running_loop()
    for run in (in_thread, in_file_thread):
        begun.clear()
        work = lambda: (loop.call_soon_threadsafe(begun.set), time.sleep(%d))
        task = asyncio.create_task(run(work))
        await begun.wait()
        task.cancel()

asyncio.run(main())
"""


def test_process_does_not_wait_for_an_answer() -> None:
    """Its client has gone; the thread would compute for a minute."""
    command = [sys.executable, "-c", SLEEPER % (10 * HANG_S)]
    assert subprocess.run(command, check=False, timeout=HANG_S).returncode == 0


def test_results_and_errors_reach_the_caller() -> None:
    async def check() -> None:
        assert await in_thread(divmod, 7, 2) == (3, 1)
        with pytest.raises(ZeroDivisionError):
            await in_thread(divmod, 7, 0)

    run_async(check())


def test_shortage_of_threads_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """A limit of processes: what cannot be computed then can be afterwards."""

    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    async def check() -> None:
        threads = Threads(2, "test")
        with monkeypatch.context() as patch:
            patch.setattr(threading.Thread, "start", refuse)
            for _ in range(3):
                with pytest.raises(RuntimeError, match="new thread"):
                    threads.submit(lambda: None)
        assert await asyncio.wrap_future(threads.submit(lambda: 3)) == 3
        gate = threading.Event()
        held = asyncio.wrap_future(threads.submit(lambda: gate.wait(HANG_S)))
        with monkeypatch.context() as patch:
            patch.setattr(threading.Thread, "start", refuse)
            later = asyncio.wrap_future(threads.submit(lambda: 4))
        assert threads._started == 1
        gate.set()
        assert await later == 4 and await held

    run_async(check())


def test_calls_wait_for_a_free_thread() -> None:
    """Threads are started as needed, and used again."""

    async def check() -> None:
        threads, gate, inside = Threads(3, "test"), threading.Event(), list[str]()

        def work() -> None:
            inside.append(threading.current_thread().name)
            gate.wait(HANG_S)

        for _ in range(5):
            await asyncio.wrap_future(threads.submit(lambda: None))
        assert threads._started == 1
        calls = [asyncio.wrap_future(threads.submit(work)) for _ in range(7)]
        while len(inside) < 3:
            await asyncio.sleep(0.001)
        assert threads._started == 3 and len(set(inside)) == 3
        gate.set()
        await asyncio.gather(*calls)
        assert len(inside) == 7 and threads._started == 3

    run_async(check())
