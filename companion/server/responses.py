"""How the API answers: JSON written fast, errors as problems (RFC 9457), and both documented.

No answer is validated on its way out: the models of ``models.py`` only describe it, and the tests
hold the answers against them.
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
    422: "A parameter is missing, or not of the allowed kind",
}


def encode(content: object) -> bytes:
    """JSON; what is not a finite number becomes null, for it is not known."""
    return orjson.dumps(content, option=orjson.OPT_NON_STR_KEYS | orjson.OPT_SERIALIZE_NUMPY)


def answer(content: object, status: int = 200) -> Response:
    """``content`` as JSON."""
    return Response(encode(content), status_code=status, media_type="application/json")


def problem(status: int, title: str, headers: dict[str, str] | None = None) -> JSONResponse:
    """An error as RFC 9457 has it."""
    body = {"type": "about:blank", "title": title, "status": status}
    return JSONResponse(body, status_code=status, headers=headers, media_type=PROBLEM_TYPE)


def answers(model: Any, *problems: int) -> dict[int | str, dict[str, Any]]:
    """What an operation answers, for the OpenAPI document: the model, or one of the problems."""
    return {200: {"model": model}} | refusals(*problems)


def refusals(*problems: int) -> dict[int | str, dict[str, Any]]:
    """The problems that an operation answers with, for the OpenAPI document."""
    return {
        status: {"model": models.Problem, "description": _MEANINGS[status]} for status in problems
    }


def install(app: FastAPI) -> None:
    """Every error of the application becomes a problem, and its document says so."""
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
    """A mistake of ours. uvicorn writes the traceback; it is nothing to show to who asked."""
    return problem(500, "the service failed to answer: its own mistake, which its log shows")


def _document(app: FastAPI) -> dict[str, Any]:
    """OpenAPI, problems under their own media type: FastAPI puts all models under JSON's."""
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
        app.openapi_schema = made
    return app.openapi_schema
