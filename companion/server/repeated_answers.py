"""Answers that are repeated: to all who ask for the same within a moment, and by their ETag.

An answer about a moment (``moments.py``) is the same for all who ask for it until the moment ends.
The first request makes it; this middleware gives the same bytes to the others, which takes a tenth
of the time of a request that is routed, validated and made. Every short answer has an ETag, so that
a client that polls gets 304 while nothing has changed.
"""

import hashlib
from dataclasses import dataclass
from typing import Final

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from companion.server.moments import moment_of
from companion.views.state import Node

OF_A_MOMENT: Final = frozenset({"/metrics", "/v1/beams", "/v1/beams/weights", "/v1/uavs"})
"""Paths whose answers are kept until the moment ends."""
KEPT: Final = 64  # answers of one moment that are kept: leads and formats differ between clients
_VARYING: Final = frozenset({b"accept", b"accept-encoding"})
"""Request headers by which answers differ."""
_OF_THE_BODY: Final = frozenset({b"content-length", b"content-type", b"content-encoding"})
"""Headers of an answer that 304 does not have."""

Key = tuple[str, bytes, tuple[tuple[bytes, bytes], ...]]
"""Path, query and varying headers of a request."""


@dataclass(frozen=True, slots=True)
class _TaggedAnswer:
    start: Message
    body: Message
    tag: bytes

    @classmethod
    def of(cls, start: Message, body: Message) -> "_TaggedAnswer":
        """Return a complete answer with its ETag, the digest of its body."""
        tag = b'W/"%s"' % hashlib.sha256(body.get("body", b"")).hexdigest()[:32].encode()
        headers = [*start.get("headers", []), (b"etag", tag)]
        return cls({**start, "headers": headers}, body, tag)

    async def send(self, known: bytes, send: Send) -> None:
        """Send the answer, or 304 if its tag is in ``known``, the client's If-None-Match."""
        if self.tag not in known:
            await send(self.start)
            await send(self.body)
            return
        headers = [one for one in self.start["headers"] if one[0].lower() not in _OF_THE_BODY]
        await send({"type": "http.response.start", "status": 304, "headers": headers})
        await send({"type": "http.response.body"})


class RepeatedAnswers:
    """ASGI middleware for GET and HEAD requests that are admitted; see the module's docstring.

    HEAD gets the answer of GET, of which the server sends the head alone. An answer in several
    pieces, or with an ETag of its own, is passed on as it is.
    """

    def __init__(self, app: ASGIApp, node: Node) -> None:
        self._app = app
        self._node = node
        self._moment = 0
        self._answers: dict[Key, _TaggedAnswer] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["method"] not in ("GET", "HEAD"):
            await self._app(scope, receive, send)
            return
        known = b",".join(value for name, value in scope["headers"] if name == b"if-none-match")
        if scope["path"] not in OF_A_MOMENT:
            await self._app(scope, receive, _TaggingSender(send, known))
            return
        moment = moment_of(self._node.now_ns())
        if moment != self._moment:
            self._moment = moment
            self._answers.clear()
        varying = tuple(one for one in scope["headers"] if one[0] in _VARYING)
        key = scope["path"], scope["query_string"], varying
        found = self._answers.get(key)
        if found is not None:
            await found.send(known, send)
            return
        sender = _TaggingSender(send, known)
        await self._app(scope, receive, sender)
        if sender.sent is not None and moment == self._moment and len(self._answers) < KEPT:
            self._answers[key] = sender.sent


class _TaggingSender:
    """ASGI ``send`` that adds an ETag to an answer of one piece; ``sent`` is that answer."""

    def __init__(self, send: Send, known: bytes) -> None:
        self.sent: _TaggedAnswer | None = None
        self._send = send
        self._known = known
        self._start: Message | None = None

    async def __call__(self, message: Message) -> None:
        start, self._start = self._start, None
        if start is None and _may_have_tag(message):
            self._start = message  # sent with the body, of which the tag is the digest
        elif start is None:
            await self._send(message)
        elif message.get("more_body"):
            await self._send(start)
            await self._send(message)
        else:
            self.sent = _TaggedAnswer.of(start, message)
            await self.sent.send(self._known, self._send)


def _may_have_tag(message: Message) -> bool:
    return (
        message["type"] == "http.response.start"
        and message["status"] == 200
        and not any(name.lower() == b"etag" for name, _ in message.get("headers", []))
    )
