"""Observations over UDP: events in order, counted rejections, and a budget against floods."""

import asyncio
import contextlib
import socket
from collections import Counter
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from typing import Any

import pytest
from observed import DIRECTION, POWER
from support import HANG_S, free_port, run_async

from companion.node import observations
from companion.node.observations import OBSERVATIONS_PER_S, OBSERVATIONS_SAVED, ObservationIntake
from companion.settings.observations import ObservationSettings
from companion.values import Event, Notice, Observation, Reason, Rejection, Severity, UserError
from companion.views.observation_records import encode

NOW_NS = DIRECTION.t_ns
OFFSET_NS = 5_000_000


class Receiver:
    """Intake on a port of its own, with a clock that stands unless the test moves it."""

    def __init__(self, *, enabled: bool = True, port: int | None = None) -> None:
        self.now_ns = NOW_NS
        self.port = port or free_port(socket.SOCK_DGRAM)
        self.events: list[Event] = []
        self.notices: list[Notice] = []
        self._changed = asyncio.Event()
        self.intake = ObservationIntake(
            settings=ObservationSettings(enabled=enabled, udp=f"127.0.0.1:{self.port}"),
            step=self._step,
            notify=self.notices.append,
            now_ns=lambda: self.now_ns,
            utc_offset_ns=lambda: OFFSET_NS,
        )

    def _step(self, event: Event) -> None:
        self.events.append(event)
        self.now_ns += 1
        self._changed.set()

    async def until(self, good: Callable[[], bool]) -> None:
        """Wait for events until a condition holds."""
        async with asyncio.timeout(HANG_S):
            while not good():
                self._changed.clear()
                await self._changed.wait()

    def of(self, kind: type) -> list[Any]:
        """Return the events of a kind."""
        return [event for event in self.events if isinstance(event, kind)]

    def rejected(self) -> Counter[Reason]:
        """Return the number of rejected datagrams by reason."""
        found = Counter[Reason]()
        for one in self.of(Rejection):
            assert one.source == f"observations udp:127.0.0.1:{self.port}"
            found[one.reason] += one.count
        return found


@contextlib.asynccontextmanager
async def receiving(**given: Any) -> AsyncIterator[tuple[Receiver, socket.socket]]:
    """Run an intake; yields it, and a socket that sends to it."""
    receiver = Receiver(**given)
    receiver.intake.open()
    task = asyncio.create_task(receiver.intake.run())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect(("127.0.0.1", receiver.port))
        try:
            yield receiver, sender
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task


def test_datagrams_become_events_in_order() -> None:
    async def test() -> None:
        async with receiving() as (receiver, sender):
            sent = [replace(DIRECTION, uav=f"{n}:1") for n in range(100)]
            sent += [POWER, replace(POWER, update=None)]
            for one in sent:
                sender.send(encode(one))
            await receiver.until(lambda: len(receiver.events) == len(sent))
            found = receiver.of(Observation)
            assert [one.t_ns for one in found] == list(range(NOW_NS, NOW_NS + len(sent)))
            for got, one in zip(found, sent, strict=True):
                measured_ns = one.measured_ns - OFFSET_NS
                assert got == replace(one, t_ns=got.t_ns, measured_ns=measured_ns)
            counts = receiver.intake.counts
            assert (counts.received, counts.malformed, counts.dropped) == (102, 0, 0)

    run_async(test())


def test_malformed_datagrams_are_counted_rejections_with_a_reason() -> None:
    async def test() -> None:
        async with receiving() as (receiver, sender):
            good = encode(DIRECTION)
            bad = [
                b"",
                b"x",
                good[:-1],
                good + b"\0",
                b"GET / HTTP/1.1\r\n\r\n" * 50,
                bytes(60_000),
            ]
            for one in (*bad, good):
                sender.send(one)
            await receiver.until(lambda: bool(receiver.of(Observation)))
            await receiver.until(lambda: receiver.rejected()[Reason.MALFORMED] == len(bad))
            first = receiver.of(Rejection)[0]
            assert first.detail == "0 bytes; a record has at least 160"
            assert receiver.intake.counts.malformed == len(bad)
            assert len(receiver.of(Observation)) == 1

    run_async(test())


def test_flood_is_limited_by_the_budget_and_counted() -> None:
    """The clock stands, so that the budget is not renewed: exactly what is saved is processed."""
    flood = 2 * int(OBSERVATIONS_SAVED)

    async def test() -> None:
        async with receiving() as (receiver, sender):
            receiver.intake._now_ns = lambda: NOW_NS
            counts = receiver.intake.counts
            for n in range(flood):
                sender.send(encode(DIRECTION) if n % 2 else b"malformed")
                if n % 100 == 99:  # the socket's buffer holds them, whatever its size
                    while counts.received + counts.malformed + counts.dropped <= n:
                        await asyncio.sleep(0)
            assert counts.received + counts.malformed == OBSERVATIONS_SAVED
            assert counts.dropped == flood // 2
            await receiver.until(lambda: receiver.rejected()[Reason.TOO_FREQUENT] == flood // 2)
            assert len(receiver.of(Rejection)) < 20  # a flood of datagrams is none of events
            receiver.intake._now_ns = lambda: NOW_NS + 1_000_000_000
            for _ in range(10):
                sender.send(encode(DIRECTION))
            before = counts.received
            await receiver.until(lambda: counts.received == before + 10)

    run_async(test())


def test_budget_is_renewed_at_its_rate() -> None:
    receiver = Receiver()
    spent = 0
    for _ in range(10_000):
        receiver.now_ns += 100_000  # 10 000 a second
        spent += receiver.intake.has_room()
    assert spent == pytest.approx(OBSERVATIONS_PER_S + OBSERVATIONS_SAVED, rel=0.01)
    assert receiver.intake.counts.dropped == 10_000 - spent


def test_few_datagrams_are_read_in_an_iteration_of_the_loop() -> None:
    async def test() -> None:
        async with receiving() as (receiver, sender):
            await asyncio.sleep(0)
            for _ in range(200):
                sender.send(encode(DIRECTION))
            most = before = 0
            while before < 200:
                await asyncio.sleep(0)
                most, before = max(most, len(receiver.events) - before), len(receiver.events)
            assert 0 < most <= 64  # 32 in a callback of the socket, of which two may run

    run_async(test())


def test_rejections_are_reported_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(observations, "REPORT_EVERY_S", HANG_S)

    async def test() -> None:
        async with receiving() as (receiver, sender):
            sender.send(b"malformed")
            while not receiver.intake.counts.malformed:
                await asyncio.sleep(0)
            assert receiver.events == []
        assert receiver.rejected() == {Reason.MALFORMED: 1}

    run_async(test())


def test_address_in_use_is_an_error_of_one_line() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        expected = rf"observations\.udp 127\.0\.0\.1:{port}: Address already in use"
        with pytest.raises(UserError, match=expected):
            Receiver(port=port).intake.open()


def test_socket_is_only_bound_if_enabled() -> None:
    async def test() -> None:
        async with receiving(enabled=False) as (receiver, _):
            (notice,) = receiver.notices
            assert notice.severity is Severity.WARNING
            assert "set `[observations] enabled = true`" in notice.text
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
                free.bind(("127.0.0.1", receiver.port))

    run_async(test())
