"""Fullness of an endpoint's buffer, for senders that wait rather than lose messages."""

import asyncio
import contextlib
import os
import pty
import socket
from collections.abc import AsyncIterator

import pytest
from link_support import LOOPS, Run, runner, until_true

from companion.mavlink.links import udp
from companion.mavlink.links.endpoints import Endpoint, Upcalls
from companion.mavlink.links.kinds import endpoint
from companion.mavlink.links.status import LinkStatus
from companion.mavlink.links.urls import parse_link


@pytest.fixture(params=LOOPS)
def run(request: pytest.FixtureRequest) -> Run:
    """Return ``run(test())``, on each of the two event loops."""
    return runner(request.param)


@contextlib.asynccontextmanager
async def serving(url: str) -> AsyncIterator[Endpoint]:
    """Run an endpoint whose received data is dropped."""
    upcalls = Upcalls(
        up=lambda: None,
        take=lambda *_: None,
        stale=lambda *_: None,
        on_peer_gone=lambda _: None,
        overflow=lambda _: None,
    )
    made = endpoint(parse_link(url), LinkStatus(url=url), upcalls)
    made.open()
    task = asyncio.create_task(made.serve())
    try:
        await until_true(lambda: bool(made.peers()))
        yield made
    finally:
        task.cancel()
        await asyncio.wait({task})


def fill(made: Endpoint) -> int:
    """Write until nothing is accepted; return the number of bytes."""
    (key,) = made.peers() or ()
    assert made.fullness(key) == 0.0
    taken = 0
    while made.write(key, bytes(200)):
        taken += 200
    assert 0.9 < made.fullness(key) <= 1.0
    return taken


def test_connection_buffer_is_full_until_read(run: Run) -> None:
    async def test(server: socket.socket) -> None:
        async with serving(f"tcp:127.0.0.1:{server.getsockname()[1]}") as made:
            (key,) = made.peers() or ()
            with server.accept()[0] as far:
                left = fill(made)
                far.setblocking(False)

                def read_all() -> bool:
                    nonlocal left
                    with contextlib.suppress(BlockingIOError):
                        left -= len(far.recv(1 << 16))
                    return left == 0

                await until_true(read_all)
                assert made.fullness(key) == 0.0
        assert made.fullness(key) == 0.0  # it has disconnected

    with socket.create_server(("127.0.0.1", 0)) as server:
        run(test(server))


def test_serial_buffer_is_full_until_read(run: Run) -> None:
    async def test() -> None:
        far, near = pty.openpty()
        try:
            os.set_blocking(far, False)
            async with serving(f"serial:{os.ttyname(near)}:921600") as made:
                left = fill(made)

                def read_all() -> bool:
                    nonlocal left
                    with contextlib.suppress(BlockingIOError):
                        left -= len(os.read(far, 1 << 16))
                    return left == 0

                await until_true(read_all)
                assert made.fullness(None) == 0.0
            assert made.fullness(None) == 0.0
        finally:
            os.close(far)
            os.close(near)

    run(test())


def test_datagram_socket_is_full_while_the_kernel_accepts_no_more(run: Run) -> None:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with near, far:
        near.setblocking(False)
        assert udp._fullness(near) == 0.0
        sent = 0
        with contextlib.suppress(BlockingIOError):
            while near.send(bytes(200)):
                sent += 1
        assert udp._fullness(near) == 1.0
        for _ in range(sent):
            far.recv(200)
        assert udp._fullness(near) == 0.0
    assert udp._fullness(near) == 0.0  # closed

    async def test() -> None:
        async with serving("udpout:127.0.0.1:9") as made:
            assert made.fullness(None) == 0.0
        assert made.fullness(None) == 0.0

    run(test())
