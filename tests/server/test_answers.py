"""Every response matches its model exactly; every error is problem+json."""

import asyncio
import io
import json
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from typing import Any

import numpy as np
import orjson
import pytest
from pydantic import TypeAdapter
from starlette.testclient import TestClient

from companion.mavlink.wire.encode import HEARTBEAT, heartbeat, pack
from companion.server import area_map, models, recordings, responses
from companion.server.app import create_app
from companion.server.beam_routes import ACCEPTED_MOST, accepted
from companion.tracking.design import answers
from companion.values import Frame, Level, Source
from companion.values.described import unit
from companion.views import (
    beam_state,
    design,
    fleet,
    glance,
    labels,
    link_state,
    mavlink_messages,
    pattern,
    series,
    settings,
    state,
    uav_state,
)

PATHS: dict[str, Any] = {
    "/healthz": models.Health,
    "/register_service": models.Registration,
    "/readyz": models.Readiness,
    "/v1/status": state.Status,
    "/v1/uavs": uav_state.Uavs,
    "/v1/uavs/1:1": uav_state.UavState,
    "/v1/links": link_state.Links,
    "/v1/fleet": fleet.Fleet,
    "/v1/history": series.History,
    "/v1/settings": settings.EffectiveSettings,
    "/v1/events": glance.Events,
    "/v1/design": design.Design,
    "/v1/labels": labels.Labels,
    "/v1/beams?lead_ms=20": beam_state.Beams,
    "/v1/beams/weights": beam_state.Weights,
    "/v1/pattern?points=5": pattern.Pattern,
    "/v1/pattern?points=5&cut=elevation": pattern.Pattern,
    "/v1/map": area_map.AreaMap,
    "/v1/recordings": recordings.Recordings,
    "/v1/mavlink/vehicles": dict[str, mavlink_messages.MavlinkVehicle],
    "/v1/mavlink/vehicles/1/components/1/messages": dict[str, mavlink_messages.MavlinkMessage],
    "/v1/mavlink/vehicles/1/components/1/messages/HEARTBEAT": mavlink_messages.MavlinkMessage,
}


@pytest.fixture(scope="module")
def client(shared_node: Any) -> Iterator[TestClient]:
    with TestClient(create_app(shared_node), raise_server_exceptions=False) as client:
        yield client


def holds(model: Any, answer: Any) -> None:
    """Check that the response has exactly the fields of the model, with its types."""
    adapter = TypeAdapter(models.outward(model))
    read = adapter.validate_json(orjson.dumps(answer), strict=True)
    assert adapter.dump_python(read, mode="json") == answer


def test_messages_are_addressed_by_system_and_component(make_node: Any) -> None:
    """In this order, with two different numbers."""
    node = make_node(flown=False)
    raw = pack(heartbeat(Source(sysid=7, compid=9)), 0)
    node.last_messages.add(
        Frame(t_ns=1, link="udp", source=Source(sysid=7, compid=9), msgid=HEARTBEAT, raw=raw)
    )
    with TestClient(create_app(node)) as client:
        for sysid, compid, status in ((7, 9, 200), (9, 7, 404)):
            path = f"/v1/mavlink/vehicles/{sysid}/components/{compid}/messages"
            assert client.get(path).status_code == status
            assert client.get(f"{path}/HEARTBEAT").status_code == status


@pytest.mark.parametrize("path", PATHS)
def test_response_matches_its_model(client: TestClient, path: str) -> None:
    answer = client.get(path)
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "application/json"
    holds(PATHS[path], answer.json())


def test_compared_responses_are_not_empty(client: TestClient) -> None:
    """Empty lists would match any model."""
    uavs = client.get("/v1/uavs").json()["uavs"]
    assert {uav["id"].startswith("icao:") for uav in uavs} == {True, False}
    beams = client.get("/v1/beams").json()["beams"]
    assert len(beams) == 4
    assert beams[0]["codebook"] is not None
    methods = {row["method"] for row in client.get("/v1/design").json()["designs"]}
    assert "lmi" in methods
    links = client.get("/v1/links").json()
    assert links["links"][0]["components"]
    assert links["message_rates"]
    assert links["out"] == [
        {"url": "cot:udp:127.0.0.1:6969", "state": "up", "peers": 1, "sent": 12, "send_dropped": 3}
    ]
    assert client.get("/v1/events").json()["events"]


def test_responses_match_their_models_before_any_report(make_node: Any) -> None:
    with TestClient(create_app(make_node(flown=False))) as client:
        for path in ("/v1/status", "/v1/uavs", "/v1/beams", "/v1/beams/weights", "/v1/design"):
            holds(PATHS.get(path) or beam_state.Beams, client.get(path).json())


