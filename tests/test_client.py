"""``companion.client`` against a live node, and against other services."""

import contextlib
import itertools
import json
import math
import os
import socket
import socketserver
import struct
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import closing
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import HANG_S, Node, end

from companion.client import Client, Measurement, ServiceError
from companion.values import UserError
from companion.views.records import HEADER

RUN = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "5:1")
TOKEN = "s3cret/ü"


def demo(folder: Path) -> Node:
    """Run the demo with its own recording folder, and wait for its four beams."""
    with contextlib.chdir(folder):
        node = Node("demo", "--port", "0", "--seconds", "36000")
    node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4)
    return node


@pytest.fixture(scope="module")
def flying(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Node]:
    """Run one demo for all tests that do not stop it."""
    node = demo(tmp_path_factory.mktemp("demo"))
    yield node
    end(node.process)


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Node]:
    """Run a service that requires a token and takes observations."""
    settings = tmp_path_factory.mktemp("guarded") / "settings.toml"
    settings.write_text("[observations]\nenabled = true\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COMPANION_TOKEN", TOKEN)
        node = Node(*RUN, "--config", str(settings))
    yield node
    end(node.process)


def test_client_returns_the_service_responses(flying: Node) -> None:
    client = Client(flying.url + "/")
    assert client.status()["version"]
    assert {uav["id"] for uav in client.uavs()} == {"1:1", "2:1", "3:1", "4:1"}
    beams = client.beams(lead_ms=50)
    assert beams["lead_ms"] == 50
    assert len(client.get("/v1/pattern", points=7, cut="elevation")["angles_deg"]) == 7
    now, later = client.weights(), client.weights(lead_ms=5000)
    assert now.matrix.shape == (64, 4)
    assert now.matrix.dtype == np.complex64
    assert sorted(now.uavs) == ["1:1", "2:1", "3:1", "4:1"]
    assert 5.0e9 <= later.valid_at_ns - now.valid_at_ns < 8.0e9
    assert not np.allclose(now.matrix, later.matrix)


def test_proxies_of_the_environment_get_no_token(flying: Node) -> None:
    code = (
        "import sys\n"
        "from companion.client import Client\n"
        "client = Client(sys.argv[1], 'a token that nobody else must get')\n"
        "client.status()\n"
        "next(client.stream(['1:1'], ['uavs'], rate_hz=50))\n"
    )
    proxied = os.environ | {"http_proxy": "http://127.0.0.1:9", "no_proxy": ""}
    command = [sys.executable, "-c", code, flying.url]
    subprocess.run(command, check=True, timeout=HANG_S, env=proxied)


def test_stream_continues_until_closed(flying: Node) -> None:
    client = Client(flying.url)
    with closing(client.stream(["1:1"], ["uavs", "weights"], rate_hz=50)) as stream:
        heard = list(itertools.islice(stream, 12))
    assert {message["topic"] for message in heard} == {"uavs", "weights"}
    stamps = [message["valid_at"] for message in heard if message["topic"] == "uavs"]
    assert stamps == sorted(set(stamps))
    assert all(message["uavs"] == ["1:1"] for message in heard if message["topic"] == "weights")
    with closing(client.records(["3:1", "1:1"])) as stream:
        heads = [np.frombuffer(record, HEADER, 1)[0] for record in itertools.islice(stream, 4)]
    assert [(head["beams"], head["elements"]) for head in heads] == [(2, 64)] * 4
    assert (np.diff([int(head["sequence"]) for head in heads]) >= 1).all()
    with pytest.raises(UserError, match=r"topic 'records' is binary; use Client\.records"):
        next(client.stream(topics=["records"]))


