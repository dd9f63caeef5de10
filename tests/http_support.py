"""Clients of the service's own HTTP server, over real connections."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

from support import HANG_S

from companion.node.serving import Server
from companion.server.access import bind

REQUEST = b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"


def get(path: str, *headers: str) -> bytes:
    """A request, on a connection that stays open unless a header closes it."""
    lines = [f"GET {path} HTTP/1.1", "Host: 127.0.0.1", *headers]
    return "\r\n".join([*lines, "", ""]).encode()


def upgrade(query: str = "") -> bytes:
    """A request that opens a stream."""
    return get(
        f"/v1/stream?{query}", "Connection: Upgrade", "Upgrade: websocket",
        "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
    )  # fmt: skip


Client = tuple[asyncio.StreamReader, asyncio.StreamWriter]
OPEN: list[asyncio.StreamWriter] = []


@contextlib.asynccontextmanager
async def served(node: Any, token: str | None = None) -> AsyncIterator[int]:
    """Run the service's own server around a node; yields its port."""
    answering = asyncio.Event()
    with bind("127.0.0.1:0", token=token, insecure=False) as listening:
        server = Server(node=node, token=token, answering=answering)
        task = asyncio.create_task(server.serve(sockets=[listening]))
        await asyncio.wait_for(answering.wait(), HANG_S)
        try:
            yield listening.getsockname()[1]
        finally:
            for writer in OPEN:
                writer.close()
                with contextlib.suppress(ConnectionError):
                    await asyncio.wait_for(writer.wait_closed(), HANG_S)
            OPEN.clear()
            server.should_exit = True
            await task


async def connected(port: int) -> Client:
    """Return a connection, which ``served`` closes."""
    client = await asyncio.wait_for(asyncio.open_connection("127.0.0.1", port), HANG_S)
    OPEN.append(client[1])
    return client


async def asked(client: Client, request: bytes = REQUEST) -> bytes:
    """Return the first line of the response; empty if the connection was closed."""
    reader, writer = client
    with contextlib.suppress(ConnectionError):
        writer.write(request)
        return await asyncio.wait_for(reader.readline(), HANG_S)
    return b""


async def ends(client: Client) -> bool:
    """Wait until the server has closed a connection."""
    with contextlib.suppress(ConnectionError):
        await asyncio.wait_for(client[0].read(), HANG_S)
    return True
