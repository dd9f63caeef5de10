"""Access control: this machine is trusted; other machines need a bearer token."""

import asyncio
import base64
import binascii
import hmac
import ipaddress
import math
import socket
import sys
from collections.abc import Collection
from functools import lru_cache
from typing import Final
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketDisconnected

from companion.server.responses import problem
from companion.values import Notice, Severity, UserError, shown
from companion.values.budget import Budget
from companion.views.state import Node

OPEN_PATHS: Final = frozenset({"/healthz", "/register_service", "/docs", "/openapi.json"})
"""Paths that need no token, in addition to the page's own files; they contain no secrets."""
SUBPROTOCOL: Final = "companion.v1"
"""Subprotocol that is selected for a WebSocket client that offers any."""
BEARER: Final = "bearer."
"""Prefix of a subprotocol that carries the token, base64url without padding.

A page in a browser cannot set headers, and a token in the URL would end up in logs and histories.
"""
UNAUTHORISED: Final = 4401  # close code of a WebSocket without a valid token

TOKEN_MIN: Final = 16  # characters of a token that other machines may try to guess
WRONG_MAX: Final = 10  # wrong tokens of an address that are answered at once
WRONG_PER_S: Final = 0.1
WRONG_ALL_MAX: Final = 100  # the same of all addresses, as an attacker may have many
WRONG_ALL_PER_S: Final = 1.0
WRONG_DELAY_S: Final = 1.0  # delay of the answer to a further one
NOTICE_EVERY_S: Final = 60.0  # shortest time between two notices of wrong tokens
ADDRESSES_MAX: Final = 1024  # addresses whose wrong tokens are remembered
UNSENT_BYTES: Final = 16_384
"""Limit on unsent bytes in the kernel for a slow client; inherited by its connections.

The default is megabytes, so a slow reader of a stream would receive outdated data.
"""
UNREAD_BYTES: Final = 16_384
"""Room in the kernel for bytes of a client, inherited by its connections. Linux fits in 24 kB.

That limits what is read at once, which waits in this process while requests are answered. The
default is 128 kB and more.
"""


class ListenError(UserError):
    """Error of an address on which the server cannot listen."""


def parse_listen(text: str) -> tuple[str, int]:
    """Parse ``HOST:PORT`` (IPv6 in brackets). Raises ``ListenError`` for anything else."""
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise ListenError(f"{shown(text)} is not HOST:PORT, such as 127.0.0.1:8080")
    return host, int(port)


def is_loopback(host: str) -> bool:
    """Return whether an address is reachable from this machine only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def bind(listen: str, *, token: str | None, insecure: bool) -> socket.socket:
    """Return the socket on which the server listens.

    Raises ``ListenError`` if the address is unavailable, or if other machines could reach it
    without a token.
    """
    host, port = parse_listen(listen)
    if not is_loopback(host) and not token and not insecure:
        raise ListenError(
            f"{listen}: other machines can reach this address; set COMPANION_TOKEN to a bearer"
            " token, or give --insecure"
        )
    if not is_loopback(host) and token and len(token) < TOKEN_MIN and not insecure:
        raise ListenError(
            f"{listen}: COMPANION_TOKEN is so short that it can be guessed;"
            f" give {TOKEN_MIN} or more characters, such as those of `openssl rand -hex 16`"
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
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, UNREAD_BYTES)
        if sys.platform == "linux":
            bound.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_BYTES)
        bound.bind(address)
        bound.listen(1024)  # clients may connect as soon as the address is known
    except OSError as error:
        bound.close()
        raise ListenError(f"{listen}: {error.strerror}") from error
    return bound


def _own_names() -> frozenset[str]:
    name = socket.gethostname().lower().partition(".")[0]
    return frozenset(("localhost", name, f"{name}.local"))


class KnownHosts:
    """ASGI middleware: ``Host`` must name this machine, by address or by a known name.

    A page of another site may let its own name resolve to this machine (DNS rebinding) and then
    read this API as its own origin. The requests of such a page carry that name. Addresses are
    always allowed; ``names`` are further names, such as that of a reverse proxy. Other requests are
    answered with 421, and their WebSockets rejected.
    """

    def __init__(self, app: ASGIApp, names: Collection[str] = ()) -> None:
        self._app = app
        self._names = _own_names() | {_host_name(name) for name in names}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan" or self._are_known(Headers(scope=scope).getlist("host")):
            await self._app(scope, receive, send)
        elif scope["type"] == "websocket":
            await WebSocket(scope, receive, send).close()  # closed before it is open: 403
        else:
            title = "unknown host name; add it to [server] hosts"
            await problem(421, title)(scope, receive, send)

    def _are_known(self, hosts: list[str]) -> bool:
        """Return whether all given hosts are known; browsers always send exactly one."""
        names = [_host_name(host) for host in hosts]
        return all(name in self._names or _is_address(name) for name in names)


@lru_cache(maxsize=64)
def _host_name(host: str) -> str:
    """Return name or address of a Host header, without port, brackets and trailing dot.

    "" if something else than a port follows the brackets.
    """
    name = host.strip().lower()
    if name.startswith("["):
        address, _, port = name[1:].partition("]")
        return address if not port or port.startswith(":") else ""
    return name.partition(":")[0].removesuffix(".")


@lru_cache(maxsize=64)
def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def is_same_site(origin: str | None, host: str | None) -> bool:
    """Return whether a request comes from this site's own page, or from no page.

    Browsers let any page open a WebSocket to any address, and send simple requests to it. They send
    the page's site in ``Origin``.
    """
    try:
        return origin is None or urlsplit(origin).netloc == host
    except ValueError:  # malformed
        return False


class WrongTokens:
    """Wrong tokens by the address that sent them: counted, reported, and answered late.

    An address may be wrong ``WRONG_MAX`` times, and regains ``WRONG_PER_S`` a second; all of them
    together ``WRONG_ALL_MAX`` times and ``WRONG_ALL_PER_S``. After that each wrong token is
    answered ``WRONG_DELAY_S`` later, and a notice is published, at most once in
    ``NOTICE_EVERY_S``. A correct token is never delayed: others may share the address.
    """

    def __init__(self, node: Node) -> None:
        self.count = 0
        self._node = node
        self._budgets: dict[str, Budget] = {}
        self._all = Budget(per_s=WRONG_ALL_PER_S, most=WRONG_ALL_MAX)
        self._notified_s = -math.inf

    def delay_s(self, address: str, now_s: float) -> float:
        """Count a wrong token; return the time until it is to be answered, seconds."""
        self.count += 1
        budget = self._budgets.pop(address, None) or Budget(per_s=WRONG_PER_S, most=WRONG_MAX)
        self._budgets[address] = budget
        if len(self._budgets) > ADDRESSES_MAX:
            del self._budgets[next(iter(self._budgets))]
        if budget.spend(1, now_s) and self._all.spend(1, now_s):
            return 0.0
        if now_s >= self._notified_s + NOTICE_EVERY_S:
            self._notified_s = now_s
            text = f"{address} sends wrong tokens; {self.count} have been rejected since the start"
            self._node.notify(
                Notice(
                    t_ns=self._node.now_ns(), severity=Severity.WARNING, subject="http", text=text
                )
            )
        return WRONG_DELAY_S


class UntilGone:
    """ASGI middleware: a WebSocket ends without an error if its client leaves at any moment."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await self._app(scope, receive, send)
        except (WebSocketDisconnect, WebSocketDisconnected):
            if scope["type"] != "websocket":
                raise


