"""Messages of ``/v1/stream``: a body for each topic, and the part of it that a client requested."""

from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import Final

import companion
from companion.server.giving_way import GivingWay
from companion.server.large_answers import FEW_ITEMS, FEW_UAVS, LargeAnswers, Make, UavParts
from companion.server.responses import encode_in_parts
from companion.values import BeamSet
from companion.views import beam_state, glance, guaranteed_gain, records, state
from companion.views import fleet as fleet_view
from companion.views.as_json import Json, as_json
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


@dataclass(frozen=True, slots=True)
class RecordBody:
    """Beams of one update as they go into a record; their times are in UTC."""

    beams: BeamSet
    sequence: int
    guaranteed_db: list[float | None] | None


OF_UAVS: Final = frozenset({Topic.UAVS, Topic.BEAMS, Topic.WEIGHTS, Topic.RECORDS})
"""Topics whose messages depend on the UAVs that a client names."""

Body = Json | RecordBody | UavParts

FEW_WEIGHTS: Final = 2048  # weights up to which the event loop encodes at once


def message(topic: Topic, body: Body, uavs: frozenset[str], way: GivingWay) -> str | bytes:
    """Return a topic's body as sent: binary for records, else JSON; only ``uavs`` if not empty."""
    if isinstance(body, RecordBody):
        return _record(body, uavs)
    if isinstance(body, UavParts):
        return body.encode({"topic": topic}, uavs).decode()
    shown = _only(topic, body, uavs) if uavs else body
    depth = 4 if topic is Topic.LINKS else 2
    return encode_in_parts({"topic": topic, **shown}, way, depth).decode()


def is_large(topic: Topic, body: Body, uavs: frozenset[str]) -> bool:
    """Return whether the encoding of a message would delay the event loop."""
    if isinstance(body, RecordBody):
        return body.beams.weights.size > FEW_WEIGHTS
    if topic is not Topic.LINKS and 0 < len(uavs) <= FEW_UAVS:
        return False
    if isinstance(body, UavParts):
        return len(body.parts) > FEW_UAVS
    match topic:
        case Topic.BEAMS:
            return len(body["beams"]) + len(body["left_out"]) > FEW_ITEMS
        case Topic.WEIGHTS:
            return len(body["uavs"]) * len(body["re"]) > FEW_WEIGHTS
        case Topic.LINKS:
            return sum(len(one["components"]) for one in body["links"]) > FEW_ITEMS
        case Topic.FLEET:
            return len(body["uavs"]) > FEW_ITEMS
        case _:
            return False


def _record(body: RecordBody, uavs: frozenset[str]) -> bytes:
    made, sure = body.beams, body.guaranteed_db
    kept = [i for i, uav in enumerate(made.uavs) if not uavs or uav in uavs]
    held = None if sure is None else [sure[i] for i in kept]
    (whole,) = records.encode(made.of(kept), body.sequence, held)
    return whole


def _only(topic: Topic, body: Json, uavs: frozenset[str]) -> Json:
    """Return a body without other UAVs; values that belong to no UAV stay."""
    match topic:
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


def _beams(node: Node) -> Make[Json]:
    update = node.pipeline.last_update or node.pipeline.look(node.now_ns())
    age_s = (node.now_ns() - update.t_ns) * 1e-9
    pipeline, equipment, number = node.pipeline, node.equipment, node.pipeline.newest_number
    return lambda _: beam_state.beams(
        pipeline, equipment, update, age_s=age_s, lead_ms=0.0, number=number
    )


def _weights(node: Node) -> Make[Json]:
    update = node.pipeline.last_update or node.pipeline.look(node.now_ns())
    number = node.pipeline.newest_number
    return lambda _: beam_state.weights(node.pipeline, update.beams, 0.0, number)


def _records(node: Node) -> Make[RecordBody]:
    pipeline = node.pipeline
    update, number = pipeline.last_update, pipeline.newest_number or 0
    update = update or pipeline.look(node.now_ns())

    def made(_way: GivingWay) -> RecordBody:
        sure = None
        if pipeline.settings.records.guaranteed:
            sure = guaranteed_gain.gains_db(pipeline, node.equipment, update)
        return RecordBody(records.in_utc(pipeline, update.beams), number, sure)

    return made


def _status(node: Node) -> Json:
    shown = state.status(node, companion.__version__)
    return {"valid_at": shown["time"], **shown}


def _links(node: Node) -> Make[Json]:
    show = state.links(node)
    return lambda _: show()


def _fleet(node: Node) -> Make[Json]:
    show = fleet_view.fleet(node.fleet_status(), node.now_ns())
    return lambda _: as_json(show(), node.pipeline.utc_ns)


async def body(topic: Topic, node: Node, large: LargeAnswers) -> Body:
    """Return the body of a topic, as the path of the same name answers.

    Raises ``HTTPException`` 503 if the work slots are full.
    """
    update = node.pipeline.last_update
    beams = 0 if update is None else update.beams.weights.size
    key = "body", topic  # a topic alone equals the key of the path of that name
    match topic:
        case Topic.UAVS:
            return await large.uavs()
        case Topic.BEAMS:
            return await large.made(key, partial(_beams, node))
        case Topic.WEIGHTS:
            many = beams > FEW_WEIGHTS
            return await large.made(key, partial(_weights, node), is_large=many)
        case Topic.RECORDS:
            many = node.pipeline.settings.records.guaranteed
            return await large.made(key, partial(_records, node), is_large=many)
        case Topic.STATUS:
            return _status(node)
        case Topic.LINKS:
            many = state.component_count(node) > FEW_ITEMS
            return await large.made(key, partial(_links, node), is_large=many)
        case Topic.FLEET:
            many = fleet_view.offer_count(node.fleet_status()) > FEW_ITEMS
            return await large.made(key, partial(_fleet, node), is_large=many)
        case Topic.EVENTS:
            return glance.events(node)
