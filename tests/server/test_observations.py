"""``POST /v1/observations``: what it accepts, what it rejects and why, and what it costs."""

import asyncio
import json
import math
from fractions import Fraction
from typing import Any, get_type_hints

import pytest
from http_support import asked, connected, served
from hypothesis import HealthCheck, given
from hypothesis import settings as run_with
from hypothesis import strategies as st
from pydantic import TypeAdapter
from starlette.testclient import TestClient
from support import run_async

from companion.client import Measurement
from companion.server import models, observation_routes
from companion.server.app import create_app
from companion.server.connections import BODY_BYTES
from companion.server.observation_model import ObservationInput, ObservationsAccepted
from companion.server.observation_routes import OBSERVATIONS_MAX, PATH
from companion.server.responses import PROBLEM_TYPE
from companion.values import Observation, UtcNs, reason_invalid
from companion.values.described import members
from companion.views.as_json import name_in_json, parse_rfc3339, rfc3339

DIRECTION: dict[str, Any] = {
    "uav": "1:1",
    "age_s": 0.25,
    "azimuth_deg": 90,
    "elevation_deg": -45.0,
    "bound_deg": 180,
}
POWERS: dict[str, Any] = {
    "uav": "icao:4CA7B3",
    "measured_at": "2026-11-20T13:00:00.123456789Z",
    "time_bound_s": 0.002,
    "beams": [0, 65_535],
    "powers_db": [-60, -63.5],
    "power_bound_db": 1.5,
    "update": 7,
}
MEASURED_NS = 1_795_179_600_123_456_789  # 2026-11-20T13:00:00.123456789Z
ENABLED = {"observations": {"enabled": True}}


@pytest.fixture
def node(make_node: Any) -> Any:
    return make_node(**ENABLED)


@pytest.fixture
def client(node: Any) -> TestClient:
    return TestClient(create_app(node), raise_server_exceptions=True)


