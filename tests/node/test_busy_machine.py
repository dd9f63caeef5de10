"""A service whose event loop is blocked, over real datagrams: the delay is the machine's, not the
radio's.

``time.sleep`` in the loop's own thread blocks it on purpose.
"""

import asyncio
import json
import socket
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Coroutine, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from link_support import frame, stamping
from support import HANG_S, read_metadata, run_async

from companion.mavlink.links.udp import READ_AT_ONCE
from companion.mavlink.links.urls import parse_link
from companion.node.replay import replay
from companion.node.service import Service
from companion.node.serving import address
from companion.pipeline.fold import Pipeline
from companion.recording.reader import read_log
from companion.settings.model import Settings
from companion.values import Frame, Tick, Tock, Update

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux stamps datagrams")

SOON_S = 0.25
"""Sending takes less than this, also on a busy machine."""

WAITING = READ_AT_ONCE + 8


@pytest.fixture(scope="module", autouse=True)
def _stamped() -> Iterator[None]:
    with stamping():
        yield


class Flight:
    """A service that receives frames from a concurrent course in its own thread."""

    def __init__(self, service: Service, page: str) -> None:
        self.service = service
        self.sent_ns: list[int] = []
        self._page = page
        self._to = ("127.0.0.1", parse_link(service.links()[0].url).port)
        self._socket = socket.socket(type=socket.SOCK_DGRAM)

    async def until_heard(self) -> None:
        """Wait until the service has processed all sent frames."""
        while self.service.pipeline.frames < len(self.sent_ns):
            await self.service.ticked()

    def hold_up(self, seconds: float) -> None:
        """Send frames while the loop is blocked: more than one read takes."""
        for _ in range(WAITING):
            self.sent_ns.append(self.service.now_ns())
            boot_ms = 1000 + (self.sent_ns[-1] - self.sent_ns[0]) // 1_000_000
            self._socket.sendto(frame(boot_ms), self._to)
            time.sleep(seconds / WAITING)

    async def ask(self, path: str) -> Any:
        """Return the service's response, whatever its status."""

        def answer() -> str:
            try:
                with urllib.request.urlopen(self._page + path, timeout=HANG_S) as found:
                    return str(found.read().decode())
            except urllib.error.HTTPError as error:
                with error:
                    return error.read().decode()

        text = await asyncio.to_thread(answer)
        return text if path == "/metrics" else json.loads(text)

    def close(self) -> None:
        self._socket.close()


def fly(folder: Path, course: Callable[[Flight], Coroutine[Any, Any, None]]) -> Flight:
    """Run a service with a concurrent course; the recording is in the folder afterwards."""
    settings = Settings().override(
        links={"urls": ["udpin:127.0.0.1:0"]},
        center={"source": "47.3977,8.5456,480"},
        recording={"directory": str(folder)},
    )

    async def run() -> Flight:
        with socket.create_server(("127.0.0.1", 0)) as http:
            service, until = Service(settings=settings, say=lambda _: None), asyncio.Event()
            flight = Flight(service, address(http))

            async def beside() -> None:
                await service.answering.wait()
                try:
                    await course(flight)
                finally:
                    until.set()

            try:
                await service.run(http, None, until, beside)
            finally:
                flight.close()
            return flight

    return run_async(run())


def test_queued_frames_keep_arrival_times_and_replay_matches(tmp_path: Path) -> None:
    async def course(flight: Flight) -> None:
        flight.hold_up(0.5)
        await flight.until_heard()
        status = await flight.ask("/v1/status")
        assert 0.45 < status["arrival_lag"]["max_s"] < 5.0
        assert status["arrival_lag"]["newest_s"] < status["arrival_lag"]["max_s"]
        (link,) = (await flight.ask("/v1/links"))["links"]
        assert (link["arrival"], link["misstamped"]) == ("kernel", 0)
        assert link["reports"]["latency_p95_s"] < SOON_S
        assert "\ncompanion_arrival_lag_max_seconds 0." in await flight.ask("/metrics")

    flight = fly(tmp_path, course)
    (log,) = tmp_path.iterdir()
    events = list(read_log(log))
    arrived_ns = [event.t_ns for event in events if isinstance(event, Frame)]
    late_s = [(a - b) * 1e-9 for a, b in zip(arrived_ns, flight.sent_ns, strict=True)]
    assert min(late_s) > -0.001 and max(late_s) < SOON_S
    # The tick that was due meanwhile came after what had arrived, or says what may have waited.
    for a, b in pairwise(events):
        if isinstance(a, Tick) and isinstance(b, Frame) and b.t_ns < a.t_ns - 50_000_000:
            assert a.waited_ns > 0
    summary = replay([log], flight.service.pipeline.settings)
    assert summary["digest"] == read_metadata(log)["summary"]["digest"]


def test_overloaded_machine_is_not_ready_and_says_why(tmp_path: Path) -> None:
    async def course(flight: Flight) -> None:
        for _ in range(50):  # one suffices when queried at once
            flight.hold_up(0.7)
            await flight.until_heard()
            status, readiness = await flight.ask("/v1/status"), await flight.ask("/readyz")
            if status["arrival_lag"]["behind"] and not readiness["ready"]:
                break
        assert status["arrival_lag"]["behind"]
        assert not readiness["ready"]
        (reason,) = [one for one in readiness["reasons"] if "this machine is overloaded" in one]
        assert reason.startswith("this machine is overloaded: frames wait up to ")
        assert readiness["reasons"] == [reason]  # later frames are late for this reason
        said = [one["text"] for one in (await flight.ask("/v1/events"))["events"]]
        told = [text.startswith("this machine is overloaded") for text in said if "machine" in text]
        assert any(told) and all(
            a != b for a, b in pairwise(told)
        )  # one notice, and one when it is over
        assert "\ncompanion_ready 0.0" in await flight.ask("/metrics")

    fly(tmp_path, course)


def test_frames_and_requests_are_handled_while_beams_are_computed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However long the computation takes; a replay processes everything in the same order."""
    held, prepare_update = threading.Event(), Pipeline.prepare_update
    held.set()

    def slow(pipeline: Pipeline, now_ns: int, lead_s: float = 0.0) -> Callable[[], Update]:
        make = prepare_update(pipeline, now_ns, lead_s)

        def made() -> Update:
            if threading.current_thread().name.startswith("beams"):
                assert held.wait(HANG_S)
            return make()

        return made

    monkeypatch.setattr(Pipeline, "prepare_update", slow)

    async def course(flight: Flight) -> None:
        service = flight.service
        flight.hold_up(0.01)
        await flight.until_heard()
        held.clear()
        while service.pipeline.aiming is None:
            await asyncio.sleep(0)
        before = service.pipeline.updates
        flight.hold_up(0.01)
        while service.pipeline.frames < len(flight.sent_ns):
            await asyncio.sleep(0)
        assert (await flight.ask("/healthz"))["status"] == "ok"
        assert (await flight.ask("/v1/uavs"))["uavs"][0]["id"] == "1:1"
        assert service.pipeline.updates == before
        held.set()
        await service.ticked()
        assert service.pipeline.updates > before

    flight = fly(tmp_path, course)
    (log,) = tmp_path.iterdir()
    between = [0]
    for event in read_log(log):
        if isinstance(event, Tick):
            between.append(0)
        between[-1] += isinstance(event, Frame)
        if isinstance(event, Tock):
            between.append(0)
    assert max(between) >= WAITING
    monkeypatch.undo()
    summary = replay([log], flight.service.pipeline.settings)
    assert summary["digest"] == read_metadata(log)["summary"]["digest"]
