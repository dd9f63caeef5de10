"""The API's responses: JSON written fast, errors as problems (RFC 9457), and both documented.

No answer is validated on its way out: the models of ``models.py`` only describe it, and the tests
compare the answers with them.
"""

from typing import Any, Final

import orjson
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.openapi.utils import get_openapi
from fastapi.responses import JSONResponse, Response
from starlette.exceptions import HTTPException

from companion.server import models

PROBLEM_TYPE: Final = "application/problem+json"
_MEANINGS: Final = {
    404: "There is no such thing",
    406: "It does not come in any form that is accepted",
    409: "Not as things are now; the title says why",
    416: "The file is shorter",
    503: "Too many ask at once",
    422: "A parameter is missing, or not of the allowed kind",
}


def encode(content: object) -> bytes:
    """JSON bytes; numbers that are not finite become null."""
    return orjson.dumps(content, option=orjson.OPT_NON_STR_KEYS | orjson.OPT_SERIALIZE_NUMPY)


def answer(content: object, status: int = 200) -> Response:
    """A response with ``content`` as JSON."""
    return json_response(encode(content), status)


def json_response(body: bytes, status: int = 200) -> Response:
    """A response of what is JSON already."""
    return Response(body, status_code=status, media_type="application/json")


def problem(status: int, title: str, headers: dict[str, str] | None = None) -> JSONResponse:
    """An error response as RFC 9457 has it."""
    body = {"type": "about:blank", "title": title, "status": status}
    return JSONResponse(body, status_code=status, headers=headers, media_type=PROBLEM_TYPE)


def answers(kind: Any, *problems: int) -> dict[int | str, dict[str, Any]]:
    """Responses of an operation, for the OpenAPI document: the described class, or a problem."""
    return {200: {"model": models.outward(kind)}} | refusals(*problems)


def refusals(*problems: int) -> dict[int | str, dict[str, Any]]:
    """Problems that an operation answers with, for the OpenAPI document."""
    return {
        status: {"model": models.model(models.Problem), "description": _MEANINGS[status]}
        for status in problems
    }


def install(app: FastAPI) -> None:
    """Turn every error of the application into a problem, and document it so."""
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
    """Answer an unexpected error; uvicorn logs the traceback, which is not shown to the client."""
    return problem(500, "the service failed to answer: its own mistake, which its log shows")


def _document(app: FastAPI) -> dict[str, Any]:
    """The OpenAPI document, with problems under their own media type, not under JSON's."""
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
        models.describe_enumerations(made["components"]["schemas"])
        app.openapi_schema = made
    return app.openapi_schema