def test_every_openapi_path_is_checked_against_its_model(client: TestClient) -> None:
    document = client.get("/openapi.json").json()
    shown = {path.split("?")[0] for path in PATHS}
    named = {path.format(uav="1:1", sys=1, comp=1, name="HEARTBEAT") for path in document["paths"]}
    recording = "/v1/recordings/HEARTBEAT"
    assert named == shown | {
        "/metrics", "/v1/map/tiles", recording, f"{recording}/history", "/v1/observations",
    }  # fmt: skip


def test_openapi_document_is_built_off_the_event_loop(
    make_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And once for all who ask: it takes 0.2 s, in which all other requests would wait."""
    beside = []

    def on_loop(**asked: Any) -> Any:
        with pytest.raises(RuntimeError, match="no running event loop"):
            asyncio.get_running_loop()
        beside.append(True)
        return made(**asked)

    made = responses.get_openapi
    monkeypatch.setattr(responses, "get_openapi", on_loop)
    with TestClient(create_app(make_node())) as client, ThreadPoolExecutor(4) as threads:
        answers = list(threads.map(client.get, ["/openapi.json"] * 4))
    assert all(one.json()["paths"] for one in answers)
    assert beside == [True]


def test_openapi_document_describes_errors_as_problem_json(client: TestClient) -> None:
    document = client.get("/openapi.json").json()
    for path, operations in document["paths"].items():
        ((_, operation),) = operations.items()
        for status, shown in operation["responses"].items():
            if status.startswith("4"):
                assert list(shown["content"]) == ["application/problem+json"], path
    weights = document["paths"]["/v1/beams/weights"]["get"]["responses"]["200"]["content"]
    assert weights["application/json"]["schema"]["$ref"].endswith("/Weights")
    assert weights["application/x-npy"]["schema"]["format"] == "binary"
    assert "HTTPValidationError" not in document["components"]["schemas"]


def test_openapi_document_describes_every_field_and_parameter(client: TestClient) -> None:
    """With the unit in which its name ends."""
    document = client.get("/openapi.json").json()
    lacking: list[str] = []
    for model, schema in document["components"]["schemas"].items():
        for name, field in schema.get("properties", {}).items():
            said, measure = field.get("description", ""), unit(name)
            if not said or (
                measure and not said.endswith(f", {measure}") and "deprecated" not in said
            ):
                lacking.append(f"{model}.{name}: {said!r}")
    assert lacking == []
    for path, operations in document["paths"].items():
        ((_, operation),) = operations.items()
        for parameter in operation.get("parameters", []):
            assert parameter.get("description"), (path, parameter["name"])


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/v1/nothing", 404),
        ("GET", "/v1/uavs/9:9", 404),
        ("GET", "/v1/status/", 404),
        ("POST", "/v1/status", 405),
        ("DELETE", "/v1/recordings/x.mcap", 405),
        ("POST", "/index.html", 405),
        ("GET", "/v1/beams?lead_ms=1e999", 422),
        ("GET", "/v1/mavlink/vehicles/256/components/1/messages/HEARTBEAT", 422),
        ("GET", "/v1/mavlink/vehicles/one/components/1/messages/HEARTBEAT", 422),
        ("GET", "/v1/mavlink/vehicles/1/components/1/messages/NO_SUCH", 404),
        ("GET", "/v1/mavlink/vehicles/1/components/1/messages/heartbeat", 404),
        ("GET", "/v1/mavlink/vehicles/9/components/1/messages/HEARTBEAT", 404),
        ("GET", "/v1/mavlink/vehicles/9/components/1/messages", 404),
        ("GET", "/v1/pattern?points=3602", 422),
    ],
)
def test_every_error_is_problem_json(
    client: TestClient, method: str, path: str, status: int
) -> None:
    answer = client.request(method, path)
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    holds(models.Problem, answer.json())
    assert answer.json()["status"] == status
    if status == 405 and path.startswith("/v1"):
        assert answer.headers["allow"] == "GET"


def test_internal_error_is_problem_json(make_node: Any) -> None:
    node = make_node(flown=False)
    del node.notices  # makes `events` fail
    with TestClient(create_app(node), raise_server_exceptions=False) as client:
        answer = client.get("/v1/events")
    assert answer.status_code == 500
    assert answer.headers["content-type"] == "application/problem+json"
    assert "notices" not in answer.text


def test_head_equals_get_without_a_body(client: TestClient) -> None:
    assert client.head("/v1/status").status_code == 200
    assert client.head("/v1/uavs/9:9").status_code == 404


@pytest.mark.parametrize(
    ("accept", "form"),
    [
        ("*/*", "json"),
        ("", "json"),
        ("application/x-npy", "npy"),
        ("application/json;q=0.1, application/x-npy;q=0.2", "npy"),
        ("text/html, application/*;q=0.5", "json"),
        ("text/html", None),
        ("application/json;q=0", None),
        ("application/json;q=much", "json"),
        (",;q=;,", "json"),
    ],
)
def test_response_format_follows_the_accept_header(accept: str, form: str | None) -> None:
    assert accepted(accept) == form


def test_only_the_first_media_types_are_read() -> None:
    """Each costs microseconds, and a header has room for thousands."""
    assert accepted("text/html," * (ACCEPTED_MOST - 1) + "application/x-npy") == "npy"
    assert accepted("text/html," * ACCEPTED_MOST + "application/x-npy") is None


def test_raw_weights_match_their_headers_and_npy_is_c_ordered(client: TestClient) -> None:
    """The headers suffice to read them, and every format holds the same numbers."""
    forms = ("application/octet-stream", "application/x-npy", "application/json")
    raw, npy, told = (client.get("/v1/beams/weights", headers={"accept": form}) for form in forms)
    given = raw.headers
    assert given["x-format"] == "complex64-le-row-major-1"
    shape = int(given["x-elements"]), int(given["x-beams"])
    matrix = np.frombuffer(raw.content, "<c8").reshape(shape)
    held = np.load(io.BytesIO(npy.content))
    assert held.flags.c_contiguous
    assert (held.shape, len(given["x-uavs"].split(","))) == (shape, shape[1] or 1)
    assert [int(turn) for turn in given["x-groups"].split(",") if turn] == told.json()["groups"]
    assert {given["x-method"], given["x-normalisation"]} == {
        told.json()["method"], told.json()["normalisation"]
    }  # fmt: skip
    assert int(given["x-valid-at-ns"]) > 0
    assert np.isfinite(matrix).all()


def test_non_finite_numbers_are_null(make_node: Any) -> None:
    node = make_node()
    node.rates = lambda: {"frames_hz": float("nan"), "updates_hz": float("inf")}
    with TestClient(create_app(node)) as client:
        assert client.get("/v1/status").json()["rates"] == {"frames_hz": None, "updates_hz": None}


def test_design_response_describes_the_active_observer(
    client: TestClient, shared_node: Any
) -> None:
    """L by its definition, A(T) M(T); the largest error within the guarantee, at each interval."""
    shown = client.get("/v1/design").json()
    pipeline, certificate = shared_node.pipeline, shown["certificate"]
    assert shown["assumed"]["acceleration_max_mps2"] == 16.0
    assert certificate["scale"] == pytest.approx(6.0)  # 3 m of noise instead of the table's 0.5 m
    p = np.array(certificate["P"])
    assert certificate["bound_m"] == pytest.approx(6 * np.sqrt(np.linalg.inv(p)[0, 0]))
    for row in shown["designs"]:
        now_ns = shared_node.now_ns()
        (track,) = [t for t in pipeline.tracks(now_ns, now_ns) if t.uav == row["uav"]]
        assert row["dt_s"] == track.dt_s
        transition = np.array([[1, row["dt_s"]], [0, 1]])
        assert np.allclose(np.array(row["L"]) + np.array(row["Q"]), transition)
        assert row["peak_gain"] <= row["gamma"] == certificate["bound_m"]
        assert row["mu"] == pytest.approx(row["gamma"] ** 2)
        closed = np.array(row["Q"])
        start = np.linalg.solve(np.linalg.cholesky(p).T, np.array([0.6, 0.8]))
        after = closed @ start
        assert after @ p @ after < start @ p @ start


def test_position_model_design_equals_companion_design_output(make_node: Any) -> None:
    node = make_node(observer={"model": "position", "alpha": 0.5})
    with TestClient(create_app(node)) as client:
        shown = client.get("/v1/design").json()
    holds(design.Design, shown)
    assert shown["certificate"] is None
    for row in shown["designs"]:
        lead_s = max(0.2, row["dt_s"])  # velocities are reported: velocity_lead_s, or the interval
        expected = answers.row(
            row["dt_s"],
            feedthrough_s=lead_s,
            alpha=0.5,
            mu_max=None,
            model="position",
            method="closed-form",
        )
        assert row == {"uav": row["uav"], **json.loads(json.dumps(expected))}


def test_beam_cost_is_null_loss_plus_time_slot_share(make_node: Any) -> None:
    """At so low a limit every UAV has its own time slot: no null loss, but a quarter of the
    time.
    """
    node = make_node(beams={"policy": "group", "condition_limit": 1.0001, "widen": False})
    node.tick(0.0)
    with TestClient(create_app(node)) as client:
        shown = client.get("/v1/beams").json()
    assert shown["groups"] == len(shown["beams"]) == 4
    for beam in shown["beams"]:
        assert beam["loss_db"] == pytest.approx(0.0, abs=1e-6)
        assert beam["cost_db"] == pytest.approx(beam["loss_db"] + 10 * np.log10(4))


def test_bearing_is_from_true_north_at_any_carrier_heading(
    client: TestClient, shared_node: Any
) -> None:
    """From the positions of track and carrier; angles in the array rotate with it."""
    now_ns, delay_ns = shared_node.now_ns(), 10_000_000
    headers = client.get("/v1/beams/weights", headers={"accept": "application/x-npy"}).headers
    later_s = (int(headers["x-valid-at-ns"]) - now_ns - delay_ns) * 1e-9
    assert 0 <= later_s <= 0.01
    update = shared_node.pipeline.look(now_ns, later_s)
    positions = {track.uav: track.position_ned_m for track in update.tracks}
    shown = client.get("/v1/beams").json()
    for beam in shown["beams"]:
        north, east, _ = positions[beam["uav"]] - update.carrier.position_ned_m
        off_deg = beam["bearing_deg"] - np.degrees(np.arctan2(east, north))
        assert (off_deg + 180) % 360 - 180 == pytest.approx(0.0, abs=0.01)
    assert abs(shown["array"]["boresight_bearing_deg"]) > 5  # the carrier is rotated


def test_arrival_lag_is_reported(make_node: Any) -> None:
    node = make_node()
    began_ns = node.now_ns()
    with TestClient(create_app(node)) as client:
        nothing = {
            "newest_s": None, "p95_s": None, "max_s": None, "behind": False, "longest_s": 0.0,
        }  # fmt: skip
        assert client.get("/v1/status").json()["arrival_lag"] == nothing
        assert "companion_arrival_lag" not in client.get("/metrics").text
        for tenth in range(20):
            node.arrival_lag.observe(began_ns + tenth * 100_000_000, 700_000_000 + tenth)
        node.tick(1.9)
        status = client.get("/v1/status").json()
        holds(state.Status, status)
        lag = {
            "newest_s": 0.700000019, "p95_s": 0.700000018, "max_s": 0.700000019, "behind": True,
            "longest_s": 0.700000019,
        }  # fmt: skip
        assert status["arrival_lag"] == pytest.approx(lag, abs=1e-10)
        assert status["health"]["behind"] == "this machine is overloaded: frames wait up to 700 ms"
        metrics = client.get("/metrics").text
    for name in ("", "_p95", "_max"):
        assert f"\ncompanion_arrival_lag{name}_seconds 0.7000000" in metrics
    assert '\ncompanion_link_misstamped_total{link="udpin:127.0.0.1:14550"} 0.0' in metrics


def test_no_way_out_calls_a_link_good_while_the_machine_is_overloaded(make_node: Any) -> None:
    node = make_node(link={"needed_db": -60.0})
    for _ in range(3):
        node.tick()
    assert Level.GOOD in {one.level for one in node.pipeline.health.verdicts.values()}

    def levels() -> dict[str, set[str]]:
        with TestClient(create_app(node)) as client:
            uavs = [one for one in client.get("/v1/uavs").json()["uavs"] if one["target"]]
            history = client.get("/v1/history").json()["uavs"].values()
            metrics = client.get("/metrics").text
            counts = client.get("/v1/status").json()["health"]
        return {
            "uavs": {one["verdict"] for one in uavs},
            "status": {level for level in ("good", "weak", "none") if counts[level]},
            "metrics": set(re.findall(r'verdict="(\w+)"} 1\.0', metrics)),
            "glance": {one["verdict"] for one in glance.glance(node)["uavs"] if one["verdict"]},
            "history": {words["verdict"][-1] for words in history} - {None},
        }

    node.series.add(node.pipeline, state.overload(node, node.now_ns()))
    assert all("good" in found for found in levels().values())
    node.arrival_lag.held_up(node.now_ns(), 700_000_000)
    node.series = series.Series()
    node.tick()
    assert Level.GOOD in {one.level for one in node.pipeline.health.verdicts.values()}
    node.series.add(node.pipeline, state.overload(node, node.now_ns()))
    assert not any("good" in found for found in levels().values())


def test_lost_carrier_is_shown_at_its_last_known_position(make_node: Any) -> None:
    node = make_node()
    with TestClient(create_app(node)) as client:
        before = client.get("/v1/status").json()
        for _ in range(4):
            node.tick(10.0)
        status = client.get("/v1/status").json()
        beams = client.get("/v1/beams").json()
    holds(state.Status, status)
    assert before["center"]["last_known"] is None
    center = status["center"]
    assert center["lat_deg"] is None and center["unfit"]
    assert center["last_known"]["lat_deg"] == pytest.approx(before["center"]["lat_deg"], abs=1e-4)
    assert center["last_known"]["at"] < status["time"]
    assert beams["left_out"] and {out["reason"] for out in beams["left_out"]} == {center["unfit"]}


def test_history_holds_the_charted_values(make_node: Any) -> None:
    node = make_node()
    for _ in range(6):
        node.tick()
        node.series.add(node.pipeline)
    with TestClient(create_app(node)) as client:
        history = client.get("/v1/history").json()
        center = client.get("/v1/status").json()["center"]
        uavs = client.get("/v1/uavs").json()["uavs"]
    holds(series.History, history)
    times = [datetime.fromisoformat(at).timestamp() for at in history["at"]]
    assert len(times) >= 5 and min(np.diff(times)) >= 0.999
    assert set(history["uavs"]) == {uav["id"] for uav in uavs if uav["target"]}
    for uav in uavs:
        if uav["target"]:
            columns = history["uavs"][uav["id"]]
            assert {len(column) for column in columns.values()} == {len(times)}
            last_db = columns["guaranteed_gain_db"][-1]
            assert uav["health"]["guaranteed_gain_db"] in (last_db, None)  # None: no beam since
            assert columns["innovation_m"][-1] is not None
            assert columns["pointing_bound_deg"][-1] > 0
            assert (columns["state"][-1], columns["verdict"][-1]) == (uav["state"], uav["verdict"])
            near = [columns[name][-1] for name in ("lat_deg", "lon_deg", "alt_m")]
            assert near == pytest.approx([uav["lat_deg"], uav["lon_deg"], uav["alt_m"]], rel=1e-3)
    assert history["carrier"]["lat_deg"][-1] == pytest.approx(center["lat_deg"], rel=1e-3)


def test_verdicts_are_in_responses_and_metrics(make_node: Any) -> None:
    node = make_node(link={"needed_db": 60.0})
    for _ in range(3):
        node.tick()
    with TestClient(create_app(node)) as client:
        uavs = client.get("/v1/uavs").json()["uavs"]
        health = client.get("/v1/status").json()["health"]
        metrics = client.get("/metrics").text
    shown = {uav["id"]: uav["verdict"] for uav in uavs if uav["target"]}
    assert shown and set(shown.values()) == {"none"}
    assert health == {
        "good": 0, "weak": 0, "none": len(shown), "behind": None,
        "headline": f"0 of {len(shown)} links good",
    }  # fmt: skip
    for uav in uavs:
        if uav["target"]:
            assert uav["health"]["reason"] and uav["health"]["remedy"]
            assert uav["health"]["needed_gain_db"] == 60.0
            likely_db = uav["health"]["likely_gain_db"]
            assert f'\ncompanion_likely_gain_decibels{{uav="{uav["id"]}"}} {likely_db}' in metrics
        else:
            assert uav["verdict"] is uav["health"] is None
    for uav in shown:
        assert f'\ncompanion_verdict{{uav="{uav}",verdict="none"}} 1.0' in metrics
        assert f'\ncompanion_verdict{{uav="{uav}",verdict="good"}} 0.0' in metrics


def test_reported_fix_is_near_the_estimate_and_labels_are_complete(client: TestClient) -> None:
    for uav in client.get("/v1/uavs").json()["uavs"]:
        for name, near in (("lat_deg", 0.5), ("lon_deg", 0.5), ("alt_m", 200.0)):
            assert uav["fix"][name] == pytest.approx(uav[name], abs=near)
    labels_of = client.get("/v1/labels").json()
    label = labels_of["values"]["UavState"]["innovation_m"]
    assert (label["label"], label["unit"]) == ("Innovation", "m")
    assert label["meaning"].startswith("distance from the prediction")
    assert labels_of["enumerations"]["Method"]["zf"] == "zero forcing"
