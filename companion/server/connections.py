"""HTTP connections within bounds: of heads, of waiting, and of their number.

uvicorn reads a head of any length, waits for ever for one that never ends, and takes connections
until there are no descriptors left. All of that comes before any token is looked at.
"""

import asyncio
import resource
from typing import Any, Final

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

HEAD_BYTES: Final = 16_384
"""Most bytes of a request's line and headers; browsers send one or two thousand."""
BODY_BYTES: Final = 65_536  # most bytes of a request's body: nothing here takes any
HEAD_S: Final = 10.0
"""How long a client may take from connecting, or from its last answer, to a whole head."""
STALLED_S: Final = 60.0  # how long a client may take nothing of an answer
_MOST: Final = 512
_OWN: Final = 96  # descriptors that are left for links, recordings and files


def most_connections() -> int:
    """Connections taken at a time, so that links and recordings always have descriptors."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return _MOST if soft == resource.RLIM_INFINITY else max(8, min(_MOST, soft - _OWN))


class TooLongError(Exception):
    """A head that is longer than any that is meant well."""


class BoundedProtocol(HttpToolsProtocol):
    """uvicorn's protocol within bounds. When there are too many, who waits longest goes."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._in_head = True
        self._unparsed = 0  # bytes since the last head; a header that goes on is not told before
        self._head_bytes = 0
        self._body_bytes = 0
        self._deadline: asyncio.TimerHandle | None = None
        self._stalled: asyncio.TimerHandle | None = None
        self._waiting_since_s = 0.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take a connection, if need be in the place of one on which nothing is asked."""
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
        """The connection is gone; see ``asyncio.Protocol``."""
        self._cancel()
        if self.transport is not None:
            super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Bytes of a client; see ``asyncio.Protocol``."""
        if self.transport is None or self.transport.is_closing():
            return
        self._unparsed += len(data)
        super().data_received(data)
        if self._in_head and self._unparsed > HEAD_BYTES and not self.transport.is_closing():
            self.send_400_response("No request has such a head.")

    @property
    def is_waiting(self) -> bool:
        """Whether no request is being answered."""
        return self.cycle is None or self.cycle.response_complete

    # --- what the parser finds ----------------------------------------------------------------

    def on_message_begin(self) -> None:
        """A request begins."""
        self._head_bytes = self._body_bytes = 0
        super().on_message_begin()

    def on_url(self, url: bytes) -> None:
        """A piece of the address."""
        self._count(len(url))
        super().on_url(url)

    def on_header(self, name: bytes, value: bytes) -> None:
        """A header."""
        self._count(len(name) + len(value) + 4)
        super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """The head is whole, and the request is answered."""
        self._cancel()
        self._in_head = False
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """A piece of a body, which nobody reads."""
        self._body_bytes += len(body)
        if self._body_bytes > BODY_BYTES:
            raise TooLongError
        super().on_body(body)

    def on_message_complete(self) -> None:
        """A request is whole; what follows is another's head."""
        self._in_head, self._unparsed = True, 0
        super().on_message_complete()

    def on_response_complete(self) -> None:
        """An answer was sent."""
        super().on_response_complete()
        if not self.transport.is_closing() and self.is_waiting:
            self._await_head()

    def _count(self, size: int) -> None:
        """Raise where the head grows beyond its bound; the parser then refuses the request."""
        self._head_bytes += size
        if self._head_bytes > HEAD_BYTES:
            raise TooLongError

    # --- waiting ------------------------------------------------------------------------------

    def pause_writing(self) -> None:
        """The client does not read."""
        super().pause_writing()
        self._stalled = self.loop.call_later(STALLED_S, self.transport.abort)

    def resume_writing(self) -> None:
        """The client reads again."""
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
