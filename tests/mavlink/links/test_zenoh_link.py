"""Raw frames over Zenoh on loopback: to and from a hub that may restart."""

import asyncio
import sys
from collections.abc import Callable

import pytest
from link_support import LOOPS, Run, frame, runner, running, until_true
from support import free_port

from companion.mavlink.links import zenoh_link
from companion.mavlink.links.kinds import FRAMES_AT_ONCE
from companion.mavlink.links.transport import Link
from companion.mavlink.links.urls import parse_link
from companion.mavlink.wire.encode import heartbeat
from companion.values import Source, UserError

pytest.importorskip("zenoh")


@pytest.fixture(params=LOOPS)
def run(request: pytest.FixtureRequest) -> Run:
    """Return ``run(test())``, on each of the two event loops."""
    return runner(request.param)


@pytest.fixture
def links() -> tuple[str, str]:
    """Open a listening hub and a link that connects to it."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    return f"zenoh:site/raw?as=hub&listen={endpoint}", f"zenoh:site/raw?connect={endpoint}"


def listened_to(link: Link) -> bool:
    return bool(link._endpoint.peers())


def test_frames_pass_both_ways(run: Run, links: tuple[str, str]) -> None:
    async def test() -> None:
        async with running(links[0]) as (hub, at_hub), running(links[1]) as (link, heard):
            await until_true(lambda: listened_to(hub) and listened_to(link))
            frames = [frame(number) for number in range(50)]
            for raw in frames:
                hub.send_raw(raw)
            await heard.until(len(frames))
            assert heard.raws == frames and not heard.rejections
            assert link.send(heartbeat(Source(5, 191))) == 1
            await at_hub.until(1)
            assert at_hub.frames[0].source == Source(5, 191)
            assert (link.status.state, link.status.arrival) == ("up", "read")

    run(test())


def test_link_that_finds_no_thread_is_opened_again(
    run: Run, links: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A limit of processes: to open and to close a session, each once."""
    in_thread, refused = asyncio.to_thread, list[str]()

    async def third(work: Callable[[], None]) -> None:
        if len(refused) < 2:
            refused.append(work.__name__)
            raise RuntimeError("can't start new thread")
        await in_thread(work)

    async def test() -> None:
        async with running(links[0]) as (hub, _):
            await until_true(lambda: hub.status.state == "up")

    monkeypatch.setattr(asyncio, "to_thread", third)
    run(test())
    assert refused == ["open", "close"]


def test_large_sample_is_processed_a_few_frames_at_a_time(run: Run, links: tuple[str, str]) -> None:
    async def test() -> None:
        async with running(links[0]) as (hub, _), running(links[1]) as (link, heard):
            await until_true(lambda: listened_to(hub) and listened_to(link))
            frames = [frame(number, seq=number % 256) for number in range(1000)]
            hub.send_raw(b"".join(frames))
            await heard.until(len(frames))
            assert heard.raws == frames
            assert max(heard.batches) <= FRAMES_AT_ONCE

    run(test())


def test_two_non_hub_links_do_not_receive_each_other(run: Run, links: tuple[str, str]) -> None:
    """Two links without a hub do not receive each other; a frame then counts as not sent."""

    async def test() -> None:
        peer = links[0].replace("as=hub&", "")
        async with running(peer) as (one, _), running(links[1]) as (other, heard):
            await until_true(lambda: other.status.state == one.status.state == "up")
            assert one.send(heartbeat(Source(5, 191))) == 0
            async with running(f"{links[1]}&as=hub") as (hub, _):
                await until_true(lambda: listened_to(hub))
                hub.send_raw(frame(1))
                await heard.until(1)

    run(test())


def test_lost_hub_is_announced_and_reconnected(
    run: Run, links: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.mavlink.links.transport.RETRY_S", (0.02,))
    monkeypatch.setattr("companion.mavlink.links.transport.STEADY_S", 0.02)

    async def test() -> None:
        async with running(links[1]) as (link, heard):
            async with running(links[0]):
                await until_true(lambda: link.status.state == "up")
            await heard.until_said(1)
            assert "is down: Zenoh's router is gone; trying again" in heard.texts[0]
            async with running(links[0]) as (hub, _):
                await until_true(lambda: listened_to(hub))
                hub.send_raw(frame(7))
                await heard.until_there_is(frame(7))
                await heard.until_said(2)
                assert heard.texts[1].endswith("is back")

    run(test())


def test_missing_router_is_announced(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zenoh_link, "OPEN_S", 0.05)

    async def test() -> None:
        async with running(f"zenoh:site?connect=tcp/127.0.0.1:{free_port()}") as (_, heard):
            await heard.until_said(1)
            assert "is down: Zenoh's router does not answer; trying again" in heard.texts[0]

    run(test())


def test_unavailable_address_is_announced(run: Run) -> None:
    async def test() -> None:
        async with running("zenoh:site?listen=tcp/192.0.2.1:7447") as (_, heard):
            await heard.until_said(1)
            assert "Cannot assign requested address" in heard.texts[0]

    run(test())


def test_receive_callback_exception_ends_the_link(run: Run, links: tuple[str, str]) -> None:
    async def test() -> None:
        def receive(found: object) -> None:
            raise ZeroDivisionError

        link = Link(url=parse_link(links[1]), receive=receive, now_ns=lambda: 1)
        async with running(links[0]) as (hub, _):
            serving = asyncio.create_task(link.run())
            await until_true(lambda: listened_to(hub))
            hub.send_raw(frame(1))
            with pytest.raises(ZeroDivisionError):
                await serving

    run(test())


def test_missing_zenoh_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zenoh", None)
    link = Link(url=parse_link("zenoh:mavlink_raw"), receive=lambda found: None, now_ns=lambda: 1)
    with pytest.raises(UserError, match=r"\[fleet\]"):
        link.open()
