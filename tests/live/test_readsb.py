"""readsb links, by Beast port and by web server: shown, recorded, and replayed identically."""

import http.server
import json
import socket
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support import BIN, HANG_S, read_metadata

EVEN = b"\x1a3\0\0\0\0\0\0\x80" + bytes.fromhex("8D40621D58C382D690C8AC2863A7")
ODD = b"\x1a3\0\0\0\0\0\0\x80" + bytes.fromhex("8D40621D58C38641ECC31999541A1A")  # 0x1a doubled


def same_digest(recording: Path) -> dict[str, Any]:
    """The replay summary of a recording, with the recorded digest."""
    done = subprocess.run(
        [BIN / "companion", "replay", recording, "--no-record", "--json"],
        capture_output=True, text=True, check=False, timeout=HANG_S,
    )  # fmt: skip
    summary: dict[str, Any] = json.loads(done.stdout)
    assert summary["digest"] == read_metadata(recording)["summary"]["digest"]
    return summary


def test_beast_stream_is_received_and_replays_identically(start_node: Any, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(HANG_S)
        node = start_node(
            *("run", "--link", f"readsb:127.0.0.1:{server.getsockname()[1]}"),
            *("--center", "52.2,3.9,10", "--listen", "127.0.0.1:0", "--record", str(tmp_path)),
        )
        receiver, _ = server.accept()
        with receiver:
            receiver.sendall(EVEN + b"noise" + ODD)
            (seen,) = node.wait_until("/v1/uavs", lambda answer: answer["uavs"])["uavs"]
            status, _, errors = node.stop()
            receiver.settimeout(HANG_S)
            assert receiver.recv(1) == b""  # the service sent nothing to it
    assert status == 0, errors
    assert seen["id"] == "icao:40621D"
    summary = same_digest(next(tmp_path.glob("*.mcap")))
    assert summary["reports"] == {"icao:40621D": 1}
    assert summary["rejected"] == {"garbage": 5, "no-position": 1}


@pytest.fixture
def web() -> Iterator[tuple[str, dict[str, Any]]]:
    """A web server whose aircraft.json is the dictionary, and its URL."""
    answer: dict[str, Any] = {}

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            body = json.dumps(answer).encode()
            self.send_response(200 if self.path == "/data/aircraft.json" else 404)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: Any) -> None:
            """Suppress the log output."""

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        yield f"readsb:http://127.0.0.1:{server.server_port}", answer
        server.shutdown()
        thread.join(HANG_S)


def lost(answer: Any, url: str) -> Any:
    """What a link of an answer of ``/v1/links`` lost."""
    return {link["url"]: link for link in answer["links"]}[url]["lost"]


def test_aircraft_json_is_polled_and_replays_identically(
    start_node: Any, tmp_path: Path, web: tuple[str, dict[str, Any]]
) -> None:
    url, answer = web
    one = {"hex": "a2fcf2", "lat": 47.1, "lon": -122.3, "alt_geom": 5650, "seen_pos": 0.1}
    answer.update(now=100.0, aircraft=[one | {"nac_p": 9}])
    node = start_node(
        *("run", "--link", f"{url}/data/aircraft.json", "--link", f"{url}/wrong"),
        *("--center", "47.1,-122.3,10", "--listen", "127.0.0.1:0", "--record", str(tmp_path)),
    )
    polled = f"{url}/data/aircraft.json"
    node.wait_until("/v1/links", lambda answer: lost(answer, polled) == {"unplaced-stamp": 1})
    answer.update(now=100.9, aircraft=[one | {"nac_p": 9}])  # the first has an unknown age
    node.wait_until("/v1/uavs", lambda answer: answer["uavs"])
    answer.update(now=102.0, aircraft=[one | {"lat": 47.1001, "nac_p": 9}])
    node.wait_until("/v1/uavs", lambda answer: answer["uavs"][0]["reports"] == 2)
    links = {link["url"]: link for link in node.json("/v1/links")["links"]}
    status, _, errors = node.stop()
    assert status == 0, errors
    assert links[polled]["state"] == "up"
    assert links[f"{url}/wrong"]["state"] != "up"
    assert f"link {url}/wrong is down: the server answers 404" in errors
    summary = same_digest(next(tmp_path.glob("*.mcap")))
    assert summary["reports"] == {"icao:A2FCF2": 2}
