"""Zenoh sessions on loopback: samples, queries, liveliness and errors."""

import asyncio
import contextlib
import json
import socket
import sys
import time
from collections.abc import AsyncIterator, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from link_support import LOOPS, Run, runner
from support import free_port, run_async

from companion.mavlink.links import to_loop, zenoh_bus, zenoh_config
from companion.mavlink.links.zenoh_bus import Bus
from companion.mavlink.links.zenoh_config import QUEUED, BusConfig, BusTls, sections
from companion.values import UserError

pytest.importorskip("zenoh")


@pytest.fixture(params=LOOPS)
def run(request: pytest.FixtureRequest) -> Run:
    """Return ``run(test())``, on each of the two event loops."""
    return runner(request.param)


@contextlib.asynccontextmanager
async def opened(config: BusConfig) -> AsyncIterator[Bus]:
    bus = Bus(config, asyncio.get_running_loop())
    await asyncio.to_thread(bus.open)
    try:
        yield bus
    finally:
        await asyncio.to_thread(bus.close)


@contextlib.asynccontextmanager
async def pair() -> AsyncIterator[tuple[Bus, Bus]]:
    """Open two peers; the second connects to the first."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with (
        opened(BusConfig(listen=(endpoint,))) as one,
        opened(BusConfig(connect=(endpoint,))) as other,
    ):
        yield one, other


class Heard(list[Any]):
    """Arguments of the callbacks."""

    def __init__(self) -> None:
        super().__init__()
        self._came = asyncio.Event()

    def take(self, *what: Any) -> None:
        self.append(what)
        self._came.set()

    async def until(self, count: int) -> None:
        while len(self) < count:
            self._came.clear()
            await self._came.wait()


async def joined(speaker: Bus, listener: Bus) -> None:
    """Wait until both know each other: declarations are exchanged, and samples arrive."""
    heard = Heard()
    listener.watch("joined/*", heard.take)
    speaker.alive("joined/speaker")
    await heard.until(1)


def test_samples_arrive_whole_and_in_order(run: Run) -> None:
    async def test() -> None:
        async with pair() as (one, other):
            heard = Heard()
            one.subscribe("site/*/frames", heard.take)
            await joined(one, other)  # the subscription was sent before
            sent = [bytes([n % 256]) * (n % 50) for n in range(800)]
            for payload in sent:
                other.put("site/b/frames", payload)
                other.put("site/b/tracks", b"nobody listens")
            await heard.until(len(sent))
            assert heard == [("site/b/frames", payload) for payload in sent]
            assert other.status.sent == 2 * len(sent)
            assert one.status.dropped == other.status.refused == 0

    run(test())


def test_session_does_not_receive_its_own_samples(run: Run) -> None:
    async def test() -> None:
        async with pair() as (one, other):
            heard, elsewhere = Heard(), Heard()
            one.subscribe("site/a", heard.take)
            other.subscribe("site/a", elsewhere.take)
            await joined(other, one)
            one.put("site/a", b"mine")
            await elsewhere.until(1)
            other.put("site/a", b"yours")
            await heard.until(1)
            assert list(heard) == [("site/a", b"yours")]

    run(test())


def test_late_subscriber_learns_present_and_departing_nodes(run: Run) -> None:
    async def test() -> None:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        async with opened(BusConfig(listen=(endpoint,))) as stays:
            seen, late = Heard(), Heard()
            stays.watch("alive/*", seen.take)
            async with opened(BusConfig(connect=(endpoint,))) as leaves:
                leaves.alive("alive/b")
                await seen.until(1)
                stays.watch("alive/*", late.take)
                await late.until(1)
            await seen.until(2)
            await late.until(2)
            assert seen == late == [("alive/b", True), ("alive/b", False)]

    run(test())


def test_query_is_answered_while_the_loop_is_busy(run: Run) -> None:
    async def test() -> None:
        async with pair() as (one, other):
            answers = Heard()
            served: list[int] = []

            def answer(key: str, payload: bytes) -> bytes:
                served.append(time.monotonic_ns())
                return key.encode() + payload

            one.serve("site/a/clock", answer)
            await joined(one, other)
            asked_ns = time.monotonic_ns()
            other.ask("site/a/clock", b"?", 20.0, answers.take)
            while not served:  # the loop does nothing else
                time.sleep(0.001)
            await answers.until(1)
            [(said, arrived_ns)] = answers
            assert said == b"site/a/clock?"
            assert asked_ns < served[0] < arrived_ns < time.monotonic_ns()

    run(test())


def test_unanswered_query_does_not_block_others(run: Run) -> None:
    async def test() -> None:
        async with pair() as (one, other):
            answers = Heard()
            one.serve("site/a/clock", lambda key, payload: payload or None)
            await joined(one, other)
            other.ask("site/a/clock", b"", 0.05, answers.take)
            other.ask("site/nobody/clock", b"!", 0.05, answers.take)
            other.ask("site/a/clock", b"!", 20.0, answers.take)
            await answers.until(1)
            assert answers[0][0] == b"!"

    run(test())


def test_callback_exception_ends_the_bus(run: Run) -> None:
    async def test() -> None:
        async with pair() as (one, other):
            calls = Heard()

            def breaks(key: str, payload: bytes) -> None:
                calls.take(payload)
                raise ZeroDivisionError

            one.subscribe("site/*", breaks)
            await joined(one, other)
            other.put("site/b", b"1")
            other.put("site/b", b"2")
            with pytest.raises(ZeroDivisionError):
                await one.run()
            assert list(calls) == [(b"1",)]

    run(test())


def test_query_handler_exception_ends_the_bus(run: Run) -> None:
    async def test() -> None:
        async with pair() as (one, other):
            one.serve("site/a", lambda key, payload: bytes([1 // len(payload)]))
            await joined(one, other)
            other.ask("site/a", b"", 0.02, lambda answer, t_ns: None)
            with pytest.raises(ZeroDivisionError):
                await one.run()

    run(test())


def test_receive_queue_is_bounded(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(to_loop, "QUEUE_MAX", 10)

    async def test() -> None:
        async with pair() as (one, other):
            heard = Heard()
            one.subscribe("site/b", heard.take)
            await joined(one, other)
            for n in range(100):
                other.put("site/b", bytes([n]))
            while one.status.dropped < 90:  # the loop does nothing else meanwhile
                time.sleep(0.001)
            await heard.until(10)
            assert [payload[0] for _, payload in heard] == list(range(10))
            assert one.status.dropped == 90

    run(test())


def test_sessions_beyond_the_limit_are_rejected(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each may hold unfinished samples in memory."""
    monkeypatch.setattr(zenoh_config, "SESSIONS_MAX", 1)
    endpoint = f"tcp/127.0.0.1:{free_port()}"

    async def test() -> None:
        async with (
            opened(BusConfig(listen=(endpoint,))) as one,
            opened(BusConfig(connect=(endpoint,))) as first,
            opened(BusConfig(connect=(endpoint,))) as second,
        ):
            heard = Heard()
            one.subscribe("site/*", heard.take)
            joining = [asyncio.create_task(joined(each, one)) for each in (first, second)]
            _, waiting = await asyncio.wait(joining, return_when=asyncio.FIRST_COMPLETED)
            for task in waiting:
                task.cancel()
            for _ in range(20):
                first.put("site/first", b"")
                second.put("site/second", b"")
                await asyncio.sleep(0.05)
            assert len({key for key, _ in heard}) == 1

    run(test())


