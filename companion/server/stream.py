"""The WebSocket ``/v1/stream``: the state as it changes, always the newest.

    ?uav=1:1&uav=2:1     only these UAVs (default: all)
    &topic=uavs          uavs, beams, weights, records, status, links, fleet, events (default:
                         uavs and beams)
    &rate_hz=10          largest rate of each topic, limited by the update rate, and by 2000
                         messages per second to all clients

Every message is a JSON object: the answer of the path of that name, with ``topic`` and
``valid_at``. ``records`` are the exception: binary messages, each the whole record of an update
(``companion.views.records``). Nothing is queued: after each message a client gets the newest state,
so a slow client misses messages, delays no other client and uses no more memory. A client that
takes nothing for 10 s is disconnected. A message is encoded once for all clients with the same
request. ``events`` are sent when there is a new one.

Close codes: 1003 the client sent a message (the stream accepts none), 1008 it sent too much, 1012
the service ends, 1013 too many streams are open, another client takes this place, or large messages
are taken too slowly (``held_bodies``), 4401 missing or wrong token (``access``), 4403 request by a
page from elsewhere, 4422 invalid arguments. The reason has details.

Over 300 lines: a client's messages, and the limits on all clients, share one state.
"""

import asyncio
from collections import Counter
from collections.abc import Coroutine
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final, TypeVar

from starlette.datastructures import QueryParams
from starlette.exceptions import HTTPException
from starlette.websockets import WebSocket

from companion.server import topics
from companion.server.access import accept, is_same_site
from companion.server.connections import most_connections
from companion.server.held_bodies import HELD
from companion.server.large_answers import LargeAnswers
from companion.server.shared_work import seen
from companion.server.topics import Body, Topic
from companion.server.websocket_connections import BoundedWebSocket
from companion.values import UAV_FORMS, UserError, is_uav_id
from companion.views.state import Node

T = TypeVar("T")
Message = tuple[Topic, frozenset[str], object]
"""Identity of a message: its topic, the UAVs that it is about (all if empty), its version."""

TOO_MANY: Final = 1013
ELSEWHERE: Final = 4403
BAD_ARGUMENTS: Final = 4422

RATE_HZ: Final = 10.0
LEAST_HZ, MOST_HZ = 0.1, 100.0
CLIENTS_MAX: Final = 256
"""Limit on streams, and at most half of the connections: the rest are left for requests."""
QUIET_S: Final = 5.0
"""Time without a sign that a client reads, after which it makes room for another, seconds.

It is longer than the time between two pings.
"""
MESSAGES_PER_S: Final = 2000.0
"""Messages per second to all clients; with more topics in all, each is sent less often."""
SLOTS: Final = 32
"""Number of slots over which clients' messages are spread after an update.

The slots span the first half of the update interval: a hundred messages at once would delay
everything else. A few clients do not wait.
"""
VERSIONS_AT_ONCE: Final = 2
"""Most versions of a topic made at once, since each holds an update; later ones are skipped."""
_EARLY: Final = 0.25
"""Fraction of its period by which a message may be early, as updates are not exact."""


