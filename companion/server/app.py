"""The HTTP API and the dashboard's files; read-only, except for ``observation_routes``."""

import asyncio
from pathlib import Path
from typing import Annotated, Final

from fastapi import FastAPI, HTTPException, Request, WebSocket
from fastapi import Path as PathParameter
from fastapi.responses import Response
from starlette.types import ASGIApp

import companion
from companion.server import area_map, beam_routes, file_routes, models, responses
from companion.server.access import OPEN_PATHS, BearerToken, KnownHosts, UntilGone, WrongTokens
from companion.server.giving_way import GivingWay
from companion.server.large_answers import FEW_ITEMS, LargeAnswers, Make
from companion.server.metrics import NodeMetrics
from companion.server.observation_routes import add_observations
from companion.server.page import PageFiles, web_directory
from companion.server.repeated_answers import RepeatedAnswers
from companion.server.responses import (
    BodyResponse,
    answer,
    answers,
    encode,
    encode_in_parts,
    encode_with_items,
    json_response,
    refusals,
)
from companion.server.security_headers import SecurityHeaders
from companion.server.stream import Stream
from companion.server.threads import in_thread
from companion.server.work_slots import WorkSlots
from companion.values import UAV_FORMS
from companion.views import fleet as fleet_view
from companion.views import glance, labels, series, settings, state, uav_state
from companion.views.as_json import as_json
from companion.views.design import Design, DesignView
from companion.views.link_state import Links
from companion.views.state import Node

Rounded = beam_routes.Rounded
UavId = Annotated[str, PathParameter(description=UAV_FORMS)]
DESCRIPTION: Final = """Location-aware beamforming from MAVLink. Read only, except observations.

Angles in degrees, distances in metres; null means unknown, never 0. Estimates are computed for
the time of the request, within 10 ms, given as `valid_at`. Short answers have an ETag, for
conditional requests. Errors are `application/problem+json` (RFC 9457).
`WS /v1/stream?uav=…&topic=…&rate_hz=…` sends `uavs`, `beams`, `weights`, `status`, `links`,
`fleet` and `events` as they change, and `records` in binary.
"""


def create_app(
    node: Node,
    token: str | None = None,
    area: Path | None = None,
    *,
    work_slots: WorkSlots | None = None,
) -> ASGIApp:
    """Return the ASGI application for a node.

    ``area`` is the map under the plan view (``companion.server.area_map``), ``work_slots`` are
    shared with the server, which yields to them.

    With a token, all paths need it except ``/healthz`` and the page's own files; the page asks the
    user for the token.
    """
    app = FastAPI(
        title="companion",
        version=companion.__version__,
        description=DESCRIPTION,
        docs_url=None,  # FastAPI's own pages load from elsewhere
        redoc_url=None,
        openapi_url=None,  # FastAPI's route would build the document on the event loop
    )
    app.router.redirect_slashes = False
    responses.install(app)
    work_slots = work_slots or WorkSlots()
    work_slots.is_overloaded = lambda: state.overload(node, node.now_ns()) is not None
    large = LargeAnswers(node, work_slots)
    stream, page = Stream(node, large), PageFiles(web_directory())
    wrong_tokens = WrongTokens(node)
    node_metrics = NodeMetrics(node, stream, wrong_tokens)
    _health_routes(app, node, large, node_metrics, needs_token=bool(token))
    _state_routes(app, node, large)
    beam_routes.add(app, node, work_slots)
    file_routes.add(app, node, large)
    add_observations(app, node)
    area_map.add(app, area)
    described = list["asyncio.Task[bytes]"]()

    @app.get("/openapi.json", include_in_schema=False)
    async def openapi() -> Response:
        if not described:  # built once: it takes most of a second of interpreter time
            making = in_thread(lambda: encode(app.openapi()))
            described.append(asyncio.create_task(making))
        try:
            return json_response(await asyncio.shield(described[0]))
        except RuntimeError:  # no thread can be started at present
            described.clear()
            raise

    @app.get("/docs", include_in_schema=False)
    async def docs(request: Request) -> Response:
        return page.answer("/docs.html", request.scope)

    @app.websocket("/v1/stream")
    async def streamed(websocket: WebSocket) -> None:
        await stream.serve(websocket)

    # Not mounted: a mount at / would match paths with a wrong method first, and hide the 405.
    app.router.default = page
    secured: ASGIApp = RepeatedAnswers(SecurityHeaders(app), node)
    if token:
        open_paths = OPEN_PATHS | page.paths
        secured = BearerToken(app=secured, token=token, open_paths=open_paths, wrong=wrong_tokens)
    return UntilGone(KnownHosts(secured, node.pipeline.settings.server.hosts))


