"""HTTP connections with limits on the size of heads, on waiting times, and on their number.

uvicorn reads heads of any length, waits forever for incomplete ones, and accepts connections until
no descriptors are left. All of that happens before any token is checked.
"""

import asyncio
import resource
from typing import Any, Final

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

HEAD_BYTES: Final = 16_384
"""Limit on the bytes of a request line and headers; browsers send one or two thousand."""
BODY_BYTES: Final = 65_536  # limit on a request's body; no route uses one
HEAD_S: Final = 10.0
"""Time limit for a complete head, from connecting or from the last answer, seconds."""
STALL_TIMEOUT_S: Final = 60.0  # time limit for a client that reads nothing of an answer
_MOST: Final = 512
_OWN: Final = 96  # descriptors reserved for links, recordings and files


def most_connections() -> int:
    """Return the limit on connections that leaves descriptors for links and recordings."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return _MOST if soft == resource.RLIM_INFINITY else max(8, min(_MOST, soft - _OWN))


class TooLongError(Exception):
    """Error of a request head that exceeds its limit."""


class BoundedProtocol(HttpToolsProtocol):
    """uvicorn's protocol with limits; beyond them, the longest idle connection is closed."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._in_head = True
        self._unparsed = 0  # bytes since the last head; the parser reports only whole headers
        self._head_bytes = 0
        self._body_bytes = 0
        self._deadline: asyncio.TimerHandle | None = None
        self._stalled: asyncio.TimerHandle | None = None
        self._waiting_since_s = 0.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a connection, if necessary by closing an idle one."""
        if len(self.connections) >= most_connections():
            waiting = [
                one
                for one in self.connections
                if isinstance(one, BoundedProtocol) and one.is_waiting
            ]
            if not waiting:
                transport.abort()
                return
            min(waiting, key=lambda one: one._waiting_since_s).transport.abort()
        super().connection_made(transport)
        self._await_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Clean up; see ``asyncio.Protocol``."""
        self._cancel()
        if self.transport is not None:
            super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Process bytes of a client; see ``asyncio.Protocol``."""
        if self.transport is None or self.transport.is_closing():
            return
        self._unparsed += len(data)
        super().data_received(data)
        if self._in_head and self._unparsed > HEAD_BYTES and not self.transport.is_closing():
            self.send_400_response("The request head is too long.")

    @property
    def is_waiting(self) -> bool:
        """Whether the connection is idle: no request is being answered."""
        return self.cycle is None or self.cycle.response_complete

    # --- callbacks of the parser --------------------------------------------------------------

    def on_message_begin(self) -> None:
        """Note the start of a request."""
        self._head_bytes = self._body_bytes = 0
        super().on_message_begin()

    def on_url(self, url: bytes) -> None:
        """Process a piece of the request's URL."""
        self._count(len(url))
        super().on_url(url)

    def on_header(self, name: bytes, value: bytes) -> None:
        """Process a header of the request."""
        self._count(len(name) + len(value) + 4)
        super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """Start the answer: the head is complete."""
        self._cancel()
        self._in_head = False
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """Ignore a piece of a request's body."""
        self._body_bytes += len(body)
        if self._body_bytes > BODY_BYTES:
            raise TooLongError
        super().on_body(body)

    def on_message_complete(self) -> None:
        """End a request; further bytes belong to the next head."""
        self._in_head, self._unparsed = True, 0
        super().on_message_complete()

    def on_response_complete(self) -> None:
        """Note the end of an answer."""
        super().on_response_complete()
        if not self.transport.is_closing() and self.is_waiting:
            self._await_head()

    def _count(self, size: int) -> None:
        """Count bytes of the head; beyond the limit, raise, and the parser rejects the request."""
        self._head_bytes += size
        if self._head_bytes > HEAD_BYTES:
            raise TooLongError

    # --- waiting ------------------------------------------------------------------------------

    def pause_writing(self) -> None:
        """Start the time limit, since the client does not read."""
        super().pause_writing()
        self._stalled = self.loop.call_later(STALL_TIMEOUT_S, self.transport.abort)

    def resume_writing(self) -> None:
        """Cancel the time limit, since the client reads again."""
        super().resume_writing()
        if self._stalled is not None:
            self._stalled.cancel()
            self._stalled = None

    def _await_head(self) -> None:
        self._cancel()
        self._waiting_since_s = self.loop.time()
        self._deadline = self.loop.call_later(HEAD_S, self.transport.abort)

    def _cancel(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
