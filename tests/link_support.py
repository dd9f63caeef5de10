"""Links at work: what the tests of links and of their endpoints share."""

import asyncio
import contextlib
import socket
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from itertools import count
from typing import Any

import uvloop
from pymavlink.dialects.v10 import all as dialect_v1
from pymavlink.dialects.v20 import all as dialect

from companion.mavlink.links import kernel_time
from companion.mavlink.links.transport import Link, MessageSigning
from companion.mavlink.links.urls import parse_link
from companion.mavlink.wire.foreign import ForeignSplitter
from companion.values import Frame, Notice, Rejection
from companion.values.budget import Budget

LIMIT_S = 20.0
"""A test that waits this long has failed."""
LOOPS: dict[str, Callable[[], asyncio.AbstractEventLoop]] = {
    "asyncio": asyncio.new_event_loop,
    "uvloop": uvloop.new_event_loop,
}
"""The loop that comes with Python, and the one in flight."""

Run = Callable[[Coroutine[Any, Any, None]], None]


def fed(splitter: ForeignSplitter, t_ns: int, data: bytes) -> list[Frame | Rejection]:
    """Everything that a splitter makes of bytes, in as many calls as it takes."""
    found = splitter.feed(t_ns, data)
    while splitter.has_more:
        found += splitter.feed(t_ns, b"")
    return found


def runner(loop: str) -> Run:
    """``run(test())`` on that loop, within the limit."""

    def run(test: Coroutine[Any, Any, None]) -> None:
        async def limited() -> None:
            async with asyncio.timeout(LIMIT_S):
                await test

        with asyncio.Runner(loop_factory=LOOPS[loop]) as runs:
            runs.run(limited())

    return run


def frame(
    number: int, sysid: int = 1, version: int = 2, seq: int | None = None, *, compid: int = 1
) -> bytes:
    """A report that no other number gives."""
    mav = (dialect if version == 2 else dialect_v1).MAVLink(None, sysid, compid)
    mav.seq = number % 256 if seq is None else seq
    module = dialect if version == 2 else dialect_v1
    message = module.MAVLink_global_position_int_message(
        number, 473977419, 85455938, 488_000, 25_000, -300, 400, -5, 35_999
    )
    return bytes(message.pack(mav))


class Inbox:
    """What a link handed on and said; the ``until`` methods wait for it to be enough."""

    def __init__(self) -> None:
        self.items: list[Frame | Rejection] = []
        self.batches: list[int] = []
        self.notices: list[Notice] = []
        self._came = asyncio.Event()

    def receive(self, items: list[Frame | Rejection]) -> None:
        self.items += items
        self.batches.append(len(items))
        self._came.set()

    def notify(self, notice: Notice) -> None:
        self.notices.append(notice)
        self._came.set()

    @property
    def frames(self) -> list[Frame]:
        return [item for item in self.items if isinstance(item, Frame)]

    @property
    def raws(self) -> list[bytes]:
        return [item.raw for item in self.frames]

    @property
    def rejections(self) -> list[Rejection]:
        return [item for item in self.items if isinstance(item, Rejection)]

    @property
    def texts(self) -> list[str]:
        return [notice.text for notice in self.notices]

    async def until_true(self, enough: Callable[[], bool]) -> None:
        while not enough():
            self._came.clear()
            await self._came.wait()

    async def until(self, frames: int) -> None:
        await self.until_true(lambda: len(self.raws) >= frames)

    async def until_there_is(self, raw: bytes) -> None:
        await self.until_true(lambda: raw in self.raws)

    async def until_said(self, notices: int) -> None:
        await self.until_true(lambda: len(self.notices) >= notices)


async def until_true(enough: Callable[[], bool]) -> None:
    """Asks on every turn of the loop, for what nothing announces; the test's limit ends it."""
    while not enough():
        await asyncio.sleep(0.001)


@contextlib.asynccontextmanager
async def running(
    url: str,
    now_ns: Callable[[], int] | None = None,
    guard: MessageSigning | None = None,
    receivers_s: Budget | None = None,
) -> AsyncIterator[tuple[Link, Inbox]]:
    """A link that is open and runs, and is cancelled at the end. Its time is 1, 2, 3 …"""
    inbox, clock = Inbox(), count(1)
    link = Link(
        url=parse_link(url),
        receive=inbox.receive,
        now_ns=now_ns or (lambda: next(clock)),
        notify=inbox.notify,
        guard=guard,
        receivers_s=receivers_s,
    )
    link.open()
    task = asyncio.create_task(link.run())
    try:
        yield link, inbox
        assert not task.done()
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
    assert link.status.state == "down"
    handed_on = len(inbox.items)
    await asyncio.sleep(0.005)  # what the loop still had to do
    assert len(inbox.items) == handed_on, "a link that is stopped has nothing more to say"


@contextlib.contextmanager
def stamping() -> Iterator[None]:
    """While the system stamps datagrams as they come in: it begins late when it is first asked."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        if not kernel_time.stamped(probe):
            yield
            return
        stamp_ns, sent_ns = None, 0
        while stamp_ns is None or stamp_ns > sent_ns + 5_000_000:
            probe.sendto(b"?", probe.getsockname())
            sent_ns = time.time_ns()
            time.sleep(0.01)
            stamp_ns = kernel_time.stamp_ns(probe.recvmsg(9, kernel_time.ANCILLARY_BYTES)[1])
        yield


def port_of(link: Link) -> int:
    """The port that the system chose."""
    return parse_link(link.status.url).port
