"""WebSocket connections with limits on what a client sends and on how long it takes nothing.

A client of the stream has nothing to send but answers to pings. uvicorn answers any number of
pings, also those of a client that was refused.
"""

import asyncio
from typing import Any, Final

from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.exceptions import InvalidState

from companion.server.connections import BUFFER_BYTES, STALL_TIMEOUT_S
from companion.values.budget import Budget

BYTES_PER_S: Final = 256.0  # bytes that a client may send; a pong every few seconds needs less
BYTES_SAVED: Final = 2048.0
TOO_MUCH: Final = 1008  # close code of a client that sends more
UNSUPPORTED: Final = 1003  # close code of a client that sends a message
CLOSE_S: Final = 2.0  # time limit for a client to confirm that the connection is closed
PING_S: Final = 4.0  # time between pings
PONG_S: Final = STALL_TIMEOUT_S - PING_S
"""Time limit for the answer to a ping, or for another sign that the client reads, seconds."""
BAD_HANDSHAKE: Final = b"HTTP/1.1 400 Bad Request\r\nconnection: close\r\ncontent-length: 0\r\n\r\n"
FRAGMENT_CHARS: Final = 65_536
"""Characters of a message that are sent, and copied for its client, at a time."""


class BoundedWebSocket(WebSocketsSansIOProtocol):
    """uvicorn's protocol with limits. ``alive_s`` is the newest sign that the client reads."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.alive_s = self.loop.time()
        self.app_state = {**self.app_state, "connection": self}
        self._budget = Budget(per_s=BYTES_PER_S, most=BYTES_SAVED)
        self._stalled: asyncio.TimerHandle | None = None
        self._closing: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Take over a connection; see ``asyncio.Protocol``."""
        super().connection_made(transport)
        transport.set_write_buffer_limits(high=BUFFER_BYTES)

    def connection_lost(self, exc: Exception | None) -> None:
        """Clean up; see ``asyncio.Protocol``."""
        for timer in (self._stalled, self._closing):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)

    def abort(self) -> None:
        """Close the connection at once; messages go nowhere."""
        self.disconnected = True
        self.writable.set()
        self.transport.abort()

    def rank(self) -> tuple[int, float] | None:
        """Return the order of replacement: only clients that were refused are replaced."""
        is_refused = self.close_sent and not self.transport.is_closing()
        return (0, self.alive_s) if is_refused else None

    def data_received(self, data: bytes) -> None:
        """Process bytes of a client; see ``asyncio.Protocol``."""
        if self.transport.is_closing():
            return
        if self.handshake_initiated and not self.handshake_complete:
            self.abort()  # a client waits for the answer to its request
            return
        # The first bytes are the request's head, which is limited already.
        if self.handshake_initiated and not self._budget.spend(len(data), self.loop.time()):
            self._refuse(TOO_MUCH)
            return
        super().data_received(data)
        if not self.handshake_initiated and not self.transport.is_closing():
            # A head that websockets rejects without an event: with a body, or a line too long.
            self.transport.write(BAD_HANDSHAKE)
            self.transport.close()
            self._abort_later()

    def send_500_response(self) -> None:
        """Answer a handshake that fails; once, also if its request ends after the service."""
        if not self.conn.eof_sent:
            super().send_500_response()

    def send_receive_event_to_app(self) -> None:
        """Refuse a message, before it is decoded: the stream accepts none."""
        self.frames = []
        if not self.close_sent:
            self._refuse(UNSUPPORTED)

    def _refuse(self, code: int) -> None:
        """Close the connection of a client that sends a message, or too much; read no more."""
        if self.handshake_complete and not self.close_sent:
            self._close(code, "the stream accepts no messages")
            self._abort_later()
        else:
            self.abort()

    def _close(self, code: int, reason: str) -> None:
        """Send a close frame, unless the service has sent one at its end."""
        try:
            self.conn.send_close(code, reason)
        except InvalidState:
            self.abort()
        else:
            self.handle_parser_exception()

    async def send(self, message: Any) -> None:
        """Send a message of the application; see ASGI."""
        await self.writable.wait()  # the connection may be closed meanwhile
        if self.close_sent and not self.disconnected:
            raise ClientDisconnected  # closed here, because the client sent too much
        if not self.handshake_complete and self.transport.is_closing():
            raise ClientDisconnected  # answered at the end of the service, or closed
        text = message.get("text") if self.handshake_complete else None
        if text is not None and len(text) > FRAGMENT_CHARS:
            await self._send_in_fragments(text)
        else:
            await super().send(message)
        if self.close_sent:
            self._abort_later()

    async def _send_in_fragments(self, text: str) -> None:
        """Send a message of megabytes a fragment at a time, as fast as the client takes them."""
        for start in range(0, len(text), FRAGMENT_CHARS):
            await self.writable.wait()
            if self.disconnected:
                raise ClientDisconnected
            piece = text[start : start + FRAGMENT_CHARS].encode()
            send = self.conn.send_continuation if start else self.conn.send_text
            try:
                send(piece, start + FRAGMENT_CHARS >= len(text))
            except InvalidState:  # closed meanwhile
                raise ClientDisconnected from None
            self.transport.write(b"".join(self.conn.data_to_send()))
            await asyncio.sleep(0)

    def replace(self, code: int, reason: str) -> None:
        """Close the connection in favour of another client."""
        if not self.close_sent and not self.transport.is_closing():
            self._close(code, reason)
        if self._stalled is not None:
            self.abort()
        else:
            self._abort_later()

    def _abort_later(self) -> None:
        if self._closing is None:
            self._closing = self.loop.call_later(CLOSE_S, self.abort)

    # --- signs that the client reads ----------------------------------------------------------

    def handle_pong(self, event: Any) -> None:
        """Note the answer to a ping."""
        self.alive_s = self.loop.time()
        super().handle_pong(event)

    def keepalive_timeout(self) -> None:
        """Close the connection, unless the client took bytes since the ping was sent."""
        if self.alive_s > self.ping_sent_at:
            # A late answer must not start a second series of pings.
            self.pending_ping_payload = self.pong_timer = None
            self.schedule_ping()
        else:
            super().keepalive_timeout()
            self._abort_later()

    def pause_writing(self) -> None:
        """Start the time limit, since the client does not read."""
        super().pause_writing()
        self._stalled = self.loop.call_later(STALL_TIMEOUT_S, self.abort)

    def resume_writing(self) -> None:
        """Cancel the time limit, since the client reads again."""
        super().resume_writing()
        self.alive_s = self.loop.time()
        if self._stalled is not None:
            self._stalled.cancel()
            self._stalled = None