def most_clients() -> int:
    """Return the limit on streams that leaves connections for requests."""
    return min(CLIENTS_MAX, most_connections() // 2)


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a stream's client requested; empty ``uavs`` means all."""

    topics: tuple[Topic, ...] = (Topic.UAVS, Topic.BEAMS)
    uavs: frozenset[str] = frozenset()
    rate_hz: float = RATE_HZ


def wanted(query: QueryParams) -> Wanted:
    """Parse the arguments of a stream. Raises ``UserError`` that names the first invalid one."""
    unknown = set(query) - {"uav", "topic", "rate_hz"}
    if unknown:
        raise UserError(f"unknown argument {min(unknown)[:40]!r}; use uav, topic, rate_hz")
    for uav in query.getlist("uav"):
        if not is_uav_id(uav):
            raise UserError(f"uav: {uav[:40]!r} is not {UAV_FORMS}")
    text = query.get("rate_hz", str(RATE_HZ))
    try:
        rate_hz = float(text)
    except ValueError:
        rate_hz = 0.0
    if not LEAST_HZ <= rate_hz <= MOST_HZ:
        raise UserError(f"rate_hz: {text[:40]!r} is not a number from {LEAST_HZ:g} to {MOST_HZ:g}")
    names = query.getlist("topic")
    bad = [name for name in names if name not in list(Topic)]
    if bad:
        raise UserError(f"topic: {bad[0][:40]!r} is unknown; use {', '.join(Topic)}")
    topics = tuple(dict.fromkeys(map(Topic, names))) or Wanted().topics
    return Wanted(topics, frozenset(query.getlist("uav")), rate_hz)


@dataclass(slots=True)
class Snapshot:
    """Messages of one update: each topic is looked up once, each message encoded once.

    Events are an exception: they may change between two updates, and count by their version.
    """

    number: int
    bodies: dict[tuple[Topic, object], "asyncio.Task[Body]"] = field(default_factory=dict)
    messages: dict[Message, "asyncio.Task[str | bytes]"] = field(default_factory=dict)


class Stream:
    """All stream clients of one node. ``sent`` counts messages."""

    def __init__(self, node: Node, large: LargeAnswers) -> None:
        self.sent = 0
        self._large = large
        self._open: list[WebSocket] = []
        self._node = node
        self._snapshot = Snapshot(-1)
        self._being_made = set[Message]()
        self._in_slot = [0] * SLOTS
        self._topics = 0  # of all clients together
        self._slot_s = 0.5 / SLOTS / node.pipeline.settings.beams.update_hz

    @property
    def clients(self) -> int:
        """Number of clients connected now."""
        return len(self._open)

    async def serve(self, websocket: WebSocket) -> None:
        """Serve one client until it disconnects or violates the protocol."""
        await accept(websocket)
        headers = websocket.headers
        if not is_same_site(headers.get("origin"), headers.get("host")):
            await websocket.close(ELSEWHERE, "pages of other sites may not connect")
            return
        if self.clients >= most_clients() and not self._makes_room(websocket):
            await websocket.close(TOO_MANY, "too many streams are open")
            return
        try:
            asked = wanted(websocket.query_params)
        except UserError as error:
            await websocket.close(BAD_ARGUMENTS, _short(str(error)))
            return
        slot = self._in_slot.index(min(self._in_slot))
        self._in_slot[slot] += 1
        self._topics += len(asked.topics)
        self._open.append(websocket)
        try:
            await self._attend(websocket, asked, slot * self._slot_s)
        finally:
            if websocket in self._open:
                self._open.remove(websocket)
            self._in_slot[slot] -= 1
            self._topics -= len(asked.topics)

    def _makes_room(self, newcomer: WebSocket) -> bool:
        """Close a stream in favour of another client, and return whether there is one to close.

        It is one of the address with the most streams, or a client that shows no sign of reading.
        """
        streams = [(one, held) for one in self._open if (held := _connection(one)) is not None]
        held_by = Counter(_host(one) for one in self._open)
        host, most = held_by.most_common(1)[0]
        if most > held_by[_host(newcomer)] + 1:
            streams = [pair for pair in streams if _host(pair[0]) == host]
        else:
            quiet_s = asyncio.get_running_loop().time() - QUIET_S
            streams = [pair for pair in streams if pair[1].alive_s < quiet_s]
        if not streams:
            return False
        websocket, connection = min(streams, key=lambda pair: pair[1].alive_s)
        self._open.remove(websocket)
        connection.replace(TOO_MANY, "another client takes this place")
        return True

    async def _attend(self, websocket: WebSocket, asked: Wanted, turn_s: float) -> None:
        sending = asyncio.create_task(self._send(websocket, asked, turn_s))
        hearing = asyncio.create_task(websocket.receive())
        try:
            await asyncio.wait({sending, hearing}, return_when=asyncio.FIRST_COMPLETED)
            if sending.cancelled():
                await _close_for_memory(websocket)
            elif sending.done():
                sending.result()
        finally:
            sending.cancel()
            hearing.cancel()
            await asyncio.gather(sending, hearing, return_exceptions=True)

    async def _send(self, websocket: WebSocket, asked: Wanted, turn_s: float) -> None:
        """Send changes at each due update, ``turn_s`` after it, until cancelled."""
        loop, said = asyncio.get_running_loop(), dict[Topic, object]()
        due_s = loop.time()
        while True:
            if turn_s:
                await asyncio.sleep(turn_s)
            updates = self._node.pipeline.updates
            period_s = max(1 / asked.rate_hz, self._topics / MESSAGES_PER_S)
            if loop.time() >= due_s - _EARLY * period_s:
                due_s = max(due_s + period_s, loop.time())
                for topic in asked.topics:
                    version = self._version(topic)
                    if said.get(topic) != version:
                        try:
                            message = await self._message(topic, asked.uavs, version)
                        except HTTPException:  # too much is being made: with the next message
                            continue
                        said[topic] = version
                        with HELD.hold(message):
                            if isinstance(message, bytes):
                                await websocket.send_bytes(message)
                            else:
                                await websocket.send_text(message)
                        del message  # of megabytes: the next one may be seconds away
                        self.sent += 1
            # A change during the sending to a slow client does not wait for another tick.
            if self._node.pipeline.updates == updates:
                await self._node.ticked()

    def _version(self, topic: Topic) -> object:
        """Return a value of a topic that changes whenever there is something new to send."""
        if topic is Topic.EVENTS:
            events = self._node.events()
            return events[-1] if events else "none yet"
        return self._node.pipeline.updates

    async def _message(self, topic: Topic, uavs: frozenset[str], version: object) -> str | bytes:
        """Return the message of a topic; encode it on first use."""
        if self._snapshot.number != self._node.pipeline.updates:
            self._snapshot = Snapshot(self._node.pipeline.updates)
        messages = self._snapshot.messages
        if topic not in topics.OF_UAVS:
            uavs = frozenset()  # the same message for all clients
        what = (topic, uavs, version)
        if what not in messages:
            self._refuse_if_many(topic, version)
            messages[what] = _task(self._encoded(self._snapshot, *what))
            self._being_made.add(what)
            messages[what].add_done_callback(lambda _: self._being_made.discard(what))
        task = messages[what]
        del messages  # which are megabytes, and this one may take seconds
        try:
            return await asyncio.shield(task)  # other clients may wait for it too
        finally:
            del task  # see ``SharedWork.run``

    def _refuse_if_many(self, topic: Topic, version: object) -> None:
        """Raise ``HTTPException`` 503 while too many versions of a topic are being made."""
        others = {one[2] for one in self._being_made if one[0] is topic} - {version}
        if len(others) >= VERSIONS_AT_ONCE:
            raise HTTPException(503, "too many updates are being encoded at once")

    async def _encoded(
        self, snapshot: Snapshot, topic: Topic, uavs: frozenset[str], version: object
    ) -> str | bytes:
        key = (topic, version)
        if key not in snapshot.bodies:
            snapshot.bodies[key] = _task(topics.body(topic, self._node, self._large))
        task = snapshot.bodies[key]
        del snapshot
        try:
            body = await asyncio.shield(task)
        finally:
            del task
        encode = partial(topics.message, topic, body, uavs)
        what, many = (topic, uavs, version), topics.is_large(topic, body, uavs)
        return await self._large.made(what, lambda: encode, is_large=many)


def _task(work: Coroutine[Any, Any, T]) -> "asyncio.Task[T]":
    task = asyncio.create_task(work)
    task.add_done_callback(seen)
    return task


def _connection(websocket: WebSocket) -> BoundedWebSocket | None:
    """Return a client's connection; None under another server, as in tests."""
    found: BoundedWebSocket | None = websocket.scope.get("state", {}).get("connection")
    return found


async def _close_for_memory(websocket: WebSocket) -> None:
    reason = "this client takes large messages too slowly"
    connection = _connection(websocket)
    if connection is None:
        await websocket.close(TOO_MANY, reason)
    else:
        connection.replace(TOO_MANY, reason)


def _host(websocket: WebSocket) -> str | None:
    return websocket.client.host if websocket.client else None


def _short(reason: str) -> str:
    """Truncate a close reason to the limit of a close frame, 123 bytes."""
    return reason.encode()[:120].decode(errors="ignore")
