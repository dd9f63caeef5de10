"""Answers that are given again within a moment, and conditional requests."""

import io
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from companion.server import repeated_answers
from companion.server.app import create_app
from companion.server.moments import EVERY_NS

SITE = "http://localhost"
PATHS = ("/v1/beams", "/v1/beams/weights", "/v1/uavs")
NPY = {"accept": "application/x-npy"}


@pytest.fixture
def node(make_node: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A node that counts the routed requests about a moment."""
    node = make_node()
    node.routed = []
    edge = repeated_answers.RepeatedAnswers.__init__

    def watched(self: Any, app: Any, of: Any) -> None:
        async def counted(scope: Any, receive: Any, send: Any) -> None:
            node.routed.append(scope["path"])
            await app(scope, receive, send)

        edge(self, counted, of)

    monkeypatch.setattr(repeated_answers.RepeatedAnswers, "__init__", watched)
    return node


@pytest.mark.parametrize("path", PATHS)
def test_an_answer_is_routed_once_in_a_moment(node: Any, path: str) -> None:
    client = TestClient(create_app(node), SITE)
    first, again = client.get(path), client.get(path)
    assert first.content == again.content and first.headers == again.headers
    assert node.routed == [path]
    node.advance(EVERY_NS * 1e-9)
    assert client.get(path).content != first.content
    assert node.routed == [path, path]


def test_requests_that_differ_get_their_own_answers(node: Any) -> None:
    client = TestClient(create_app(node), SITE)
    for _ in range(2):
        as_json = client.get("/v1/beams/weights")
        as_npy = client.get("/v1/beams/weights", headers=NPY)
        later = client.get("/v1/beams/weights?lead_ms=500", headers=NPY)
        plain = client.get("/v1/uavs", headers={"accept-encoding": "identity"})
        packed = client.get("/v1/uavs", headers={"accept-encoding": "gzip"})
        assert as_json.json()["uavs"]
        assert as_npy.content[:6] == b"\x93NUMPY" == later.content[:6]
        assert as_npy.content != later.content
        assert (plain.headers.get("content-encoding"), plain.json()) == (None, packed.json())
        assert packed.headers["content-encoding"] == "gzip"
    assert len(node.routed) == 5


def test_a_known_answer_is_not_sent_again(node: Any) -> None:
    client = TestClient(create_app(node), SITE)
    for path in (*PATHS, "/v1/settings", "/healthz"):
        for _ in range(2):  # the one that is made, and the one that is repeated
            whole = client.get(path)
            tag = whole.headers["etag"]
            same = client.get(path, headers={"if-none-match": f'"other", {tag}'})
            assert (same.status_code, same.content) == (304, b""), path
            assert same.headers["etag"] == tag
            assert "content-length" not in same.headers
            assert "content-type" not in same.headers
            assert "content-security-policy" in same.headers
            other = client.get(path, headers={"if-none-match": '"other"'})
            assert (other.status_code, other.content) == (200, whole.content)


def test_head_has_the_headers_of_get(node: Any) -> None:
    client = TestClient(create_app(node), SITE)
    for path in (*PATHS, "/v1/settings"):
        assert client.head(path).headers == client.get(path).headers
    assert node.routed.count("/v1/beams") == 1


def test_errors_are_not_repeated(node: Any) -> None:
    client = TestClient(create_app(node), SITE)
    for _ in range(2):
        wrong = client.get("/v1/beams?lead_ms=-1")
        assert wrong.status_code == 422 and "etag" not in wrong.headers
        assert client.get("/v1/beams/weights", headers={"accept": "text/x"}).status_code == 406
    assert len(node.routed) == 4


def test_a_repeated_answer_needs_the_token(node: Any) -> None:
    client = TestClient(create_app(node, token="a-long-enough-token"), SITE)
    right = {"authorization": "Bearer a-long-enough-token"}
    assert client.get("/v1/beams", headers=right).status_code == 200
    assert client.get("/v1/beams", headers=right).status_code == 200
    assert node.routed == ["/v1/beams"]
    assert client.get("/v1/beams").status_code == 401
    elsewhere = client.get("/v1/beams", headers={**right, "host": "elsewhere.example"})
    assert elsewhere.status_code == 421


def test_kept_answers_are_bounded(node: Any) -> None:
    client = TestClient(create_app(node), SITE)
    paths = [f"/v1/beams?lead_ms={lead}" for lead in range(repeated_answers.KEPT + 4)]
    for path in paths * 2:
        assert client.get(path).status_code == 200
    assert len(node.routed) == len(paths) + 4


def test_repeated_weights_are_the_computed_ones(node: Any) -> None:
    client = TestClient(create_app(node), SITE)
    found = [client.get("/v1/beams/weights?lead_ms=20", headers=NPY) for _ in range(2)]
    assert found[0].content == found[1].content
    moment_ns = -(-node.now_ns() // EVERY_NS) * EVERY_NS
    lead_s = (moment_ns - node.now_ns()) * 1e-9 + 0.02
    expected = node.pipeline.look(node.now_ns(), lead_s).beams.weights
    assert np.array_equal(np.load(io.BytesIO(found[1].content)), expected.astype("c8"))
