"""Responses of the API: fast JSON, errors as problems (RFC 9457), and their documentation.

Answers are not validated: the models of ``models.py`` only describe them, and the tests compare
both.
"""

import asyncio
from collections.abc import Iterable
from typing import Any, Final

import orjson
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.openapi.utils import get_openapi
from fastapi.responses import JSONResponse, Response
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import Receive, Scope, Send

from companion.server import models
from companion.server.compression import LEAST_BYTES, SharedCompression, is_text, preferred
from companion.server.giving_way import GivingWay
from companion.server.held_bodies import HELD
from companion.server.observation_model import ObservationInput
from companion.views.as_json import Json

PIECE_BYTES: Final = 65_536  # bytes of a body that are sent in one iteration of the event loop
PROBLEM_TYPE: Final = "application/problem+json"
_MEANINGS: Final = {
    403: "Not accepted from this client, or by the settings; the title says why",
    404: "Not found",
    406: "No supported media type is accepted",
    409: "Not possible in the current state; the title says why",
    413: "The request is too long",
    415: "The body is not application/json",
    416: "The range begins beyond the end of the file",
    503: "Too many requests at once",
    422: "A parameter, or the body, is missing or invalid",
}


def encode(content: object) -> bytes:
    """Return a value as JSON bytes; numbers that are not finite become null."""
    return orjson.dumps(content, option=orjson.OPT_NON_STR_KEYS | orjson.OPT_SERIALIZE_NUMPY)


def encode_in_parts(content: object, way: GivingWay, depth: int = 2) -> bytes:
    """Return the same bytes as ``encode``, without holding the interpreter for all of it.

    ``encode`` is one call, during which no other thread runs: 5 ms for a megabyte. Here it is
    called for each item ``depth`` containers deep, and gives way between them.
    """
    if depth and isinstance(content, dict):
        items = way.between(content.items())
        parts = [
            encode(str(key)) + b":" + encode_in_parts(one, way, depth - 1) for key, one in items
        ]
        return b"{" + b",".join(parts) + b"}"
    if depth and isinstance(content, list):
        some = [encode_in_parts(one, way, depth - 1) for one in way.between(content)]
        return b"[" + b",".join(some) + b"]"
    return encode(content)


def encode_with_items(head: Json, items: Iterable[bytes]) -> bytes:
    """Return ``head`` as JSON, with encoded items in its last value, an empty list."""
    return encode(head).removesuffix(b"]}") + b",".join(items) + b"]}"


class BodyResponse(Response):
    """Response whose body is sent a piece at a time, as fast as the client takes it.

    One call with a megabyte takes milliseconds in the kernel, and copies what the client does not
    take at once. Texts are compressed if the client accepts that.
    """

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the response; see ASGI."""
        await self._compress(Headers(scope=scope).get("accept-encoding", ""))
        if len(self.body) <= PIECE_BYTES:
            await super().__call__(scope, receive, send)
            return
        with HELD.hold(bytes(self.body)):
            await self._send_pieces(send)

    async def _send_pieces(self, send: Send) -> None:
        body, headers = memoryview(self.body), self.raw_headers
        await send({"type": "http.response.start", "status": self.status_code, "headers": headers})
        for start in range(0, len(body), PIECE_BYTES):
            piece, more = bytes(body[start : start + PIECE_BYTES]), start + PIECE_BYTES < len(body)
            await send({"type": "http.response.body", "body": piece, "more_body": more})
            await asyncio.sleep(0)

    async def _compress(self, accepted: str) -> None:
        if len(self.body) < LEAST_BYTES or not is_text(self.media_type):
            return
        self.headers.add_vary_header("accept-encoding")
        encoding = preferred(accepted)
        if encoding is not None:
            self.body = await _compression.of(bytes(self.body), encoding)
            self.headers["content-encoding"] = encoding
            self.headers["content-length"] = str(len(self.body))


_compression: Final = SharedCompression()


def answer(content: object, status: int = 200) -> Response:
    """Return a response with ``content`` as JSON."""
    return json_response(encode(content), status)


def json_response(body: bytes, status: int = 200) -> Response:
    """Return a response with a JSON body."""
    return BodyResponse(body, status_code=status, media_type="application/json")


def problem(status: int, title: str, headers: dict[str, str] | None = None) -> JSONResponse:
    """Return an error response by RFC 9457."""
    body = {"type": "about:blank", "title": title, "status": status}
    return JSONResponse(body, status_code=status, headers=headers, media_type=PROBLEM_TYPE)


def answers(kind: Any, *problems: int) -> dict[int | str, dict[str, Any]]:
    """Return the responses of an operation for the OpenAPI document: class and problems."""
    return {200: {"model": models.outward(kind)}} | refusals(*problems)


def refusals(*problems: int) -> dict[int | str, dict[str, Any]]:
    """Return the problems that an operation may answer with, for the OpenAPI document."""
    return {
        status: {"model": models.model(models.Problem), "description": _MEANINGS[status]}
        for status in problems
    }


def install(app: FastAPI) -> None:
    """Turn every error of the application into a problem, and document it."""
    app.add_exception_handler(HTTPException, _refused)
    app.add_exception_handler(RequestValidationError, _unprocessable)
    app.add_exception_handler(Exception, _failed)
    app.openapi = lambda: _document(app)  # type: ignore[method-assign]


async def _refused(_request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    return problem(error.status_code, str(error.detail), dict(error.headers or {}))


async def _unprocessable(_request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    wrong = error.errors()[0]
    where = ".".join(str(part) for part in wrong["loc"])
    return problem(422, f"{where}: {wrong['msg']}")


async def _failed(_request: Request, _error: Exception) -> JSONResponse:
    """Answer an unexpected error; uvicorn logs the traceback, which clients do not get."""
    return problem(500, "internal error of the service; see its log")


def _document(app: FastAPI) -> dict[str, Any]:
    """Return the OpenAPI document, with problems under their own media type instead of JSON."""
    if app.openapi_schema is None:
        made = get_openapi(
            title=app.title, version=app.version, description=app.description, routes=app.routes
        )
        for operations in made["paths"].values():
            for operation in operations.values():
                for shown in operation["responses"].values():
                    content = shown.get("content", {})
                    schema = content.get("application/json", {}).get("schema", {})
                    if schema.get("$ref", "").endswith("/Problem"):
                        shown["content"] = {PROBLEM_TYPE: content["application/json"]}
        schemas = made["components"]["schemas"]
        schemas[ObservationInput.__name__] = ObservationInput.model_json_schema()
        models.describe_enumerations(schemas)
        app.openapi_schema = made
    return app.openapi_schema
