"""Ten minutes with all faults at once: the service keeps running and loses no data."""

import contextlib
import json
import random
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from support import BALLAST, HANG_S, ROOT, Node, end, fill, read_metadata, run_async
from websockets.asyncio.client import connect

from companion.mavlink.wire.encode import heartbeat, pack
from companion.node.replay import replay, settings_for
from companion.recording.parts import read_recording_info
from companion.recording.recover import recover_leftovers
from companion.values import Source

UAVS = 20
FRAMES_HZ = 1000
SETTINGS = "[recording]\nrotate_s = 60.0\n"
STREAM = "/v1/stream?topic=uavs&topic=beams&topic=status&rate_hz=10"  # as in the documentation
STALLED = 40
MEMORY = "process_resident_memory_bytes"
CYCLE_S = 60.0
"""In which every trouble comes once, and memory comes and goes by some 10 MB with what waits."""
GROWS_MB = 12.0
"""Most that memory may grow after the first quarter: from the cycle there to the last one."""


def vehicles(port: int, count: int, frames_hz: int, first: int) -> "subprocess.Popen[bytes]":
    """Vehicles that fly in one process, until it is stopped."""
    sender = [sys.executable, str(ROOT / "tests" / "load_sender.py")]
    numbers = map(str, (port, count, frames_hz, 3600, first))
    return subprocess.Popen([*sender, *numbers], stdout=subprocess.DEVNULL)


