"""The HTTP API and the dashboard's files, over a running node. Read only."""

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import FastAPI, HTTPException, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from fastapi.staticfiles import StaticFiles
from prometheus_client import CollectorRegistry, generate_latest
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

import companion
from companion.server import beam_views, link_views, views, weight_formats
from companion.server.access import BearerToken
from companion.server.metrics import NodeCollector
from companion.server.views import Node
from companion.server.words import rfc3339
from companion.values import Update

LeadMs = Annotated[float, Query(ge=0, le=10_000, description="milliseconds ahead of now")]
CONTENT_POLICY = b"default-src 'self'; frame-ancestors 'none'"


def create_app(node: Node, token: str | None = None) -> ASGIApp:
    """The ASGI application for a node; with a token, all but ``/healthz`` asks for it."""
    app = FastAPI(
        title="companion",
        version=companion.__version__,
        description="Location-aware beamforming from MAVLink.",
    )
    app.add_exception_handler(StarletteHTTPException, _problem)
    app.add_exception_handler(RequestValidationError, _unprocessable)
    _health_routes(app, node)
    _state_routes(app, node)
    _beam_routes(app, node)
    app.mount("/", StaticFiles(directory=web_directory(), html=True))
    secured: ASGIApp = _ContentPolicy(app)
    return BearerToken(secured, token) if token else secured


def web_directory() -> Path:
    """Where the dashboard's files are: inside the installed package, or beside it in a checkout."""
    package = Path(companion.__file__).parent
    installed = package / "_web"
    return installed if installed.is_dir() else package.parent / "web"


def _health_routes(app: FastAPI, node: Node) -> None:
    registry = CollectorRegistry(auto_describe=False)
    registry.register(NodeCollector(node))

    @app.get("/healthz", summary="The process answers")
    async def healthz() -> dict[str, str]:
        return {"status": "ok"}

    @app.get("/readyz", summary="Fit to be used, or why not (503)")
    async def readyz() -> JSONResponse:
        reasons = node.unfit()
        return JSONResponse(
            {"ready": not reasons, "reasons": reasons}, status_code=503 if reasons else 200
        )

    @app.get("/metrics", summary="Prometheus")
    async def metrics() -> Response:
        return Response(generate_latest(registry), media_type="text/plain; version=0.0.4")


def _state_routes(app: FastAPI, node: Node) -> None:
    @app.get("/v1/status", summary="Version, uptime, links, center, recording, rates")
    async def status() -> dict[str, Any]:
        return views.status(node, companion.__version__)

    @app.get("/v1/uavs", summary="Every UAV as it is now")
    async def uavs() -> dict[str, Any]:
        return {"valid_at": rfc3339(node.now_ns()), "uavs": views.uavs(node)}

    @app.get("/v1/uavs/{uav}", summary="One UAV as it is now")
    async def one_uav(uav: str) -> dict[str, Any]:
        found = views.uavs(node, only=uav)
        if not found:
            raise HTTPException(404, f"no UAV {uav!r} has been heard")
        return found[0]

    @app.get("/v1/links", summary="Links, who is heard over each, and the rates asked for")
    async def links() -> dict[str, Any]:
        now_ns = node.now_ns()
        shown = [
            link_views.link(item, node.pipeline.link_share(item.url), now_ns)
            | {"components": link_views.components(item, now_ns)}
            for item in node.links()
        ]
        rates = [link_views.rate(rate) for rate in node.message_rates()]
        return {"valid_at": rfc3339(now_ns), "links": shown, "message_rates": rates}

    @app.get("/v1/events", summary="What was said to the operator last")
    async def events() -> dict[str, Any]:
        return {"events": [link_views.event(notice) for notice in node.events()]}


