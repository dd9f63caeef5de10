"""Link that polls a document over HTTP."""

import asyncio
import socket
import ssl
import threading
from collections.abc import Collection, Hashable
from functools import cache
from typing import Final

from companion.mavlink.links.connecting import HostLookup, connected
from companion.mavlink.links.daemon_threads import in_daemon_thread
from companion.mavlink.links.endpoints import Upcalls
from companion.mavlink.links.urls import LinkUrl
from companion.mavlink.wire.aircraft_json import DOCUMENT_MAX

PERIOD_S: Final = 0.93
"""Seconds from one request to the next; receivers write a document about once a second.

Not a second: as the phase varies, the time of writing becomes known (``document_times``).
"""
ANSWER_S: Final = 5.0  # timeout of a request
UNCHANGED_S: Final = 15.0
"""Seconds after which an unchanged document shows that its receiver has stopped."""
HEAD_MAX: Final = 16 << 10
BODY_MAX: Final = DOCUMENT_MAX


_making: Final = threading.Lock()


def _shared_context() -> ssl.SSLContext:
    """Return the TLS context of all links; the first call takes 40 ms, others wait for it."""
    with _making:
        return _context()


@cache
def _context() -> ssl.SSLContext:
    return ssl.create_default_context()


class HttpPoll:
    """Link that polls one document of one server, its only peer."""

    def __init__(self, url: LinkUrl, upcalls: Upcalls) -> None:
        self._url = url
        self._lookup = HostLookup(url, socket.SOCK_STREAM)
        self._secure: ssl.SSLContext | None = None  # None until made, or without TLS
        self._upcalls = upcalls
        self._unchanged = b""  # last document of a receiver that has stopped; else empty

    def open(self) -> None:
        """Do nothing: the server may start later."""

    async def serve(self) -> None:
        """Poll until an answer fails, or the document no longer changes; raises ``OSError``.

        What is known of the server's clock is forgotten then.
        """
        try:
            await self._poll()
        finally:
            self._upcalls.on_peer_gone(None)

    async def _poll(self) -> None:
        loop = asyncio.get_running_loop()
        if self._url.way == "https" and self._secure is None:
            self._secure = await in_daemon_thread(_shared_context)
        is_up, newest, changed_s = False, self._unchanged, loop.time()
        while True:
            due_s = loop.time() + PERIOD_S
            self._upcalls.request()
            try:
                async with asyncio.timeout(ANSWER_S):
                    body = await _get(self._url, self._lookup, self._secure)
            except ssl.SSLCertVerificationError as error:  # a ValueError, too
                raise OSError(f"its certificate is not valid: {error.verify_message}") from error
            except (ValueError, EOFError) as error:
                raise OSError(f"malformed HTTP answer: {error}") from error
            if body != newest:
                newest, changed_s = body, loop.time()
            elif loop.time() - changed_s > UNCHANGED_S:
                self._unchanged = body
                raise OSError(f"the document has not changed for {UNCHANGED_S:.0f} s")
            if not is_up and body != self._unchanged:
                self._upcalls.up()
                is_up = True
            while self._upcalls.take(None, body, None):
                body = b""  # the next aircraft of the same document
                await asyncio.sleep(0)
            await asyncio.sleep(max(0.0, due_s - loop.time()))

    def peers(self) -> Collection[Hashable]:
        """Return no peers: the link is receive-only."""
        return ()

    def write(self, key: Hashable, raw: bytes) -> bool:
        """Send nothing: the link is receive-only."""
        return False

    def fullness(self, key: Hashable) -> float:
        """Return 0: the link has no send buffer."""
        return 0.0


async def _get(url: LinkUrl, lookup: HostLookup, secure: ssl.SSLContext | None) -> bytes:
    """Return the body of a document (HTTP/1.0, RFC 1945: it ends where the server hangs up).

    Raises ``OSError`` if the document is not available, ``ValueError`` or ``EOFError`` for
    malformed HTTP.
    """
    named = url.host if secure else None
    sock = await connected(lookup)
    try:
        reader, writer = await asyncio.open_connection(
            sock=sock, ssl=secure, server_hostname=named, limit=HEAD_MAX
        )
    except BaseException:
        sock.close()
        raise
    try:
        host = f"[{url.host}]" if ":" in url.host else url.host
        asked = (
            f"GET {url.path} HTTP/1.0\r\nHost: {host}:{url.port}\r\nAccept: application/json\r\n"
        )
        writer.write(f"{asked}Connection: close\r\n\r\n".encode("ascii"))
        try:
            head = await reader.readuntil(b"\r\n\r\n")
        except asyncio.LimitOverrunError as error:
            raise ValueError("header is too long") from error
        status = head.split(None, 2)[1:2]
        if not head.startswith(b"HTTP/") or not status:
            raise ValueError("status line is missing")
        if status != [b"200"]:
            raise OSError(f"the server answers {status[0][:3].decode('ascii', 'replace')}")
        body = bytearray()
        while piece := await reader.read(1 << 16):
            body += piece
            if len(body) > BODY_MAX:
                raise ValueError(f"body exceeds {BODY_MAX} bytes")
        return bytes(body)
    finally:
        writer.transport.abort()