class Flapping(threading.Thread):
    """A TCP peer that disconnects every few seconds, often in the middle of a frame."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        self.times = 0

    def run(self) -> None:
        rng = random.Random(17)
        said = pack(heartbeat(Source(200, 1)), 0)
        with contextlib.suppress(OSError):
            while True:
                peer, _ = self.listener.accept()
                self.times += 1
                with peer, contextlib.suppress(OSError):
                    for _ in range(rng.randrange(20, 200)):
                        peer.send(said)
                        time.sleep(0.02)  # the frame rate of a peer
                    peer.send(said[: rng.randrange(1, len(said))])


@contextlib.contextmanager
def stalling(url: str) -> Iterator[None]:
    """Clients that send requests and never read, or never complete a request."""
    host, _, port = url.removeprefix("http://").partition(":")
    with contextlib.ExitStack() as stack:
        for number in range(STALLED):
            made = stack.enter_context(socket.create_connection((host, int(port))))
            end_of_head = "\r\n" if number % 2 else ""
            made.send(
                f"GET {STREAM} HTTP/1.1\r\nHost: {host}\r\nConnection: Upgrade\r\n"
                f"Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
                f"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n{end_of_head}".encode()
            )
        yield


class Page(threading.Thread):
    """Read the stream as the page does; ``ages_s`` of the beams on arrival."""

    def __init__(self, node: Node) -> None:
        super().__init__(daemon=True)
        self.ages_s: list[float] = []
        self.until = threading.Event()
        self._url = node.url.replace("http", "ws") + STREAM

    def run(self) -> None:
        while not self.until.is_set():  # a hang timeout is shorter than a soak test
            with contextlib.suppress(TimeoutError):
                run_async(self._read())

    async def _read(self) -> None:
        async with connect(self._url, max_size=None) as stream:
            while not self.until.is_set():
                said = json.loads(await stream.recv())
                if said["topic"] == "beams":
                    self.ages_s.append(said["age_s"])


def resident_mb(node: Node) -> float:
    lines = node.get("/metrics")[1].decode().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith(MEMORY)) / 1e6


class Troubles:
    """Disturbances in each ``cycle_s``: the disk fills and is freed, the carrier disappears and
    another takes over; finished parts are removed, as an operator must do."""

    def __init__(self, node: Node, disk: Path, kept: Path, cycle_s: float) -> None:
        self._node, self._disk, self._kept = node, disk, kept
        self._cycle_s = cycle_s
        self._done = (-1, -1)
        self.carrier = self._take_over()
        self.took_over = 0

    def _take_over(self) -> "subprocess.Popen[bytes]":
        return vehicles(self._node.udp_port, 1, 50, 0)

    def at(self, passed_s: float) -> None:
        """Run all actions that are due."""
        cycle, into_s = divmod(passed_s, self._cycle_s)
        quarter = int(4 * into_s / self._cycle_s)
        if self._done == (cycle, quarter):
            return
        self._done = int(cycle), quarter
        match quarter:
            case 0:
                self.tidy()
            case 1:
                fill(self._disk)
            case 2:
                (self._disk / BALLAST).unlink(missing_ok=True)
                end(self.carrier)
            case 3:
                self.carrier = self._take_over()
                self.took_over += 1

    def tidy(self) -> None:
        """Remove all but the newest part from the disk; truncated parts are recovered elsewhere."""
        for part in sorted(self._disk.glob("*.mcap*"), key=lambda path: path.stat().st_mtime)[:-1]:
            shutil.copy(part, self._kept)
            part.unlink()

    def over(self) -> None:
        """Free the disk and stop all flights."""
        end(self.carrier)
        (self._disk / BALLAST).unlink(missing_ok=True)


class Seen(NamedTuple):
    """Measurements during the run; memory with the time since the start."""

    healthy_s: list[float]
    memory: list[tuple[float, float]]  # s, MB
    ages_s: list[float]

    def usual_mb(self, begin_s: float, long_s: float) -> float:
        """The median of memory in a window of time."""
        return float(np.median([mb for at_s, mb in self.memory if 0 <= at_s - begin_s < long_s]))


def tell(table: Any, seconds: float, seen: Seen) -> None:
    """Add the measurements to the table and check them against their limits."""
    window_s = min(CYCLE_S, seconds / 4)
    first_mb = seen.usual_mb(seconds / 4, window_s)
    grown_mb = seen.usual_mb(seconds - window_s, window_s) - first_mb
    health_ms = float(np.percentile(seen.healthy_s, 99)) * 1e3
    age_s = float(np.percentile(seen.ages_s, 99))
    name = f"{seconds:.0f} s of all faults: "
    tenth_s = seconds / 10
    tenths_mb = (seen.usual_mb(number * tenth_s, tenth_s) for number in range(10))
    print("MB by the tenth:", *(f"{mb:.1f}" for mb in tenths_mb))
    table.add(name + "memory at the end", seen.memory[-1][1], "MB", "flat")
    table.add(name + "grown since a quarter", grown_mb, "MB", f"< {GROWS_MB:g} MB")
    table.add(name + "/healthz, p99", health_ms, "ms", "-")
    table.add(name + "age of beams on the page, p99", age_s, "s", "< 1 s")
    assert grown_mb < GROWS_MB
    assert age_s < 1.0


@pytest.mark.parametrize(
    "seconds", [40.0, pytest.param(600.0, marks=[pytest.mark.soak, pytest.mark.timeout(1800)])]
)
def test_service_survives_all_faults_at_once_and_records_all(
    start_node: Any, small_disk: Path, tmp_path: Path, table: Any, seconds: float
) -> None:
    (tmp_path / "settings.toml").write_text(SETTINGS)
    kept = tmp_path / "kept"
    kept.mkdir()
    flapping = Flapping()
    flapping.start()
    links = ("--link", "udpin:127.0.0.1:0", "--link", f"tcp:127.0.0.1:{flapping.port}")
    rest = (
        "--listen",
        "127.0.0.1:0",
        "--center",
        "1:1",
        "--config",
        str(tmp_path / "settings.toml"),
    )
    node = start_node("run", *links, *rest, "--record", str(small_disk))
    flight = vehicles(node.udp_port, UAVS, FRAMES_HZ, 1)
    troubles = Troubles(node, small_disk, kept, min(CYCLE_S, seconds / 2))
    page, healthy_s, memory = Page(node), list[float](), list[tuple[float, float]]()
    try:
        node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) >= UAVS // 2)
        page.start()
        with stalling(node.url):
            begun_s = time.monotonic()
            while (passed_s := time.monotonic() - begun_s) < seconds:
                troubles.at(passed_s)
                asked_s = time.monotonic()
                assert node.get("/healthz")[0] == 200
                healthy_s.append(time.monotonic() - asked_s)
                memory.append((passed_s, resident_mb(node)))
                time.sleep(0.2)  # between two requests
        troubles.over()
        node.wait_until("/v1/status", lambda answer: answer["recording"]["state"] == "recording")
        status = node.json("/v1/status")
        page.until.set()
        page.join(HANG_S)
    finally:
        end(flight)
        end(troubles.carrier)
        flapping.listener.close()
    code, _, err = node.stop()
    assert code == 0, err
    shutil.copytree(small_disk, kept, dirs_exist_ok=True)
    recover_leftovers(kept)  # as the next start does with the part truncated by the full disk
    parts = sorted(
        kept.iterdir(), key=lambda path: getattr(read_recording_info(path).part, "number", 0)
    )
    settings = settings_for(parts, None, None)
    summary = replay(parts, settings)
    tell(table, seconds, Seen(healthy_s, memory, page.ages_s))
    name = f"{seconds:.0f} s of all faults: "
    for what, value in (
        ("events not recorded", status["recording"]["dropped"]),
        ("frames replayed", summary["frames"]),
        ("times that a link's peer hung up", flapping.times),
        ("parts, all of which replay", len(parts)),
    ):
        table.add(name + what, value, "", "0" if what.startswith("events") else "-")
    assert status["recording"]["dropped"] == 0
    assert summary["missing"] == []
    assert summary["frames"] >= status["frames"] > 0.9 * seconds * FRAMES_HZ
    assert summary["digest"] == read_metadata(parts[-1])["summary"]["digest"]
    assert troubles.took_over and flapping.times > 1