def problem(answer: Any, status: int) -> str:
    """Return the title of a problem with this status."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == PROBLEM_TYPE
    assert answer.json()["status"] == status
    return str(answer.json()["title"])


def test_direction_becomes_an_event(client: TestClient, node: Any) -> None:
    answer = client.post(PATH, json=DIRECTION)
    assert answer.status_code == 202
    assert answer.json() == {"accepted": 1, "dropped": 0, "errors": []}
    (observed,) = node.observed
    assert observed == Observation(
        t_ns=node.now_ns(),
        measured_ns=node.now_ns() - 250_000_000,
        uav="1:1",
        azimuth_rad=math.pi / 2,
        elevation_rad=-math.pi / 4,
        bound_rad=math.pi,
    )


def test_time_is_converted_from_utc(client: TestClient, node: Any) -> None:
    node.pipeline.utc_offset_ns = 77
    assert client.post(PATH, json=[POWERS]).json()["accepted"] == 1
    (observed,) = node.observed
    assert observed == Observation(
        t_ns=node.now_ns(),
        measured_ns=MEASURED_NS - 77,
        time_bound_ns=2_000_000,
        uav="icao:4CA7B3",
        beams=(0, 65_535),
        powers_db=(-60.0, -63.5),
        power_bound_db=1.5,
        update=7,
    )


@given(st.integers(0, 4_000_000_000), st.text("0123456789", max_size=9))
def test_times_are_read_to_the_nanosecond(seconds: int, digits: str) -> None:
    whole = rfc3339(UtcNs(seconds * 1_000_000_000)).removesuffix(".000Z")
    fraction_ns = int(Fraction(f"0.{digits or 0}") * 1_000_000_000)
    text = f"{whole}.{digits}Z" if digits else f"{whole}+00:00"
    assert parse_rfc3339(text) == seconds * 1_000_000_000 + fraction_ns


def test_invalid_items_of_a_list_are_named(client: TestClient, node: Any) -> None:
    items = [DIRECTION, DIRECTION | {"uav": "x"}, POWERS, 5, DIRECTION | {"azimuth_deg": 181}]
    answer = client.post(PATH, json=items)
    assert answer.status_code == 202
    found = answer.json()
    adapter = TypeAdapter(models.outward(ObservationsAccepted))
    assert adapter.dump_python(adapter.validate_python(found, strict=True)) == found
    assert (found["accepted"], found["dropped"]) == (2, 0)
    assert [error["item"] for error in found["errors"]] == [1, 3, 4]
    assert found["errors"][0]["title"].startswith("uav: 'x' is not SYSID:COMPID")
    assert found["errors"][2]["title"] == "azimuth: is not within -180 and 180 degrees"
    assert [isinstance(one, str) for one in node.observed] == [False, True, False, True, True]


def test_errors_of_an_answer_are_limited(client: TestClient, node: Any) -> None:
    found = client.post(PATH, json=[DIRECTION, *[{}] * 100]).json()
    assert len(found["errors"]) == observation_routes.ERRORS_MAX
    assert len(node.observed) == 101


MALFORMED = {
    "no time": ({"age_s": None}, "give exactly one of measured_at and age_s"),
    "two times": ({"measured_at": "2026-11-20T13:00:00Z"}, "give exactly one of measured_at"),
    "local time": ({"age_s": None, "measured_at": "2026-11-20T13:00:00"}, "measured_at: '2026"),
    "other zone": ({"age_s": None, "measured_at": "2026-11-20T13:00:00+01:00"}, "measured_at: "),
    "month": ({"age_s": None, "measured_at": "2026-13-20T13:00:00Z"}, "measured_at: '2026-13"),
    "leap second": ({"age_s": None, "measured_at": "2026-12-31T23:59:60Z"}, "measured_at: "),
    "digits": ({"age_s": None, "measured_at": "2026-11-20T13:00:00.1234567890Z"}, "measured_at: "),
    "before 1970": ({"age_s": None, "measured_at": "1969-11-20T13:00:00Z"}, "measured_at: time is"),
    "future": ({"age_s": -0.1}, "age_s: Input should be greater than or equal to 0"),
    "age": ({"age_s": 3601}, "age_s: Input should be less than or equal to 3600"),
    "huge age": ({"age_s": 1e308}, "age_s: "),
    "time bound": ({"time_bound_s": 10.001}, "time_bound_s: "),
    "huge time bound": ({"time_bound_s": 1e308}, "time_bound_s: "),
    "string": ({"azimuth_deg": "1"}, "azimuth_deg: Input should be a valid number"),
    "boolean": ({"azimuth_deg": True}, "azimuth_deg: "),
    "unknown field": ({"azimut_deg": 1}, "azimut_deg: Extra inputs are not permitted"),
    "no name": ({"uav": None}, "uav: "),
    "bound": ({"bound_deg": 0}, "bound: is not above 0"),
    "both": ({"beams": [1, 2], "powers_db": [1, 2]}, "both a direction and powers"),
    "incomplete": ({"bound_deg": None}, "direction is incomplete"),
    "float beams": ({"beams": [1.5, 2]}, "beams.0: "),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_observation_is_rejected_with_its_reason(
    client: TestClient, node: Any, name: str
) -> None:
    change, reason = MALFORMED[name]
    item = {key: one for key, one in (DIRECTION | change).items() if one is not None}
    title = problem(client.post(PATH, json=item), 422)
    assert title.startswith(f"item 0: {reason}")
    assert "\n" not in title
    assert node.observed == [title.removeprefix("item 0: ")]  # it is counted, with its reason


@pytest.mark.parametrize(
    ("body", "status", "reason"),
    [
        (b"{", 422, "body: is not JSON"),
        (b"", 422, "body: is not JSON"),
        (b"\xff", 422, "body: is not JSON"),
        (b'{"uav": "1:1", "age_s": NaN}', 422, "body: is not JSON"),
        (b"[" * 5000, 422, "body: is not JSON"),
        (b"[]", 422, "body: the list is empty"),
        (b"null", 422, "item 0: "),
        (b"[[]]", 422, "item 0: "),
        (b"[" + b"0," * OBSERVATIONS_MAX + b"0]", 413, "401 observations; send at most 400"),
        (b" " * (BODY_BYTES + 1), 413, "the body has more than 65536 bytes"),
    ],
    ids=["cut", "empty", "not text", "NaN", "nested", "empty list", "null", "list", "many", "long"],
)
def test_malformed_body_is_rejected(
    client: TestClient, body: bytes, status: int, reason: str
) -> None:
    headers = {"content-type": "application/json"}
    assert problem(client.post(PATH, content=body, headers=headers), status).startswith(reason)


def test_observations_are_off_unless_enabled(make_node: Any) -> None:
    node = make_node(flown=False)
    answer = TestClient(create_app(node)).post(PATH, json=DIRECTION)
    assert "set `[observations] enabled = true`" in problem(answer, 403)
    assert node.observed == []


def test_replay_takes_no_observations(client: TestClient, node: Any) -> None:
    node.replay = lambda: "a replay"
    assert "a replay takes no observations" in problem(client.post(PATH, json=DIRECTION), 409)
    assert node.observed == []


@pytest.mark.parametrize("given", [None, "Bearer wrong", "Basic x"])
def test_token_is_required(node: Any, given: str | None) -> None:
    client = TestClient(create_app(node, "s3cret"))
    headers = {} if given is None else {"authorization": given}
    problem(client.post(PATH, json=DIRECTION, headers=headers), 401)
    assert node.observed == []
    good = client.post(PATH, json=DIRECTION, headers={"authorization": "Bearer s3cret"})
    assert good.status_code == 202


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"content-type": "text/plain"}, 415),
        ({"content-type": "application/x-www-form-urlencoded"}, 415),
        ({"content-type": "application/json; charset=utf-8"}, 202),
        ({"content-type": "application/json", "origin": "https://evil.example"}, 403),
        ({"content-type": "application/json", "origin": "null"}, 403),
        ({"content-type": "application/json", "origin": "http://["}, 403),
        ({"content-type": "application/json", "origin": "http://testserver"}, 202),
        ({"content-type": "application/json", "host": "evil.example"}, 421),
    ],
    ids=["text", "form", "JSON", "other site", "no site", "malformed", "own page", "rebinding"],
)
def test_pages_of_other_sites_cannot_send_observations(
    client: TestClient, node: Any, headers: dict[str, str], status: int
) -> None:
    answer = client.post(PATH, content=json.dumps(DIRECTION), headers=headers)
    assert answer.status_code == status
    assert len(node.observed) == (status == 202)


def test_no_cross_origin_preflight_is_granted(client: TestClient) -> None:
    headers = {"origin": "https://evil.example", "access-control-request-method": "POST"}
    answer = client.options(PATH, headers=headers)
    assert not [name for name in answer.headers if name.startswith("access-control-")]


def test_observations_beyond_the_budget_are_dropped(client: TestClient, node: Any) -> None:
    node.budget = 3
    assert client.post(PATH, json=[DIRECTION] * 5).json() == {
        "accepted": 3, "dropped": 2, "errors": [],
    }  # fmt: skip
    answer = client.post(PATH, json=[DIRECTION] * 5)
    assert problem(answer, 503) == "too many observations at once"
    assert answer.headers["retry-after"] == "1"
    assert len(node.observed) == 3


def test_long_list_lets_other_work_run(node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(observation_routes, "SLICE_S", -1.0)  # each item has its own slice
    others: list[int] = []

    async def test() -> None:
        async def beside() -> None:
            while True:
                others.append(len(node.observed))
                await asyncio.sleep(0)

        task = asyncio.create_task(beside())
        found = await observation_routes._process(node, [DIRECTION] * 50, node.now_ns())
        task.cancel()
        assert found.accepted == 50

    run_async(test())
    assert set(range(1, 50)) <= set(others)


def test_long_lists_of_many_clients_are_processed_one_after_the_other(
    node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise their slices would add up, and other work would wait for all of them."""
    monkeypatch.setattr(observation_routes, "SLICE_S", -1.0)  # each item has its own slice
    running = most = 0
    process = observation_routes._process

    async def counted(*arguments: Any) -> Any:
        nonlocal running, most
        running += 1
        most = max(most, running)
        try:
            return await process(*arguments)
        finally:
            running -= 1

    monkeypatch.setattr(observation_routes, "_process", counted)
    body = json.dumps([DIRECTION] * 50).encode()
    head = (
        f"POST {PATH} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
        f"Content-Length: {len(body)}\r\n\r\n"
    ).encode()

    async def test() -> None:
        async with served(node) as port:
            clients = [await connected(port) for _ in range(5)]
            answers = await asyncio.gather(*(asked(one, head + body) for one in clients))
            assert {line.split()[1] for line in answers} == {b"202"}

    run_async(test())
    assert most == 1


