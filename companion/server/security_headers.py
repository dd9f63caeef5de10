"""Headers of every answer that restrict what a page of this service may load."""

from typing import Final

from starlette.types import ASGIApp, Message, Receive, Scope, Send

CONTENT_POLICY: Final = b"default-src 'self'; frame-ancestors 'none'"
DRAWN_POLICY: Final = CONTENT_POLICY + b"; style-src 'self' 'unsafe-inline'; img-src 'self' data:"
"""Content security policy of ``/docs``: Swagger UI uses embedded images and inline styles."""


class SecurityHeaders:
    """ASGI middleware that handles HEAD requests and adds security headers.

    HEAD is handled as GET, and the server omits the body. The headers allow a page to load nothing
    from elsewhere.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        if scope["method"] == "HEAD":
            scope = {**scope, "method": "GET"}
        policy = DRAWN_POLICY if scope["path"] == "/docs" else CONTENT_POLICY

        async def with_policy(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = [
                    *message.get("headers", []),
                    (b"content-security-policy", policy),
                    (b"x-content-type-options", b"nosniff"),
                ]
                if not any(name == b"cache-control" for name, _ in headers):
                    headers.append((b"cache-control", b"no-cache"))
                message["headers"] = headers
            await send(message)

        await self._app(scope, receive, with_policy)