@pytest.mark.full
def test_service_shutdown_is_reported_to_stream_readers(tmp_path: Path) -> None:
    """A reader is notified, and a client that never reads does not delay the shutdown."""
    flying = demo(tmp_path)
    host, _, port = flying.url.removeprefix("http://").partition(":")
    with socket.socket() as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.connect((host, int(port)))
        deaf.sendall(
            b"GET /v1/stream?rate_hz=100&topic=weights&topic=beams&topic=uavs HTTP/1.1\r\n"
            b"Host: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        )
        stream = Client(flying.url).stream(rate_hz=50)
        for _ in itertools.islice(stream, 60):
            pass
        returncode, _, err = flying.stop()
        assert returncode == 0, err
        assert "Traceback" not in err
        with pytest.raises(ServiceError) as raised:
            for _ in stream:
                pass
    assert raised.value.status == 1012


def test_error_responses_have_status_and_title(guarded: Node) -> None:
    client = Client(guarded.url, TOKEN)
    with pytest.raises(ServiceError, match=r"422: query\.lead_ms: ") as raised:
        client.beams(lead_ms=-1)
    assert raised.value.status == 422
    with pytest.raises(ServiceError, match="404: no UAV '9:9' is tracked"):
        client.get("/v1/uavs/9:9")
    with pytest.raises(ServiceError, match="4422: uav: 'x' is not SYSID:COMPID") as raised:
        next(client.stream(uavs=["x"]))
    assert raised.value.status == 4422
    empty = client.weights()
    assert empty.uavs == ()
    assert empty.matrix.shape == (64, 0)


def test_missing_or_wrong_token_is_rejected(guarded: Node) -> None:
    for wrong in (Client(guarded.url), Client(guarded.url, "wrong")):
        with pytest.raises(ServiceError, match="401: a bearer token is needed"):
            wrong.status()
        with pytest.raises(ServiceError, match="4401: a bearer token is needed"):
            next(wrong.stream())


def test_correct_token_is_accepted(guarded: Node) -> None:
    client = Client(guarded.url, TOKEN)
    assert client.status()["version"]
    with closing(client.stream(topics=["status"])) as stream:
        assert next(stream)["topic"] == "status"


DIRECTION: Measurement = {
    "uav": "3:1", "age_s": 0.01, "azimuth_deg": 12.5, "elevation_deg": -3.0, "bound_deg": 2.0,
}  # fmt: skip


def test_observations_are_given_to_the_service(guarded: Node) -> None:
    """One or many, with numbers and arrays of numpy; errors are returned, or raised if all fail."""
    client = Client(guarded.url, TOKEN)
    before = client.status()["observations"]
    assert client.observe(DIRECTION) == {"accepted": 1, "dropped": 0, "errors": []}
    powers: Measurement = {
        "uav": "3:1",
        "measured_at": "2026-11-20T13:00:00.123Z",
        "beams": np.arange(3),
        "powers_db": np.linspace(-70, -60, 3),
        "power_bound_db": np.float64(1.5),
    }
    wrong: Measurement = {**DIRECTION, "uav": "x"}
    found = client.observe([DIRECTION, wrong, powers])
    assert (found["accepted"], [error["item"] for error in found["errors"]]) == (2, [1])
    after = client.status()["observations"]
    assert {key: after[key] - before[key] for key in after} == {
        "received": 3, "malformed": 1, "dropped": 0,
    }  # fmt: skip
    with pytest.raises(ServiceError, match="422: item 0: uav: 'x' is not") as raised:
        client.observe(wrong)
    assert raised.value.status == 422
    with pytest.raises(ServiceError, match="413: 401 observations; send at most 400"):
        client.observe([DIRECTION] * 401)
    with pytest.raises(ServiceError, match="401: a bearer token is needed"):
        Client(guarded.url).observe(DIRECTION)


@pytest.mark.parametrize("azimuth_deg", [math.nan, object()], ids=["NaN", "no number"])
def test_observation_that_is_not_json_is_not_sent(azimuth_deg: Any) -> None:
    with pytest.raises(UserError, match="observation: "):
        Client("http://127.0.0.1:9").observe({**DIRECTION, "azimuth_deg": azimuth_deg})


def test_service_without_observations_says_what_to_do(flying: Node) -> None:
    with pytest.raises(ServiceError, match=r"403: .*set `\[observations\] enabled = true`"):
        Client(flying.url).observe(DIRECTION)


def test_unreachable_service_raises_service_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    client = Client(f"http://127.0.0.1:{port}")
    with pytest.raises(ServiceError, match="refused") as raised:
        client.status()
    assert raised.value.status is None
    with pytest.raises(ServiceError, match="refused"):
        next(client.stream())
    with pytest.raises(ValueError, match="is not http"):
        Client("ftp://127.0.0.1")


class _Stranger(BaseHTTPRequestHandler):
    """Another HTTP service: an error in HTML, and a truncated response."""

    def do_GET(self) -> None:
        if self.path == "/v1/status":
            self.send_error(503)
            return
        self.send_response(200)
        self.send_header("content-length", "1000")
        self.end_headers()
        self.wfile.write(json.dumps({}).encode())

    def log_message(self, *_: object) -> None:
        pass


def test_foreign_http_service_raises_service_error() -> None:
    with HTTPServer(("127.0.0.1", 0), _Stranger) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            client = Client(f"http://127.0.0.1:{server.server_port}")
            with pytest.raises(ServiceError, match="503: Service Unavailable"):
                client.status()
            with pytest.raises(ServiceError, match="the answer is incomplete"):
                client.uavs()
            with pytest.raises(ServiceError):
                next(client.stream())
        finally:
            server.shutdown()
            thread.join(HANG_S)


@contextlib.contextmanager
def _answering(head: bytes, piece: bytes) -> Iterator[str]:
    """Run a server that answers with a header, and then with pieces without an end."""
    over = threading.Event()

    class Endless(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            self.request.recv(4096)
            with contextlib.suppress(OSError):
                self.request.sendall(b"HTTP/1.1 " + head + b"\r\n\r\n")
                while not over.wait(0.005):
                    self.request.sendall(piece)

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Endless) as server:
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}"
        finally:
            over.set()
            server.shutdown()
            thread.join(HANG_S)