def test_body_beyond_the_limit_of_the_connection_is_rejected(node: Any) -> None:
    async def test() -> None:
        async with served(node) as port:
            body = b" " * (2 * BODY_BYTES)
            head = (
                f"POST {PATH} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
                f"Content-Length: {len(body)}\r\n\r\n"
            )
            line = await asked(await connected(port), head.encode() + body)
            assert line.split()[1] in (b"400", b"413")
            item = json.dumps(DIRECTION).encode()
            head = (
                f"POST {PATH} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
                f"Content-Length: {len(item)}\r\n\r\n"
            )
            line = await asked(await connected(port), head.encode() + item)
            assert line.split()[1] == b"202"

    run_async(test())


def test_client_that_leaves_within_its_body_writes_nothing_to_the_log(
    node: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    head = f"POST {PATH} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"

    async def left() -> None:
        async with served(node) as port:
            for _ in range(3):
                _, writer = await connected(port)
                writer.write(f"{head}Content-Length: 100\r\n\r\n[".encode())
                assert await asked(await connected(port)) == b"HTTP/1.1 200 OK\r\n"
                writer.transport.abort()
            assert await asked(await connected(port)) == b"HTTP/1.1 200 OK\r\n"

    run_async(left())
    assert capfd.readouterr().err == ""


def test_names_derive_from_the_event() -> None:
    """Every value of the event is given under its name in JSON; times have names of their own."""
    expected = {name_in_json(one.name) for one in members(Observation) if one.name != "t_ns"}
    expected = expected - {"measured", "time_bound"} | {"measured_at", "age_s", "time_bound_s"}
    assert set(ObservationInput.model_fields) == expected
    assert set(get_type_hints(Measurement)) == expected


VALUES = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9)
ITEMS = st.dictionaries(
    st.sampled_from(sorted(ObservationInput.model_fields)) | st.text(max_size=3),
    VALUES | st.lists(VALUES, max_size=3),
)


@run_with(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(items=st.lists(st.builds(lambda changed: DIRECTION | changed, ITEMS) | ITEMS | VALUES))
def test_arbitrary_json_gives_valid_events_or_problems(
    client: TestClient, node: Any, items: list[Any]
) -> None:
    node.observed.clear()
    headers = {"content-type": "application/json"}
    answer = client.post(PATH, content=json.dumps(items), headers=headers)
    assert answer.status_code in (202, 422)
    for one in node.observed:
        assert isinstance(one, str) or reason_invalid(one) is None
