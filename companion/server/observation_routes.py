"""The route ``POST /v1/observations``: what the array's own receiver measures.

It is the only route that changes anything. A page of another site may send simple requests to this
machine without being asked; such a request has no ``application/json`` body, and its ``Origin``
names another site. Both are rejected.
"""

import asyncio
import time
from typing import Any, Final

import orjson
from fastapi import FastAPI, HTTPException, Request
from fastapi.responses import Response

from companion.server import models
from companion.server.access import is_same_site
from companion.server.connections import BODY_BYTES
from companion.server.observation_model import (
    ObservationError,
    ObservationInput,
    ObservationsAccepted,
    to_observation,
)
from companion.server.responses import answer, refusals
from companion.views.as_json import as_json
from companion.views.state import Node

OBSERVATIONS_MAX: Final = 400  # most observations in one request
ERRORS_MAX: Final = 20  # most errors in one answer
SLICE_S: Final = 0.001  # time slice, after which other work of the event loop runs
PATH: Final = "/v1/observations"
_ITEM: Final = {"$ref": f"#/components/schemas/{ObservationInput.__name__}"}
BODY: Final[dict[str, Any]] = {
    "required": True,
    "description": f"one observation, or a list of 1 to {OBSERVATIONS_MAX};"
    f" at most {BODY_BYTES} bytes",
    "content": {
        "application/json": {
            "schema": {
                "anyOf": [
                    _ITEM,
                    {"type": "array", "items": _ITEM, "minItems": 1, "maxItems": OBSERVATIONS_MAX},
                ]
            }
        }
    },
}


def add_observations(app: FastAPI, node: Node) -> None:
    """Add the route to the application."""
    one_at_a_time = asyncio.Lock()  # the slices of many requests would add up

    @app.post(
        PATH,
        summary="Give measurements of the array's own receiver: directions, or powers through"
        " beams",
        status_code=202,
        responses={
            202: {
                "model": models.model(ObservationsAccepted),
                "description": "At least one observation was accepted",
            },
            **refusals(403, 409, 413),
            **refusals(415, 422, 503),
        },
        openapi_extra={"requestBody": BODY},
    )
    async def observations(request: Request) -> Response:
        arrival_ns = node.now_ns()
        _check_allowed(request, node)
        items = _items(await _body(request))
        async with one_at_a_time:
            found = await _process(node, items, arrival_ns)
        if found.accepted == 0 and found.errors:
            first = found.errors[0]
            raise HTTPException(422, f"item {first.item}: {first.title}")
        if found.accepted == 0:
            raise HTTPException(503, "too many observations at once", {"retry-after": "1"})
        return answer(as_json(found, node.pipeline.utc_ns), 202)


def _check_allowed(request: Request, node: Node) -> None:
    """Raise ``HTTPException`` unless this service takes observations from this client."""
    origin = request.headers.get("origin")
    if not is_same_site(origin, request.headers.get("host")):
        raise HTTPException(403, "requests of pages of other sites are not accepted")
    if node.replay() is not None:
        raise HTTPException(409, "a replay takes no observations; send them to the live service")
    if not node.pipeline.settings.observations.enabled:
        raise HTTPException(
            403, "observations are not accepted; set `[observations] enabled = true`"
        )
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type != "application/json":
        raise HTTPException(415, "the body is not application/json; set the header content-type")


async def _body(request: Request) -> bytes:
    """Return the body of a request. Raises ``HTTPException`` 413 beyond ``BODY_BYTES``."""
    body = bytearray()
    async for piece in request.stream():
        body += piece
        if len(body) > BODY_BYTES:
            raise HTTPException(413, f"the body has more than {BODY_BYTES} bytes; send fewer items")
    return bytes(body)


def _items(body: bytes) -> list[object]:
    try:
        given = orjson.loads(body)
    except ValueError as error:
        raise HTTPException(422, f"body: is not JSON: {error}") from error
    items = given if isinstance(given, list) else [given]
    if not items:
        raise HTTPException(422, "body: the list is empty; give at least one observation")
    if len(items) > OBSERVATIONS_MAX:
        title = f"{len(items)} observations; send at most {OBSERVATIONS_MAX} in one request"
        raise HTTPException(413, title)
    return items


async def _process(node: Node, items: list[object], arrival_ns: int) -> ObservationsAccepted:
    accepted = dropped = 0
    errors: list[ObservationError] = []
    until_s = time.monotonic() + SLICE_S
    for index, given in enumerate(items):
        if time.monotonic() > until_s:
            await asyncio.sleep(0)
            until_s = time.monotonic() + SLICE_S
        if not node.may_observe():
            dropped += 1
            continue
        found = to_observation(
            given,
            arrival_ns=arrival_ns,
            now_ns=node.now_ns(),
            utc_offset_ns=node.pipeline.utc_offset_ns,
        )
        node.observe(found)
        if not isinstance(found, str):
            accepted += 1
        elif len(errors) < ERRORS_MAX:
            errors.append(ObservationError(index, found))
    return ObservationsAccepted(accepted, dropped, errors)