def test_samples_beyond_the_limit_are_not_received(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Zenoh itself discards them, and the connection stays."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"

    async def test() -> None:
        monkeypatch.setattr(zenoh_config, "MESSAGE_MAX", 200_000)
        async with opened(BusConfig(listen=(endpoint,))) as one:
            monkeypatch.setattr(zenoh_config, "MESSAGE_MAX", 1 << 30)
            async with opened(BusConfig(connect=(endpoint,))) as other:
                heard = Heard()
                one.subscribe("site/b", heard.take)
                await joined(one, other)
                for size in (150_000, 250_000, 3):
                    other.put("site/b", bytes(size))
                await heard.until(2)
                assert [len(payload) for _, payload in heard] == [150_000, 3]

    run(test())


def test_received_bytes_are_bounded(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(to_loop, "BYTES_MAX", 10_000)

    async def test() -> None:
        async with pair() as (one, other):
            heard = Heard()
            one.subscribe("site/b", heard.take)
            await joined(one, other)
            for _ in range(20):
                other.put("site/b", bytes(1000))
            while one.status.dropped < 10:  # the loop does nothing else meanwhile
                time.sleep(0.001)
            await heard.until(10)
            assert one.status.dropped == 10

    run(test())


def test_samples_after_close_are_rejected_without_an_exception(run: Run) -> None:
    async def test() -> None:
        async with opened(BusConfig()) as bus:
            bus.put("site/a", b"1")
        bus.put("site/a", b"2")
        bus.put("site/b", b"3")
        assert (bus.status.sent, bus.status.refused) == (1, 2)

    run(test())


def test_a_burst_of_urgent_samples_arrives(run: Run) -> None:
    async def test() -> None:
        async with pair() as (one, other):
            heard = Heard()
            one.subscribe("site/b", heard.take)
            await joined(one, other)
            for n in range(QUEUED - 4):
                other.put("site/b", bytes([n]), express=True)
            await heard.until(QUEUED - 4)

    run(test())


def test_best_effort_samples_use_datagrams(run: Run) -> None:
    async def test() -> None:
        ports = free_port(), free_port(socket.SOCK_DGRAM)
        endpoints = (f"tcp/127.0.0.1:{ports[0]}?rel=1", f"udp/127.0.0.1:{ports[1]}?rel=0")
        async with (
            opened(BusConfig(listen=endpoints)) as one,
            opened(BusConfig(listen=(), connect=endpoints)) as other,
        ):
            heard = Heard()
            one.subscribe("site/b", heard.take)
            await joined(one, other)
            while len(other._opened().info.links()) < 2:
                await asyncio.sleep(0.001)
            kinds = {link.dst[:3]: link.reliability for link in other._opened().info.links()}
            assert [str(kinds["tcp"]), str(kinds["udp"])] == [
                "Reliability.RELIABLE",
                "Reliability.BEST_EFFORT",
            ]
            other.put("site/b", b"", reliable=False)
            await heard.until(1)
            (publisher,) = other._publishers.values()
            assert str(publisher.reliability) == "Reliability.BEST_EFFORT"

    run(test())


def test_samples_on_many_keys_are_all_sent(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zenoh_bus, "PUBLISHERS_MAX", 2)

    async def test() -> None:
        async with pair() as (one, other):
            heard = Heard()
            one.subscribe("site/*", heard.take)
            await joined(one, other)
            for n in range(5):
                other.put(f"site/{n}", b"", express=True, priority="real_time")
            await heard.until(5)
            assert sorted(heard) == [(f"site/{n}", b"") for n in range(5)]

    run(test())


def test_subscribers_and_neighbours_are_detected(run: Run) -> None:
    async def test() -> None:
        async with pair() as (stays, leaves):
            near = Heard()
            stays.neighbours(near.take)
            leaves.subscribe("site/a", lambda key, payload: None)
            stays.subscribe(
                "site/*", lambda key, payload: None
            )  # a session's own subscription does not count
            await joined(leaves, stays)
            await near.until(1)
            assert stays.is_wanted("site/a") and not stays.is_wanted("site/b")
            assert stays.is_wanted("site/a", "data_high")
            await asyncio.to_thread(leaves.close)
            while near[-1][1]:  # on a busy machine the join may be reported twice
                await near.until(len(near) + 1)
            assert {is_joined for _, is_joined in near[:-1]} == {True}
            assert len({who for who, _ in near}) == 1
            assert not stays.is_wanted("site/a") and not leaves.is_wanted("site/a")

    run(test())


def test_unsubscribed_session_receives_nothing(run: Run) -> None:
    async def test() -> None:
        async with pair() as (speaks, listens):
            some, others, near = Heard(), Heard(), Heard()
            end = listens.subscribe("site/a", some.take)
            listens.subscribe("site/b", others.take)
            speaks.neighbours(near.take)
            await joined(listens, speaks)
            await near.until(1)
            speaks.put("site/a", b"1")
            await some.until(1)
            end()
            while speaks.is_wanted("site/a"):
                await asyncio.sleep(0.01)
            speaks.put("site/a", b"2")
            speaks.put("site/b", b"3")
            await others.until(1)
            assert [payload for _, payload in some] == [b"1"]
            await asyncio.to_thread(listens.close)
            end()  # once more, after the session: nothing is sent

    run(test())


def test_client_waits_for_its_router_until_closed(run: Run) -> None:
    async def test() -> None:
        nobody = f"tcp/127.0.0.1:{free_port()}"
        bus = Bus(BusConfig(mode="client", connect=(nobody,)), asyncio.get_running_loop())
        opening = asyncio.create_task(asyncio.to_thread(bus.open))
        await asyncio.to_thread(bus.close)
        await opening

    run(test())


def test_neighbour_that_starts_later_is_found(run: Run) -> None:
    async def test() -> None:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        config = BusConfig(connect=(endpoint,), retry_s=0.02)
        async with opened(config) as early, opened(BusConfig(listen=(endpoint,))) as late:
            await joined(early, late)

    run(test())


def listening() -> dict[str, str]:
    """Return this process's receiving sockets: by inode, the table and the address."""
    mine = set()
    for descriptor in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # the descriptor by which the folder was read
            mine.add(str(descriptor.readlink()))
    found = {}
    for table, state in (("tcp", "0A"), ("tcp6", "0A"), ("udp", "07"), ("udp6", "07")):
        for line in Path(f"/proc/net/{table}").read_text("ascii").splitlines()[1:]:
            fields = line.split()
            if fields[3] == state and f"socket:[{fields[9]}]" in mine:
                found[fields[9]] = f"{table} {fields[1].split(':')[0]}"
    return found


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="the system has no such list")
def test_zenoh_listens_on_loopback_by_default(run: Run) -> None:
    async def test() -> None:
        before = listening()
        async with opened(BusConfig()):
            new = {inode: at for inode, at in listening().items() if inode not in before}
            assert list(new.values()) == ["tcp 0100007F"]  # 127.0.0.1

    run(test())


def wrong_configurations(nowhere: Path) -> Iterator[tuple[BusConfig, str]]:
    """Return invalid configurations, and a word of each error message."""
    yield BusConfig(listen=("tpc/127.0.0.1:0",)), "tpc"
    yield BusConfig(listen=("tcp/192.0.2.1:7447",)), "192.0.2.1"
    yield BusConfig(connect=("nonsense",)), "nonsense"
    yield BusConfig(listen=("tls/127.0.0.1:0",)), "TLS private key"
    yield (
        BusConfig(
            listen=("tls/127.0.0.1:0",),
            tls=BusTls(ca=nowhere, certificate=nowhere, private_key=nowhere),
        ),
        "TLS",
    )
    yield BusConfig(access_control=nowhere), str(nowhere)
    yield BusConfig(access_control=Path(__file__)), "configuration"


def test_command_error_is_one_line(tmp_path: Path) -> None:
    async def said(config: BusConfig) -> str:
        with pytest.raises(UserError) as error:
            await asyncio.to_thread(Bus(config, asyncio.get_running_loop()).open)
        return str(error.value)

    for config, word in wrong_configurations(tmp_path / "missing"):
        message = run_async(said(config))
        assert word in message, message
        assert "\n" not in message
        assert "cargo" not in message


def test_missing_zenoh_package_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in chain(sys.modules, ["zenoh"]) if name.startswith("zenoh")]:
        monkeypatch.setitem(sys.modules, name, None)

    async def test() -> None:
        Bus(BusConfig(), asyncio.get_running_loop()).open()

    with pytest.raises(UserError, match=r"needs the package zenoh: pip install '.*\[fleet\]'"):
        run_async(test())


@pytest.mark.parametrize("mutual", [True, False])
def test_mutual_tls_is_the_default(mutual: bool) -> None:
    tls = BusTls(
        ca=Path("ca.pem"), certificate=Path("me.pem"), private_key=Path("me.key"), mutual=mutual
    )
    section = json.loads(sections(BusConfig(tls=tls))["transport/link/tls"])
    assert section["enable_mtls"] is mutual
    assert section["listen_certificate"] == section["connect_certificate"] == "me.pem"
    assert BusTls(ca=Path("ca.pem")).mutual
