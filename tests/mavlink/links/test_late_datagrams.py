"""Datagrams that wait while other work keeps the event loop busy."""

import asyncio
import socket
import time

import pytest
from link_support import frame, port_of, runner, running, stamping, until_true

from companion.mavlink.links import udp

FRAMES = 200
BUSY_S = 0.1  # other work in each iteration of the event loop


@pytest.mark.skipif(not udp.datagrams.IS_DIRECT, reason="needs the kernel's stamps")
def test_late_datagrams_are_read_in_a_few_iterations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(udp, "LATE_SLICE_MAX_S", BUSY_S)
    iterations = 0

    async def test() -> None:
        async with running("udpin:127.0.0.1:0", time.monotonic_ns) as (link, _):
            loop, frames = asyncio.get_running_loop(), [frame(n) for n in range(FRAMES)]

            def work() -> None:
                nonlocal iterations
                iterations += 1
                time.sleep(BUSY_S)
                if link.status.bytes < sum(map(len, frames)):
                    loop.call_soon(work)

            with stamping(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                for raw in frames:
                    sender.sendto(raw, ("127.0.0.1", port_of(link)))
                loop.call_soon(work)
                await until_true(lambda: link.status.bytes == sum(map(len, frames)))

    runner("uvloop")(test())
    assert iterations < FRAMES / udp.READ_AT_ONCE / 1.5
