"""Figures of the running service: startup, memory, and answers per second: ``make bench``."""

import asyncio
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from figures import Figures
from support import BIN, HANG_S, Node, run_async, started

from companion import Pipeline, Settings, Tick, read_log

pytestmark = pytest.mark.benchmark
RUN = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "5:1")
CLIENTS = 4
ASKED_S = 2.0
LEAST_OVER_HEALTHZ = {"weights, npy": 1.1, "weights, JSON": 0.9, "/v1/beams": 0.4, "/v1/uavs": 1.2}
"""Answers of a moment that is made, over those of ``/healthz``, which are routed and made."""
PEER = "import numpy, fastapi, uvicorn, google.protobuf.message, zstandard"


async def _ask(node: Node, path: str, accept: str, until_s: float) -> int:
    """Answers per second for one client over one connection."""
    address = node.url.removeprefix("http://")
    host, port = address.rsplit(":", 1)
    reader, writer = await asyncio.open_connection(host, int(port))
    request = f"GET {path} HTTP/1.1\r\nHost: {address}\r\nAccept: {accept}\r\n\r\n".encode()
    answers = 0
    while time.perf_counter() < until_s:
        writer.write(request)
        head = await reader.readuntil(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 200"), head
        (length,) = (
            int(line.split(b":")[1])
            for line in head.lower().split(b"\r\n")
            if line.startswith(b"content-length")
        )
        await reader.readexactly(length)
        answers += 1
    writer.close()
    return answers


def answers_per_s(node: Node, path: str, accept: str = "*/*") -> float:
    async def ask() -> int:
        until_s = time.perf_counter() + ASKED_S
        return sum(
            await asyncio.gather(*(_ask(node, path, accept, until_s) for _ in range(CLIENTS)))
        )

    return run_async(ask()) / ASKED_S


@pytest.fixture
def flown(start_node: Any, tmp_path: Path) -> Any:
    """A service that records four UAVs and forms beams towards them."""
    node = start_node(*RUN, "--record", str(tmp_path))
    to = f"udpout:127.0.0.1:{node.udp_port}"
    flight = [str(BIN / "sitl-replay"), "fly", "waypoints", "--to", to]
    with started(flight, stdout=subprocess.DEVNULL):
        node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4)
        yield node


def test_requests_answered_per_second(flown: Any, figures: Figures) -> None:
    asked = {
        "/healthz": ("/healthz", "*/*"),
        "weights, npy": ("/v1/beams/weights", "application/x-npy"),
        "weights, JSON": ("/v1/beams/weights", "application/json"),
        "/v1/beams": ("/v1/beams", "*/*"),
        "/v1/uavs": ("/v1/uavs", "*/*"),
    }
    found: dict[str, list[float]] = {name: [] for name in asked}
    for _ in range(3):
        for name, (path, accept) in asked.items():
            found[name].append(answers_per_s(flown, path, accept))
    for name, rates in found.items():
        figures.note(f"{name}, {CLIENTS} clients", rates, "a second", "more")
        if name != "/healthz":
            over = figures.ratio(f"{name} over /healthz", rates, found["/healthz"], "more")
            assert over > LEAST_OVER_HEALTHZ[name], name


def test_memory_of_the_service(flown: Any, figures: Figures) -> None:
    flown.wait_until("/v1/status", lambda status: status["recording"]["messages"] > 1000)
    status = Path(f"/proc/{flown.process.pid}/status").read_text()
    held = dict(line.split(":", 1) for line in status.splitlines())
    figures.note("memory, 4 UAVs, recording", int(held["VmRSS"].split()[0]) / 1024, "MB", "less")


def test_startup_time_against_library_import(start_node: Any, figures: Figures) -> None:
    ready_s, loaded_s = [], []
    for _ in range(3):
        begin = time.perf_counter()
        node = start_node(*RUN, "--silent")
        assert node.get("/healthz")[0] == 200
        ready_s.append(time.perf_counter() - begin)
        node.stop()
        begin = time.perf_counter()
        subprocess.run([sys.executable, "-c", PEER], check=True, timeout=HANG_S)
        loaded_s.append(time.perf_counter() - begin)
    figures.note("from the command to an answer", ready_s, "s", "less")
    figures.ratio("start over loading its libraries", ready_s, loaded_s)


def test_time_from_frame_to_weights(cut_log: Path, figures: Figures) -> None:
    """In this process: one frame received, and one update of all beams; numpy's speed for
    comparison."""
    pipeline = Pipeline(Settings().override(center={"source": "5:1"}))
    took_us: dict[str, list[float]] = {"a frame": [], "a look at all beams": []}
    unit: list[float] = []
    matrix = np.exp(1j * np.outer(np.arange(64), np.arange(4)))
    for event in read_log(cut_log):
        if isinstance(event, Tick):
            continue
        begin = time.perf_counter()
        pipeline.step(event)
        took_us["a frame"].append((time.perf_counter() - begin) * 1e6)
        if len(took_us["a frame"]) % 10 == 0:
            begin = time.perf_counter()
            made = pipeline.look(event.t_ns)
            seconds = time.perf_counter() - begin
            if len(made.beams.beams) == 4:
                took_us["a look at all beams"].append(seconds * 1e6)
                begin = time.perf_counter()
                np.linalg.pinv(matrix)
                unit.append((time.perf_counter() - begin) * 1e6)
    for name, took in took_us.items():
        figures.note(f"{name}, median", statistics.median(took), "us", "less")
        figures.note(f"{name}, p99", float(np.percentile(took, 99)), "us", "less")
    looks = statistics.median(took_us["a look at all beams"])
    figures.note("a look over pinv of 64x4", looks / statistics.median(unit), "times", "less")
