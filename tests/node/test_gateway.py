"""Events that the links pass to the pipeline and its recording, and those that are dropped."""

import asyncio
import contextlib
import socket
import threading
from collections.abc import AsyncIterator, Callable
from types import SimpleNamespace
from typing import Any

import pytest
from link_support import LIMIT_S, frame, port_of, runner, until_true
from pymavlink.dialects.v20 import all as dialect

from companion.mavlink.links.urls import LinkError
from companion.mavlink.trust.newcomers import NEW_SAVED
from companion.mavlink.wire.encode import COMMAND_LONG, HEARTBEAT
from companion.node.gateway import Gateway
from companion.settings.model import Settings
from companion.values import Event, Frame, Notice, Reason, Rejection, Severity, Source

SECRET = bytes(range(100, 132))


def setup_signing() -> bytes:
    """Return the SETUP_SIGNING message by which 255:190 distributes a signing key."""
    sender = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    message = dialect.MAVLink_setup_signing_message(1, 1, list(SECRET), 7)
    return bytes(message.pack(sender))


def test_signing_key_is_dropped_and_counted() -> None:
    """It reaches neither the pipeline nor a recording; the frames before and after it do."""
    stepped: list[Event] = []
    sent = [frame(1), setup_signing(), frame(2)]

    async def test() -> None:
        settings = Settings().override(links={"urls": ["udpin:127.0.0.1:0"]})
        gateway = Gateway(
            settings=settings, step=stepped.append, notify=lambda _: None, now_ns=lambda: 5
        )
        gateway.open()
        serving = asyncio.create_task(gateway.run())
        with socket.socket(type=socket.SOCK_DGRAM) as sender:
            sender.sendto(b"".join(sent), ("127.0.0.1", port_of(gateway.links[0])))
            await until_true(lambda: len(stepped) == 3)
        serving.cancel()
        await asyncio.wait([serving])
        gateway.close()

    assert SECRET in sent[1]
    runner("asyncio")(test())
    before, refused, after = stepped
    assert isinstance(before, Frame) and isinstance(after, Frame)
    assert [before.raw, after.raw] == [sent[0], sent[2]]
    assert refused == Rejection(t_ns=before.t_ns, source="255:190", reason=Reason.SECRET, msgid=256)
    assert repr(SECRET)[2:-1] not in repr(stepped)


