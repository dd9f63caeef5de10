"""Messages of ``/v1/stream``: a body for each topic, and the part of it that a client requested."""

import inspect
from collections.abc import Callable
from dataclasses import replace
from enum import StrEnum
from typing import Any, Final

from starlette.concurrency import run_in_threadpool

import companion
from companion.server.responses import encode
from companion.values import BeamSet
from companion.views import beam_state, glance, guaranteed_gain, records, state, uav_state
from companion.views import fleet as fleet_view
from companion.views.as_json import Json
from companion.views.state import Node


class Topic(StrEnum):
    """Topic of the stream; its messages equal the answers of the path of that name."""

    UAVS = "uavs"
    BEAMS = "beams"
    WEIGHTS = "weights"
    RECORDS = "records"
    STATUS = "status"
    LINKS = "links"
    FLEET = "fleet"
    EVENTS = "events"


def message(topic: Topic, body: Json, uavs: frozenset[str]) -> str | bytes:
    """Return a topic's body as sent: binary for records, else JSON; only ``uavs`` if not empty."""
    if topic is Topic.RECORDS:
        return _record(body, uavs)
    return encode({"topic": topic, **(_only(topic, body, uavs) if uavs else body)}).decode()


def _record(body: Json, uavs: frozenset[str]) -> bytes:
    made: BeamSet = body["beams"]
    kept = [i for i, uav in enumerate(made.uavs) if not uavs or uav in uavs]
    shown = replace(made, beams=tuple(made.beams[i] for i in kept), weights=made.weights[:, kept])
    sure = body["guaranteed_db"]
    held = None if sure is None else [sure[i] for i in kept]
    (whole,) = records.encode(shown, body["sequence"], held)
    return whole


def _only(topic: Topic, body: Json, uavs: frozenset[str]) -> Json:
    """Return a body without other UAVs; values that belong to no UAV stay."""
    match topic:
        case Topic.UAVS:
            return body | {"uavs": [one for one in body["uavs"] if one["id"] in uavs]}
        case Topic.BEAMS:
            parts = {
                key: [one for one in body[key] if one["uav"] in uavs]
                for key in ("beams", "left_out")
            }
            return body | parts
        case Topic.WEIGHTS:
            columns = [i for i, uav in enumerate(body["uavs"]) if uav in uavs]
            return body | {
                "uavs": [body["uavs"][i] for i in columns],
                "groups": [body["groups"][i] for i in columns],
                "re": [[row[i] for i in columns] for row in body["re"]],
                "im": [[row[i] for i in columns] for row in body["im"]],
            }
        case _:
            return body


async def _beams(node: Node) -> Json:
    update = node.pipeline.last_update or node.pipeline.look(node.now_ns())
    age_s = (node.now_ns() - update.t_ns) * 1e-9
    return await run_in_threadpool(
        beam_state.beams, node.pipeline, node.equipment, update, age_s=age_s, lead_ms=0.0
    )


def _weights(node: Node) -> Json:
    update = node.pipeline.last_update or node.pipeline.look(node.now_ns())
    return beam_state.weights(node.pipeline, update.beams, 0.0)


async def _records(node: Node) -> Json:
    pipeline = node.pipeline
    update, number = pipeline.last_update, max(pipeline.updates - 1, 0)
    update = update or pipeline.look(node.now_ns())
    sure = None
    if pipeline.settings.records.guaranteed:
        sure = await run_in_threadpool(guaranteed_gain.gains_db, pipeline, node.equipment, update)
    return {
        "beams": records.in_utc(pipeline, update.beams),
        "sequence": number,
        "guaranteed_db": sure,
    }


def _status(node: Node) -> Json:
    shown = state.status(node, companion.__version__)
    return {"valid_at": shown["time"], **shown}


BODIES: Final[dict[Topic, Callable[[Node], Any]]] = {
    Topic.UAVS: uav_state.uavs,
    Topic.BEAMS: _beams,
    Topic.WEIGHTS: _weights,
    Topic.RECORDS: _records,
    Topic.STATUS: _status,
    Topic.LINKS: state.links,
    Topic.FLEET: lambda node: fleet_view.fleet(node.pipeline, node.fleet_status(), node.now_ns()),
    Topic.EVENTS: glance.events,
}


async def body(topic: Topic, node: Node) -> Json:
    """Return the body of a topic, as the path of the same name answers."""
    made = BODIES[topic](node)
    found: Json = await made if inspect.isawaitable(made) else made
    return found
