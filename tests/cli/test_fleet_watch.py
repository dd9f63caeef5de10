"""``companion fleet watch`` on a node, on other services, with a token, and across a restart."""

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest
from click.testing import CliRunner, Result
from support import HANG_S

from companion.cli import fleet as watching
from companion.cli.main import main

NODE: dict[str, Any] = {
    "node": "north", "is_self": True, "state": "here", "reason": None, "serves": 1, "most": 8,
    "clock_offset_s": None, "clock_doubt_s": None, "way_p99_ms": None,
}  # fmt: skip
OTHER = NODE | {"node": "harbour-south", "state": "there", "clock_offset_s": -0.0015,
                "clock_doubt_s": 0.0008, "way_p99_ms": 41.6}  # fmt: skip
LIAR = NODE | {"node": "liar", "state": "aside", "most": None, "clock_offset_s": 3.0,
               "clock_doubt_s": 0.002, "reason": "has an inconsistent clock"}  # fmt: skip
WENT = NODE | {"node": "west", "is_self": False, "state": "gone", "heard_s": 61.3}


def uav(name: str, *by: str, to: str | None = None, unconfirmed: bool = False) -> dict[str, Any]:
    return {"uav": name, "served_by": by, "handing_to": to, "unconfirmed": unconfirmed}


FLEET = {
    "valid_at": "2026-11-23T02:00:00.000Z", "node": "north", "site": "harbour",
    "nodes": [NODE, OTHER, LIAR, WENT], "sent_bps": 14_200.0, "heard_bps": 54_000.0, "damaged": 0,
    "uavs": [
        uav("1:1", "north"), uav("2:1", "harbour-south", to="north"), uav("3:1"),
        uav("4:1", "north", "harbour-south", to="harbour-south", unconfirmed=True),
    ],
}  # fmt: skip


class Service(ThreadingHTTPServer):
    """Gives the prepared responses one after the other; the last one repeats."""

    answers: list[tuple[int, str]]
    tokens: list[str | None]

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"


class Handler(BaseHTTPRequestHandler):
    server: Service

    def do_GET(self) -> None:
        self.server.tokens.append(self.headers["authorization"])
        answers = self.server.answers
        status, body = answers.pop(0) if len(answers) > 1 else answers[0]
        self.send_response(status if self.path == "/v1/fleet" else 404)
        self.end_headers()
        self.wfile.write(body.encode())

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def service() -> Iterator[Service]:
    with Service(("127.0.0.1", 0), Handler) as made:
        made.answers, made.tokens = [(200, json.dumps(FLEET))], []
        thread = threading.Thread(target=made.serve_forever, args=(0.01,))
        thread.start()
        yield made
        made.shutdown()
        thread.join(HANG_S)


def watch(*arguments: str) -> Result:
    return CliRunner().invoke(main, ["fleet", "watch", *arguments])


def test_fleet_watch_lists_serving_nodes_and_warnings(service: Service) -> None:
    done = watch(service.url, "--seconds", "0.001")
    assert done.exit_code == 0, done.stderr
    lines = done.stdout.splitlines()[:9]
    assert lines[0] == "2026-11-23T02:00:00.000Z  fleet harbour, seen from north"
    assert "  north         here    serves   2 of at most 8: 1:1, 4:1" in lines
    assert (
        "  harbour-south there   serves   2 of at most 8: 2:1, 4:1  clock -1.5 ± 0.4 ms"
        "  way p99 42 ms"
    ) in lines
    assert lines[3].endswith("of at most -: -  clock +3.000 ± 0.001 s")
    assert lines[4:] == [
        "    not trusted: it has an inconsistent clock",
        "  west          gone, 61 s ago",
        "  2:1 is being handed over to north",
        "  3:1 is served by no node",
        "  4:1 is served by north and harbour-south",
    ]
    said = done.stdout
    assert "  4:1 is received by one node only" in said
    assert "  sent 14 kbit/s, received 54 kbit/s" in said
    assert "1:1 is" not in said


def test_long_names_of_nodes_make_no_wide_table(service: Service) -> None:
    """Each of 1500 names was padded to one of 500 kB: 3.8 GB."""
    nodes = [FLEET["nodes"][-1] | {"node": name} for name in ["n" * 500_000, *map(str, range(300))]]
    service.answers = [(200, json.dumps(FLEET | {"nodes": nodes}))]
    done = watch(service.url, "--seconds", "0.001")
    assert done.exit_code == 0, done.stderr
    assert len(done.stdout) < 1_000_000


def test_fleet_watch_json_prints_one_line_per_response(service: Service) -> None:
    done = watch(service.url, "--seconds", "0.001", "--json")
    for line in done.stdout.splitlines():
        assert json.loads(line)["node"] == "north"
    assert done.stdout


@pytest.mark.parametrize(
    ("status", "body", "says"),
    [
        (200, json.dumps(FLEET | {"node": None}), ": node is not in a fleet; set its [fleet] node"),
        (200, "{}", ": not a companion: no node in /v1/fleet; check the address"),
        (200, '{"node": "north"}', ": malformed answer of /v1/fleet; check the address"),
        (200, "[1]", "the answer is not a JSON object"),
        (200, "<html>", "the answer is not JSON"),
        (404, "", "404: Not Found"),
        (
            401,
            '{"title": "a bearer token is needed"}',
            "401: a bearer token is needed (COMPANION_TOKEN)",
        ),
    ],
)
def test_service_outside_a_fleet_is_reported_in_one_line(
    service: Service, status: int, body: str, says: str
) -> None:
    service.answers = [(status, body)]
    done = watch(service.url)
    assert (done.exit_code, done.stdout) == (1, "")
    assert done.stderr.startswith(f"companion: {service.url}")
    assert done.stderr.endswith(f"{says}\n")
    assert done.stderr.count(service.url) == 1
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("url", ["nonsense", "ftp://127.0.0.1", "http://", "http://127.0.0.1:x"])
def test_invalid_address_is_reported_in_one_line(url: str) -> None:
    done = watch(url)
    assert (done.exit_code, done.stdout) == (1, "")
    assert len(done.stderr.splitlines()) == 1


def test_token_comes_from_the_environment(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COMPANION_TOKEN", "s3cret")
    watch(service.url, "--seconds", "0.001")
    assert set(service.tokens) == {"Bearer s3cret"}


def test_fleet_watch_waits_for_a_restarted_node(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watching, "EVERY_S", 0.001)
    good, gone = (200, json.dumps(FLEET)), (503, "")
    service.answers = [good, gone, good, (200, json.dumps(FLEET | {"node": None}))]
    done = watch(service.url)  # it ends once the node is no longer in a fleet
    assert done.stdout.count("seen from north") == 2
    assert done.stderr.splitlines() == [
        f"no answer: {service.url}: 503: Service Unavailable",
        f"companion: {service.url}: node is not in a fleet; set its [fleet] node",
    ]