def _beam_routes(app: FastAPI, node: Node) -> None:
    pipeline, equipment = node.pipeline, node.equipment

    def look(lead_ms: float) -> Update:
        return pipeline.look(node.now_ns(), lead_ms * 1e-3)

    @app.get("/v1/beams", summary="The beams, applied lead_ms from now")
    async def beams(lead_ms: LeadMs = 0.0) -> dict[str, Any]:
        update = look(lead_ms)
        return await run_in_threadpool(beam_views.beams, pipeline, equipment, update, 0.0, lead_ms)

    @app.get(
        "/v1/beams/weights",
        summary="The M×N weights, by Accept: JSON, application/x-npy, raw, or a device's format",
        response_class=Response,
        responses={200: {"content": {kind: {} for kind in weight_formats.TYPES.values()}}},
    )
    async def weights(request: Request, lead_ms: LeadMs = 0.0) -> Response:
        form = _accepted(request.headers.get("accept", "*/*"))
        if form is None:
            raise HTTPException(406, f"weights come as {', '.join(weight_formats.TYPES.values())}")
        beam_set = look(lead_ms).beams
        try:
            body = await run_in_threadpool(
                weight_formats.encode, form, beam_set, pipeline.array, equipment, lead_ms
            )
        except ValueError as error:  # what the device cannot do, as the beams are now
            raise HTTPException(409, str(error)) from error
        headers = {
            "x-valid-at": rfc3339(beam_set.valid_at_ns),
            "x-uavs": ",".join(beam_set.uavs),
            "x-normalisation": str(beam_set.normalisation),
        }
        return Response(body, media_type=weight_formats.TYPES[form], headers=headers)

    @app.get("/v1/pattern", summary="Array response in dB along a cut through each beam")
    async def pattern(
        cut: Literal["azimuth", "elevation"] = "azimuth",
        points: Annotated[int, Query(ge=2, le=3601)] = 361,
        uav: str | None = None,
        lead_ms: LeadMs = 0.0,
    ) -> dict[str, Any]:
        update = look(lead_ms)
        if uav is not None and uav not in update.beams.uavs:
            raise HTTPException(404, f"there is no beam on {uav!r}")
        return await run_in_threadpool(
            beam_views.pattern, pipeline, update, cut, points, uav, lead_ms
        )


def _accepted(accept: str) -> str | None:
    """The form that an Accept header likes best (RFC 9110: by q, the first of those alike); None
    where it takes none of them."""
    forms = {media_type: form for form, media_type in weight_formats.TYPES.items()}
    parts = [part.lower().replace(" ", "") for part in accept.split(",")]
    for part in sorted(parts, key=_quality, reverse=True):
        wanted = part.split(";")[0]
        if _quality(part) <= 0:
            break
        if wanted in forms:
            return forms[wanted]
        if wanted in ("*/*", "application/*", ""):
            return "json"
    return None


def _quality(part: str) -> float:
    """The q of one part of an Accept header; 1 where there is none that can be read."""
    found = re.search(r";q=([01](?:\.\d*)?)(?:;|$)", part)
    return float(found[1]) if found else 1.0


def problem(status: int, title: str, headers: dict[str, str] | None = None) -> JSONResponse:
    """An error as RFC 9457 has it."""
    body = {"type": "about:blank", "title": title, "status": status}
    return JSONResponse(
        body, status_code=status, headers=headers, media_type="application/problem+json"
    )


async def _problem(_request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, StarletteHTTPException)
    return problem(error.status_code, str(error.detail), dict(error.headers or {}))


async def _unprocessable(_request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    wrong = error.errors()[0]
    where = ".".join(str(part) for part in wrong["loc"])
    return problem(422, f"{where}: {wrong['msg']}")


class _ContentPolicy:
    """ASGI middleware: nothing on the page comes from elsewhere (but for ``/docs``)."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["path"] == "/docs":
            await self._app(scope, receive, send)
            return

        async def with_policy(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [
                    *message.get("headers", []),
                    (b"content-security-policy", CONTENT_POLICY),
                    (b"x-content-type-options", b"nosniff"),
                    (b"cache-control", b"no-cache"),
                ]
            await send(message)

        await self._app(scope, receive, with_policy)
