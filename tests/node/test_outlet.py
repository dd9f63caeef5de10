"""Tracks forwarded over an output link, as pymavlink receives them."""

import asyncio
import socket
from itertools import count

from pymavlink.dialects.v20 import common
from support import HANG_S, ROOT, run_async

from companion.node import moment
from companion.node.outlet import Outlet
from companion.settings.model import Settings


def test_each_forwarded_vehicle_has_its_own_sequence_numbers() -> None:
    settings = Settings().override(center={"source": "5:1"})
    log = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"
    pipeline, update = moment.look([log], settings, "3")
    now_ns = (update.t_ns + 20_000_000 * n for n in count())
    numbers: list[int] = []

    async def test(heard: socket.socket) -> None:
        out = {"urls": [f"udpout:127.0.0.1:{heard.getsockname()[1]}"], "rate_hz": 50.0}
        outlet = Outlet(
            settings=settings.override(out=out),
            pipeline=pipeline,
            notify=lambda notice: None,
            now_ns=lambda: next(now_ns),
        )
        outlet.open()
        task, mav = asyncio.create_task(outlet.run()), common.MAVLink(None)
        while len(numbers) < 3:
            (message,) = mav.parse_buffer(await asyncio.to_thread(heard.recv, 2048))
            if message.get_srcSystem() == 1:
                assert message.get_type() == "GLOBAL_POSITION_INT"
                numbers.append(message.get_seq())
        task.cancel()

    with socket.socket(type=socket.SOCK_DGRAM) as heard:
        heard.bind(("127.0.0.1", 0))
        heard.settimeout(HANG_S)
        run_async(test(heard))
    assert numbers == [numbers[0] + n for n in range(3)]