def _health_routes(
    app: FastAPI, node: Node, large: LargeAnswers, node_metrics: NodeMetrics, *, needs_token: bool
) -> None:
    @app.get("/healthz", summary="Liveness of the process", responses=answers(models.Health))
    async def healthz() -> Response:
        return answer({"status": "ok", "needs_token": needs_token})

    @app.get(
        "/register_service",
        summary="Description of this service for BlueOS, which shows its page in a menu",
        responses=answers(models.Registration),
    )
    async def register_service() -> Response:
        return answer(as_json(models.REGISTRATION, node.pipeline.utc_ns))

    @app.get(
        "/readyz",
        summary="Whether the service is ready, or why not (503)",
        responses=answers(models.Readiness)
        | {
            503: {
                "model": models.model(models.Readiness),
                "description": "The service is not ready, for the given reasons",
            }
        },
    )
    async def readyz() -> Response:
        reasons = node.unfit()
        return answer({"ready": not reasons, "reasons": reasons}, 503 if reasons else 200)

    @app.get(
        "/metrics",
        summary="Prometheus metrics",
        response_class=Response,
        responses={200: {"content": {"text/plain": {}}}, **refusals(503)},
    )
    async def metrics() -> Response:
        made = await large.of_uavs("metrics", node_metrics.prepare)
        return BodyResponse(made, media_type="text/plain; version=0.0.4")


def _state_routes(app: FastAPI, node: Node, large: LargeAnswers) -> None:
    design_view, pipeline = DesignView(node.pipeline.settings), node.pipeline

    @app.get(
        "/v1/status",
        summary="Version, uptime, links, center, recording, rates",
        responses=answers(state.Status),
    )
    async def status() -> Response:
        return answer(state.status(node, companion.__version__))

    @app.get(
        "/v1/uavs", summary="Every UAV as it is now", responses=answers(uav_state.Uavs, 422, 503)
    )
    async def uavs(rounded: Rounded = False) -> Response:
        return json_response((await large.uavs(is_rounded=rounded)).whole)

    @app.get(
        "/v1/uavs/{uav}",
        summary="One UAV as it is now",
        responses=answers(uav_state.UavState, 404, 422),
    )
    async def one_uav(uav: UavId) -> Response:
        found = uav_state.states(node, node.now_ns(), only=uav)
        if not found:
            raise HTTPException(404, f"no UAV {uav!r} is tracked")
        return answer(as_json(found[0], node.pipeline.utc_ns))

    @app.get(
        "/v1/links",
        summary="Links, the components received over each, and the requested message rates",
        responses=answers(Links, 503),
    )
    async def links() -> Response:
        def prepare() -> Make[bytes]:
            show = state.links(node)
            return lambda way: encode_in_parts(show(), way, depth=4)

        many = state.component_count(node) > FEW_ITEMS
        return json_response(await large.made("links", prepare, is_large=many))

    @app.get(
        "/v1/fleet",
        summary="The nodes of the fleet, and the UAVs that each serves",
        responses=answers(fleet_view.Fleet, 503),
    )
    async def fleet() -> Response:
        def prepare() -> Make[bytes]:
            show = fleet_view.fleet(node.fleet_status(), node.now_ns())
            return lambda way: encode_in_parts(as_json(show(), pipeline.utc_ns), way)

        many = fleet_view.offer_count(node.fleet_status()) > FEW_ITEMS
        return json_response(await large.made("fleet", prepare, is_large=many))

    @app.get(
        "/v1/events", summary="The newest notices to the operator", responses=answers(glance.Events)
    )
    async def events() -> Response:
        return answer(glance.events(node))

    histories = dict[bool, tuple[series.Sample | None, bytes]]()  # rounded or not, of a sample

    @app.get(
        "/v1/history",
        summary=f"Samples of at most {series.UAVS_MAX} UAVs, those with beams first, and of the"
        " carrier, one per second of the last five minutes",
        responses=answers(series.History, 422, 503),
    )
    async def history(rounded: Rounded = False) -> Response:
        def prepare() -> Make[bytes]:
            samples, now_ns = node.series.samples(), node.now_ns()

            def make(way: GivingWay) -> bytes:
                shown = series.show(
                    samples,
                    now_ns,
                    pipeline.utc_ns,
                    is_rounded=rounded,
                    most=series.UAVS_MAX,
                    between=way.between,
                )
                return encode_in_parts(shown, way, depth=3)

            return make

        newest = node.series.newest
        sampled, body = histories.get(rounded, (None, b""))
        if sampled is None or sampled is not newest:
            body = await large.made(("history", rounded), prepare)
            for old in [one for one, (of, _) in histories.items() if of is not newest]:
                del histories[old]  # megabytes
            histories[rounded] = newest, body
        return json_response(body)

    @app.get(
        "/v1/settings",
        summary="The effective settings, and the origin of each",
        responses=answers(settings.EffectiveSettings),
    )
    async def effective() -> Response:
        return answer(settings.show(node.pipeline.settings, node.origins))

    shown_labels = encode(as_json(labels.labels(), node.pipeline.utc_ns))

    @app.get(
        "/v1/labels",
        summary="Names, units and meanings of values and enumerations, for pages",
        responses=answers(labels.Labels),
    )
    async def names() -> Response:
        return json_response(shown_labels)

    @app.get(
        "/v1/design",
        summary="The observer in use: gains at each UAV's interval, and their certificate",
        responses=answers(Design, 503),
    )
    async def design() -> Response:
        def prepare(seen: uav_state.Overview) -> Make[bytes]:
            def make(way: GivingWay) -> bytes:
                designs = design_view.designs(known.snapshot for known in seen.uavs)
                rows = (encode(as_json(one, pipeline.utc_ns)) for one in way.between(designs))
                return encode_with_items(design_view.show(seen.now_ns, pipeline.utc_ns), rows)

            return make

        return json_response(await large.of_uavs("design", prepare))
