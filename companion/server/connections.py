"""HTTP connections with limits on heads, bodies, waiting times, queued requests and their number.

uvicorn reads heads of any length, waits forever for incomplete ones, parses any number of requests
ahead of their answers, and accepts connections until no descriptors are left. All of that happens
before any token is checked.
"""

import asyncio
from typing import Any, Final

from starlette.requests import ClientDisconnect
from uvicorn.protocols.http.flow_control import FlowControl
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from companion.mavlink.links.descriptors import share
from companion.server.request_queue import Rank, RequestQueue
from companion.values.budget import Budget

HEAD_BYTES: Final = 16_384
"""Limit on the bytes of a request line and headers; browsers send one or two thousand."""
HEADERS_MOST: Final = 100  # limit on a request's headers; each takes microseconds
PARAMETERS_MAX: Final = 300  # limit on a query's parameters; 256 UAVs may be named
CHUNKS_MAX: Final = 512  # limit on the parts of a request's body, each of which takes microseconds
BODY_BYTES: Final = 65_536  # limit on a request's body; /v1/observations has one
HEAD_S: Final = 10.0
"""Time limit for a complete head, from connecting or from the last answer, seconds."""
STALL_TIMEOUT_S: Final = 10.0  # time limit for a client that takes nothing of an answer
BUFFER_BYTES: Final = 16_384
"""Bytes of an answer that wait in this process for a slow client.

A client that takes half of them within ``STALL_TIMEOUT_S`` is not stalled.
"""
PIECE_BYTES: Final = 256
"""Bytes parsed at a time: at most this many bytes of pipelined requests are parsed ahead."""
REQUESTS_PER_S: Final = 50.0  # requests of a connection that are started before those of others
REQUESTS_SAVED: Final = 200.0
SETTLED_S: Final = 2.0
"""Time for a new connection's request, and for an answer, before it makes room for another."""
RANKS: Final = {"/healthz": Rank.HEALTH, "/v1/beams": Rank.BEAMS, "/v1/beams/weights": Rank.BEAMS}
"""Ranks of paths without a query; all others have the last one."""
CONNECTIONS_MAX: Final = 512
DESCRIPTORS: Final = 0.5  # ratio of the descriptors that connections may take


def most_connections() -> int:
    """Return the limit on connections that leaves descriptors for links and recordings."""
    return share(CONNECTIONS_MAX, DESCRIPTORS)


class CutShortError(Exception):
    """Error of an answer that has begun and cannot be completed."""


class _HoldingFlow(FlowControl):
    """Flow control of a connection that reads nothing while bytes of it are unparsed."""

    def __init__(self, transport: asyncio.Transport) -> None:
        super().__init__(transport)
        self._holding = False

    def hold(self, holding: bool) -> None:
        """Stop reading, or continue."""
        self._holding = holding
        if holding:
            self.pause_reading()
        else:
            self.resume_reading()

    def resume_reading(self) -> None:
        """Continue to read, unless bytes are unparsed."""
        if not self._holding:
            super().resume_reading()