HEADS = [b"200 OK", b"200 OK\r\nTransfer-Encoding: chunked", b"200 OK\r\nContent-Length: 99999999"]


@pytest.mark.parametrize("head", HEADS, ids=["unlimited", "chunked", "announced"])
def test_answer_that_drips_is_given_up(head: bytes) -> None:
    """Each piece arrives in time, the whole answer does not."""
    piece = b"1\r\n \r\n" if b"chunked" in head else b" "
    with (
        _answering(head, piece) as url,
        pytest.raises(ServiceError, match=r"the answer takes longer than 0\.3 s"),
    ):
        Client(url, timeout_s=0.3).status()


@pytest.mark.parametrize(
    ("head", "piece"),
    [(b"HTTP/1.1 200 OK\r\n", b"x: y\r\n"), (b"HTTP/1.1 ", b"2"), (b"", b"HTTP/1.1 100 C\r\n\r\n")],
    ids=["headers", "status", "continue"],
)
def test_head_that_drips_is_given_up(head: bytes, piece: bytes) -> None:
    """Each byte arrives in time: a drive held its device's last command for hours."""
    is_left = threading.Event()

    def drip(server: socket.socket) -> None:
        connection, _ = server.accept()
        with server, connection:
            try:
                connection.sendall(head)
                for _ in range(200):
                    time.sleep(0.02)
                    connection.sendall(piece)
            except OSError:  # the client is gone
                is_left.set()

    server = socket.create_server(("127.0.0.1", 0))
    thread = threading.Thread(target=drip, args=(server,), daemon=True)
    thread.start()
    with pytest.raises(ServiceError):
        Client(f"http://127.0.0.1:{server.getsockname()[1]}", timeout_s=0.3).status()
    thread.join(HANG_S)
    assert is_left.is_set()


