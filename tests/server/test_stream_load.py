"""Many stream clients, some of which never read: others are not affected."""

import asyncio
import re
import subprocess
import time
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from support import BIN, HANG_S, Node, run_async, started
from websockets.asyncio.client import connect

SETTINGS = "[beams]\nupdate_hz = 20\n"
RUN = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "5:1")
QUERY = "/v1/stream?topic=uavs&topic=beams&rate_hz=10"
FRESH_S = 0.2
MEMORY_BYTES = 60e6
"""Memory for 200 connections and their buffers, without a queue of messages."""

MEMORY = "process_resident_memory_bytes"
CPU = "process_cpu_seconds_total"
SENT = "companion_stream_messages_total"


def lag(node: Node) -> list[tuple[float, float]]:
    """Return the bucket bounds in seconds of the event loop's lag histogram, and its counts."""
    text = node.get("/metrics")[1].decode()
    found = re.findall(r'companion_event_loop_lag_seconds_bucket{le="(.*?)"} (\S+)', text)
    return [(float(end), float(count)) for end, count in found]


def p99_s(before: list[tuple[float, float]], after: list[tuple[float, float]]) -> float:
    """Return the upper bound of the bucket that holds the 99th percentile."""
    counts = [b - a for (_, a), (_, b) in zip(before, after, strict=True)]
    return next(
        end for (end, _), count in zip(after, counts, strict=True) if count >= 0.99 * counts[-1]
    )


def metric(node: Node, name: str) -> float:
    """Return the value of a metric without labels."""
    found = re.search(rf"^{name} (\S+)$", node.get("/metrics")[1].decode(), re.MULTILINE)
    assert found is not None
    return float(found[1])


async def read(address: str, all_open: asyncio.Barrier, seconds: float, ages_s: list[float]) -> int:
    """Read for a time from when all are open; record the age of each message on arrival.

    Ages of the first second are not recorded: they include messages that waited meanwhile.
    """
    heard = 0
    async with connect(address, max_queue=4, compression=None) as websocket:
        await asyncio.wait_for(all_open.wait(), HANG_S)
        begun_s = now_s = time.time()
        while now_s < begun_s + seconds:
            text = await asyncio.wait_for(websocket.recv(), HANG_S)
            now_s = time.time()
            heard += 1
            if now_s > begun_s + 1.0:
                stamp = re.search(r'"valid_at":"(.*?)"', str(text))
                assert stamp is not None
                ages_s.append(now_s - datetime.fromisoformat(stamp[1]).timestamp())
    return heard


async def crowd(node: Node, readers: int, deaf: int, seconds: float) -> tuple[list[int], Any]:
    """Return how many messages each reader received, and their ages."""
    address = node.url.replace("http", "ws", 1) + QUERY
    ages_s: list[float] = []
    silent = [
        await connect(address, max_queue=1, compression=None, ping_interval=None)
        for _ in range(deaf)
    ]
    all_open = asyncio.Barrier(readers)
    heard = await asyncio.gather(
        *[read(address, all_open, seconds, ages_s) for _ in range(readers)]
    )
    for one in silent:
        one.transport.abort()
    return heard, ages_s


def measure(
    node: Node, directory: Path, readers: int, deaf: int, seconds: float
) -> dict[str, float]:
    """Measure a flight without clients, then with the crowd."""
    to = f"udpout:127.0.0.1:{node.udp_port}"
    command = [BIN / "sitl-replay", "fly", "paper", "--to", to, "--duration", str(3 * seconds + 9)]
    with started(command, stdout=subprocess.DEVNULL, cwd=directory) as flight:
        try:
            node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4)
            start = lag(node)
            time.sleep(seconds)  # what is measured is a time
            alone, memory_bytes = lag(node), metric(node, MEMORY)
            cpu_s, sent = metric(node, CPU), metric(node, SENT)
            heard, ages_s = run_async(crowd(node, readers, deaf, seconds))
            watched = lag(node)
            grown_bytes = metric(node, MEMORY) - memory_bytes
            cpu_s, sent = metric(node, CPU) - cpu_s, metric(node, SENT) - sent
        finally:
            flight.kill()
    ages_s.sort()
    return {
        "alone_p99_s": p99_s(start, alone),
        "watched_p99_s": p99_s(alone, watched),
        "grown_bytes": grown_bytes,
        "cpu_per_message_s": cpu_s / sent,
        "age_p99_s": ages_s[int(0.99 * len(ages_s))],
        "least_heard": min(heard),
    }


@pytest.mark.full
@pytest.mark.parametrize(
    ("readers", "deaf", "seconds"),
    [(18, 2, 3.0), pytest.param(180, 20, 10.0, marks=pytest.mark.benchmark)],
)
def test_many_stream_clients_do_not_delay_the_service(
    start_node: Any, tmp_path: Path, readers: int, deaf: int, seconds: float
) -> None:
    settings = tmp_path / "settings.toml"
    settings.write_text(SETTINGS)
    found = measure(start_node(*RUN, "--config", str(settings)), tmp_path, readers, deaf, seconds)
    print(found)
    assert found["grown_bytes"] < MEMORY_BYTES
    assert found["age_p99_s"] < FRESH_S
    assert found["least_heard"] > 0.5 * 2 * 10 * (seconds - 1)
    assert found["watched_p99_s"] <= 2 * max(found["alone_p99_s"], 0.01)