class BoundedProtocol(HttpToolsProtocol):
    """uvicorn's protocol with limits; beyond them, the longest idle connection is closed."""

    def __init__(self, queue: RequestQueue, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._queue = queue
        self._budget = Budget(per_s=REQUESTS_PER_S, most=REQUESTS_SAVED)
        self.url = b""  # uvicorn sets it when a request line begins
        self._unparsed = bytearray()
        self._in_head = True
        self._parsed_bytes = 0  # since the last complete request, framing of its body included
        self._chunks = 0  # parts of the body that is being received
        self._deadline: asyncio.TimerHandle | None = None
        self._stalled: asyncio.TimerHandle | None = None
        self._since_s = 0.0  # time of the connection, of the last head, or of the last answer
        self._over_budget = False
        self._is_lost = False
        self._is_upgrading = False  # becomes a WebSocket, and what it sends until then is ignored
        self._answered: Any = None  # the request that is being answered, or the last one

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a connection, if necessary by closing another one."""
        if len(self.connections) >= most_connections() and not _replace_one(self.connections):
            transport.abort()
            return
        super().connection_made(transport)
        transport.set_write_buffer_limits(high=BUFFER_BYTES)
        self.flow = _HoldingFlow(transport)
        self._await_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Clean up; see ``asyncio.Protocol``."""
        self._is_lost = True
        self._cancel()
        self._unparsed.clear()
        if self._answered is not None:
            self._answered.disconnected = True  # uvicorn tells the newest request only
        if self.transport is not None:
            self._read_again()
            super().connection_lost(exc)
            self.cycle = self._answered = None  # type: ignore[assignment]  # breaks a cycle

    def data_received(self, data: bytes) -> None:
        """Process bytes of a client; see ``asyncio.Protocol``."""
        if self.transport is None or self.transport.is_closing() or self._is_upgrading:
            return
        self._unparsed += data
        self._parse()

    def rank(self) -> tuple[int, float] | None:
        """Return the order of replacement, lowest first; None if it is being closed.

        First are idle connections, then those that wait to become a WebSocket, newest first; then
        clients over their budget or not reading, then long answers, and last new connections and
        answers, oldest first.
        """
        if self.transport.is_closing():
            return None
        is_idle = self.cycle is None or self.cycle.response_complete
        is_old = self.loop.time() > self._since_s + SETTLED_S
        if self._is_upgrading:
            return 1, -self._since_s
        if is_idle and is_old:
            return 0, self._since_s
        if not is_idle and (self._over_budget or self._stalled is not None):
            return 2, self._since_s
        return (3 if is_old else 4), self._since_s

    def _parse(self) -> None:
        """Parse pieces until the newest request waits for its answer."""
        while self._unparsed and not self.transport.is_closing() and not self._is_ahead():
            piece = bytes(self._unparsed[:PIECE_BYTES])
            del self._unparsed[:PIECE_BYTES]
            self._parsed_bytes += len(piece)
            super().data_received(piece)
            most = HEAD_BYTES if self._in_head else HEAD_BYTES + BODY_BYTES
            is_long = (
                self._parsed_bytes > most
                or len(self.headers or ()) > HEADERS_MOST
                or self.url.count(b"&") >= PARAMETERS_MAX
                or self._chunks > CHUNKS_MAX
            )
            if is_long and not self.transport.is_closing():
                self.send_400_response("The request is too long.")
        self.flow.hold(bool(self._unparsed))  # type: ignore[attr-defined]

    def _is_ahead(self) -> bool:
        """Return whether the newest request is complete and its answer is not."""
        return self._in_head and self.cycle is not None and not self.cycle.response_complete

    # --- callbacks of the parser --------------------------------------------------------------

    def on_headers_complete(self) -> None:
        """Start the answer: the head is complete."""
        self._cancel()
        self._in_head = False
        self._since_s = self.loop.time()
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """Count a part of the body; a piece of 256 bytes may have forty."""
        self._chunks += 1
        super().on_body(body)

    def on_message_complete(self) -> None:
        """End a request; further bytes belong to the next head."""
        self._in_head, self._parsed_bytes, self._chunks = True, 0, 0
        super().on_message_complete()

    def handle_websocket_upgrade(self) -> None:
        """Hand the connection over, as soon as its turn comes; see ``BoundedWebSocket``."""
        self._is_upgrading = True
        self._unparsed.clear()  # a client must wait for the answer
        self._abort_after(HEAD_S)

        def start() -> None:
            self._cancel()
            self._read_again()
            super(BoundedProtocol, self).handle_websocket_upgrade()

        self._queue.add_stream(start, lambda: not self._is_lost and not self.transport.is_closing())

    def on_response_complete(self) -> None:
        """Note the end of an answer, and parse the next request."""
        super().on_response_complete()
        if self.transport.is_closing():
            self._abort_after(STALL_TIMEOUT_S)
        else:
            if not self._is_ahead():
                self._await_head()
            self._parse()

    def send_400_response(self, msg: str) -> None:
        """Reject the request, and close the connection."""
        super().send_400_response(msg)
        self._abort_after(STALL_TIMEOUT_S)

    # --- answers ------------------------------------------------------------------------------

    def _start_asgi_task(self, cycle: Any, app: Any) -> None:
        """Queue an answer; ``RequestQueue`` starts it."""
        self._over_budget = not self._budget.spend(1, self.loop.time())

        async def until_closed(scope: Any, receive: Any, send: Any) -> None:
            async def send_if_open(message: Any) -> None:
                if self.transport.is_closing():
                    cycle.disconnected = True
                await send(message)

            try:
                await app(scope, receive, send_if_open)
            except (asyncio.CancelledError, ClientDisconnect, CutShortError):
                # The service ends, the client is gone, or a file is shorter than its answer.
                cycle.disconnected = True
                self.transport.abort()

        def start() -> None:
            if not self.transport.is_closing():
                self._answered = cycle
                super(BoundedProtocol, self)._start_asgi_task(cycle, until_closed)

        path, query = cycle.scope["path"], cycle.scope["query_string"]
        rank = Rank.OTHER if query else RANKS.get(path, Rank.OTHER)
        self._queue.add(start, within_budget=not self._over_budget, rank=rank)

    # --- waiting ------------------------------------------------------------------------------

    def pause_writing(self) -> None:
        """Start the time limit, since the client does not read."""
        super().pause_writing()
        self._stalled = self.loop.call_later(STALL_TIMEOUT_S, self.transport.abort)

    def resume_writing(self) -> None:
        """Cancel the time limit, since the client reads again."""
        super().resume_writing()
        self._read_again()

    def _read_again(self) -> None:
        if self._stalled is not None:
            self._stalled.cancel()
            self._stalled = None

    def _await_head(self) -> None:
        self._since_s = self.loop.time()
        self._abort_after(HEAD_S)

    def _abort_after(self, seconds: float) -> None:
        self._cancel()
        if self._is_lost:
            return  # a timer would keep the connection's memory until then
        self._deadline = self.loop.call_later(seconds, self.transport.abort)

    def _cancel(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


def _replace_one(connections: set[Any]) -> bool:
    """Close the connection of the lowest rank, and return whether there is one.

    ``rank`` of a connection is None while it must not be replaced.
    """
    ranks = [(rank, one) for one in connections if (rank := one.rank()) is not None]
    if not ranks:
        return False
    min(ranks, key=lambda ranked: ranked[0])[1].transport.abort()
    return True
