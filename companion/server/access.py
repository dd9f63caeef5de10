"""Who may ask: anybody on this machine; from elsewhere only with a bearer token."""

import hmac
import ipaddress
import socket

from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Receive, Scope, Send

OPEN_PATHS = frozenset({"/healthz"})


class ListenError(ValueError):
    """An address that cannot be listened on; the message is one line for the user."""


def parse_listen(text: str) -> tuple[str, int]:
    """Read ``HOST:PORT`` (IPv6 in brackets); ``ListenError`` otherwise."""
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
    """The listening socket. ``ListenError`` if the address cannot be had, or would lie open."""
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
        bound = socket.socket(family, kind, proto)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(address)
        bound.listen(1024)  # who reads the address may connect at once
    except OSError as error:
        raise ListenError(f"{listen}: {error.strerror}") from error
    return bound


class BearerToken:
    """ASGI middleware: every path but ``/healthz`` wants ``Authorization: Bearer TOKEN``."""

    def __init__(self, app: ASGIApp, token: str) -> None:
        self._app = app
        self._expected = f"Bearer {token}".encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and scope["path"] not in OPEN_PATHS:
            given = Headers(scope=scope).get("authorization", "").encode()
            if not hmac.compare_digest(given, self._expected):
                refusal = JSONResponse(
                    {"type": "about:blank", "title": "a bearer token is needed", "status": 401},
                    status_code=401,
                    headers={"www-authenticate": "Bearer"},
                    media_type="application/problem+json",
                )
                await refusal(scope, receive, send)
                return
        await self._app(scope, receive, send)
