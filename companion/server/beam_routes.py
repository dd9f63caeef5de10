"""The routes ``/v1/beams``, ``/v1/beams/weights`` and ``/v1/pattern``, computed on request."""

import re
from typing import Annotated, Any, Final

from fastapi import FastAPI, HTTPException, Query, Request
from fastapi.responses import Response

from companion.server import models
from companion.server.moments import Moments
from companion.server.responses import BodyResponse, answers, encode, json_response, refusals
from companion.server.work_slots import WorkSlots
from companion.values import Update, UserError, WeightFormat
from companion.views import as_json, beam_state, weight_formats
from companion.views import pattern as pattern_view
from companion.views.state import Node

ACCEPTED_MOST: Final = 32  # media types of an Accept header that are read
ANGLES_MAX: Final = 20_000
"""Limit on beams times angles in one answer, which then takes half a second."""
LeadMs = Annotated[float, Query(ge=0, le=10_000, description="milliseconds ahead of now")]
Cut = Annotated[
    pattern_view.Cut, Query(description="the angle that varies; the other is the beam's own")
]
Points = Annotated[int, Query(ge=2, le=3601, description="angles along the cut")]
Only = Annotated[str | None, Query(description="SYSID:COMPID; default: every beam")]
Rounded = Annotated[
    bool, Query(description="round for a display: coordinates to 7 decimals, other numbers to 3")
]
_JSON = {"schema": {"$ref": "#/components/schemas/Weights"}}
_BINARY: dict[str, Any] = {"schema": {"type": "string", "format": "binary"}}


def add(app: FastAPI, node: Node, work_slots: WorkSlots) -> None:
    """Add the routes to the application; they compute in ``work_slots``."""
    pipeline, equipment = node.pipeline, node.equipment
    moments = Moments(node, work_slots)

    @app.get(
        "/v1/beams",
        summary="The beams, applied lead_ms from now",
        responses=answers(beam_state.Beams, 422, 503),
    )
    async def beams(lead_ms: LeadMs = 0.0, rounded: Rounded = False) -> Response:
        def make(update: Update) -> bytes:
            shown = beam_state.beams(pipeline, equipment, update, age_s=0.0, lead_ms=lead_ms)
            return encode(as_json.rounded(shown) if rounded else shown)

        what = "beams", rounded
        return json_response(await moments.made(lead_ms, what, make, is_usual=True))

    @app.get(
        "/v1/beams/weights",
        summary="The M×N weights, by Accept: JSON, application/x-npy, raw, or a device's format",
        response_class=Response,
        responses=_weight_answers(),
    )
    async def weights(request: Request, lead_ms: LeadMs = 0.0, uav: Only = None) -> Response:
        form = accepted(request.headers.get("accept", "*/*"))
        if form is None:
            raise HTTPException(
                406, f"supported types: {', '.join(form.media_type for form in WeightFormat)}"
            )

        def make(update: Update) -> tuple[bytes, dict[str, str]]:
            made = update.beams
            if uav is not None:
                made = made.of([i for i, one in enumerate(made.uavs) if one == uav])
            body = weight_formats.encode(form, made, pipeline, equipment, lead_ms)
            return body, {**weight_formats.headers(pipeline, made), "vary": "accept"}

        try:
            what, is_usual = (form, uav), uav is None
            body, headers = await moments.made(lead_ms, what, make, is_usual=is_usual)
        except UserError as error:  # the device cannot apply the current beams
            raise HTTPException(409, str(error)) from error
        return BodyResponse(body, media_type=form.media_type, headers=headers)

    @app.get(
        "/v1/pattern",
        summary="Array response in dB along a cut through each beam",
        responses=answers(pattern_view.Pattern, 404, 422, 503),
    )
    async def pattern(
        cut: Cut = "azimuth", points: Points = 361, uav: Only = None, lead_ms: LeadMs = 0.0
    ) -> Response:
        # A UAV that has lost its beam a moment ago is no mistake of the client.
        is_tracked = uav is not None and uav in pipeline.tracker.uavs

        def make(update: Update) -> bytes:
            served = update.beams.uavs
            if uav is not None and uav not in served and not is_tracked:
                raise HTTPException(404, f"no UAV {uav!r} is tracked")
            shown = 1 if uav is not None else len(served)
            if shown * points > ANGLES_MAX:
                wanted = f"{shown} beams at {points} angles"
                raise HTTPException(422, f"too large: {wanted}; give uav, or fewer points")
            return encode(
                pattern_view.pattern(
                    pipeline, update, cut, points=points, only=uav, lead_ms=lead_ms
                )
            )

        return json_response(await moments.made(lead_ms, (cut, points, uav), make))


def _weight_answers() -> dict[int | str, dict[str, Any]]:
    kinds = dict.fromkeys((form.media_type for form in WeightFormat), _BINARY)
    # The model puts its schema into the document; the content says where it applies.
    content = {
        "model": models.model(beam_state.Weights),
        "content": kinds | {"application/json": _JSON},
    }
    return {200: content} | refusals(406, 409, 422, 503)


def accepted(accept: str) -> WeightFormat | None:
    """Return the weight format that an Accept header prefers; None if it accepts none.

    By RFC 9110, the format with the highest q is preferred, the first of equal ones. Of a longer
    list only the first ``ACCEPTED_MOST`` are read.
    """
    forms = {form.media_type: form for form in WeightFormat}
    parts = [part.lower().replace(" ", "") for part in accept.split(",", ACCEPTED_MOST)]
    del parts[ACCEPTED_MOST:]
    for part in sorted(parts, key=_quality, reverse=True):
        wanted = part.split(";")[0]
        if _quality(part) <= 0:
            break
        if wanted in forms:
            return forms[wanted]
        if wanted in ("*/*", "application/*", ""):
            return WeightFormat.JSON
    return None


def _quality(part: str) -> float:
    """Return the q value of one part of an Accept header; 1 if missing or malformed."""
    found = re.search(r";q=([01](?:\.\d*)?)(?:;|$)", part)
    return float(found[1]) if found else 1.0