def test_carrier_is_admitted_during_a_flood_of_invented_ids() -> None:
    """Named in the settings as the array's carrier, it needs no place among the first senders."""
    stepped: list[Event] = []
    invented = [frame(1, sysid=1 + n // 200, compid=1 + n % 200) for n in range(600)]

    async def test() -> None:
        settings = Settings().override(
            links={"urls": ["udpin:127.0.0.1:0"]}, center={"source": "9:1"}
        )
        gateway = Gateway(
            settings=settings, step=stepped.append, notify=lambda _: None, now_ns=lambda: 5
        )
        gateway.open()
        serving = asyncio.create_task(gateway.run())
        with socket.socket(type=socket.SOCK_DGRAM) as sender:
            for raw in (*invented, frame(1, sysid=9, compid=2), frame(1, sysid=9, compid=1)):
                sender.sendto(raw, ("127.0.0.1", port_of(gateway.links[0])))
            carrier = Source(9, 1)
            await until_true(
                lambda: any(isinstance(one, Frame) and one.source == carrier for one in stepped)
            )
        serving.cancel()
        await asyncio.wait([serving])
        gateway.close()

    runner("asyncio")(test())
    sources = {one.source for one in stepped if isinstance(one, Frame)}
    assert len(sources) == round(NEW_SAVED) + 1
    assert Source(9, 2) not in sources


@contextlib.asynccontextmanager
async def saving(
    write: Callable[[object], None], notify: Callable[[Notice], None]
) -> AsyncIterator[None]:
    """Save signing timestamps without a pause, with this function."""
    timestamps: Any = SimpleNamespace(due=lambda _: True, snapshot=lambda _: None, write=write)
    gateway = Gateway(settings=Settings(), step=lambda _: None, notify=notify, now_ns=lambda: 5)
    task = asyncio.create_task(gateway._save(timestamps))
    yield
    task.cancel()
    await asyncio.wait([task])


def test_timestamps_that_cannot_be_saved_are_reported_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.node.gateway.SAVE_EVERY_S", 0.001)
    tries, said = [], list[Notice]()

    def write(_: object) -> None:
        tries.append(1)
        raise LinkError("timestamps.bin: no space left")

    async def test() -> None:
        async with saving(write, said.append):
            await until_true(lambda: len(tries) > 2)

    runner("asyncio")(test())
    text = "timestamps.bin: no space left"
    assert said == [Notice(t_ns=5, severity=Severity.ERROR, subject="signing", text=text)]


def test_disk_that_does_not_take_the_timestamps_is_reported_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("companion.node.gateway.SAVE_EVERY_S", 0.001)
    monkeypatch.setattr("companion.node.gateway.STALLED_S", 0.01)
    written, said, answers = list[int](), list[Notice](), threading.Event()

    def write(_: object) -> None:
        written.append(1)
        assert answers.wait(LIMIT_S)

    async def test() -> None:
        async with saving(write, said.append):
            await until_true(lambda: len(said) == 1)
            assert len(written) == 1
            answers.set()
            await until_true(lambda: len(written) > 3)

    runner("asyncio")(test())
    (only,) = said
    assert only.severity is Severity.ERROR and "has not answered" in only.text


def beat() -> bytes:
    """Return a heartbeat of 1:1."""
    message = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
    return bytes(message.pack(dialect.MAVLink(None, srcSystem=1, srcComponent=1)))


def test_request_goes_over_the_link_last_received_on() -> None:
    """Its position rate is too low. It was received on the first link and is now on the second."""
    stepped: list[Event] = []
    now_s = [1]

    async def test() -> None:
        settings = Settings().override(
            center={"source": "5:1"},
            links={"urls": ["udpin:127.0.0.1:0", "udpin:localhost:0"]},
            presence={"enabled": True, "position_hz": 10.0},
        )
        gateway = Gateway(
            settings=settings,
            step=stepped.append,
            notify=lambda _: None,
            now_ns=lambda: now_s[0] * 10**9,
        )
        gateway.open()
        serving = asyncio.create_task(gateway.run())
        loop = asyncio.get_running_loop()
        with (
            socket.socket(type=socket.SOCK_DGRAM) as first,
            socket.socket(type=socket.SOCK_DGRAM) as second,
        ):
            for sock, link in zip((first, second), gateway.links, strict=True):
                sock.setblocking(False)
                sock.connect(("127.0.0.1", port_of(link)))

            async def told(sock: socket.socket, beats: int) -> list[int]:
                """The ids of what comes, up to so many heartbeats."""
                found: list[int] = []
                while found.count(HEARTBEAT) < beats:
                    raw = await loop.sock_recv(sock, 300)
                    found.append(int.from_bytes(raw[7:10], "little"))
                return found

            gateway.speak(True, [Source(1, 1)], {})
            first.send(frame(1000))
            await until_true(lambda: len(stepped) == 1)
            for _ in range(9):
                now_s[0] += 1
                heard = len(stepped)
                second.send(beat())
                await until_true(lambda heard=heard: len(stepped) > heard)
                gateway.speak(True, [Source(1, 1)], {})
            assert COMMAND_LONG in await told(second, 9)
            assert COMMAND_LONG not in await told(first, 9)
        serving.cancel()
        await asyncio.wait([serving])
        gateway.close()

    runner("asyncio")(test())


def where(north_m: float, boot_ms: int) -> bytes:
    """Return a position of 1:1 at a distance north of the origin."""
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    lat = 473977419 + round(north_m * 1e7 / 111_195.0)
    return bytes(
        dialect.MAVLink_global_position_int_message(
            boot_ms, lat, 85455938, 488_000, 25_000, 0, 0, 0, 0
        ).pack(mav)
    )


def test_positions_of_another_radio_are_announced() -> None:
    said: list[Notice] = []
    now_ms = 100_000
    gateway = Gateway(
        settings=Settings().override(links={"urls": ["udpin:127.0.0.1:0"]}),
        step=lambda _: None,
        notify=said.append,
        now_ns=lambda: now_ms * 1_000_000,
    )
    gateway.open()
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    try:
        for number in range(100):
            now_ms += 100
            turned = dialect.MAVLink_attitude_message(now_ms, 0, 0, 0, 0, 0, 0)
            gateway.links[0].take(("127.0.0.1", 5), bytes(turned.pack(mav)))
            gateway.links[0].take(("127.0.0.1", 5 if number < 20 else 6), where(0, now_ms))
    finally:
        gateway.links[0]._endpoint._socket.close()  # type: ignore[attr-defined]
    (told,) = said
    assert told.text == (
        "1:1: positions are used from 127.0.0.1:6, since 127.0.0.1:5 sends none; add the trusted"
        " peer to `[links] routers`"
    )


@pytest.mark.parametrize(("routers", "refused_port"), [([], 6), (["127.0.0.1:6"], 5)])
def test_contradicting_peer_is_announced_once_and_rejected(
    routers: list[str], refused_port: int
) -> None:
    """The second one copies the clock and claims to be 20 m away: too little for the gate."""
    stepped: list[Event] = []
    said: list[Notice] = []
    now_ms = 100_000
    urls = ["udpin:127.0.0.1:0", "tcpin:127.0.0.1:0"]
    settings = Settings().override(links={"urls": urls, "routers": routers})
    gateway = Gateway(
        settings=settings,
        step=stepped.append,
        notify=said.append,
        now_ns=lambda: now_ms * 1_000_000,
    )
    gateway.open()
    try:
        for number in range(100):
            now_ms += 100
            gateway.links[0].take(("127.0.0.1", 5), where(0, now_ms))
            gateway.links[1].take(("127.0.0.1", 6), where(20 * (number > 20), now_ms))
    finally:
        for link in gateway.links:
            link._endpoint._socket.close()  # type: ignore[attr-defined]
    refused = [one for one in stepped if isinstance(one, Rejection)]
    assert {one.reason for one in refused} == {Reason.STRANGER}
    believed = [one for one in stepped[-50:] if isinstance(one, Frame)]
    assert len(believed) == 25
    assert {one.link for one in believed} == {gateway.links[6 - refused_port].status.url}
    (told,) = said
    known_port = 11 - refused_port
    assert (
        f"1:1: reports from 127.0.0.1:{refused_port} contradict those from 127.0.0.1:{known_port}"
        in told.text
    )
