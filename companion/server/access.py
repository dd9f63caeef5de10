"""Access control: anybody on this machine; from elsewhere only with a bearer token."""

import base64
import binascii
import hmac
import ipaddress
import socket
import sys
from collections.abc import Collection
from typing import Final

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket

from companion.server.responses import problem
from companion.values import UserError

OPEN_PATHS: Final = frozenset({"/healthz", "/docs", "/openapi.json"})
"""Paths that need no token, beside the page's own files: nothing in them is secret."""
SUBPROTOCOL: Final = "companion.v1"
"""Subprotocol with which a WebSocket client that names any is answered."""
BEARER: Final = "bearer."
"""Prefix of a subprotocol that carries the token, base64url without padding.

A page in a browser cannot set headers, and an address with a token in it ends up in logs and
histories.
"""
UNAUTHORISED: Final = 4401
"""Code with which a WebSocket without a right token is closed."""

UNSENT_BYTES: Final = 16_384
"""Bytes that the system queues for a client that does not read; connections inherit it.

The default is megabytes, and a slow reader of a stream would be sent what is long past.
"""


class ListenError(UserError):
    """An address that cannot be listened on. The message is one line for the user."""


def parse_listen(text: str) -> tuple[str, int]:
    """Read ``HOST:PORT`` (IPv6 in brackets). Raises ``ListenError`` otherwise."""
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise ListenError(f"{text!r} is not HOST:PORT, such as 127.0.0.1:8080")
    return host, int(port)


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches the address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def bind(listen: str, *, token: str | None, insecure: bool) -> socket.socket:
    """The listening socket.

    Raises ``ListenError`` if the address cannot be had, or could be reached from elsewhere without
    a token.
    """
    host, port = parse_listen(listen)
    if not is_loopback(host) and not token and not insecure:
        raise ListenError(
            f"{listen} can be reached from elsewhere: set COMPANION_TOKEN to a bearer token, "
            "or say --insecure"
        )
    try:
        family, kind, proto, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
    except OSError as error:
        raise ListenError(f"{listen}: {error.strerror}") from error
    bound = socket.socket(family, kind, proto)
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if sys.platform == "linux":
            bound.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_BYTES)
        bound.bind(address)
        bound.listen(1024)  # clients may connect as soon as the address is known
    except OSError as error:
        bound.close()
        raise ListenError(f"{listen}: {error.strerror}") from error
    return bound


class BearerToken:
    """ASGI middleware: every path needs ``Authorization: Bearer TOKEN``, except ``open_paths``.

    A WebSocket may bring the token as a subprotocol instead (``BEARER``), beside ``SUBPROTOCOL``.
    Without a right token it is opened and closed with 4401, whatever its path: a page in a browser
    cannot see the status of a handshake that is refused.
    """

    def __init__(self, app: ASGIApp, token: str, open_paths: Collection[str] = OPEN_PATHS) -> None:
        self._app = app
        self._token = token.encode()
        self._open_paths = frozenset(open_paths)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if (scope["type"] == "http" and scope["path"] in self._open_paths) or self._may(scope):
            await self._app(scope, receive, send)
        elif scope["type"] == "websocket":
            websocket = WebSocket(scope, receive, send)
            offered = scope.get("subprotocols", [])
            await websocket.accept(SUBPROTOCOL if SUBPROTOCOL in offered else None)
            await websocket.close(UNAUTHORISED, "a bearer token is needed")
        else:
            title, headers = "a bearer token is needed", {"www-authenticate": "Bearer"}
            await problem(401, title, headers)(scope, receive, send)

    def _may(self, scope: Scope) -> bool:
        given = [Headers(scope=scope).get("authorization", "").encode()]
        for offered in scope.get("subprotocols", []):
            if offered.startswith(BEARER):
                given.append(b"Bearer " + _decoded(offered.removeprefix(BEARER)))
        expected = b"Bearer " + self._token
        return any(hmac.compare_digest(one, expected) for one in given)


def _decoded(text: str) -> bytes:
    """Decode base64url without padding; empty for anything else."""
    try:
        return base64.urlsafe_b64decode(text + "=" * (-len(text) % 4))
    except (binascii.Error, ValueError):
        return b""