class BearerToken:
    """ASGI middleware: every path needs ``Authorization: Bearer TOKEN``, except ``open_paths``.

    A WebSocket may send the token as a subprotocol instead (``BEARER``), beside ``SUBPROTOCOL``. A
    WebSocket without a valid token is opened and closed with 4401, whatever its path: a page in a
    browser cannot see the status of a rejected handshake.
    """

    def __init__(
        self, *, app: ASGIApp, token: str, open_paths: Collection[str], wrong: WrongTokens
    ) -> None:
        self._app = app
        self._token = token.encode()
        self._open_paths = frozenset(open_paths)
        self._wrong = wrong

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and scope["path"] in self._open_paths:
            await self._app(scope, receive, send)
            return
        given = _tokens(scope)
        if any(hmac.compare_digest(one, self._token) for one in given):
            await self._app(scope, receive, send)
            return
        if given:
            address = scope["client"][0] if scope.get("client") else "unknown address"
            now_s = asyncio.get_running_loop().time()
            await asyncio.sleep(self._wrong.delay_s(address, now_s))
        if scope["type"] == "websocket":
            websocket = WebSocket(scope, receive, send)
            await accept(websocket)
            await websocket.close(UNAUTHORISED, "a bearer token is needed")
        else:
            title, headers = "a bearer token is needed", {"www-authenticate": "Bearer"}
            await problem(401, title, headers)(scope, receive, send)


async def accept(websocket: WebSocket) -> None:
    """Accept a WebSocket, with ``SUBPROTOCOL`` if the client offers it."""
    offered = websocket.scope.get("subprotocols", [])
    await websocket.accept(SUBPROTOCOL if SUBPROTOCOL in offered else None)


def _tokens(scope: Scope) -> list[bytes]:
    """Return the tokens of a request, in its header or as subprotocols.

    A header outside ASCII is Latin-1 to some clients, and UTF-8 to others (curl).
    """
    scheme, _, credentials = Headers(scope=scope).get("authorization", "").partition(" ")
    text = credentials.strip()
    given = [text.encode(), text.encode("latin-1")] if scheme.lower() == "bearer" else []
    for offered in scope.get("subprotocols", []):
        if offered.startswith(BEARER):
            given.append(_decoded(offered.removeprefix(BEARER)))
    return given


def _decoded(text: str) -> bytes:
    try:
        return base64.urlsafe_b64decode(text + "=" * (-len(text) % 4))
    except (binascii.Error, ValueError):
        return b""
