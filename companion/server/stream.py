"""The WebSocket ``/v1/stream``: the state as it changes, always the newest.

    ?uav=1:1&uav=2:1     only these UAVs (default: all)
    &topic=uavs          uavs, beams, weights, status, links, events (default: uavs and beams)
    &rate_hz=10          greatest rate of each topic; never more than updates

Every message is a JSON object: the answer of the path of that name, with ``topic`` and
``valid_at``. Nothing is queued: a client that has taken one message is given what is newest then,
so a slow one misses messages, holds nobody up and makes no memory grow. A message is encoded once
for all who asked for the same. ``events`` come when there is a new one.

Closed with: 1003 the client sent something (the stream takes nothing), 1012 the service ends, 1013
too many streams are open, 4401 no or a wrong token (``access``), 4403 a page from elsewhere asked,
4422 bad arguments. The reason says more.
"""

import asyncio
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final
from urllib.parse import urlsplit

from starlette.concurrency import run_in_threadpool
from starlette.datastructures import QueryParams
from starlette.websockets import WebSocket, WebSocketDisconnect

import companion
from companion.server.access import SUBPROTOCOL
from companion.server.responses import encode
from companion.values import UserError
from companion.views import beam_state, link_state, state
from companion.views.state import Node
from companion.views.words import rfc3339

Json = dict[str, Any]

TAKES_NOTHING: Final = 1003
TOO_MANY: Final = 1013
ELSEWHERE: Final = 4403
BAD_ARGUMENTS: Final = 4422

RATE_HZ: Final = 10.0
LEAST_HZ, MOST_HZ = 0.1, 100.0
_UAV: Final = re.compile(
    r"\d{1,3}:\d{1,3}|icao:[0-9A-F]{6}|(rid|cot):[A-Za-z0-9._-]{1,64}", re.ASCII
)
MOST_CLIENTS: Final = 256
"""Streams at a time: half of the connections, the others are left for questions."""
SLOTS: Final = 32
"""Number of slots in which clients take turns after an update.

They span the first half of the time between two updates: a hundred messages sent in one go would
hold up everything else. A few clients do not wait.
"""
_EARLY: Final = 0.25
"""Fraction of its period by which a message may be early; updates are not exact."""


