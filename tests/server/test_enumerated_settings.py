"""Every response matches the OpenAPI document for every value of an enumerated setting.

The settings are found in their model, so new settings and values are covered. The headers of
each binary weight format are checked against its bytes.
"""

import enum
import io
import json
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from starlette.testclient import TestClient

from companion.server.app import create_app
from companion.settings.model import Settings
from companion.values import Method, WeightFormat

PATHS = {
    "/v1/uavs/{uav}": "/v1/uavs/1:1",
    "/v1/recordings/{name}": None,  # a file, not JSON
    "/v1/map/tiles": None,
    "/metrics": None,
    "/v1/mavlink/vehicles/{sys}/components/{comp}/messages": (
        "/v1/mavlink/vehicles/1/components/1/messages"
    ),
    "/v1/mavlink/vehicles/{sys}/components/{comp}/messages/{name}": (
        "/v1/mavlink/vehicles/1/components/1/messages/HEARTBEAT"
    ),
}


def words(annotation: Any) -> Iterator[Any]:
    """Return the values that an annotation enumerates."""
    if typing.get_origin(annotation) is typing.Literal:
        yield from typing.get_args(annotation)
    elif typing.get_origin(annotation) in (typing.Union, types.UnionType, typing.Annotated):
        for part in typing.get_args(annotation):
            yield from words(part)
    elif isinstance(annotation, type) and issubclass(annotation, enum.Enum):
        yield from (one.value for one in annotation)
    elif annotation is bool:
        yield from (False, True)


def enumerated() -> list[tuple[str, str, Any]]:
    """Return section, key and value of each enumerated setting."""
    return [
        (section, key, value)
        for section, field in Settings.model_fields.items()
        for key, setting in typing.cast(Any, field.annotation).model_fields.items()
        for value in words(setting.annotation)
    ]


def beside(section: str, key: str, value: Any, *, folder: Path) -> dict[str, dict[str, object]]:
    """Return other settings that a value requires."""
    match section, key, value:
        case "array", "kind", "list":
            return {"array": {"positions_m": [[0, 0, 0], [0, 0.005, 0], [0, 0.01, 0]]}}
        case "codebook", "kind", "file":
            np.save(folder / "beams.npy", np.eye(64, dtype=complex)[:, :5])
            return {"codebook": {"file": str(folder / "beams.npy")}}
    return {}


def strict(document: dict[str, Any]) -> dict[str, Any]:
    """Return the document with additional properties disallowed in every object."""
    for schema in document["components"]["schemas"].values():
        if "properties" in schema:
            schema["additionalProperties"] = False
    return document


def faults(document: dict[str, Any], schema: dict[str, Any], answer: Any) -> list[str]:
    whole = {**schema, "components": document["components"]}
    found = jsonschema.Draft202012Validator(whole).iter_errors(answer)
    return [f"{error.json_path}: {error.message[:200]}" for error in found]


def check_every_answer(client: TestClient) -> int:
    """Check each JSON response of a service against its document; return their number."""
    document, checked = strict(client.get("/openapi.json").json()), 0
    for path, operations in document["paths"].items():
        asked = PATHS.get(path, path)
        if asked is None or "get" not in operations:
            continue
        answer = client.get(asked)
        content = operations["get"]["responses"][str(answer.status_code)]["content"]
        schema = content[answer.headers["content-type"]]["schema"]
        assert faults(document, schema, answer.json()) == [], path
        checked += answer.status_code == 200
    return checked


@pytest.mark.parametrize(("section", "key", "value"), enumerated())
def test_every_response_matches_the_openapi_document(
    make_node: Any, tmp_path: Path, section: str, key: str, value: Any
) -> None:
    more = beside(section, key, value, folder=tmp_path)
    given = more.setdefault(section, {})
    node = make_node(**{**more, section: {**given, key: value}})
    node.tick()
    with TestClient(create_app(node)) as client:
        assert check_every_answer(client) >= 18


def test_response_that_violates_the_document_is_detected(make_node: Any) -> None:
    """The document's methods were once copied by hand, and one was missing."""
    node = make_node(beams={"method": "mmse"})
    node.tick()
    with TestClient(create_app(node)) as client:
        document = strict(client.get("/openapi.json").json())
        beams = client.get("/v1/beams").json()
    schema = {"$ref": "#/components/schemas/Beams"}
    assert beams["method"] == Method.MMSE
    assert faults(document, schema, beams) == []
    document["components"]["schemas"]["Method"]["enum"].remove("mmse")
    assert faults(document, schema, beams)
    assert faults(document, schema, {**beams, "more": 1})


@pytest.mark.parametrize("method", list(Method))
def test_every_binary_format_matches_its_headers(make_node: Any, method: Method) -> None:
    node = make_node(beams={"method": method.value})
    node.tick()
    with TestClient(create_app(node)) as client:

        def weights(form: WeightFormat) -> Any:
            return client.get("/v1/beams/weights", headers={"accept": form.media_type})

        told = json.loads(weights(WeightFormat.JSON).content)
        matrix = np.array(told["re"]) + 1j * np.array(told["im"])
        for form in WeightFormat:
            answer = weights(form)
            if answer.status_code == 409:  # unsupported by the device, with a reason
                assert form in (WeightFormat.TMYTEK, WeightFormat.SIVERS)
                continue
            assert answer.headers["content-type"].partition(";")[0] == form.media_type
            head = answer.headers
            assert head["x-format"] == "complex64-le-row-major-1"
            assert (int(head["x-elements"]), int(head["x-beams"])) == matrix.shape
            assert head["x-uavs"].split(",") == told["uavs"]
            assert [int(slot) for slot in head["x-groups"].split(",")] == told["groups"]
            assert head["x-method"] == told["method"]
            assert head["x-normalisation"] == told["normalisation"]
        raw = np.frombuffer(weights(WeightFormat.RAW).content, "<c8").reshape(matrix.shape)
        packed = np.load(io.BytesIO(weights(WeightFormat.NPY).content))
    assert packed.dtype == np.dtype("<c8")
    for found in (raw, packed):
        assert np.abs(found - matrix).max() <= 1e-6 * np.abs(matrix).max()
