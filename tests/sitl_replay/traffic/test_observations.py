"""Measurements of a simulated receiver over real sockets, and in a running service."""

import asyncio
import json
import logging
import math
import socket
import threading
from collections import Counter
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from support import HANG_S, free_port, run_async

from companion.values import Observation, UserError
from companion.views.observation_records import decode
from sitl_replay.flight import scenario
from sitl_replay.flight.vehicles import schedule
from sitl_replay.receiver.model import ReceiverModel, measurements
from sitl_replay.traffic import observations, player
from sitl_replay.traffic.observations import (
    ReceiverPlan,
    as_measurement,
    check_url,
    observe,
    open_outlet,
)

MODEL = ReceiverModel(rate_hz=20.0, outliers=0.2)
FLIGHT = scenario.paper(2)
NOWHERE = "udpout:127.0.0.1:9"


def meant(seconds: float = 0.5) -> list[Observation]:
    items = measurements(FLIGHT, MODEL, 3, epoch_ns=10**18, duration_s=seconds)
    return [one.observation for one in items]


class Service(ThreadingHTTPServer):
    """Stands in for the service: it takes every observation but those of ``refused``.

    ``gate``: set while requests are answered.
    """

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Answers)
        self.bodies: list[list[dict[str, Any]]] = []
        self.tokens: set[str | None] = set()
        self.refused = ""
        self.gate = threading.Event()
        self.gate.set()
        self.asked = threading.Event()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    @property
    def items(self) -> list[dict[str, Any]]:
        return [item for body in self.bodies for item in body]


class _Answers(BaseHTTPRequestHandler):
    server: Service

    def do_POST(self) -> None:
        assert self.path == "/v1/observations"
        body = json.loads(self.rfile.read(int(self.headers["content-length"])))
        self.server.bodies.append(body)
        self.server.tokens.add(self.headers["authorization"])
        self.server.asked.set()
        assert self.server.gate.wait(HANG_S)
        bad = [n for n, item in enumerate(body) if item["uav"] == self.server.refused]
        answer = {
            "accepted": len(body) - len(bad),
            "dropped": 0,
            "errors": [{"item": n, "title": "uav: is refused"} for n in bad],
        }
        said = json.dumps(answer).encode()
        self.send_response(202)
        self.send_header("content-length", str(len(said)))
        self.end_headers()
        self.wfile.write(said)

    def log_message(self, format: str, *args: Any) -> None:
        pass


@pytest.fixture
def service() -> Iterator[Service]:
    with Service() as serving:
        thread = threading.Thread(target=serving.serve_forever, args=(0.01,))
        thread.start()
        yield serving
        serving.gate.set()
        serving.shutdown()
        thread.join(HANG_S)


def flown(url: str, token: str | None = None, seconds: float = 0.5) -> player.Tally:
    plan = ReceiverPlan(url=url, token=token, model=MODEL)
    return run_async(player.fly(FLIGHT, [NOWHERE], seconds, 3, receiver=plan))


def test_datagrams_contain_the_measurements_of_the_flight() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.bind(("127.0.0.1", 0))
        bound.settimeout(20.0)
        tally = flown(f"udp:127.0.0.1:{bound.getsockname()[1]}")
        wanted = meant()
        found = [decode(bound.recv(4096), 0) for _ in wanted]
    assert tally.observed == {"sent": len(wanted)}
    shift_ns = found[0].measured_ns - wanted[0].measured_ns
    for got, want in zip(found, wanted, strict=True):
        assert got.measured_ns - shift_ns == want.measured_ns
        assert (got.uav, got.bound_rad, got.time_bound_ns) == (want.uav, want.bound_rad, 1_000_000)
        assert (got.azimuth_rad, got.elevation_rad) == (want.azimuth_rad, want.elevation_rad)


def test_requests_contain_the_measurements_and_the_token(service: Service) -> None:
    service.refused = "2:1"
    tally = flown(service.url, "secret-of-16-bytes")
    wanted = meant()
    refused = [one for one in wanted if one.uav == "2:1"]
    assert 0 < len(refused) < len(wanted)
    assert tally.observed == {"sent": len(wanted) - len(refused), "failed": len(refused)}
    assert service.tokens == {"Bearer secret-of-16-bytes"}
    for got, want in zip(service.items, wanted, strict=True):
        assert got["uav"] == want.uav
        assert math.radians(got["azimuth_deg"]) == pytest.approx(want.azimuth_rad)
        assert math.radians(got["elevation_deg"]) == pytest.approx(want.elevation_rad)
        assert got["bound_deg"] == pytest.approx(2.0)


