"""No piece of work holds the event loop for long: a watchdog in the service names those that do.

Measured is the processor time of the event loop's thread in each callback, as other processes would
add to wall-clock time.
"""

import json
import signal
import subprocess
from pathlib import Path
from typing import Any, Final

import pytest
from support import BIN, HANG_S, run_async, started
from websockets.asyncio.client import connect

UAVS: Final = 20
HELD_S: Final = 0.002  # longest processor time of a callback on the event loop
RARE: Final = 0.01  # share of a callback's calls that may take longer: collections of garbage
TRIES: Final = 3  # measurements, of which one must be good: other processes evict caches
UPDATES: Final = 60
RUN: Final = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "5:1")
WATCHED: Final = """
import asyncio, atexit, json, signal, sys, threading, time
from companion.node import serving
serving._loop_factory = lambda: None  # uvloop's callbacks cannot be watched
into, main, run, took_s = sys.argv.pop(1), threading.get_ident(), asyncio.Handle._run, {}
watched = []

def name(callback):
    task = getattr(callback, "__self__", None)
    if isinstance(task, asyncio.Task):
        return f"task {task.get_coro().__qualname__}"
    return getattr(callback, "__qualname__", repr(callback))

def timed(handle):
    if not watched or threading.get_ident() != main:
        return run(handle)
    called, began_s = name(handle._callback), time.thread_time()
    run(handle)
    took_s.setdefault(called, []).append(time.thread_time() - began_s)

def write():
    watched.clear()
    with open(into, "w") as file:
        json.dump(took_s, file)

asyncio.Handle._run = timed
signal.signal(signal.SIGUSR1, lambda *_: watched.append(True))
atexit.register(write)
from companion.cli.main import main as command
command()
"""
"""A service that writes the processor times of its event loop's callbacks, from SIGUSR1 on."""


def offenders(into: Path) -> dict[str, str]:
    """Callbacks of which more than ``RARE`` took longer than ``HELD_S``, with how long."""
    found = dict[str, str]()
    for name, took_s in json.loads(into.read_text()).items():
        allowed = sorted(took_s)[int((1 - RARE) * (len(took_s) - 1))]
        if allowed > HELD_S:
            found[name] = f"{allowed * 1e3:.1f} ms, {len(took_s)} calls"
    return found


async def attend(node: Any, updates: int) -> None:
    """Read the stream that a page reads, for some updates, and ask for all answers meanwhile."""
    address = node.url.replace("http", "ws") + "/v1/stream?topic=uavs&topic=beams"
    async with connect(address, max_size=None) as stream:
        for number in range(updates):
            await stream.recv()
            if number % 10 == 0:
                for path in ("/v1/uavs", "/v1/beams/weights", "/v1/status", "/v1/links"):
                    assert node.get(path)[0] == 200


def watch(start_node: Any, into: Path, uavs: int) -> dict[str, str]:
    """Fly UAVs towards a recorded service with a client, and return what held its event loop."""
    node = start_node(str(into), *RUN, "--record", str(into.parent), code=WATCHED)
    to = f"udpout:127.0.0.1:{node.udp_port}"
    flight = [str(BIN / "sitl-replay"), "fly", "waypoints", "--uavs", str(uavs), "--to", to]
    with started(flight, stdout=subprocess.DEVNULL):
        node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == uavs)
        node.process.send_signal(signal.SIGUSR1)
        run_async(attend(node, UPDATES))
        node.process.send_signal(signal.SIGINT)
        node.process.wait(HANG_S)
    return offenders(into)


@pytest.mark.xdist_group("live")
def test_no_callback_holds_the_event_loop(start_node: Any, tmp_path: Path) -> None:
    found = dict[str, str]()
    for number in range(TRIES):
        found = watch(start_node, tmp_path / f"{number}.json", UAVS)
        if not found:
            return
    assert found == {}


def test_a_callback_that_holds_the_event_loop_is_named(tmp_path: Path) -> None:
    took_s = {"quick": [0.001] * 100, "rarely slow": [0.001] * 199 + [0.03], "slow": [0.003] * 5}
    (tmp_path / "x.json").write_text(json.dumps(took_s))
    assert offenders(tmp_path / "x.json") == {"slow": "3.0 ms, 5 calls"}
