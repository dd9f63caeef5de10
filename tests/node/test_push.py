"""Weights pushed over UDP to a receiver that does not listen yet."""

import asyncio
import socket

from support import ROOT, free_port, run_async

from companion.node import moment
from companion.node.push import RECOVERED_AFTER, Push
from companion.pipeline import assembly
from companion.settings.model import Settings
from companion.settings.outlets import RecordSettings
from companion.values import Notice


def test_refused_udp_push_and_recovery_are_announced_once() -> None:
    settings = Settings().override(center={"source": "5:1"})
    log = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"
    pipeline, update = moment.look([log], settings, "3")
    equipment, notices = assembly.equipment(settings, pipeline.array), list[Notice]()
    to = ("127.0.0.1", free_port(socket.SOCK_DGRAM))
    way = RecordSettings(udp=(f"{to[0]}:{to[1]}",))
    push = Push(
        settings=way,
        pipeline=pipeline,
        equipment=equipment,
        notify=notices.append,
        now_ns=lambda: 0,
    )

    async def test() -> None:
        task = asyncio.create_task(push.run())

        async def pushed(number: int) -> None:
            for n in range(number):
                push.newest(update, n)
                await asyncio.sleep(0)
                await asyncio.sleep(0)

        await pushed(
            RECOVERED_AFTER
        )  # every second datagram reports that the previous one was refused
        assert [one.text.partition(":")[2] for one in notices] == [
            f"{to[1]} fail: Connection refused"
        ]
        with socket.socket(type=socket.SOCK_DGRAM) as listener:
            listener.bind(to)
            await pushed(RECOVERED_AFTER + 1)
        assert [one.text for one in notices[1:]] == [
            f"records to {to[0]}:{to[1]} can be sent again"
        ]
        task.cancel()

    push.open()
    run_async(test())
    push.close()