def test_a_slow_service_gets_what_waits_in_one_request(service: Service) -> None:
    """Sending never waits for an answer."""
    items = meant(40.0)

    async def sent() -> Counter[str]:
        counts: Counter[str] = Counter()
        outlet = open_outlet(ReceiverPlan(url=service.url), counts)
        service.gate.clear()
        outlet.send(items[0])
        await asyncio.to_thread(service.asked.wait, HANG_S)
        for item in items[1:]:
            outlet.send(item)
        service.gate.set()
        await outlet.close()
        return counts

    assert run_async(sent()) == {"sent": len(items)}
    sizes = [len(body) for body in service.bodies]
    assert sizes[0] == 1
    assert sizes[1:-1] == [400] * (len(sizes) - 2)
    assert sum(sizes) == len(items) > 800


def test_measurements_beyond_those_that_may_wait_are_dropped_oldest_first(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(observations, "WAITING_MAX", 5)
    items = meant()

    async def sent() -> Counter[str]:
        counts: Counter[str] = Counter()
        outlet = open_outlet(ReceiverPlan(url=service.url), counts)
        for item in items:  # in one step of the loop, before the first request
            outlet.send(item)
        await outlet.close()
        return counts

    assert run_async(sent()) == {"failed": len(items) - 5, "sent": 5}
    assert [one["uav"] for one in service.items] == [one.uav for one in items[-5:]]


@pytest.mark.parametrize("scheme", ["http://", "udp:"])
def test_missing_service_is_logged_once_and_does_not_stop_the_flight(
    scheme: str, caplog: pytest.LogCaptureFixture
) -> None:
    port = free_port(socket.SOCK_DGRAM if scheme == "udp:" else socket.SOCK_STREAM)
    with caplog.at_level(logging.WARNING):
        tally = flown(f"{scheme}127.0.0.1:{port}")
    assert tally.frames == sum(1 for _ in schedule(FLIGHT, 3, duration_s=0.5))
    assert tally.observed.total() == len(meant())
    assert tally.observed["failed"] > 0
    assert len([one for one in caplog.records if "refused" in one.message]) == 1


def test_no_measurement_is_sent_before_its_time() -> None:
    items = list(measurements(FLIGHT, MODEL, 3, duration_s=0.3))

    async def sent() -> list[float]:
        loop, times_s = asyncio.get_running_loop(), []

        class Clocked:
            def __init__(self) -> None:
                self.counts: Counter[str] = Counter()

            def send(self, observation: Observation) -> None:
                times_s.append(loop.time())

            async def close(self) -> None:
                pass

        start_s = loop.time()
        await observe(items, Clocked(), start_s)
        return [t_s - start_s for t_s in times_s]

    for sent_s, item in zip(run_async(sent()), items, strict=True):
        assert sent_s >= item.t_s - 1e-3  # the resolution of the loop's clock


def test_json_has_the_exact_time() -> None:
    (one, *_) = meant()
    seconds = "2001-09-09T01:46:40."
    assert as_measurement(one)["measured_at"] == f"{seconds}{one.measured_ns % 10**9:09d}Z"
    assert as_measurement(one)["time_bound_s"] == pytest.approx(0.001)


@pytest.mark.parametrize(
    ("url", "complaint"),
    [
        ("127.0.0.1:9100", "is not the address of a service; give http://HOST:PORT or udp:"),
        ("udp:127.0.0.1", "udpout:127.0.0.1"),
        ("http://:80", "is not http://HOST:PORT"),
    ],
)
def test_invalid_address_is_a_one_line_error(url: str, complaint: str) -> None:
    with pytest.raises(UserError, match=complaint):
        check_url(url)


def test_unknown_host_is_a_one_line_error() -> None:
    with pytest.raises(UserError, match=r"udp:no-such-host\.invalid:9"):
        flown("udp:no-such-host.invalid:9")


@pytest.mark.parametrize("scheme", ["http", "udp"])
def test_a_running_service_accepts_every_measurement(
    start_node: Any, tmp_path: Path, scheme: str
) -> None:
    port = free_port(socket.SOCK_DGRAM)
    config = tmp_path / "settings.toml"
    config.write_text(f'[observations]\nenabled = true\nudp = "127.0.0.1:{port}"\n')
    words = ("--link", "udpin:127.0.0.1:0", "--center", "5:1", "--listen", "127.0.0.1:0")
    node = start_node("run", *words, "--config", str(config), "--record", str(tmp_path / "out"))
    url = node.url if scheme == "http" else f"udp:127.0.0.1:{port}"
    plan = ReceiverPlan(url=url, model=MODEL)
    tally = run_async(
        player.fly(FLIGHT, [f"udpout:127.0.0.1:{node.udp_port}"], 1.0, 3, receiver=plan)
    )
    assert tally.observed == {"sent": len(meant(1.0))}
    answer = node.wait_until(
        "/v1/status", lambda found: found["observations"]["received"] == len(meant(1.0))
    )
    assert answer["observations"]["malformed"] == answer["observations"]["dropped"] == 0