class Topic(StrEnum):
    """What can be streamed; each topic is the answer of the path of that name."""

    UAVS = "uavs"
    BEAMS = "beams"
    WEIGHTS = "weights"
    STATUS = "status"
    LINKS = "links"
    EVENTS = "events"


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a client asks for; empty ``uavs`` means all of them."""

    topics: tuple[Topic, ...] = (Topic.UAVS, Topic.BEAMS)
    uavs: frozenset[str] = frozenset()
    rate_hz: float = RATE_HZ


def wanted(query: QueryParams) -> Wanted:
    """Read the arguments. Raises ``UserError``, which names the first that is wrong."""
    unknown = set(query) - {"uav", "topic", "rate_hz"}
    if unknown:
        raise UserError(f"{min(unknown)[:40]!r} is none of uav, topic, rate_hz")
    for uav in query.getlist("uav"):
        if not _UAV.fullmatch(uav):
            raise UserError(f"uav: {uav[:40]!r} is not SYSID:COMPID, icao:HEX, rid:ID or cot:UID")
    text = query.get("rate_hz", str(RATE_HZ))
    try:
        rate_hz = float(text)
    except ValueError:
        rate_hz = 0.0
    if not LEAST_HZ <= rate_hz <= MOST_HZ:
        raise UserError(f"rate_hz: {text[:40]!r} is not a number of {LEAST_HZ:g} to {MOST_HZ:g}")
    names = query.getlist("topic")
    bad = [name for name in names if name not in list(Topic)]
    if bad:
        raise UserError(f"topic: {bad[0][:40]!r} is none of {', '.join(Topic)}")
    topics = tuple(dict.fromkeys(map(Topic, names))) or Wanted().topics
    return Wanted(topics, frozenset(query.getlist("uav")), rate_hz)


@dataclass(slots=True)
class Snapshot:
    """The messages of one update: each topic is looked up once, each message made once."""

    number: int
    bodies: dict[Topic, "asyncio.Task[Json]"] = field(default_factory=dict)
    texts: dict[tuple[Topic, frozenset[str]], str] = field(default_factory=dict)


class Stream:
    """All clients of one node. ``clients`` are connected now, ``sent`` counts messages."""

    def __init__(self, node: Node) -> None:
        self.clients = 0
        self.sent = 0
        self._node = node
        self._snapshot = Snapshot(-1)
        self._in_slot = [0] * SLOTS
        self._slot_s = 0.5 / SLOTS / node.pipeline.settings.beams.update_hz

    async def serve(self, websocket: WebSocket) -> None:
        """Serve one client until it goes, or breaks the rules."""
        offered = websocket.scope.get("subprotocols", [])
        await websocket.accept(SUBPROTOCOL if SUBPROTOCOL in offered else None)
        if not _is_from_here(websocket):
            await websocket.close(ELSEWHERE, "a page from elsewhere may not ask")
            return
        if self.clients >= MOST_CLIENTS:
            await websocket.close(TOO_MANY, "too many streams are open")
            return
        try:
            asked = wanted(websocket.query_params)
        except UserError as error:
            await websocket.close(BAD_ARGUMENTS, _short(str(error)))
            return
        slot = self._in_slot.index(min(self._in_slot))
        self._in_slot[slot] += 1
        self.clients += 1
        try:
            await self._attend(websocket, asked, slot * self._slot_s)
        except WebSocketDisconnect:
            pass  # gone while it was being sent to
        finally:
            self.clients -= 1
            self._in_slot[slot] -= 1

    async def _attend(self, websocket: WebSocket, asked: Wanted, turn_s: float) -> None:
        sending = asyncio.create_task(self._send(websocket, asked, turn_s))
        hearing = asyncio.create_task(websocket.receive())
        try:
            await asyncio.wait({sending, hearing}, return_when=asyncio.FIRST_COMPLETED)
            if hearing.done() and hearing.result()["type"] == "websocket.receive":
                sending.cancel()
                await websocket.close(TAKES_NOTHING, "the stream takes no messages")
            elif sending.done():
                sending.result()
        finally:
            sending.cancel()
            hearing.cancel()
            await asyncio.gather(sending, hearing, return_exceptions=True)

    async def _send(self, websocket: WebSocket, asked: Wanted, turn_s: float) -> None:
        """Send changes at each update that is due, ``turn_s`` after it, until cancelled."""
        loop, period_s = asyncio.get_running_loop(), 1 / asked.rate_hz
        due_s, said = loop.time(), dict[Topic, object]()
        while True:
            updates = self._node.pipeline.updates
            if loop.time() >= due_s - _EARLY * period_s:
                due_s = max(due_s + period_s, loop.time())
                for topic in asked.topics:
                    version = self._version(topic)
                    if said.get(topic) != version:
                        said[topic] = version
                        await websocket.send_text(await self._text(topic, asked.uavs))
                        self.sent += 1
            # What came while it was sent to a slow client does not wait for another tick.
            if self._node.pipeline.updates == updates:
                await self._node.ticked()
            if turn_s:
                await asyncio.sleep(turn_s)

    def _version(self, topic: Topic) -> object:
        """A value that differs whenever there is something new to say."""
        if topic is Topic.EVENTS:
            events = self._node.events()
            return events[-1] if events else "none yet"
        return self._node.pipeline.updates

    async def _text(self, topic: Topic, uavs: frozenset[str]) -> str:
        """The message, made when it is first asked for."""
        if self._snapshot.number != self._node.pipeline.updates:
            self._snapshot = Snapshot(self._node.pipeline.updates)
        snapshot = self._snapshot
        if topic not in snapshot.bodies:
            snapshot.bodies[topic] = asyncio.create_task(_BODIES[topic](self._node))
        body = await asyncio.shield(snapshot.bodies[topic])  # others may wait for it too
        text = snapshot.texts.get((topic, uavs))
        if text is None:
            shown = only(topic, body, uavs) if uavs else body
            text = encode({"topic": topic, **shown}).decode()
            snapshot.texts[topic, uavs] = text
        return text


def only(topic: Topic, body: Json, uavs: frozenset[str]) -> Json:
    """A message without the other UAVs; what concerns no UAV stays."""
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


# --- one function a topic ---------------------------------------------------------------------


async def _uavs(node: Node) -> Json:
    return {"valid_at": rfc3339(node.now_ns()), "uavs": state.uavs(node)}


async def _beams(node: Node) -> Json:
    update = node.pipeline.last_update or node.pipeline.look(node.now_ns())
    age_s = (node.now_ns() - update.t_ns) * 1e-9
    return await run_in_threadpool(
        beam_state.beams, node.pipeline, node.equipment, update, age_s, 0.0
    )


async def _weights(node: Node) -> Json:
    update = node.pipeline.last_update or node.pipeline.look(node.now_ns())
    return beam_state.weights(update.beams, 0.0)


async def _status(node: Node) -> Json:
    shown = state.status(node, companion.__version__)
    return {"valid_at": shown["time"], **shown}


async def _links(node: Node) -> Json:
    return state.links(node)


async def _events(node: Node) -> Json:
    events = [link_state.event(notice) for notice in node.events()]
    return {"valid_at": rfc3339(node.now_ns()), "events": events}


_BODIES: Final[dict[Topic, Callable[[Node], Any]]] = {
    Topic.UAVS: _uavs,
    Topic.BEAMS: _beams,
    Topic.WEIGHTS: _weights,
    Topic.STATUS: _status,
    Topic.LINKS: _links,
    Topic.EVENTS: _events,
}


def _is_from_here(websocket: WebSocket) -> bool:
    """Whether a WebSocket was opened by this site's own page, or by no page.

    Browsers let any page open a WebSocket to any address, and name the page's site in Origin.
    """
    origin = websocket.headers.get("origin")
    try:
        return origin is None or urlsplit(origin).netloc == websocket.headers.get("host")
    except ValueError:  # no address at all
        return False


def _short(reason: str) -> str:
    """A reason cut to the room of a closing frame, 123 bytes."""
    return reason.encode()[:120].decode(errors="ignore")
