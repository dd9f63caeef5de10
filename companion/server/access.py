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
UNAUTHORISED: Final = 4401  # code with which a WebSocket without a right token is closed

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


def _own_names() -> frozenset[str]:
    """What this machine is called in its own network; no name of the internet is among them."""
    name = socket.gethostname().lower().partition(".")[0]
    return frozenset(("localhost", name, f"{name}.local"))


class KnownHosts:
    """ASGI middleware: requests must name this machine in ``Host``, by address or by a known name.

    A page from anywhere may have its own name resolve to this machine (DNS rebinding) and then read
    what is served here as if it were its own. Its requests bear that name. Addresses are nobody's
    name; ``names`` are further ones, as of a reverse proxy. Others are answered with 421, and their
    WebSockets refused.
    """

    def __init__(self, app: ASGIApp, names: Collection[str] = ()) -> None:
        self._app = app
        self._names = _own_names() | {name.lower() for name in names}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan" or self._are_known(Headers(scope=scope).getlist("host")):
            await self._app(scope, receive, send)
        elif scope["type"] == "websocket":
            await WebSocket(scope, receive, send).close()  # before it is open: 403
        else:
            title = "this name is not known to be of this service: [server] hosts"
            await problem(421, title)(scope, receive, send)

    def _are_known(self, hosts: list[str]) -> bool:
        """Whether all are; no browser leaves it out, nor names two."""
        names = [_host_name(host) for host in hosts]
        return all(name in self._names or _is_address(name) for name in names)


def _host_name(host: str) -> str:
    """The name or address in a Host header: without port, brackets and the dot of the root."""
    name = host.strip().lower()
    if name.startswith("["):
        return name[1:].partition("]")[0]
    return name.partition(":")[0].removesuffix(".")


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


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
        scheme, _, credentials = Headers(scope=scope).get("authorization", "").partition(" ")
        given = [credentials.strip().encode()] if scheme.lower() == "bearer" else []
        for offered in scope.get("subprotocols", []):
            if offered.startswith(BEARER):
                given.append(_decoded(offered.removeprefix(BEARER)))
        return any(hmac.compare_digest(one, self._token) for one in given)


def _decoded(text: str) -> bytes:
    """Decode base64url without padding; empty for anything else."""
    try:
        return base64.urlsafe_b64decode(text + "=" * (-len(text) % 4))
    except (binascii.Error, ValueError):
        return b""
