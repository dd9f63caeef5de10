"""Requests generated from the OpenAPI document: every response conforms, and none is a 500.

Schemathesis generates allowed and disallowed requests, seeded and bounded.
"""

from typing import Any
from urllib.parse import quote

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, seed
from hypothesis import settings as run_with
from hypothesis import strategies as st
from hypothesis.errors import Unsatisfiable
from starlette.testclient import TestClient
from support import examples

from companion.server.app import create_app
from companion.server.responses import PROBLEM_TYPE

OPERATIONS = 26
WITH_RULES = {"/v1/beams", "/v1/beams/weights", "/v1/pattern"}
EXAMPLES = 12
EXAMPLES_SOAK = 150


def check_every_operation(node: Any, examples: int) -> tuple[int, set[str]]:
    """Return how many operations there are, and for how many invalid requests can be generated."""
    schema = schemathesis.openapi.from_asgi("/openapi.json", create_app(node))
    found, broken = 0, set()
    for result in schema.get_all_operations():
        operation = result.ok()
        for mode in (schemathesis.GenerationMode.POSITIVE, schemathesis.GenerationMode.NEGATIVE):

            @seed(1)
            @run_with(
                max_examples=examples,
                database=None,
                deadline=None,
                phases=[Phase.explicit, Phase.generate],
                suppress_health_check=list(HealthCheck),
            )
            @given(case=operation.as_strategy(generation_mode=mode))
            def check(case: Any) -> None:
                answer = case.call_and_validate()
                assert answer.status_code < 500

            try:
                check()
            except Unsatisfiable:  # without parameters no invalid request exists
                assert mode is schemathesis.GenerationMode.NEGATIVE
            else:
                if mode is schemathesis.GenerationMode.NEGATIVE:
                    broken.add(operation.path)
        found += 1
    return found, broken


@pytest.mark.full
def test_every_response_conforms_to_the_openapi_document(shared_node: Any) -> None:
    found, broken = check_every_operation(shared_node, EXAMPLES)
    assert found == OPERATIONS
    assert broken >= WITH_RULES


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_every_response_conforms_to_the_openapi_document_soak(shared_node: Any) -> None:
    assert check_every_operation(shared_node, EXAMPLES_SOAK)[0] == OPERATIONS


NAMES = ["/v1/uavs/", "/v1/recordings/", "/v1/mavlink/vehicles/1/components/1/messages/", "/v1/"]
QUERIES = ["lead_ms", "points", "cut", "uav", "rate_hz", "x"]


@pytest.mark.full
@run_with(
    max_examples=examples(150),
    deadline=None,
    suppress_health_check=list(HealthCheck),
    database=None,
)
@seed(2)
@given(
    method=st.sampled_from(["GET", "HEAD", "POST", "PUT", "DELETE", "OPTIONS", "TRACE", "NOPE"]),
    path=st.sampled_from([*NAMES, "/v1/beams", "/v1/beams/weights", "/v1/pattern", "/"]),
    name=st.text(max_size=20),
    query=st.dictionaries(st.sampled_from(QUERIES), st.text(max_size=12), max_size=3),
    accept=st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=30),
    span=st.text("bytes=0123456789-, ", max_size=20),
)
def test_no_request_causes_an_internal_error(
    *,
    shared_node: Any,
    method: str,
    path: str,
    name: str,
    query: dict[str, str],
    accept: str,
    span: str,
) -> None:
    client = TestClient(create_app(shared_node), raise_server_exceptions=True)
    headers = {"accept": accept, "range": span}
    address = path + (quote(name, safe="") if path in NAMES else "")
    answer = client.request(method, address, params=query, headers=headers)
    assert answer.status_code < 500
    if answer.status_code >= 400:
        assert answer.headers["content-type"] == PROBLEM_TYPE