def test_redirects_are_not_followed() -> None:
    with (
        _answering(b"302 Found\r\nLocation: http://127.0.0.1:1/\r\nContent-Length: 0", b"") as url,
        pytest.raises(ServiceError) as error,
    ):
        Client(url).status()
    assert error.value.status == 302


def test_endless_answer_uses_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.client.TEXT_MAX", 200_000)
    with (
        _answering(HEADS[0], bytes(65_536)) as url,
        pytest.raises(ServiceError, match="the answer exceeds 200000 bytes"),
    ):
        Client(url).status()


@pytest.mark.parametrize("text", [b"[],", b"{},", b"1,"])
def test_answer_of_millions_of_values_is_not_parsed(text: bytes) -> None:
    """60 MB of empty lists took 0.7 GB, and a drive did not end for 10 s."""
    body = b'{"beams":[' + text * 1_200_000 + b"1]}"
    head = b"200 OK\r\nContent-Length: %d" % len(body)
    with (
        _answering(head, body) as url,
        pytest.raises(ServiceError, match="the answer exceeds 1048576 values"),
    ):
        Client(url).beams()
    with (
        _answering(b"200 OK\r\nContent-Length: 1200000", b"\n" * 1_200_000) as url,
        pytest.raises(ServiceError, match="the answer exceeds 1048576 lines"),
    ):
        Client(url).table("text/csv")


def test_deeply_nested_answer_is_no_json() -> None:
    with (
        _answering(b"200 OK\r\nContent-Length: 200000", b"[" * 200_000) as url,
        pytest.raises(ServiceError, match="the answer is not JSON"),
    ):
        Client(url).status()


def npy(header: str, data: bytes = bytes(8)) -> bytes:
    """An ``.npy`` file, whatever its header says."""
    text = header.encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


HOSTILE = {
    "huge": npy("{'descr': '<c8', 'fortran_order': False, 'shape': (1000000000, 1000000), }"),
    "beyond 64 bits": npy(f"{{'descr': '<c8', 'fortran_order': False, 'shape': ({10**30}, 9), }}"),
    "negative": npy("{'descr': '<c8', 'fortran_order': False, 'shape': (-1, -1), }"),
    "objects": npy("{'descr': '|O', 'fortran_order': False, 'shape': (1, 1), }"),
    "one axis": npy("{'descr': '<c8', 'fortran_order': False, 'shape': (1,), }"),
    "no numbers": npy("{'descr': 'zz', 'fortran_order': False, 'shape': (1, 1), }"),
    "nested": npy("(" * 9000),
    "long header": npy(
        "{'descr': '<c8', 'fortran_order': False, 'shape': (1, 1), }" + " " * 60_000
    ),
    "cut": npy("{'descr': '<c8', 'fortran_order': False, 'shape': (1, 1), }", bytes(7)),
    "cut header": b"\x93NUMPY\x01\x00\xff\xff{",
    "version": b"\x93NUMPY\x09\x00" + bytes(100),
    "pickle": b"\x80\x04cposix\nsystem\n.",
    "zip": b"PK\x03\x04" + bytes(100),
    "empty": b"",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_weights_are_rejected_in_one_line_and_little_memory(name: str) -> None:
    body = HOSTILE[name]
    head = b"200 OK\r\nx-valid-at-ns: 1\r\nContent-Length: %d" % len(body)
    tracemalloc.start()
    try:
        with (
            _answering(head, body) as url,
            pytest.raises(ServiceError, match="the weights are malformed") as raised,
        ):
            Client(url, timeout_s=5.0).weights()
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()
    assert "\n" not in str(raised.value)


def test_weights_without_their_headers_are_malformed() -> None:
    body = npy("{'descr': '<c8', 'fortran_order': False, 'shape': (1, 1), }")
    with (
        _answering(b"200 OK\r\nContent-Length: %d" % len(body), body) as url,
        pytest.raises(ServiceError, match="the weights are malformed"),
    ):
        Client(url).weights()
