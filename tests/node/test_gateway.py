"""What goes from the links to the fold and its recording, and what does not."""

import asyncio
import socket

from link_support import frame, port_of, runner, until_true
from pymavlink.dialects.v20 import all as dialect

from companion.mavlink.wire.encode import COMMAND_LONG, HEARTBEAT
from companion.node.gateway import Gateway
from companion.settings.model import Settings
from companion.values import Event, Frame, Reason, Rejection, Source

SECRET = bytes(range(100, 132))


def setup_signing() -> bytes:
    """The message by which a ground station hands out a signing key, from 255:190."""
    sender = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    message = dialect.MAVLink_setup_signing_message(1, 1, list(SECRET), 7)
    return bytes(message.pack(sender))


def test_a_signing_key_goes_no_further_and_that_is_counted() -> None:
    """Neither to the fold nor, with it, into a recording; what comes before and after it does."""
    stepped: list[Event] = []
    sent = [frame(1), setup_signing(), frame(2)]

    async def test() -> None:
        settings = Settings().override(links={"urls": ["udpin:127.0.0.1:0"]})
        gateway = Gateway(settings, stepped.append, lambda _: None, lambda: 5)
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
    assert refused == Rejection(before.t_ns, "255:190", Reason.SECRET, msgid=256)
    assert repr(SECRET)[2:-1] not in repr(stepped)


def beat() -> bytes:
    """A heartbeat of 1:1."""
    message = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
    return bytes(message.pack(dialect.MAVLink(None, srcSystem=1, srcComponent=1)))


def test_a_uav_is_asked_over_the_link_on_which_it_was_heard_last() -> None:
    """Its positions come too seldom. It came over the first link, and is now on the second."""
    stepped: list[Event] = []
    now_s = [1]

    async def test() -> None:
        settings = Settings().override(
            center={"source": "5:1"},
            links={"urls": ["udpin:127.0.0.1:0", "udpin:localhost:0"]},
            presence={"enabled": True, "position_hz": 10.0},
        )
        gateway = Gateway(settings, stepped.append, lambda _: None, lambda: now_s[0] * 10**9)
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

            gateway.speak(True, [Source(1, 1)])
            first.send(frame(1000))
            await until_true(lambda: len(stepped) == 1)
            for _ in range(9):
                now_s[0] += 1
                heard = len(stepped)
                second.send(beat())
                await until_true(lambda heard=heard: len(stepped) > heard)
                gateway.speak(True, [Source(1, 1)])
            assert COMMAND_LONG in await told(second, 9)
            assert COMMAND_LONG not in await told(first, 9)
        serving.cancel()
        await asyncio.wait([serving])
        gateway.close()

    runner("asyncio")(test())
